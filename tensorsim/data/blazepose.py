"""BlazePose landmarks of a video, as output by MediaPipe, in JSON."""

import os
from pathlib import Path
from typing import Any

import torch

from tensorsim.data.coco import Keypoints2D, coco_of, json_files, told_apart
from tensorsim.errors import TensorsimError, check_finite
from tensorsim.files import reading
from tensorsim.limits import check_range

#: BlazePose landmark for each of ``tensorsim.COCO_KEYPOINTS`` (https://ai.google.dev/edge/mediapipe, Pose Landmarker).
COCO_OF_BLAZEPOSE = (0, 2, 5, 7, 8, 11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28)
_LANDMARKS = 33
#: Names that MediaPipe's interfaces (Python, JavaScript, protocol buffers) use for the landmarks of an image.
_NAMES = ("pose_landmarks", "poseLandmarks", "landmarks", "landmark")


def load_keypoints(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> Keypoints2D:
    """Read keypoints of a video: COCO-17 or BlazePose-33, in one JSON file or a folder with one per frame.

    For COCO see :func:`~tensorsim.data.coco.load_coco_keypoints`. BlazePose is a list of frames, or an object with
    ``frames`` and optionally ``width`` and ``height``. A frame is MediaPipe's output for an image: 33 landmarks, a
    list of these per person, an object that holds them as ``pose_landmarks``, ``poseLandmarks``, ``landmarks`` or
    ``landmark``, or null or empty if nobody is there. A landmark has ``x`` and ``y``, 0 to 1 across the image, and
    ``visibility``.
    People are matched between frames by where they were last seen, as in COCO files without ``track_id``. Of the 33
    landmarks, only the 17 of COCO are used.

    Args:
        path: the file or folder.
        size: (height, width) of the images in pixels; None if a file states it.

    Raises:
        TensorsimError: missing files, files in neither format or without people, or landmarks without an image size.
    """
    path = Path(path)
    contents = json_files(path)
    with reading(path, "JSON of keypoints"):
        frames, said = _frames(contents, path.is_dir())
    if frames is None:
        return coco_of(path, contents)
    size = said if size is None else size
    if size is None:
        raise TensorsimError(f"{path}: the file does not state the image size; give it (--image-size)")
    for side in size:
        check_range(side, "image side", f"{path}: size of the pictures")
    with reading(path, "JSON of BlazePose landmarks"):
        return _in_pixels([_people(frame) for frame in frames], size, path)


def _in_pixels(frames: list[list[Any]], size: tuple[int, int], path: Path) -> Keypoints2D:
    """Landmarks of the people in each frame as COCO keypoints in images of (height, width) pixels."""
    count = max(len(people) for people in frames)
    check_range(count, "people in a frame", str(path))
    data, valid = torch.zeros(len(frames), count, 17, 3), torch.zeros(len(frames), count, dtype=torch.bool)
    for t, people in enumerate(frames):
        for p, landmarks in enumerate(people):
            if len(landmarks) != _LANDMARKS:
                raise TensorsimError(
                    f"{path}: frame {t}: got {len(landmarks)} landmarks of a person, expected {_LANDMARKS}"
                )
            chosen = [landmarks[i] for i in COCO_OF_BLAZEPOSE]
            data[t, p] = torch.tensor([[one["x"], one["y"], one.get("visibility", 1.0)] for one in chosen])
            valid[t, p] = True
    check_finite(data, str(path))
    # 0 and 1 are the borders of an image; the centres of its pixels are at integers.
    pixels = data[..., :2] * torch.tensor([size[1], size[0]]) - 0.5
    scores = data[..., 2:].clamp(0.0, 1.0)
    data, valid = told_apart(torch.cat([pixels, scores], dim=-1), valid, path)
    return Keypoints2D(data[..., :2], data[..., 2], valid, size)


def _frames(
    contents: list[tuple[Path, Any]], one_each: bool
) -> tuple[list[Any] | None, tuple[int, int] | None]:
    """Frames of BlazePose landmarks, or None if there are none, and (height, width) if a file states it."""
    frames, size = [content for _, content in contents], None
    if not one_each:
        whole = frames[0]
        if isinstance(whole, dict) and "frames" in whole:
            frames = list(whole["frames"])
            size = (int(whole["height"]), int(whole["width"])) if "height" in whole else None
        elif isinstance(whole, list) and whole and not _is_landmark(whole[0]):
            frames = whole
    return (frames if any(_is_blazepose(frame) for frame in frames) else None), size


def _is_landmark(content: Any) -> bool:
    return isinstance(content, dict) and "x" in content and "y" in content


def _is_blazepose(frame: Any) -> bool:
    """Whether a file's entry for an image contains landmarks."""
    if isinstance(frame, dict):
        return any(_is_blazepose(frame[name]) for name in _NAMES if name in frame)
    if not isinstance(frame, list):
        return False
    return any(_is_landmark(part) or _is_blazepose(part) for part in frame[:1])


def _people(frame: Any) -> list[Any]:
    """The landmarks of every person in an image."""
    if isinstance(frame, dict):
        named = [frame[name] for name in _NAMES if name in frame]
        return _people(named[0]) if named else []
    if not frame:
        return []
    if _is_landmark(frame[0]):
        return [frame]
    return [one for part in frame for one in _people(part)]

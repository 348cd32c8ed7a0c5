"""Where the people of a simulation come from: a video, keypoints from one, or known motion."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tensorsim.body.skeleton import mid_hips
from tensorsim.config import CameraConfig
from tensorsim.data.blazepose import load_keypoints
from tensorsim.data.coco import Keypoints2D
from tensorsim.data.motion_files import load_motion, place
from tensorsim.data.skeletons import Motion
from tensorsim.data.video import VideoReader
from tensorsim.errors import TensorsimError, check_count, check_positive
from tensorsim.geometry.framing import camera_on, keypoint_boxes, seen_keypoints
from tensorsim.pipeline import VideoToPose
from tensorsim.pipeline.reach import NEAREST_M
from tensorsim.streaming import Found, lifted_film, people_of_film
from tensorsim.types import Pose, Tracks
from tensorsim.vision.smoothing.along_time import nearest_valid

#: Size and grey level of the blank picture on which people without a video are drawn.
CANVAS = (360, 640)
_GREY = 40

#: Kinds of input files, by name.
KINDS = {"video": "a video", "keypoints": "keypoints (.json)", "motion": "motion capture (.bvh, .npz)"}


@dataclass(frozen=True)
class Source:
    """People and the frames to draw them on.

    Attributes:
        kind: one of :data:`KINDS`.
        fps: frames per second.
        frame_count: expected number of frames, None if it is not known.
        find: finds the people, with or without progress bars (``quiet``).
        frames: the frames, in chunks (n, 3, H, W) uint8 RGB.
        threshold: minimum score for a keypoint to be drawn.
        about: what the summary says about the source besides its kind.
    """

    kind: str
    fps: float
    frame_count: int | None
    find: Callable[[bool], Found]
    frames: Callable[[], Iterable[Tensor]]
    threshold: float
    about: dict[str, Any]


def kind_of(path: Path) -> str:
    """The kind of source by the suffix of its path; a folder with any JSON file holds keypoints."""
    if path.is_dir():
        return "keypoints" if any(path.glob("*.json")) else "video"
    return {".bvh": "motion", ".npz": "motion", ".json": "keypoints"}.get(path.suffix.lower(), "video")


def film_source(
    reader: VideoReader, stage: VideoToPose, device: torch.device, calibrate: bool = False
) -> Source:
    """People of a video, found by the networks of ``stage``; on request the camera is estimated from them."""
    return Source(
        "video",
        reader.fps,
        None if reader.duration_s is None else round(reader.duration_s * reader.fps),
        lambda quiet: people_of_film(stage, reader, device, quiet, calibrate),
        lambda: reader.even_chunks(8),
        stage.keypoint_threshold,
        {},
    )


class Cut(NamedTuple):
    """Which frames to keep: those at ``start_s <= k / fps < end_s``, every ``stride``-th of them."""

    start_s: float | None = None
    end_s: float | None = None
    stride: int = 1

    def frames(self, count: int, fps: float, path: Path) -> slice:
        """The frames to keep, out of ``count`` at ``fps``, as a slice.

        Raises:
            TensorsimError: a stride below 1, an end that is not after the start, or fewer than 2 frames left.
        """
        check_count(self.stride, "stride")
        start = 0.0 if self.start_s is None else self.start_s
        end = math.inf if self.end_s is None else self.end_s
        if not 0 <= start < end:
            raise TensorsimError(f"start, end: got {start} and {end} s, expected 0 <= start < end")
        first = min(count, math.ceil(start * fps - 1e-6))
        stop = count if end == math.inf else min(count, math.ceil(end * fps - 1e-6))
        kept = len(range(first, stop, self.stride))
        if kept < 2:
            raise TensorsimError(
                f"{path}: got {kept} of its {count} frames at {fps:g} fps, expected at least 2: motion needs "
                "two moments"
            )
        return slice(first, stop, self.stride)


def keypoint_source(
    path: Path,
    stage: VideoToPose,
    fps: float | None,
    size: tuple[int, int] | None = None,
    cut: Cut = Cut(),  # noqa: B008  # immutable
    calibrate: bool = False,
) -> Source:
    """People with known COCO or BlazePose keypoints; of ``stage``, only lifting, placing and smoothing run.

    Args:
        path: see :func:`~tensorsim.data.blazepose.load_keypoints`.
        stage: its detector, tracker and pose network are not used.
        fps: frames per second; such files do not state it.
        size: (height, width) of the frames; None if the file states it.
        cut: the frames to keep.
        calibrate: estimate the camera from the people instead of using the camera of the stage.

    Raises:
        TensorsimError: no frame rate, no size, a file that cannot be read, or a size that does not fit the keypoints.
    """
    if fps is None:
        raise TensorsimError(f"{path}: the file has no frame rate; give --fps")
    check_positive(fps, "fps")
    found = load_keypoints(path, size)
    size = found.size if size is None else size
    if size is None:
        raise TensorsimError(f"{path}: the file does not state the image size; give --image-size")
    kept = cut.frames(found.valid.shape[0], fps, path)
    _check_size(found, size)
    people = _lifted(found, stage, kept, size, fps / cut.stride, calibrate)
    count = people.pose.valid.shape[2]
    return Source(
        "keypoints",
        fps / cut.stride,
        count,
        lambda quiet: people,
        lambda: blank_frames(count, size),
        stage.keypoint_threshold,
        {"image_size": list(size)},
    )


def _check_size(found: Keypoints2D, size: tuple[int, int]) -> None:
    """Refuse a frame size (height, width) that most seen keypoints lie outside of, and normalised coordinates."""
    seen = found.keypoints[(found.scores > 0.3) & found.valid[..., None]]
    if len(seen) and float(seen.abs().quantile(0.95)) <= 2.0:
        raise TensorsimError(
            f"keypoints: got coordinates up to {float(seen.abs().quantile(0.95)):.2g}, expected pixels, not shares of "
            f"the picture"
        )
    inside = ((seen >= 0) & (seen < seen.new_tensor([size[1], size[0]]))).all(dim=-1)
    if len(seen) and float(inside.float().mean()) < 0.5:
        right, low = seen.quantile(0.95, dim=0).tolist()
        raise TensorsimError(
            f"--image-size: got {size[1]} x {size[0]} pixels, expected the width and height of the pictures in which "
            f"the keypoints were found, which reach to ({right:.0f}, {low:.0f})"
        )


def _lifted(
    found: Keypoints2D, stage: VideoToPose, kept: slice, size: tuple[int, int], fps: float, calibrate: bool
) -> Found:
    """Lift people with known keypoints."""
    keypoints = found.keypoints[kept].transpose(0, 1)
    scores = found.scores[kept].transpose(0, 1)
    matched = found.valid[kept].transpose(0, 1)
    somebody = matched.any(dim=-1)
    keypoints, scores, matched = keypoints[somebody], scores[somebody], matched[somebody]
    # As for tracks: somebody missed for some frames is still there.
    valid = (matched.cumsum(-1) > 0) & (matched.flip(-1).cumsum(-1).flip(-1) > 0)
    nearest = nearest_valid(matched)[..., None].expand(-1, -1, 4)
    boxes = keypoint_boxes(keypoints, scores).gather(1, nearest) * valid[..., None]
    tracks = Tracks(boxes[None], valid[None], matched[None])
    return lifted_film(stage, tracks, keypoints[None], scores[None], size, fps, calibrate)


def motion_source(
    path: Path,
    clip: str | None = None,
    fps: float | None = None,
    heading_rad: float = 0.0,
    start_range_m: float | None = None,
    cut: Cut = Cut(),  # noqa: B008
) -> Source:
    """People of a motion file.

    The frames are blank; people are drawn on them as a camera at the radar would see them, turned and zoomed so that
    everybody is in view.

    Args:
        path, clip, fps: see :func:`~tensorsim.data.motion_files.load_motion`.
        heading_rad: rotation about the vertical, counter-clockwise seen from above.
        start_range_m: y of the first person's hips in the first frame; None keeps the positions of the file unless
            somebody comes nearer than :data:`~tensorsim.pipeline.reach.NEAREST_M`: then all people are moved so that
            the nearest is at that distance.
        cut: the frames to keep.

    Raises:
        TensorsimError: a file that cannot be read, an unknown clip, or nobody in it.
    """
    motion = load_motion(path, clip, fps)
    kept = cut.frames(motion.valid.shape[1], motion.fps, path)
    motion = Motion(motion.joints[:, kept], motion.valid[:, kept], motion.fps / cut.stride)
    present = motion.valid.any(dim=1)
    if not bool(present.any()):
        raise TensorsimError(f"{path}: contains no people in these frames, expected at least one")
    motion = place(
        Motion(motion.joints[present], motion.valid[present], motion.fps), start_range_m, heading_rad
    )
    moved = False
    if start_range_m is None:
        nearest = float(motion.joints[motion.valid][..., 1].min())
        moved = nearest < NEAREST_M
        if moved:
            motion = _in_front(motion, nearest)
    camera = camera_on(motion.joints, motion.valid, *CANVAS)
    keypoints, scores = seen_keypoints(motion.joints, motion.valid, camera, *CANVAS)
    pose = Pose(
        keypoint_boxes(keypoints, scores)[None],
        keypoints[None],
        scores[None],
        motion.joints[None],
        motion.valid[None],
    )
    count = motion.valid.shape[1]
    return Source(
        "motion",
        motion.fps,
        count,
        lambda quiet: Found(pose),
        lambda: blank_frames(count, CANVAS),
        0.5,
        {"moved_in_front_of_the_radar": moved, **drawn_by(camera, CANVAS)},
    )


def _in_front(motion: Motion, nearest: float) -> Motion:
    """Move people so that nobody comes too near and their paths are centred on x = 0."""
    x = mid_hips(motion.joints[motion.valid])[:, 0]
    shift = motion.joints.new_tensor([-float(x.min() + x.max()) / 2, NEAREST_M - nearest, 0.0])
    return motion._replace(joints=(motion.joints + shift) * motion.valid[..., None, None])


def drawn_by(camera: CameraConfig, size: tuple[int, int]) -> dict[str, Any]:
    """What the summary says about a camera."""
    return {
        "camera": {
            "position_m": list(camera.position_m),
            "horizontal_fov_deg": round(math.degrees(camera.horizontal_fov_rad), 2),
            "pitch_deg": round(math.degrees(camera.pitch_rad), 2),
            "yaw_deg": round(math.degrees(camera.yaw_rad), 2),
            "image_size": list(size),
        }
    }


def blank_frames(count: int, size: tuple[int, int]) -> Iterator[Tensor]:
    """Blank frames, one at a time."""
    for _ in range(count):
        yield torch.full((1, 3, *size), _GREY, dtype=torch.uint8)

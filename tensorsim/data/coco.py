"""COCO keypoints of a video, as JSON."""

import itertools
import json
import math
import os
import re
import statistics
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, check_finite
from tensorsim.files import reading
from tensorsim.limits import check_range
from tensorsim.vision.tracking.assignment import assign

#: A person more than this many body sizes from everybody's last position counts as new.
_NEW = 2.0
#: Image ids that span more frames than this, almost an hour at 30 per second, are not taken as frame numbers.
_LONGEST = 100_000


class Keypoints2D(NamedTuple):
    """People in the frames of a video.

    Attributes:
        keypoints: (T, P, 17, 2) pixels, order of ``tensorsim.COCO_KEYPOINTS``.
        scores: (T, P, 17); 0 where a keypoint is not labelled.
        valid: (T, P) bool, whether the person is in the frame.
        size: (height, width) of the frames in pixels; None if the file does not state it.
    """

    keypoints: Tensor
    scores: Tensor
    valid: Tensor
    size: tuple[int, int] | None = None


def load_coco_keypoints(path: str | os.PathLike[str]) -> Keypoints2D:
    """Read COCO keypoints of a video: annotations or results in one JSON file, or a folder with one file per frame.

    Frames are in ascending order of their image ids, or of the file names in a folder; names sort by the numbers in
    them, ``2.jpg`` before ``10.jpg``.

    Results do not list images in which nobody was found, so gaps in the numbering count as such frames. This applies
    to three or more ids that are numbers, or names that differ only in their last number, if at least half of the
    steps between them are at most three frames (one frame being the largest step that divides all steps) and if they
    span at most 100 000 frames. Otherwise the numbers are not taken as frame numbers, and only listed frames count.

    People are identified by ``track_id`` if there is one (null is none), else by where they were last seen, in order
    of appearance; a person more than two body sizes from there counts as new. ``keypoints`` are 51 numbers: x, y, and
    visibility (0, 1 or 2) or score (0 to 1) of each; scores slightly above 1 count as 1.

    Raises:
        TensorsimError: files that are missing or not such JSON, no people, the wrong number of keypoints, scores
            above 2, a ``track_id`` for only some people, or the same one twice in a frame.
    """
    path = Path(path)
    return coco_of(path, json_files(path))


def json_files(path: Path) -> list[tuple[Path, Any]]:
    """The JSON of a file, or of all files of a folder in the order of the numbers in their names, each with its path.

    Raises:
        TensorsimError: no such file, or one that is not JSON.
    """
    if not path.exists():
        raise TensorsimError(f"{path}: no such file, expected keypoints (.json)")
    contents = []
    files = sorted(path.glob("*.json"), key=lambda file: _by_number(file.name)) if path.is_dir() else [path]
    for file in files:
        with reading(file, "JSON of keypoints"):
            check_range(file.stat().st_size, "size of a file", str(file))
            contents.append((file, json.loads(file.read_text(encoding="utf-8"))))
    return contents


def coco_of(path: Path, contents: list[tuple[Path, Any]]) -> Keypoints2D:
    """:func:`load_coco_keypoints` for files that were already read.

    Args:
        path: path of the file or folder.
        contents: see :func:`json_files`.
    """
    people: dict[Any, list[dict[str, Any]]] = {}
    size, listed = None, path.is_dir()
    for number, (file, content) in enumerate(contents):
        with reading(file, "JSON of COCO keypoints"):
            whole = isinstance(content, dict)
            listed = listed or (whole and "images" in content)
            for image in content.get("images", []) if whole else []:
                people.setdefault(number if path.is_dir() else image["id"], [])
                if "height" in image and "width" in image:
                    size = (int(image["height"]), int(image["width"]))
                    for side in size:
                        check_range(side, "image side", f"{file}: size of the images")
            people.setdefault(number, []) if path.is_dir() else None
            for person in content.get("annotations", []) if whole else content:
                numbers = person.get("keypoints") if isinstance(person, dict) else None
                if not isinstance(numbers, list) or len(numbers) != 51:
                    raise TensorsimError(
                        f"{file}: got an entry without 17 keypoints, expected 51 numbers each"
                    )
                people.setdefault(number if path.is_dir() else person.get("image_id", 0), []).append(person)
    everybody = [person for frame in people.values() for person in frame]
    if not everybody:
        raise TensorsimError(f"{path}: got no keypoints, expected COCO annotations or results")
    tracked = sum(person.get("track_id") is not None for person in everybody)
    if 0 < tracked < len(everybody):
        raise TensorsimError(
            f"{path}: got a track_id for {tracked} of {len(everybody)} people, expected one for all or for none"
        )

    with reading(path, "JSON of COCO keypoints"):
        frames = [people.get(frame, []) for frame in (sorted(people) if listed else _numbered(people))]
        tracks = sorted({person["track_id"] for person in everybody if tracked})
        count = len(tracks) or max(len(frame) for frame in frames)
        check_range(max(len(frame) for frame in frames), "people in a frame", str(path))
        check_range(count, "people", str(path))
        data = torch.zeros(len(frames), count, 17, 3)
        valid = torch.zeros(len(frames), count, dtype=torch.bool)
        for t, frame in enumerate(frames):
            for p, person in enumerate(frame):
                place = tracks.index(person["track_id"]) if tracked else p
                if valid[t, place]:
                    raise TensorsimError(
                        f"{path}: got track_id {person['track_id']!r} twice in frame {t}, expected it once"
                    )
                data[t, place] = torch.tensor(person["keypoints"], dtype=torch.float32).view(17, 3)
                valid[t, place] = True
    check_finite(data, str(path))
    if not tracked:
        data, valid = told_apart(data, valid, path)
    # Annotations flag visibility by 0, 1 or 2; networks write scores.
    scores = data[..., 2]
    if float(scores.max()) > 2:
        raise TensorsimError(
            f"{path}: got a score of {float(scores.max()):g} for a keypoint, expected 0 to 1, or visibility 0, 1 or 2"
        )
    scores = (scores > 0).float() if bool((scores == scores.round()).all()) else scores.clamp(0, 1)
    return Keypoints2D(data[..., :2], scores, valid, size)


def told_apart(data: Tensor, valid: Tensor, path: Path) -> tuple[Tensor, Tensor]:
    """Reorder people (T, P, 17, 3) so that each keeps one index over time, by nearest last position.

    In each frame the first entries are people, as ``valid`` (T, P) tells. A person far from everybody seen before gets
    a new index. Indices are in order of appearance, within a frame in the order listed.

    Raises:
        TensorsimError: more people than a file may have; ``path`` is that of the file.
    """
    last, places = data.new_zeros(0, 17, 3), {}
    for t in valid.any(dim=1).nonzero().flatten().tolist():
        people = data[t, valid[t]]
        place = assign(_apart(people, last), torch.ones(len(people), len(last), dtype=torch.bool), _NEW)
        new = place < 0
        place[new] = torch.arange(len(last), len(last) + int(new.sum()))
        last = torch.cat([last, people[new]])
        check_range(len(last), "people", str(path))
        # Hidden keypoints stay where they were: from a foot alone the size of the body cannot be told.
        last[place] = torch.where(people[..., 2:] > 0, people, last[place])
        places[t] = place
    ordered = data.new_zeros(len(data), len(last), 17, 3)
    there = valid.new_zeros(len(data), len(last))
    for t, place in places.items():
        ordered[t, place], there[t, place] = data[t, valid[t]], True
    return ordered, there


def _apart(people: Tensor, others: Tensor) -> Tensor:
    """Mean distances (n, m) between the keypoints (..., 17, 3) that both have, in units of the larger body's size."""
    here, other = people[:, None, :, :2].double(), others[None, :, :, :2].double()
    both = (people[:, None, :, 2] > 0) & (others[None, :, :, 2] > 0)
    size = torch.maximum(_size(people)[:, None], _size(others)[None])
    apart = ((here - other).norm(dim=-1) * both).sum(dim=-1) / both.sum(dim=-1).clamp(min=1) / size
    # Without a common keypoint there is no evidence that they are different people.
    return torch.where(both.any(dim=-1), apart, 0.99 * _NEW)


def _size(people: Tensor) -> Tensor:
    """Width or height (n,) of the keypoints (n, 17, 3), whichever is larger, at least one pixel."""
    seen, place = people[..., 2:] > 0, people[..., :2].double()
    high, low = (
        torch.where(seen, place, -math.inf).amax(dim=1),
        torch.where(seen, place, math.inf).amin(dim=1),
    )
    return (high - low).amax(dim=-1).clamp(min=1.0)


def _numbered(people: dict[Any, list[dict[str, Any]]]) -> list[Any]:
    """The image ids of results in order; if ids number the frames, None stands for frames without anybody."""
    ids = sorted(people, key=_by_number)
    parts = [re.split(r"(\d+)", str(id_)) for id_ in ids]
    if len(ids) < 3 or any(len(name) < 3 or _but_number(name) != _but_number(parts[0]) for name in parts):
        return ids
    id_of = {int(name[-2]): id_ for name, id_ in zip(parts, ids, strict=True)}
    steps = [after - before for before, after in itertools.pairwise(id_of)]
    if len(id_of) < len(ids) or min(steps) < 0:  # 1.jpg beside 01.jpg, negative numbers
        return ids
    frame = math.gcd(*steps)
    every = range(min(id_of), max(id_of) + frame, frame)
    if statistics.median_low(steps) > 3 * frame or len(every) > _LONGEST:
        return ids
    return [id_of.get(number) for number in every]


def _but_number(name: list[str]) -> list[str]:
    """A name, split at its numbers, without its last number."""
    return [*name[:-2], name[-1]]


def _by_number(name: Any) -> Any:
    """Sort key that puts ``2.jpg`` before ``10.jpg``; numbers sort by value."""
    if not isinstance(name, str):
        return name
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]

"""Labels of people corrected by a second set of keypoints, found by another network.

Leeds Sports Pose Extended was labelled by untrained annotators: left and right are sometimes swapped, joints are off
by a hand's width, and faces have no points. A network trained on other pictures makes different mistakes. Where the
two agree, both are assumed to be right, and their mean is better than either.
"""

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from tensorsim.body.skeleton import MIRRORED
from tensorsim.errors import TensorsimError
from tensorsim.geometry.boxes import box_iou
from tensorsim.training.pose_data import Person
from tensorsim.training.shards import Floats

#: Boxes and keypoints (n, 17, 3), x, y and score, by the key of the picture.
Results = Mapping[str, tuple[Floats, Floats]]

#: Distance above which two labels of a joint contradict each other, as a share of the longer side of the box.
NEAR = 0.08
#: Share of the joints that must agree.
MOST = 0.6
#: Score above which a point of the face is trusted.
FACE_SCORE = 0.35
_BODY = slice(5, 17)


def read_results(path: str | os.PathLike[str]) -> dict[str, tuple[Floats, Floats]]:
    """Keypoints in COCO's results format, with their boxes.

    Args:
        path: json with a list of ``{"image_id": KEY, "bbox": [x, y, w, h], "keypoints": [x, y, score, ...]}``, of 17
            points each.

    Raises:
        TensorsimError: no such file, or other content.
    """
    try:
        entries = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(entries, list):
            raise TypeError(f"a {type(entries).__name__} where a list was expected")
        found: dict[str, tuple[list[Floats], list[Floats]]] = {}
        for entry in entries:
            boxes, points = found.setdefault(str(entry["image_id"]), ([], []))
            box = np.array(entry["bbox"], np.float32).reshape(4)
            boxes.append(np.concatenate([box[:2], box[:2] + box[2:]]))
            points.append(np.array(entry["keypoints"], np.float32).reshape(17, 3))
            if not (np.isfinite(box).all() and np.isfinite(points[-1]).all()):
                raise ValueError(f"missing or non-finite numbers for image_id {entry['image_id']}")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TensorsimError(
            f"{path}: not a COCO file of keypoint results with image_id, bbox and 17 keypoints ({error})"
        ) from error
    return {key: (np.stack(boxes), np.stack(points)) for key, (boxes, points) in found.items()}


def put_right(persons: Sequence[Person], results: Results) -> tuple[list[Person], list[Person]]:
    """Divide people into those confirmed by second labels, with improved keypoints, and the others, unchanged.

    People are confirmed if at least :data:`MOST` of the labelled body joints are within :data:`NEAR` of the second
    labels. Their joints are set to the mean of both, disagreeing ones count as not labelled, and the face and the
    assignment of left and right are taken from the second labels.

    Args:
        persons: people whose left and right may have been confused.
        results: from :func:`read_results`; people without results are not confirmed.

    Returns:
        The confirmed and the others.
    """
    confirmed, others = [], []
    for person in persons:
        second = _second(person, results)
        better = None if second is None else _mean(person, second)
        if better is None:
            others.append(person)
        else:
            confirmed.append(person._replace(keypoints=better))
    return confirmed, others


def _second(person: Person, results: Results) -> Floats | None:
    """The second keypoints (17, 3) of this person, found by the box."""
    boxes, points = results.get(person.sample.key, (None, None))
    if boxes is None or points is None:
        return None
    shared = box_iou(torch.from_numpy(person.box), torch.from_numpy(boxes))
    best = int(shared.argmax())
    return points[best] if shared[best] > 0.9 else None


def _mean(person: Person, second: Floats) -> Floats | None:
    """Keypoints (19, 3) from both labellings; None if they contradict each other."""
    near = NEAR * float((person.box[2:] - person.box[:2]).max())
    ways = [person.keypoints[:17], person.keypoints[list(MIRRORED)]]
    agree = [
        (way[_BODY, 2] > 0) & (np.linalg.norm((way - second)[_BODY, :2], axis=-1) <= near) for way in ways
    ]
    best = int(agree[1].sum() > agree[0].sum())
    body = ways[best][_BODY].copy()
    if agree[best].sum() < MOST * (body[:, 2] > 0).sum():
        return None
    keypoints = person.keypoints.copy()
    body[:, :2] = (body[:, :2] + second[_BODY, :2]) / 2
    body[~agree[best]] = 0
    keypoints[_BODY] = body
    face = second[: _BODY.start].copy()
    face[:, 2] = 2.0 * (face[:, 2] >= FACE_SCORE)
    keypoints[: _BODY.start] = face * (face[:, 2:] > 0)
    return keypoints

"""BlazePose landmarks in the layouts of MediaPipe's interfaces become COCO keypoints in pixels."""

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from tensorsim.config import COCO_KEYPOINTS
from tensorsim.data import load_keypoints
from tensorsim.errors import TensorsimError
from tests.fuzz.files import mutated

#: MediaPipe's names of its landmarks, in order.
NAMES = [
    *(
        "nose",
        "left_eye_inner",
        "left_eye",
        "left_eye_outer",
        "right_eye_inner",
        "right_eye",
        "right_eye_outer",
    ),
    *("left_ear", "right_ear", "mouth_left", "mouth_right"),
    *(
        f"{side}_{part}"
        for part in (
            *("shoulder", "elbow", "wrist", "pinky", "index", "thumb"),
            *("hip", "knee", "ankle", "heel", "foot_index"),
        )
        for side in ("left", "right")
    ),
]
SIZE = (100, 200)


def person(shift: float = 0.0) -> list[dict[str, float]]:
    """Landmark i at (i / 50 + shift, i / 100) with visibility i / 100."""
    return [{"x": i / 50 + shift, "y": i / 100, "z": 0.0, "visibility": i / 100} for i in range(33)]


#: One person, nobody, two people, as frames.
FRAMES: dict[str, tuple[Any, ...]] = {
    "lists": (person(), [], [person(), person(0.1)]),
    "null": (person(), None, [person(), person(0.1)]),
    "tasks": ({"landmarks": [person()]}, {"landmarks": []}, {"landmarks": [person(), person(0.1)]}),
    "python": ({"pose_landmarks": [person()]}, {}, {"pose_landmarks": [person(), person(0.1)]}),
    "web": ({"poseLandmarks": person()}, {"poseLandmarks": None}, {"poseLandmarks": [person(), person(0.1)]}),
    "protocol": ({"landmark": person()}, {}, [{"landmark": person()}, {"landmark": person(0.1)}]),
}


@pytest.mark.parametrize("frames", FRAMES.values(), ids=FRAMES)
@pytest.mark.parametrize("way", ["list", "object", "folder"])
def test_layouts(tmp_path: Path, frames: tuple[Any, ...], way: str) -> None:
    path = tmp_path / "people.json"
    if way == "folder":
        path.mkdir()
        for t, frame in enumerate(frames):
            (path / f"{t:03d}.json").write_text(json.dumps(frame))
    else:
        content = list(frames) if way == "list" else {"width": 1, "height": 1, "frames": list(frames)}
        path.write_text(json.dumps(content))
    people = load_keypoints(path, SIZE)
    assert people.valid.tolist() == [[True, False], [False, False], [True, True]]
    assert people.size == SIZE
    assert people.keypoints.shape == (3, 2, 17, 2)
    landmarks = torch.tensor([NAMES.index(name) for name in COCO_KEYPOINTS]).float()
    expected = torch.stack([landmarks / 50 * 200 - 0.5, landmarks / 100 * 100 - 0.5], dim=-1)
    torch.testing.assert_close(people.keypoints[0, 0], expected, atol=1e-4, rtol=0)
    torch.testing.assert_close(people.scores[0, 0], landmarks / 100)
    torch.testing.assert_close(people.keypoints[2, 1] - expected, torch.tensor([20.0, 0.0]).expand(17, 2))
    assert not people.keypoints[1].any()


def test_the_size_may_be_in_the_file_and_visibility_missing(tmp_path: Path) -> None:
    path = tmp_path / "people.json"
    bare = [{"x": 0.5, "y": 0.5}] * 33
    path.write_text(json.dumps({"width": 200, "height": 100, "frames": [bare, bare]}))
    people = load_keypoints(path)
    assert people.size == SIZE
    assert people.keypoints.unique().tolist() == [49.5, 99.5]
    assert people.scores.min() == 1.0


def test_people_keep_their_places_when_another_leaves_or_their_order_changes(tmp_path: Path) -> None:
    path = tmp_path / "people.json"
    path.write_text(json.dumps([[person(), person(0.3)], [person(0.3)], [person(0.3), person()]]))
    people = load_keypoints(path, SIZE)
    assert people.valid.tolist() == [[True, True], [False, True], [True, True]]
    torch.testing.assert_close(people.keypoints[2], people.keypoints[0])
    torch.testing.assert_close(people.keypoints[1, 1], people.keypoints[0, 1])


def test_coco_is_still_coco(tmp_path: Path) -> None:
    path = tmp_path / "coco.json"
    numbers = [1 if k % 3 == 2 else k for k in range(51)]
    path.write_text(json.dumps([{"keypoints": numbers, "image_id": i} for i in range(2)]))
    assert load_keypoints(path).keypoints[0, 0, 1].tolist() == [3.0, 4.0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: [person()[:17]] * 2, "frame 0: got 17 landmarks of a person, expected 33"),
        (lambda: [[person(), person()[:5]]], "got 5 landmarks"),
        (lambda: [person(float("nan"))], "finite"),
        (lambda: [[*person()[:28], {"x": 1.0}, *person()[29:]]], "'y'"),
        (lambda: [person(), 7], "cannot be read"),
        (lambda: [[person()] * 65], "people in a frame"),
        (lambda: [[{"x": "a", "y": 0.0}] * 33], "cannot be read"),
        (lambda: {"frames": 3}, "cannot be read"),
        (lambda: [[], None], "no keypoints|17 keypoints"),
    ],
)
def test_what_cannot_be_is_refused(tmp_path: Path, content: Callable[[], Any], message: str) -> None:
    path = tmp_path / "people.json"
    path.write_text(json.dumps(content()))
    with pytest.raises(TensorsimError, match=rf"people\.json.*({message})"):
        load_keypoints(path, SIZE)


def test_a_size_is_needed(tmp_path: Path) -> None:
    path = tmp_path / "people.json"
    path.write_text(json.dumps([person()]))
    with pytest.raises(TensorsimError, match="the file does not state the image size"):
        load_keypoints(path)
    with pytest.raises(TensorsimError, match="got 100000, expected image side"):
        load_keypoints(path, (100_000, 10))


def test_damaged_files_are_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "people.json"
    whole = json.dumps(
        {"width": 64, "height": 48, "frames": [person(), [person(), person(0.1)], None]}
    ).encode()
    refused = 0
    for seed in range(300):
        path.write_bytes(mutated(random.Random(seed), whole))
        try:
            people = load_keypoints(path)
        except TensorsimError:
            refused += 1
        else:
            assert people.keypoints.isfinite().all()
            assert people.scores.isfinite().all()
    assert 50 < refused < 300

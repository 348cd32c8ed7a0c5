"""Two sets of labels: where they agree the mean is taken, sides are put right, contradictions are left out."""

import json
from pathlib import Path

import numpy as np
import pytest

from tensorsim.body.skeleton import MIRRORED
from tensorsim.errors import TensorsimError
from tensorsim.training.pose_data import Person
from tensorsim.training.second_labels import put_right, read_results
from tensorsim.training.shards import Sample
from tests.training.test_pose_data import BOX, standing

LEFT_WRIST, RIGHT_WRIST, NOSE, LEFT_EYE, LEFT_ELBOW = 9, 10, 0, 1, 7


def person(keypoints: np.ndarray, key: str = "a") -> Person:
    """A person in the picture of that name."""
    label = np.array([[0, 0, 200, 280]], np.float32)
    return Person(
        Sample(key, label, keypoints[None], np.ones(1, np.float32), False, Path(key)), BOX, keypoints, 1.0
    )


def second(keypoints: np.ndarray) -> np.ndarray:
    """The same points by a network that is sure of all of them, three pixels further right."""
    points = keypoints[:17].copy()
    points[:, 0] += 3
    points[:, 2] = 0.9
    return points


def results(points: np.ndarray, box: np.ndarray = BOX) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of a picture with a distant person first."""
    return {"a": (np.stack([box + 500, box]), np.stack([points + 500, points]).astype(np.float32))}


def test_the_mean_where_both_agree_and_the_face_of_the_second() -> None:
    labels = standing()
    labels[NOSE] = 0  # LSPE has no face
    given = second(standing())
    given[LEFT_EYE, 2] = 0.1  # the network does not see it
    confirmed, others = put_right([person(labels)], results(given))
    assert not others
    found = confirmed[0].keypoints
    np.testing.assert_allclose(found[LEFT_WRIST], [141.5, 130, 2])
    np.testing.assert_allclose(found[NOSE], [103, 50, 2])
    assert found[LEFT_EYE, 2] == 0
    assert found[LEFT_ELBOW, 2] == 0, "nobody labelled it, and the second labels alone are not believed"
    np.testing.assert_array_equal(found[17:], labels[17:])
    np.testing.assert_array_equal(labels[NOSE], 0, "the person that came in is as it was")


def test_sides_are_those_of_the_second_labels() -> None:
    exchanged = standing()
    exchanged[:17] = exchanged[list(MIRRORED)]
    confirmed, _ = put_right([person(exchanged)], results(second(standing())))
    np.testing.assert_allclose(confirmed[0].keypoints[LEFT_WRIST], [141.5, 130, 2])
    np.testing.assert_allclose(confirmed[0].keypoints[RIGHT_WRIST], [61.5, 130, 2])


def test_a_joint_that_contradicts_is_left_out() -> None:
    given = second(standing())
    given[LEFT_WRIST, 1] += 60
    confirmed, _ = put_right([person(standing())], results(given))
    assert confirmed[0].keypoints[LEFT_WRIST, 2] == 0
    assert confirmed[0].keypoints[RIGHT_WRIST, 2] == 2


@pytest.mark.parametrize("case", ["another pose", "another picture", "another box"])
def test_who_is_not_confirmed_stays_as_labelled(case: str) -> None:
    given, box, key = second(standing()), BOX, "a"
    if case == "another pose":
        given[5:, 1] += 70
    elif case == "another picture":
        key = "b"
    else:
        box = BOX + np.array([0, 0, 60, 0], np.float32)
    labelled = person(standing(), key)
    confirmed, others = put_right([labelled], results(given, box))
    assert not confirmed
    assert others == [labelled]


def test_reads_the_results_of_coco(tmp_path: Path) -> None:
    path = tmp_path / "found.json"
    entry = {
        "image_id": 12,
        "category_id": 1,
        "bbox": [5, 6, 10, 20],
        "keypoints": [1, 2, 0.5] * 17,
        "score": 1,
    }
    path.write_text(json.dumps([entry, entry | {"image_id": "im1"}, entry]))
    found = read_results(path)
    assert set(found) == {"12", "im1"}
    boxes, points = found["12"]
    np.testing.assert_array_equal(boxes, [[5, 6, 15, 26]] * 2)
    assert points.shape == (2, 17, 3)
    assert points.dtype == np.float32
    np.testing.assert_array_equal(points[0, 3], [1, 2, 0.5])


MISSING = json.dumps([{"image_id": 1, "bbox": [0, 0, 9, 9], "keypoints": [None] * 51}])


@pytest.mark.parametrize("text", [None, "not json", "{}", '[{"image_id": 1}]', "[1]", MISSING])
def test_other_files_are_refused(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "found.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(TensorsimError, match="keypoint results"):
        read_results(path)

"""Shards and COCO files against tarfile, json and OpenCV used by hand."""

import json
import pickle
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tensorsim.errors import TensorsimError
from tensorsim.training.shards import AREA_OF_BOX, POINTS, Shards, find_shards, read_coco
from tests.training.tars import write_tar


def jpg(seed: int, height: int = 20, width: int = 30) -> bytes:
    colour = np.random.default_rng(seed).integers(0, 256, 3)
    picture = np.full((height, width, 3), colour, np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def label(persons: list[dict[str, Any]], everyone: bool = True) -> dict[str, Any]:
    return {"width": 30, "height": 20, "all_persons_labelled": everyone, "persons": persons}


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    points = [[i, 2 * i, i % 3] for i in range(19)]
    persons = [
        {"bbox": [2, 3, 10, 12], "keypoints": points},
        {"bbox": [0, 0, 5, 5], "keypoints": None},
    ]
    return write_tar(
        tmp_path / "some-00.tar",
        {
            "b.jpg": jpg(1),
            "b.json": label(persons, everyone=False),
            "a.json": label([]),
            "a.jpg": jpg(2),
            "place.jpg": jpg(3, 8, 9),
        },
    )


def test_samples_are_what_the_tar_says(shard: Path) -> None:
    samples = Shards([shard])
    assert [sample.key for sample in samples] == ["a", "b", "place"]
    assert [sample.all_labelled for sample in samples] == [True, False, True]
    person = samples[1]
    np.testing.assert_array_equal(person.boxes, [[2, 3, 12, 15], [0, 0, 5, 5]])
    np.testing.assert_array_equal(person.keypoints[0], [[i, 2 * i, i % 3] for i in range(19)])
    assert not person.keypoints[1].any()
    np.testing.assert_allclose(person.areas, [AREA_OF_BOX * 120, AREA_OF_BOX * 25])
    assert samples[0].boxes.shape == (0, 4)
    assert samples[0].keypoints.shape == (0, len(POINTS), 3)


def test_pictures_are_those_that_tarfile_finds_in_rgb(shard: Path) -> None:
    with tarfile.open(shard) as tar:
        for sample in reversed(Shards([shard])):
            member = tar.extractfile(f"{sample.key}.jpg")
            assert member is not None
            expected = cv2.imdecode(np.frombuffer(member.read(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
            np.testing.assert_array_equal(sample.image(), expected)


def test_a_copy_in_another_process_reads_too(shard: Path) -> None:
    copy = pickle.loads(pickle.dumps(Shards([shard])))
    np.testing.assert_array_equal(copy[1].image(), Shards([shard])[1].image())


def test_shards_come_in_the_order_given(tmp_path: Path) -> None:
    for name in ("x-01", "x-00", "y-00"):
        write_tar(tmp_path / f"{name}.tar", {f"{name}.jpg": jpg(0)})
    assert [sample.key for sample in Shards(find_shards(tmp_path, "x"))] == ["x-00", "x-01"]
    with pytest.raises(TensorsimError, match=r"no z-\*\.tar"):
        find_shards(tmp_path, "z")


@pytest.mark.parametrize("files", [{}, {"a.json": label([])}, {"a.jpg": b"", "a.json": {"persons": 3}}])
def test_other_tars_are_refused(tmp_path: Path, files: dict[str, Any]) -> None:
    with pytest.raises(TensorsimError, match="shard of"):
        Shards([write_tar(tmp_path / "bad.tar", files)])


@pytest.mark.parametrize(
    ("person", "message"),
    [
        ({"bbox": [2, 3, 10]}, r"a: got bbox \[2, 3, 10\], expected x, y, width, height"),
        ({"bbox": [2, 3, 10, 12, 0, 0, 5, 5]}, "a: got bbox"),
        ({"bbox": [2, 3, float("nan"), 12]}, "a: got bbox"),
        ({"bbox": [2, 3, -10, 12]}, "a: got bbox"),
        ({"area": float("inf")}, "a: got area inf, expected pixels"),
        ({"keypoints": [[1, 2, 2]] * 18}, r"a: got keypoints \(18, 3\), expected 17 or 19 rows"),
        ({"keypoints": [1, 2, 2] * 17}, r"a: got keypoints \(51,\)"),
        ({"keypoints": [[float("nan"), 2, 2]] * 17}, "expected 17 or 19 rows of finite x, y, v"),
        ({"keypoints": [[1, 2, "high"]] * 17}, "not a shard"),
    ],
)
def test_wrong_labels_are_refused(tmp_path: Path, person: dict[str, Any], message: str) -> None:
    labelled = label([{"bbox": [2, 3, 10, 12], "keypoints": None} | person])
    with pytest.raises(TensorsimError, match=message):
        Shards([write_tar(tmp_path / "bad.tar", {"a.jpg": jpg(0), "a.json": labelled})])


def test_labels_that_are_not_what_they_should_be_are_refused(tmp_path: Path) -> None:
    everyone = label([]) | {"all_persons_labelled": "no"}
    with pytest.raises(TensorsimError, match="a: got all_persons_labelled 'no', expected true or false"):
        Shards([write_tar(tmp_path / "bad.tar", {"a.jpg": jpg(0), "a.json": everyone})])
    with pytest.raises(TensorsimError, match="not a shard"):
        Shards([write_tar(tmp_path / "bad.tar", {"a.jpg": jpg(0), "a.json": b"[" * 100_000})])


def test_what_is_no_tar_or_no_picture_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.tar"
    path.write_bytes(b"not a tar at all" * 100)
    with pytest.raises(TensorsimError, match="not a shard"):
        Shards([path])
    with pytest.raises(TensorsimError, match="not a picture"):
        Shards([write_tar(path, {"a.jpg": b"not a jpg"})])[0].image()
    with pytest.raises(TensorsimError, match="not a picture"):
        Shards([write_tar(path, {"a.jpg": b""})])[0].image()


def test_coco_file(tmp_path: Path) -> None:
    (tmp_path / "7.jpg").write_bytes(jpg(0))
    flat = [float(n) for n in range(51)]
    annotations = [
        {"image_id": 7, "category_id": 1, "bbox": [1, 2, 3, 4], "area": 5.5, "keypoints": flat, "iscrowd": 0},
        {"image_id": 7, "category_id": 3, "bbox": [0, 0, 9, 9], "area": 81.0},
        {"image_id": 8, "category_id": 1, "bbox": [0, 0, 9, 9], "area": 40.0, "iscrowd": 1},
    ]
    content = {
        "images": [{"id": 7, "file_name": "7.jpg"}, {"id": 8, "file_name": "8.jpg"}],
        "categories": [{"id": 1, "name": "person"}, {"id": 3, "name": "car"}],
        "annotations": annotations,
    }
    path = tmp_path / "coco.json"
    path.write_text(json.dumps(content))
    one, crowd = read_coco(path, tmp_path)
    np.testing.assert_array_equal(one.boxes, [[1, 2, 4, 6]])
    np.testing.assert_array_equal(one.keypoints[0, :17], np.reshape(flat, (17, 3)))
    np.testing.assert_array_equal(one.areas, [5.5])
    assert one.image().shape == (20, 30, 3)
    assert one.all_labelled
    assert not crowd.all_labelled
    assert len(crowd.boxes) == 0
    np.testing.assert_array_equal(crowd.crowds, [[0, 0, 9, 9]])
    path.write_text("{}")
    with pytest.raises(TensorsimError, match="COCO"):
        read_coco(path, tmp_path)


def test_real_shards(shared_data: Path) -> None:
    samples = Shards(find_shards(shared_data / "train", "coco_small"))
    assert len(samples) == 291
    assert sum(len(sample.boxes) > 0 for sample in samples) == 104

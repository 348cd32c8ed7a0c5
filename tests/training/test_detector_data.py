"""Pictures to train a detector on: boxes stay on the people, and unknown areas are marked."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tensorsim.errors import TensorsimError
from tensorsim.training.canvas import KNOWN_CELLS, Canvas
from tensorsim.training.cutouts import Cutouts
from tensorsim.training.detector_data import Labelled, PictureMaker, Sources
from tensorsim.training.detector_people import outline
from tensorsim.training.shards import POINTS, Sample, Shards
from tensorsim.training.views import random_turn
from tests.training.tars import write_tar

RED, GREEN = (230, 20, 20), (20, 200, 20)


def red_box(image: np.ndarray) -> np.ndarray:
    """Box around everything red, corners."""
    red = (image[..., 0].astype(int) - image[..., 1:].max(-1)) > 90
    rows, columns = np.flatnonzero(red.any(1)), np.flatnonzero(red.any(0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], float)


def encoded(image: np.ndarray, suffix: str) -> bytes:
    order = [2, 1, 0, 3][: image.shape[-1]]
    quality = [cv2.IMWRITE_JPEG_QUALITY, 98] if suffix == ".jpg" else []
    return cv2.imencode(suffix, np.ascontiguousarray(image[..., order]), quality)[1].tobytes()


PERSON = {
    "neck": (60, 40), "head_top": (60, 22), "left_shoulder": (50, 42), "right_shoulder": (70, 42),
    "left_elbow": (46, 58), "right_elbow": (74, 58), "left_wrist": (44, 72), "right_wrist": (76, 72),
    "left_hip": (54, 75), "right_hip": (66, 75), "left_knee": (53, 98), "right_knee": (67, 98),
    "left_ankle": (52, 120), "right_ankle": (68, 120),
}  # fmt: skip


def drawn_person(path: Path, thickness: float = 1.0) -> tuple[Sample, np.ndarray]:
    """A person of red lines on noisy ground, with joints, and which pixels show it."""
    mask = np.zeros((144, 120), np.uint8)
    lines = [("neck", "head_top", 9), ("left_shoulder", "right_shoulder", 9), ("left_hip", "right_hip", 9)]
    lines += [("left_shoulder", "left_hip", 13), ("right_shoulder", "right_hip", 13), ("neck", "left_hip", 9)]
    lines += [(f"{s}_{a}", f"{s}_{b}", 7) for s in ("left", "right") for a, b in (
        ("shoulder", "elbow"), ("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle")
    )]  # fmt: skip
    for a, b, wide in lines:
        cv2.line(mask, PERSON[a], PERSON[b], 1, max(1, round(wide * thickness)))
    image = np.where(mask[..., None] > 0, RED, (60, 90, 150)).astype(float)
    image += np.random.default_rng(0).normal(0, 6, image.shape)
    points = [[*PERSON[name], 2] if name in PERSON else [0, 0, 0] for name in POINTS]
    persons = [{"bbox": [38, 16, 44, 112], "keypoints": points}]
    label = {"all_persons_labelled": False, "persons": persons}
    files = {
        "a.jpg": encoded(np.clip(image, 0, 255).astype(np.uint8), ".jpg"),
        "a.json": json.dumps(label).encode(),
    }
    return Shards([write_tar(path, files)])[0], mask > 0


def test_people_are_cut_out_along_their_outline(tmp_path: Path) -> None:
    sample, truth = drawn_person(tmp_path / "d.tar")
    rgba = outline(sample, side=144)
    assert rgba is not None
    rows, columns = np.flatnonzero(truth.any(1)), np.flatnonzero(truth.any(0))
    wanted = truth[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    inside = cv2.resize(rgba[..., 3], wanted.shape[::-1]) > 127
    assert (inside & wanted).sum() / (inside | wanted).sum() > 0.85


def test_people_around_whom_all_has_their_colour_are_not_cut_out(tmp_path: Path) -> None:
    assert outline(drawn_person(tmp_path / "d.tar", thickness=2.5)[0]) is None
    # Nor are those whose joints nobody labelled.
    assert outline(shard(tmp_path / "s.tar", True)[0]) is None


def shard(path: Path, people: bool, everyone: bool = True) -> list[Sample]:
    """One picture 120 x 160, with a red person of 30 x 60 at (40, 20) or empty."""
    image = np.full((120, 160, 3), 90, np.uint8)
    persons = []
    if people:
        image[20:80, 40:70] = RED
        persons = [{"bbox": [40, 20, 30, 60], "keypoints": None}]
    label = {"all_persons_labelled": everyone, "persons": persons}
    files = {"a.jpg": encoded(image, ".jpg"), "a.json": json.dumps(label).encode()}
    return list(Shards([write_tar(path, files)]))


def cutouts(path: Path) -> Cutouts:
    """A green ellipse with soft edges."""
    rgba = np.zeros((90, 40, 4), np.uint8)
    rgba[..., :3] = GREEN
    alpha = cv2.ellipse(np.zeros((90, 40), np.uint8), (20, 45), (17, 42), 0, 0, 360, 255, -1)
    rgba[..., 3] = cv2.blur(alpha, (3, 3))
    label = json.dumps({"keypoints": [[20.0, 45.0, 2]] * 17}).encode()
    return Cutouts([write_tar(path, {"0.png": encoded(rgba, ".png"), "0.json": label})])


@pytest.fixture
def sources(tmp_path: Path) -> Sources:
    complete, empty = shard(tmp_path / "p.tar", True), shard(tmp_path / "e.tar", False)
    partial = shard(tmp_path / "s.tar", True, everyone=False)
    return Sources(complete, empty, [partial], cutouts=cutouts(tmp_path / "c.tar"))


@pytest.mark.parametrize("seed", range(12))
def test_placed_boxes_hold_the_person(sources: Sources, seed: int) -> None:
    canvas = Canvas(128)
    canvas.place(sources.complete[0], (0, 0, 128, 128), np.random.default_rng(seed))
    boxes = canvas.final_boxes()
    assert len(boxes) == 1
    # A pixel on either side is what interpolation and jpeg smear.
    np.testing.assert_allclose(boxes[0], red_box(canvas.image), atol=1.6)
    assert canvas.known.all()


@pytest.mark.parametrize("seed", range(6))
def test_shrunk_pictures_do_not_move(sources: Sources, seed: int) -> None:
    canvas = Canvas(40)
    canvas.place(sources.complete[0], (0, 0, 40, 40), np.random.default_rng(seed))
    left, top, right, bottom = canvas.final_boxes()[0]
    red = np.maximum(canvas.image[..., 0].astype(float) - canvas.image[..., 1] - 20, 0)
    if min(left, top) > 1 and max(right, bottom) < 39:
        v, u = np.mgrid[:40, :40] + 0.5
        centre = np.array([(u * red).sum(), (v * red).sum()]) / red.sum()
        np.testing.assert_allclose(centre, [(left + right) / 2, (top + bottom) / 2], atol=0.08)


def test_of_whom_the_edge_leaves_little_nothing_is_known(
    sources: Sources, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five of the 30 columns of the person are left, at the one edge or in the mirror at the other."""
    monkeypatch.setattr("tensorsim.training.canvas._placement", lambda *_: (1.0, np.array([-65.0, 0.0])))
    canvas = Canvas(80)
    canvas.place(sources.complete[0], (0, 0, 80, 80), np.random.default_rng(0))
    assert len(canvas.final_boxes()) == 0
    unknown = np.zeros_like(canvas.known)
    unknown[10:, :3] = True
    assert (~canvas.known == unknown).all() or (~canvas.known == unknown[:, ::-1]).all()


@pytest.mark.parametrize("seed", range(12))
def test_boxes_are_tight_around_people_in_turned_pictures(tmp_path: Path, seed: int) -> None:
    """Around an ellipse, which the recomputed box should hold to the pixel at any turn."""
    image = np.full((300, 400, 3), 90, np.uint8)
    cv2.ellipse(image, (200, 150), (30, 75), 0, 0, 360, RED, -1)
    persons = [{"bbox": [169.5, 74.5, 62, 152], "keypoints": None}]
    label = {"all_persons_labelled": True, "persons": persons}
    files = {"a.jpg": encoded(image, ".jpg"), "a.json": json.dumps(label).encode()}
    sample = Shards([write_tar(tmp_path / "e.tar", files)])[0]
    rng = np.random.default_rng(seed)
    canvas = Canvas(256)
    canvas.place(sample, (0, 0, 256, 256), rng, random_turn((300, 400), rng))
    assert len(canvas.boxes) == 1
    np.testing.assert_allclose(canvas.boxes[0], red_box(canvas.image), atol=2.5)


def test_kinds_without_pictures_are_left_out(sources: Sources) -> None:
    kinds, shares = sources.kinds()
    assert "films" not in kinds
    assert sum(shares) == pytest.approx(1)
    assert shares[kinds.index("complete")] / shares[kinds.index("empty")] == pytest.approx(0.55 / 0.12)
    kinds, _ = Sources(sources.complete, sources.empty, sources.partial, sources.complete).kinds()
    assert kinds == ["complete", "films", "partial", "empty"]


def test_placing_flips_and_scales(sources: Sources) -> None:
    """The twelve seeds of the test above are not all the same case."""
    shapes = []
    for seed in range(12):
        canvas = Canvas(128)
        canvas.place(sources.complete[0], (0, 0, 128, 128), np.random.default_rng(seed))
        shapes.append(canvas.final_boxes()[0])
    heights = np.array(shapes)[:, 3] - np.array(shapes)[:, 1]
    assert heights.max() > 1.5 * heights.min()


@pytest.mark.parametrize("seed", range(6))
def test_pictures_stay_in_their_rectangle(sources: Sources, seed: int) -> None:
    canvas, rng = Canvas(128), np.random.default_rng(seed)
    canvas.place(sources.complete[0], (50, 30, 128, 128), rng)
    canvas.paste(sources.cutouts[0].rgba, (50, 30, 128, 128), rng)
    assert (canvas.image[:30] == 114).all()
    assert (canvas.image[:, :50] == 114).all()
    boxes = canvas.final_boxes()
    assert (boxes[:, :2] >= [50, 30]).all()
    assert (boxes[:, 2:] <= 128).all()


def test_beyond_partial_labels_nothing_is_known(sources: Sources) -> None:
    canvas = Canvas(160)
    canvas.place(sources.partial[0][0], (0, 0, 160, 160), np.random.default_rng(3))
    box = canvas.final_boxes()[0]
    cell = 160 / KNOWN_CELLS
    left, top, right, bottom = (box / cell).round().astype(int)
    assert canvas.known[top:bottom, left:right].all()
    assert not canvas.known.all()
    share = canvas.known.sum() * cell**2 / ((box[2] - box[0]) * (box[3] - box[1]))
    assert share < 2.2  # 1.3 x 1.3, and whole cells


@pytest.mark.parametrize("seed", range(8))
def test_boxes_of_cut_outs_are_of_what_is_seen(sources: Sources, seed: int) -> None:
    canvas, rng = Canvas(160), np.random.default_rng(seed)
    for _ in range(3):
        canvas.paste(sources.cutouts[0].rgba, (0, 0, 160, 160), rng)
    green = (canvas.image[..., 1].astype(int) - canvas.image[..., 0]) > 90
    boxes = canvas.final_boxes()
    covered = np.zeros((160, 160), bool)
    for x0, y0, x1, y1 in boxes.astype(int):
        assert green[y0:y1, x0:x1].any()
        covered[y0:y1, x0:x1] = True
    cell = int(160 / KNOWN_CELLS)
    doubtful = ~np.kron(canvas.known, np.ones((cell, cell), bool))
    assert (covered | doubtful)[green].mean() > 0.97


@pytest.mark.parametrize("seed", range(4))
def test_cut_outs_have_no_dark_rim(seed: int) -> None:
    """Where they end, their colour and that of the ground mix, but not the black beyond the outline."""
    alpha = cv2.ellipse(np.zeros((90, 40), np.uint8), (20, 45), (17, 42), 0, 0, 360, 255, -1)
    white = np.dstack([np.where(alpha[..., None] > 0, np.uint8(255), np.uint8(0)).repeat(3, 2), alpha])
    canvas = Canvas(160)
    canvas.image[:] = 255
    canvas.paste(white, (0, 0, 160, 160), np.random.default_rng(seed))
    assert (canvas.owner == 1).any()
    assert canvas.image.min() >= 253


@pytest.mark.parametrize("seed", range(8))
def test_somebody_beside_another_stands_close(sources: Sources, seed: int) -> None:
    canvas, rng = Canvas(400), np.random.default_rng(seed)
    rgba = sources.cutouts[0].rgba
    one = canvas.paste(rgba, (0, 0, 400, 400), rng)
    other = canvas.paste(rgba, (0, 0, 400, 400), rng, beside=one)
    assert 0.8 < other[3] / one[3] < 1.2
    assert abs(other[1] + other[3] - one[1] - one[3]) < 0.2 * one[3]
    apart = abs(other[0] + other[2] / 2 - one[0] - one[2] / 2)
    assert 0.2 < apart / ((one[2] + other[2]) / 2) < 1.1


@pytest.mark.parametrize("seed", range(8))
def test_pieces_of_other_pictures_are_nobody(sources: Sources, seed: int) -> None:
    """They change the picture within the rectangle, get no box, and boxes of people are of what they leave to see."""
    canvas, rng = Canvas(160), np.random.default_rng(seed)
    canvas.image[:] = (20, 20, 200)
    for _ in range(3):
        canvas.distract(sources.empty[0], (40, 0, 160, 160), rng)
    assert len(canvas.final_boxes()) == 0
    assert (canvas.image != (20, 20, 200)).any()
    assert (canvas.image[:, :40] == (20, 20, 200)).all()
    assert canvas.known.all()
    canvas.paste(sources.cutouts[0].rgba, (0, 0, 160, 160), rng)
    shown = (canvas.owner == 1).sum()
    for _ in range(6):
        canvas.distract(sources.empty[0], (0, 0, 160, 160), rng)
    assert (canvas.owner == 1).sum() <= shown
    green = (canvas.image[..., 1].astype(int) - canvas.image[..., 0]) > 90
    assert green[canvas.owner == 1].sum() >= 0.9 * (canvas.owner == 1).sum()


def test_pictures_of_films_have_grey_below(sources: Sources) -> None:
    maker = PictureMaker(sources, size=128, mosaic=0.0, film=1.0)
    for seed in range(6):
        picture = maker(np.random.default_rng(seed))
        assert np.ptp(picture.image[97:].astype(int).mean(-1)) < 60  # noise at most
        assert picture.known[-5:].all()
        assert (picture.boxes[:, 3] <= 96).all()


def test_a_picture_depends_on_its_random_numbers_alone(sources: Sources) -> None:
    maker = PictureMaker(sources, size=128)

    def make(seed: int) -> Labelled:
        return maker(np.random.default_rng(seed))

    first = [make(seed) for seed in range(6)]
    again = [make(seed) for seed in reversed(range(6))][::-1]
    for a, b in zip(first, again, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_array_equal(x, y)
    assert len({p.image.tobytes() for p in first}) == 6
    for picture in first:
        assert picture.image.shape == (128, 128, 3)
        assert picture.image.dtype == np.uint8
        assert picture.boxes.shape[1:] == (4,)
        assert picture.boxes.dtype == np.float32


def test_cutout_shards_are_read_back(tmp_path: Path) -> None:
    found = cutouts(tmp_path / "c.tar")
    assert len(found) == 1
    rgba, keypoints = found[0]
    assert tuple(rgba[45, 20]) == (*GREEN, 255)
    assert rgba[0, 0, 3] == 0
    np.testing.assert_array_equal(keypoints, [[20, 45, 2]] * 17)


def test_what_is_no_shard_of_cutouts_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.tar"
    path.write_bytes(b"no tar")
    with pytest.raises(TensorsimError, match="not a shard of cut-outs"):
        Cutouts([path])
    with pytest.raises(TensorsimError, match="not a shard of cut-outs"):
        Cutouts([write_tar(path, {"a.png": b"", "a.json": b"{}"})])

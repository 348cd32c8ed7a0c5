"""Letterbox, decoding and suppression against OpenCV, NumPy and closed forms."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tensorsim.geometry.boxes import (
    box_intersection,
    box_iou,
    center_to_xyxy,
    distances_to_boxes,
    letterbox,
    letterbox_size,
    non_maximum_suppression,
    resize_8bit,
    undo_letterbox,
    xyxy_to_center,
)

SIZES = [
    (1080, 1920, 180, 320),
    (270, 480, 360, 640),  # enlarges
    (352, 640, 176, 320),  # halves: OpenCV averages areas there
    (333, 500, 426, 640),
    (100, 61, 320, 195),
    (50, 50, 50, 50),
    (3, 200, 5, 320),
    (1, 1, 7, 9),
]


def picture(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def as_images(*pictures: np.ndarray) -> Tensor:
    return torch.from_numpy(np.stack(pictures)).permute(0, 3, 1, 2)


# ---- letterbox -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", SIZES)
def test_resize_equals_opencv_to_the_bit(sizes: tuple[int, int, int, int]) -> None:
    import cv2

    height, width, new_height, new_width = sizes
    a, b = picture(height, width, 1), picture(height, width, 2)
    expected = as_images(*[cv2.resize(p, (new_width, new_height)) for p in (a, b)])
    assert torch.equal(resize_8bit(as_images(a, b), new_height, new_width), expected.int())
    for dtype in (torch.float32, torch.float64):
        assert torch.equal(
            resize_8bit(as_images(a, b).to(dtype) / 255, new_height, new_width), expected.int()
        )


@pytest.mark.parametrize("side", [320, 640])
def test_letterbox_of_photographs(shared_data, side: int) -> None:
    import cv2

    for path in sorted((shared_data / "coco" / "images").glob("*.jpg")):
        image = cv2.imread(str(path))
        height, width = image.shape[:2]
        scale = min(side / height, side / width)
        size = int(width * scale + 0.5), int(height * scale + 0.5)
        expected = np.full((side, side, 3), 114, np.uint8)
        expected[: size[1], : size[0]] = cv2.resize(image, size)
        assert torch.equal(letterbox(as_images(image), side), as_images(expected).int())


@pytest.mark.parametrize(
    ("height", "width", "expected"),
    [(720, 1280, (180, 320)), (425, 640, (213, 320)), (160, 40, (320, 80)), (10, 9000, (1, 320))],
)
def test_letterbox_size_rounds_half_up_and_enlarges(
    height: int, width: int, expected: tuple[int, int]
) -> None:
    assert letterbox_size(height, width, 320) == expected


def test_letterbox_pads_right_and_bottom() -> None:
    black = torch.zeros(1, 3, 20, 40, dtype=torch.uint8)
    wide, tall = letterbox(black, 64), letterbox(black.transpose(2, 3), 64)
    assert (wide[..., :32, :] == 0).all()
    assert (wide[..., 32:, :] == 114).all()
    assert (tall[..., :32] == 0).all()
    assert (tall[..., 32:] == 114).all()


def test_undo_letterbox_has_a_scale_per_axis() -> None:
    # 425 x 640 becomes 213 x 320, not 212.5 x 320: the whole picture must come back as the whole picture.
    whole = undo_letterbox(torch.tensor([[0.0, 0.0, 320.0, 213.0]]), 425, 640, 320)
    torch.testing.assert_close(whole, torch.tensor([[0.0, 0.0, 640.0, 425.0]]))


# ---- boxes -----------------------------------------------------------------------------------------------


def test_points_are_cell_corners_row_by_row() -> None:
    distances = torch.zeros(1, 4, 2, 3)
    distances[0, :, 1, 2] = torch.tensor([1.0, 2.0, 3.0, 4.0])
    boxes = distances_to_boxes(distances, 8)
    assert boxes.shape == (1, 6, 4)
    assert boxes[0, 1].tolist() == [8, 0, 8, 0]
    assert boxes[0, 3].tolist() == [0, 8, 0, 8]
    assert boxes[0, 5].tolist() == [16 - 1, 8 - 2, 16 + 3, 8 + 4]


def random_boxes(rng: np.random.Generator, count: int, clusters: int = 6, side: float = 100.0) -> np.ndarray:
    """Boxes in whole pixels around a few centres, so that they overlap, repeat and tie."""
    centre = rng.uniform(0, side, (clusters, 4))[rng.integers(0, clusters, count)]
    corner = np.round(centre[:, :2] + rng.normal(0, 4, (count, 2)))
    return np.concatenate(
        [corner, corner + np.maximum(np.round(10 + centre[:, 2:] / 3 + rng.normal(0, 3, (count, 2))), 1)], 1
    )


def iou_by_pixels(a: np.ndarray, b: np.ndarray) -> float:
    canvas = np.zeros((2, 300, 300), bool)
    for layer, (x1, y1, x2, y2) in zip(canvas, (a.astype(int) + 100, b.astype(int) + 100), strict=True):
        layer[y1:y2, x1:x2] = True
    return float((canvas[0] & canvas[1]).sum() / (canvas[0] | canvas[1]).sum())


def test_iou_counts_pixels() -> None:
    rng = np.random.default_rng(0)
    a, b = random_boxes(rng, 50), random_boxes(rng, 50)
    expected = [iou_by_pixels(p, q) for p, q in zip(a, b, strict=True)]
    actual = box_iou(torch.from_numpy(a), torch.from_numpy(b))
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-12)
    assert max(expected) > 0.4
    assert box_iou(torch.zeros(4), torch.zeros(4)) == 0


def test_intersection_and_centres_by_hand() -> None:
    a, b = torch.tensor([0.0, 0, 4, 4]), torch.tensor([2.0, 3, 6, 9])
    assert box_intersection(a, b) == 2
    assert box_intersection(a, b + 10) == 0
    assert xyxy_to_center(b).tolist() == [4, 6, 4, 6]
    assert torch.equal(center_to_xyxy(xyxy_to_center(b)), b)


# ---- suppression -----------------------------------------------------------------------------------------


def greedy(boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray, threshold: float) -> list[int]:
    """Textbook greedy suppression, one box at a time."""
    x1, y1, x2, y2 = boxes.T
    area = (x2 - x1) * (y2 - y1)
    order = list(np.argsort(-scores, kind="stable"))
    kept = []
    while order:
        i = order.pop(0)
        kept.append(int(i))
        rest = []
        for j in order:
            width = min(x2[i], x2[j]) - max(x1[i], x1[j])
            height = min(y2[i], y2[j]) - max(y1[i], y1[j])
            overlap = max(width, 0) * max(height, 0)
            if labels[i] != labels[j] or overlap / (area[i] + area[j] - overlap) <= threshold:
                rest.append(j)
        order = rest
    return kept


def assert_equals_greedy(boxes, scores, labels, valid, threshold: float, count: int, suppress) -> None:
    index, found = suppress(
        *[torch.from_numpy(np.stack(x)) for x in (boxes, scores, labels, valid)], threshold, count
    )
    assert index.shape == found.shape == (len(boxes), count)
    for i in range(len(boxes)):
        places = np.flatnonzero(valid[i])
        kept = greedy(boxes[i][places], scores[i][places], labels[i][places], threshold)
        expected = places[kept].tolist()[:count]
        assert found[i].tolist() == [True] * len(expected) + [False] * (count - len(expected))
        assert index[i][found[i]].tolist() == expected


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 80),
    classes=st.integers(1, 3),
    levels=st.sampled_from([3, 10, 10**6]),  # few score levels make ties
    threshold=st.sampled_from([0.0, 0.3, 0.5, 0.6, 1.0]),
)
@settings(max_examples=60, deadline=None)
def test_suppression_equals_the_textbook(
    seed: int, count: int, classes: int, levels: int, threshold: float
) -> None:
    rng = np.random.default_rng(seed)
    batch = range(3)
    boxes = [random_boxes(rng, count) for _ in batch]
    scores = [rng.integers(0, levels, count) / levels for _ in batch]
    labels = [rng.integers(0, classes, count) for _ in batch]
    valid = [rng.random(count) < 0.8 for _ in batch]
    for limit in (count, 3):
        assert_equals_greedy(boxes, scores, labels, valid, threshold, limit, non_maximum_suppression)


def test_suppression_scripts_and_takes_many_boxes() -> None:
    rng = np.random.default_rng(0)
    boxes = [np.float32(random_boxes(rng, 1500, 200, 600.0)) for _ in range(2)]
    scores = [np.float32(rng.random(1500)) for _ in range(2)]
    labels = [rng.integers(0, 2, 1500) for _ in range(2)]
    valid = [np.ones(1500, bool) for _ in range(2)]
    scripted = torch.jit.script(non_maximum_suppression)
    assert_equals_greedy(boxes, scores, labels, valid, 0.6, 100, scripted)


def test_a_chain_of_overlaps_keeps_every_other_box() -> None:
    # Each overlaps the next by 1/2 only. Suppression by suppressed boxes would keep the first alone.
    x = torch.arange(9, dtype=torch.float32) * 10
    boxes = torch.stack([x, torch.zeros(9), x + 30, torch.ones(9)], -1).unsqueeze(0)
    scores = torch.linspace(0.9, 0.1, 9).unsqueeze(0)
    zeros, ones = torch.zeros(1, 9, dtype=torch.int64), torch.ones(1, 9, dtype=torch.bool)
    index, found = non_maximum_suppression(boxes, scores, zeros, ones, 0.4, 9)
    assert index[found].tolist() == [0, 2, 4, 6, 8]
    # An overlap equal to the threshold suppresses nothing.
    index, found = non_maximum_suppression(boxes, scores, zeros, ones, 0.5, 9)
    assert index[found].tolist() == list(range(9))


def test_suppression_of_nothing() -> None:
    empty = torch.zeros(2, 0, dtype=torch.int64)
    index, found = non_maximum_suppression(
        torch.zeros(2, 0, 4), torch.zeros(2, 0), empty, empty.bool(), 0.5, 4
    )
    assert index.shape == found.shape == (2, 4)
    assert not found.any()

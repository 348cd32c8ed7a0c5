"""Assignment of cells to objects, and the losses, against NumPy written from the paper and values by hand."""

import numpy as np
import numpy.typing as npt
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tensorsim.training.assign import (
    assign,
    cells_of,
    detection_losses,
    distillation_loss,
    giou_loss,
    quality_focal_loss,
)

STRIDES = [8, 16, 32]
Doubles = npt.NDArray[np.float64]


def iou(a: Doubles, b: Doubles) -> float:
    low, high = np.maximum(a[:2], b[:2]), np.minimum(a[2:], b[2:])
    both = float(np.prod(np.maximum(high - low, 0)))
    return both / max(float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2])) - both, 1e-12)


def reference(
    logits: Doubles, boxes: Doubles, points: Doubles, strides: Doubles, objects: Doubles
) -> tuple[npt.NDArray[np.int64], Doubles]:
    """One picture, cell by cell and object by object."""
    cells = len(logits)
    target, quality = np.full(cells, -1), np.zeros(cells)
    inside = [any(o[0] < p[0] < o[2] and o[1] < p[1] < o[3] for o in objects) for p in points]
    cost, overlap = np.full((cells, len(objects)), np.inf), np.zeros((cells, len(objects)))
    for i in range(cells):
        for j, o in enumerate(objects):
            if inside[i]:
                u, s = iou(boxes[i], o), 1 / (1 + np.exp(-logits[i]))
                entropy = -(u * np.log(s) + (1 - u) * np.log(1 - s))
                away = np.hypot(*(points[i] - (o[:2] + o[2:]) / 2)) / strides[i]
                cost[i, j] = entropy * (u - s) ** 2 - 3 * np.log(u + 1e-7) + 10 ** (away - 3)
                overlap[i, j] = u
    takers: list[list[int]] = [[] for _ in range(cells)]
    for j in range(len(objects)):
        k = max(1, int(np.sort(overlap[:, j])[::-1][:13].sum()))
        for i in np.argsort(cost[:, j], kind="stable")[:k]:
            if np.isfinite(cost[i, j]):
                takers[i].append(j)
    for i, who in enumerate(takers):
        if who:
            target[i] = who[0] if len(who) == 1 else int(np.argmin(cost[i]))
            quality[i] = overlap[i, target[i]]
    return target, quality


def scene(seed: int, count: int, side: int = 96) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Random logits, boxes, cells and objects of one picture in float64."""
    generator = torch.Generator().manual_seed(seed)
    points, strides = cells_of(side, side, STRIDES, torch.device("cpu"))
    points, strides = points.double(), strides.double()
    n = len(points)
    logits = torch.randn(n, generator=generator, dtype=torch.float64)
    reach = torch.rand(n, 4, generator=generator, dtype=torch.float64) * 30 + 3
    boxes = torch.cat([points - reach[:, :2], points + reach[:, 2:]], dim=1)
    low = torch.rand(count, 2, generator=generator, dtype=torch.float64) * (side - 30)
    # Wider than the finest stride, so that each object has a cell inside.
    size = torch.rand(count, 2, generator=generator, dtype=torch.float64) * 40 + 10
    return logits, boxes, points, strides, torch.cat([low, (low + size).clamp(max=side)], dim=1)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 6))
def test_assignment_equals_the_reference(seed: int, count: int) -> None:
    logits, boxes, points, strides, objects = scene(seed, count)
    expected, quality = reference(*(x.numpy() for x in (logits, boxes, points, strides, objects)))
    valid = torch.ones(1, count, dtype=torch.bool)
    found = assign(logits[None], boxes[None], points, strides, objects[None], valid)
    assert found.target[0].tolist() == expected.tolist()
    np.testing.assert_allclose(found.quality[0].numpy(), quality, atol=1e-12)
    assert (expected >= 0).any()


def test_batch_equals_loop_whatever_the_padding() -> None:
    a, b = scene(1, 4), scene(2, 2)
    objects = torch.zeros(2, 5, 4, dtype=torch.float64)
    valid = torch.zeros(2, 5, dtype=torch.bool)
    # Padding is not at the end, and is where cells are.
    objects[:] = torch.tensor([0.0, 0.0, 96.0, 96.0])
    objects[0, [0, 1, 3, 4]], valid[0, [0, 1, 3, 4]] = a[4], True
    objects[1, [2, 4]], valid[1, [2, 4]] = b[4], True
    found = assign(torch.stack([a[0], b[0]]), torch.stack([a[1], b[1]]), a[2], a[3], objects, valid)
    for i, (picture, slots) in enumerate(((a, [0, 1, 3, 4]), (b, [2, 4]))):
        logits, boxes, points, strides, own = picture
        alone = assign(
            logits[None], boxes[None], points, strides, own[None], torch.ones(1, len(own), dtype=torch.bool)
        )
        named = torch.tensor([*slots, -1])[alone.target[0]]
        assert torch.equal(found.target[i], named)
        torch.testing.assert_close(found.quality[i], alone.quality[0])


def test_nobody_is_assigned_where_nobody_is() -> None:
    logits, boxes, points, strides, objects = scene(0, 3)
    for some in (objects[None, :0], objects[None]):
        valid = torch.zeros(1, some.shape[1], dtype=torch.bool)
        found = assign(logits[None], boxes[None], points, strides, some, valid)
        assert bool((found.target == -1).all())
        assert not found.quality.any()


def test_cells_are_corners_row_by_row() -> None:
    points, strides = cells_of(32, 64, STRIDES, torch.device("cpu"))
    assert points[:3].tolist() == [[0, 0], [8, 0], [16, 0]]
    assert points[8].tolist() == [0, 8]
    assert points[32:34].tolist() == [[0, 0], [16, 0]]
    assert points[-1].tolist() == [32, 0]
    assert strides.unique(return_counts=True)[1].tolist() == [32, 8, 2]


def test_generalised_overlap_by_hand() -> None:
    # Squares of side 2, apart by 1: no overlap, union 8, around them 5 x 2.
    a, b = torch.tensor([0.0, 0.0, 2.0, 2.0]), torch.tensor([3.0, 0.0, 5.0, 2.0])
    assert float(giou_loss(a, b)) == pytest.approx(1 + 2 / 10)
    # Half over one another: 2 of 6, nothing else around.
    assert float(giou_loss(a, torch.tensor([1.0, 0.0, 3.0, 2.0]))) == pytest.approx(1 - 1 / 3)
    assert float(giou_loss(a, a)) == pytest.approx(0)


def test_losses_have_right_gradients() -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(5, 4, dtype=torch.float64, generator=generator)
    a[:, 2:] += 1.2
    b = torch.rand(5, 4, dtype=torch.float64, generator=generator)
    b[:, 2:] += 1.5
    assert torch.autograd.gradcheck(giou_loss, (a.requires_grad_(), b))
    logits = torch.randn(6, dtype=torch.float64, generator=generator, requires_grad=True)
    quality = torch.rand(6, dtype=torch.float64, generator=generator)
    assert torch.autograd.gradcheck(quality_focal_loss, (logits, quality))


def test_quality_focal_loss_by_hand() -> None:
    logits, quality = torch.tensor([0.3, -1.0]), torch.tensor([0.8, 0.0])
    score = 1 / (1 + np.exp(-np.array([0.3, -1.0])))
    entropy = [-(0.8 * np.log(score[0]) + 0.2 * np.log(1 - score[0])), -np.log(1 - score[1])]
    expected = [(0.8 - score[0]) ** 2 * entropy[0], score[1] ** 2 * entropy[1]]
    np.testing.assert_allclose(quality_focal_loss(logits, quality).numpy(), expected, rtol=1e-5)
    # The score that costs least is the quality.
    grid = torch.linspace(-4, 4, 801)
    best = quality_focal_loss(grid, torch.full_like(grid, 0.7)).argmin()
    assert float(grid[best].sigmoid()) == pytest.approx(0.7, abs=0.01)


def test_distillation_loss_by_hand() -> None:
    # Two cells: the teacher is confident of the first, 0.8, and has a box there; the second has 0.2, too little.
    taught = torch.tensor([[0.8, 0.2]]).logit()
    boxes = torch.tensor([[[1.0, 0.0, 3.0, 2.0], [0.0, 0.0, 9.0, 9.0]]])
    taught_boxes = torch.tensor([[[0.0, 0.0, 2.0, 2.0], [0.0, 0.0, 1.0, 1.0]]])
    entropy = -np.log(0.5)  # of a score of a half, whatever the teacher's
    classification = 0.3**2 * entropy + 0.3**2 * entropy
    # Scores that add up to less than one count as one.
    expected = (classification + 2 * 0.8 * (1 - 1 / 3)) / 1.0
    assert float(distillation_loss(torch.zeros(1, 2), boxes, taught, taught_boxes)) == pytest.approx(expected)
    assert float(distillation_loss(taught, taught_boxes, taught, taught_boxes)) == pytest.approx(0, abs=1e-6)
    twice = [x.expand(4, *x.shape[1:]) for x in (torch.zeros(1, 2), boxes, taught, taught_boxes)]
    assert float(distillation_loss(*twice)) == pytest.approx(4 * expected / 3.2)


def dense(score: float, side: int = 64) -> tuple[list[Tensor], Tensor]:
    logits = [torch.full((1, 1, side // s, side // s), score, requires_grad=True) for s in STRIDES]
    points, strides = cells_of(side, side, STRIDES, torch.device("cpu"))
    return logits, torch.cat([points - strides[:, None], points + strides[:, None]], dim=1)[None]


def test_what_is_not_known_costs_nothing() -> None:
    logits, boxes = dense(1.0)
    known = torch.ones(1, 4, 4, dtype=torch.bool)
    known[0, 0, 2:] = False  # the top right quarter of the rows above 16, the columns from 32 on
    losses = detection_losses(
        logits, boxes, STRIDES, torch.zeros(1, 0, 4), torch.zeros(1, 0, dtype=torch.bool), known
    )
    losses["loss"].backward()
    for level, stride in zip(logits, STRIDES, strict=True):
        assert level.grad is not None
        y, x = torch.meshgrid(*(torch.arange(64 // stride) * stride,) * 2, indexing="ij")
        ignored = (x >= 32) & (y < 16)
        assert torch.equal(level.grad[0, 0] == 0, ignored)


def test_people_cost_even_where_absence_is_not_known() -> None:
    logits, boxes = dense(0.0)
    objects = torch.tensor([[[10.0, 10.0, 50.0, 60.0]]])
    valid = torch.ones(1, 1, dtype=torch.bool)
    losses = detection_losses(logits, boxes, STRIDES, objects, valid, torch.zeros(1, 4, 4, dtype=torch.bool))
    losses["loss"].backward()
    touched = sum(int((level.grad != 0).sum()) for level in logits if level.grad is not None)
    assert 1 <= touched <= 13
    assert float(losses["box"]) > 0


@pytest.mark.parametrize("count", [3, 1])
def test_losses_are_sums_over_cells_by_the_sum_of_qualities(count: int) -> None:
    """Both by the sum of qualities, at least 1, and the box loss counts twice: in NumPy, cell by cell."""
    logits, boxes, points, strides, objects = scene(3, count)
    if count == 1:  # hardly an overlap: the sum of qualities is below 1
        boxes = torch.cat([points - 1.0, points + 1.0], dim=1)
    sides = [(96 // s) ** 2 for s in STRIDES]
    levels = [
        part.reshape(1, 1, 96 // s, 96 // s)
        for part, s in zip(logits.float().split(sides), STRIDES, strict=True)
    ]
    known = torch.ones(1, 4, 4, dtype=torch.bool)
    valid = torch.ones(1, count, dtype=torch.bool)
    found = detection_losses(levels, boxes.float()[None], STRIDES, objects.float()[None], valid, known)

    target, quality = reference(*(x.numpy() for x in (logits, boxes, points, strides, objects)))
    total = max(float(quality.sum()), 1.0)
    assert (quality.sum() < 1.0) == (count == 1)
    score = 1 / (1 + np.exp(-logits.numpy()))
    entropy = -(quality * np.log(score) + (1 - quality) * np.log(1 - score))
    classification = float(((quality - score) ** 2 * entropy).sum()) / total
    box = 0.0
    for cell in np.flatnonzero(target >= 0):
        a, b = boxes[cell].numpy(), objects[target[cell]].numpy()
        around = float(np.prod(np.maximum(a[2:], b[2:]) - np.minimum(a[:2], b[:2])))
        areas = float(np.prod(a[2:] - a[:2]) + np.prod(b[2:] - b[:2]))
        union = areas / (1 + iou(a, b))
        box += quality[cell] * (1 - iou(a, b) + (around - union) / around) / total
    assert float(found["classification"]) == pytest.approx(classification, rel=1e-4)
    assert float(found["box"]) == pytest.approx(box, rel=1e-4)
    assert float(found["loss"]) == pytest.approx(classification + 2 * box, rel=1e-4)

"""Assignment of a detector's cells to objects, and the classification and box losses.

B images, N cells (of all levels, in the order of their predictions), G objects per image, padded.

Reference:
    Lyu et al., "RTMDet", 2022, section 3.3: dynamic soft label assignment, quality focal loss, GIoU loss.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.geometry.boxes import box_area, box_iou

#: An object gets as many cells as the sum of its best overlaps, over at most this many cells.
MOST_CELLS = 13
IOU_WEIGHT = 3.0
#: The cost of a cell includes 10^(distance to the centre of the object in strides - this).
CENTRE_RADIUS = 3.0
#: Score above which a student learns a teacher's box.
TAUGHT_SCORE = 0.25


class Assignment(NamedTuple):
    """The object assigned to each cell.

    Attributes:
        target: (B, N) int64, the object; -1 for none.
        quality: (B, N) overlap of the cell's box with it; 0 for none.
    """

    target: Tensor
    quality: Tensor


def cells_of(height: int, width: int, strides: list[int], device: torch.device) -> tuple[Tensor, Tensor]:
    """Points (N, 2) of the cells of all levels, row by row, in pixels, and their strides (N,)."""
    points, steps = [], []
    for stride in strides:
        y, x = torch.meshgrid(
            torch.arange(height // stride, device=device),
            torch.arange(width // stride, device=device),
            indexing="ij",
        )
        points.append(torch.stack([x, y], dim=-1).reshape(-1, 2).float() * stride)
        steps.append(torch.full((x.numel(),), float(stride), device=device))
    return torch.cat(points), torch.cat(steps)


def assign(
    logits: Tensor, boxes: Tensor, points: Tensor, strides: Tensor, objects: Tensor, valid: Tensor
) -> Assignment:
    """Dynamic soft labels: each object takes the cells that already predict it best.

    With IoU u of the predicted box, score s and distance d to the centre of the object in strides, the cost is
    ``BCE(s, u) (u - s)^2 - 3 log u + 10^(d - 3)`` among the cells inside any object. An object takes the
    ``max(1, floor(sum of its 13 largest u))`` cheapest ones; a cell taken by several goes to the object with the
    lowest cost.

    Args:
        logits: (B, N) of the class.
        boxes: (B, N, 4) predicted ``xyxy``.
        points: (N, 2) cells.
        strides: (N,) pixels per cell.
        objects: (B, G, 4) ``xyxy``.
        valid: (B, G) bool, which objects exist.
    """
    batch, count = logits.shape
    if objects.shape[1] == 0:
        return Assignment(logits.new_full((batch, count), -1, dtype=torch.int64), torch.zeros_like(logits))
    low, high = objects[:, None, :, :2], objects[:, None, :, 2:]
    at = points[:, None]
    inside = ((at > low) & (at < high)).all(dim=-1) & valid[:, None]
    candidate = inside.any(dim=-1, keepdim=True) & valid[:, None]

    iou = box_iou(boxes[:, :, None], objects[:, None]) * candidate
    score = logits[..., None]
    soft = F.binary_cross_entropy_with_logits(score.expand_as(iou), iou, reduction="none")
    steps = (at - (low + high) / 2).norm(dim=-1) / strides[:, None]
    cost = (
        soft * (iou - score.sigmoid()).square()
        - IOU_WEIGHT * torch.log(iou + 1e-7)
        + 10 ** (steps - CENTRE_RADIUS).clamp(max=30.0)  # larger exponents overflow single precision
    )
    cost = cost.masked_fill(~candidate, torch.inf)

    most = min(MOST_CELLS, count)
    wanted = iou.topk(most, dim=1).values.sum(dim=1).floor().clamp(min=1)  # (B, G)
    cheapest = cost.topk(most, dim=1, largest=False)
    rank = torch.arange(most, device=cost.device)[:, None]
    taken = torch.zeros_like(candidate.expand_as(iou)).scatter(
        1, cheapest.indices, (rank < wanted[:, None]) & torch.isfinite(cheapest.values)
    )
    several = taken.sum(dim=-1) > 1
    target = torch.where(several, cost.argmin(dim=-1), taken.int().argmax(dim=-1))
    quality = iou.gather(-1, target[..., None])[..., 0]
    some = taken.any(dim=-1)
    return Assignment(target.masked_fill(~some, -1), quality * some)


def quality_focal_loss(logits: Tensor, quality: Tensor) -> Tensor:
    """Quality focal loss ``|q - s|^2 BCE(s, q)`` of each cell, s the score; q = 0 for background.

    Reference:
        Li et al., "Generalized Focal Loss", 2020, eq. (2) with beta = 2.
    """
    entropy = F.binary_cross_entropy_with_logits(logits, quality, reduction="none")
    return (quality - logits.sigmoid()).square() * entropy


def giou_loss(a: Tensor, b: Tensor) -> Tensor:
    """``1 - GIoU`` (...) of boxes (..., 4) ``xyxy``: ``GIoU = I / U - (C - U) / C``, C the area around both.

    Reference:
        Rezatofighi et al., "Generalized Intersection over Union", 2019.
    """
    low, high = torch.maximum(a[..., :2], b[..., :2]), torch.minimum(a[..., 2:], b[..., 2:])
    both = (high - low).clamp(min=0).prod(dim=-1)
    union = (box_area(a) + box_area(b) - both).clamp(min=1e-7)
    corners = torch.cat(
        [torch.minimum(a[..., :2], b[..., :2]), torch.maximum(a[..., 2:], b[..., 2:])], dim=-1
    )
    around = box_area(corners).clamp(min=1e-7)
    return 1 - both / union + (around - union) / around


def detection_losses(
    logits: list[Tensor],
    boxes: Tensor,
    strides: list[int],
    objects: Tensor,
    valid: Tensor,
    counted: Tensor,
) -> dict[str, Tensor]:
    """Classification and box loss of a one-class detector, and both together.

    Args:
        logits: per level (B, 1, h, w).
        boxes: (B, N, 4) decoded ``xyxy``.
        strides: of the levels.
        objects: (B, G, 4).
        valid: (B, G) bool.
        counted: (B, m, m) bool over the square picture: where the absence of an object is known. Cells
            elsewhere without an object are left out of the loss.
    """
    height, width = logits[0].shape[-2] * strides[0], logits[0].shape[-1] * strides[0]
    flat = torch.cat([level.flatten(1) for level in logits], dim=1).float()
    points, steps = cells_of(height, width, strides, flat.device)
    with torch.no_grad():
        target, quality = assign(flat, boxes, points, steps, objects, valid)
        place = (points * counted.shape[-1] / width).long()
        known = counted[:, place[:, 1], place[:, 0]]
        weight = (known | (target >= 0)).float()
        total = quality.sum().clamp(min=1.0)
    classification = (quality_focal_loss(flat, quality) * weight).sum() / total
    image, cell = (target >= 0).nonzero(as_tuple=True)
    error = giou_loss(boxes[image, cell], objects[image, target[image, cell]])
    box = (error * quality[image, cell]).sum() / total
    return {
        "loss": classification + 2.0 * box,
        "classification": classification.detach(),
        "box": box.detach(),
    }


def distillation_loss(logits: Tensor, boxes: Tensor, taught_logits: Tensor, taught_boxes: Tensor) -> Tensor:
    """Difference of the outputs of a one-class detector from a teacher's, cell by cell; 0 if they are the same.

    The quality focal loss against the teacher's scores, and twice the GIoU loss against its boxes, weighted with the
    scores where they exceed :data:`TAUGHT_SCORE`; both divided by the sum of these scores.

    Args:
        logits: (B, N) of the class.
        boxes: (B, N, 4) predicted ``xyxy``.
        taught_logits: (B, N), without gradients.
        taught_boxes: (B, N, 4), without gradients.

    Reference:
        Hinton et al., "Distilling the Knowledge in a Neural Network", 2015; here for every cell.
    """
    quality = taught_logits.sigmoid()
    weight = quality * (quality > TAUGHT_SCORE)
    total = weight.sum().clamp(min=1.0)
    classification = quality_focal_loss(logits, quality).sum() / total
    image, cell = weight.nonzero(as_tuple=True)
    error = giou_loss(boxes[image, cell], taught_boxes[image, cell])
    return classification + 2.0 * (error * weight[image, cell]).sum() / total

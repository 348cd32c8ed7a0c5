"""Boxes: overlap and suppression; letterbox images for a detector and its dense predictions as boxes.

Boxes are ``xyxy`` pixels in the convention of COCO: (0, 0) is the outer corner of the first pixel and (W, H)
that of the last one.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.errors import is_exporting, is_writing_onnx

#: Grey level around a picture that does not fill its square, as RTMDet was trained with.
LETTERBOX_GREY = 114


def resize_8bit(images: Tensor, height: int, width: int) -> Tensor:
    """Resize as ``cv2.resize`` (INTER_LINEAR, uint8) does, to the bit.

    Bilinear without antialiasing, in fixed point: weights in 1/2048, the share of each row truncated to a quarter
    of a grey level. Detectors were trained on such images, and one grey level can decide between two boxes of
    nearly equal score.

    Args:
        images: (B, C, H, W) uint8, or floating point in [0, 1], which is rounded to 8 bits.
        height: rows of the result.
        width: columns of the result.

    Returns:
        (B, C, height, width) int32 in 0 to 255. Not differentiable.
    """
    top, bottom, y = _linear_taps(images.shape[-2], height, images.device)
    left, right, x = _linear_taps(images.shape[-1], width, images.device)
    y = y.unsqueeze(-1)
    shares: list[Tensor] = []
    for row, weight in ((top, 2048 - y), (bottom, y)):
        line = images.index_select(-2, row)
        a, b = _to_8bit(line.index_select(-1, left)), _to_8bit(line.index_select(-1, right))
        shares.append((weight * ((a * (2048 - x) + b * x) >> 4)) >> 16)
    return (shares[0] + shares[1] + 2) >> 2


def _to_8bit(x: Tensor) -> Tensor:
    return (x.detach() * 255).round().to(torch.int32) if x.is_floating_point() else x.to(torch.int32)


def _linear_taps(length: int, size: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Both neighbours of each of ``size`` places along ``length`` pixels, weight of the second in 1/2048."""
    scale = 1.0 / (size / length)
    # Pixel centres of both grids lie at half integers; single precision from here on, as in OpenCV.
    place = ((torch.arange(size, device=device, dtype=torch.float64) + 0.5) * scale - 0.5).float()
    first = place.floor()
    weight = ((place - first) * 2048).round().to(torch.int32)
    index = first.to(torch.int64)
    return index.clamp(0, length - 1), (index + 1).clamp(0, length - 1), weight


def letterbox_size(height: int, width: int, side: int) -> tuple[int, int]:
    """Height and width of an image scaled to fit a square of ``side`` pixels (it also enlarges)."""
    scale = min(side / height, side / width)
    return max(int(height * scale + 0.5), 1), max(int(width * scale + 0.5), 1)


def letterbox(images: Tensor, side: int, grey: float = LETTERBOX_GREY) -> Tensor:
    """Scale images into a square and pad it at the right and at the bottom.

    Args:
        images: (B, C, H, W) uint8, or floating point in [0, 1].
        side: of the square, pixels.
        grey: level of the padding, 0 to 255.

    Returns:
        (B, C, side, side) int32 in 0 to 255.
    """
    # Equal to cv2.resize and cv2.copyMakeBorder, which cannot be scripted: see OnnxDetector.
    height, width = letterbox_size(images.shape[-2], images.shape[-1], side)
    scaled = resize_8bit(images, height, width)
    return F.pad(scaled, [0, side - width, 0, side - height], value=grey)


def undo_letterbox(boxes: Tensor, height: int, width: int, side: int) -> Tensor:
    """Boxes (..., 4) of the square, in pixels of the (height, width) image it was made of."""
    new_height, new_width = letterbox_size(height, width, side)
    # The sizes are rounded to whole pixels, so the two scales differ slightly.
    x, y = new_width / width, new_height / height
    return boxes / torch.tensor([x, y, x, y], dtype=boxes.dtype, device=boxes.device)


def distances_to_boxes(distances: Tensor, stride: int) -> Tensor:
    """Boxes around the points of a feature map.

    Args:
        distances: (B, 4, h, w) from the point to the left, top, right and bottom edge, pixels.
        stride: pixels per cell. The point of a cell is its outer corner, ``stride`` times (column, row).

    Returns:
        (B, h w, 4), row by row.
    """
    h, w = distances.shape[-2], distances.shape[-1]
    x = torch.arange(w, dtype=distances.dtype, device=distances.device) * stride
    y = (torch.arange(h, dtype=distances.dtype, device=distances.device) * stride).unsqueeze(-1)
    left, top, right, bottom = distances.unbind(1)
    return torch.stack([x - left, y - top, x + right, y + bottom], -1).flatten(1, 2)


def xyxy_to_center(boxes: Tensor) -> Tensor:
    """``xyxy`` boxes (..., 4) as centre u, centre v, width, height."""
    low, high = boxes[..., :2], boxes[..., 2:]
    return torch.cat([(low + high) / 2.0, high - low], dim=-1)


def center_to_xyxy(boxes: Tensor) -> Tensor:
    """The inverse of :func:`xyxy_to_center`."""
    center, half = boxes[..., :2], boxes[..., 2:] / 2.0
    return torch.cat([center - half, center + half], dim=-1)


def box_area(boxes: Tensor) -> Tensor:
    """Area (...) of boxes (..., 4)."""
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])


def box_intersection(a: Tensor, b: Tensor) -> Tensor:
    """Area (...) that boxes (..., 4) and (..., 4), broadcast, have in common."""
    x1, y1 = torch.maximum(a[..., 0], b[..., 0]), torch.maximum(a[..., 1], b[..., 1])
    x2, y2 = torch.minimum(a[..., 2], b[..., 2]), torch.minimum(a[..., 3], b[..., 3])
    return (x2 - x1).clamp(min=0) * (y2 - y1).clamp(min=0)


def box_iou(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union (...) of boxes (..., 4) and (..., 4), broadcast; 0 where both are empty."""
    intersection = box_intersection(a, b)
    union = box_area(a) + box_area(b) - intersection
    return intersection / union.clamp(min=1e-12)


@torch.jit.unused
def _onnx_suppression(
    boxes: Tensor,
    scores: Tensor,
    labels: Tensor,
    valid: Tensor,
    iou_threshold: float,
    max_detections: int,
) -> tuple[Tensor, Tensor]:
    """The suppression as one operation, which ONNX has."""
    from tensorsim.onnx_operations import suppression

    return suppression()(boxes, scores, labels, valid, iou_threshold, max_detections)


def non_maximum_suppression(
    boxes: Tensor, scores: Tensor, labels: Tensor, valid: Tensor, iou_threshold: float, max_detections: int
) -> tuple[Tensor, Tensor]:
    """Greedy non-maximum suppression per class, exact, for a batch.

    Takes the best remaining box, drops it and all of its class that overlap it by more than ``iou_threshold``, and
    repeats. One step processes the whole batch and needs one row of the overlap matrix: keeping k of n boxes
    costs O(k n) time and O(n) memory. Among equal scores the first box wins.

    Args:
        boxes: (B, n, 4).
        scores: (B, n).
        labels: (B, n) class of each box.
        valid: (B, n) bool, which boxes exist.
        iou_threshold: boxes that overlap by exactly this much both stay.
        max_detections: k, at most this many are kept.

    Returns:
        Indices (B, k) into the n boxes, best first, and whether each was found (B, k). Not differentiable.
    """
    # kornia.geometry.bbox.nms takes one image, one class and no limit, and does not export.
    if is_writing_onnx():
        return _onnx_suppression(boxes, scores, labels, valid, iou_threshold, max_detections)
    batch, count = scores.shape
    picked = torch.zeros((batch, max_detections), dtype=torch.int64, device=scores.device)
    found = torch.zeros((batch, max_detections), dtype=torch.bool, device=scores.device)
    if count == 0:
        return picked, found
    order = torch.arange(count, device=scores.device).expand(batch, -1)
    if not is_exporting():
        # Few boxes exist; only they, in their order, are compared.
        first = valid.to(torch.uint8).sort(dim=1, descending=True, stable=True).indices
        order = first[:, : max(1, int(valid.sum(1).max()))]
    boxes, nothing = boxes.detach().gather(1, order.unsqueeze(-1).expand(-1, -1, 4)), -float("inf")
    labels = labels.gather(1, order)
    left = scores.detach().masked_fill(~valid, nothing).gather(1, order)
    for k in range(max_detections):
        best, index = left.max(1, keepdim=True)
        exists = best > nothing
        if not is_exporting() and not bool(exists.any()):
            break
        picked[:, k : k + 1] = order.gather(1, index)
        found[:, k : k + 1] = exists
        box = boxes.gather(1, index.unsqueeze(-1).expand(-1, -1, 4))
        dropped = (box_iou(box, boxes) > iou_threshold) & (labels == labels.gather(1, index))
        left = left.masked_fill(dropped, nothing).scatter(1, index, nothing)
    return picked, found

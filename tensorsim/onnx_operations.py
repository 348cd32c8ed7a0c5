"""Operations that ONNX has and torch lacks, for :func:`tensorsim.export.to_onnx`."""

from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor

Suppression = Callable[[Tensor, Tensor, Tensor, Tensor, float, int], tuple[Tensor, Tensor]]


@cache
def suppression() -> Suppression:
    """:func:`~tensorsim.geometry.boxes.non_maximum_suppression` as a single operation of a traced graph."""
    from tensorsim.geometry.boxes import non_maximum_suppression

    operation = torch.library.custom_op(
        "tensorsim::non_maximum_suppression", non_maximum_suppression, mutates_args=()
    )

    @operation.register_fake
    def _(
        boxes: Tensor,
        scores: Tensor,
        labels: Tensor,
        valid: Tensor,
        iou_threshold: float,
        max_detections: int,
    ) -> tuple[Tensor, Tensor]:
        shape = (scores.shape[0], max_detections)
        return labels.new_empty(shape, dtype=torch.int64), labels.new_empty(shape, dtype=torch.bool)

    return operation


def onnx_suppression(
    boxes: Any, scores: Any, labels: Any, valid: Any, iou_threshold: float, max_detections: int
) -> tuple[Any, Any]:
    """The same with ONNX's NonMaxSuppression, which works per class and does not order boxes across classes."""
    from onnxscript import opset18

    op: Any = opset18  # its annotations do not allow constants
    nothing = op.Constant(value_float=-1.0)
    scores = op.Where(valid, scores, nothing)
    classes = op.Range(0, op.Add(op.ReduceMax(labels, keepdims=0), 1), 1)
    of_class = op.Equal(op.Unsqueeze(labels, [1]), op.Unsqueeze(classes, [0, 2]))  # (B, C, n)
    by_class = op.Where(of_class, op.Unsqueeze(scores, [1]), nothing)
    most = op.Constant(value_ints=[max_detections])
    # (found, 3): picture, class, box
    chosen = op.NonMaxSuppression(boxes, by_class, most, [iou_threshold], [0.0])
    place = op.Gather(chosen, [0, 2], axis=1)
    kept = op.ScatterND(op.Expand(nothing, op.Shape(scores)), place, op.GatherND(scores, place))
    best, index = op.TopK(kept, most)
    return index, op.Greater(best, 0.0)


def translations() -> dict[Callable[..., Any], Callable[..., Any]]:
    """ONNX translations of this module's operations."""
    suppression()
    return {torch.ops.tensorsim.non_maximum_suppression.default: onnx_suppression}

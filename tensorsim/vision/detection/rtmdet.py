"""RTMDet: detection of people (or the 80 classes of COCO) in images, from pixels to final boxes in one module."""

import os
from typing import Any

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_choice, check_count, check_images
from tensorsim.geometry.boxes import (
    distances_to_boxes,
    letterbox,
    non_maximum_suppression,
    undo_letterbox,
)
from tensorsim.types import Detections
from tensorsim.vision.detection.rtmdet_layers import RTMDET_SIZES, CSPNeXt, CSPNeXtPAFPN, RTMDetSepBNHead


class RTMDet(nn.Module):
    """The RTMDet detector with the keys and shapes of the published checkpoints.

    Letterbox, normalisation, network, decoding and class-aware non-maximum suppression are one graph of
    tensor operations. It scripts, and it goes through torch.export for one image size and (with a dynamic
    dimension) any batch; exported, suppression is unrolled to ``max_detections`` steps. Images are rounded to
    8 bits, as the network was trained, so only :meth:`dense` is differentiable with respect to its input.

    A fresh module is in training mode; call ``eval()`` before use (``from_pretrained`` does).

    Args:
        variant: "nano-person", "small-person", "tiny", "s", "m", "l", "x" (80 classes of COCO, 0 = person) or
            "m-person".
        score_threshold: detections score more than this. None, here and below, is the setting of the
            published figures: 0.05 for one class, 0.001 for 80. For tracking, 0.3 is usual.
        nms_iou: boxes of a class that overlap more are one object. None: 0.6 for one class, 0.65 for 80.
        max_detections: K, the padded count. None: 100 for one class, 300 for 80.
        nms_pre: candidates kept per level. None: 1000 for one class, 30000 for 80.
        input_size: side of the square input in pixels, a multiple of 32. None: 320 for nano and small, else 640.

    Raises:
        TensorsimError: an unknown variant or a setting out of range.

    Reference:
        Lyu et al., "RTMDet: An Empirical Study of Designing Real-Time Object Detectors", 2022.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        variant: str = "nano-person",
        score_threshold: float | None = None,
        nms_iou: float | None = None,
        max_detections: int | None = None,
        nms_pre: int | None = None,
        input_size: int | None = None,
    ) -> None:
        super().__init__()
        check_choice(variant, RTMDET_SIZES, "RTMDet.variant")
        size = RTMDET_SIZES[variant]
        one_class = size.num_classes == 1
        self.variant = variant
        self.score_threshold = (0.05 if one_class else 0.001) if score_threshold is None else score_threshold
        self.nms_iou = (0.6 if one_class else 0.65) if nms_iou is None else nms_iou
        self.max_detections = (100 if one_class else 300) if max_detections is None else max_detections
        self.nms_pre = (1000 if one_class else 30000) if nms_pre is None else nms_pre
        self.input_size = size.input_size if input_size is None else input_size
        for name in ("score_threshold", "nms_iou"):
            if not 0 <= getattr(self, name) <= 1:
                raise TensorsimError(
                    f"RTMDet.{name}: got {getattr(self, name)}, expected a number from 0 to 1"
                )
        for name in ("max_detections", "nms_pre"):
            check_count(getattr(self, name), f"RTMDet.{name}")
        if self.input_size < 32 or self.input_size % 32:
            raise TensorsimError(
                f"RTMDet.input_size: got {self.input_size}, expected a positive multiple of 32"
            )

        self.strides = [8, 16, 32]
        self.exp_on_reg = size.exp_on_reg
        self.backbone = CSPNeXt(size)
        self.neck = CSPNeXtPAFPN(self.backbone.channels, size)
        self.bbox_head = RTMDetSepBNHead(self.backbone.channels[0], size)
        mean = torch.tensor([123.675, 116.28, 103.53]).reshape(3, 1, 1)
        std = torch.tensor([58.395, 57.12, 57.375]).reshape(3, 1, 1)
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("std", std, persistent=False)

    @classmethod
    def from_pretrained(
        cls, source: str | os.PathLike[str] | None = None, variant: str | None = None, **options: Any
    ) -> "RTMDet":
        """Build the network of a weight file and load it, ready for use (``eval()``).

        Args:
            source: a published ``.pth``, a ``.safetensors`` of its keys, or an ``.onnx`` exported by mmdeploy; or a
                name that ``tensorsim models list`` prints, such as ``"rtmdet-m-person"``; None: the shipped weights.
            variant: None infers it from the shapes in the file.
            **options: further arguments of the constructor. An ``input_size`` and an ``nms_iou`` that a
                ``.safetensors`` file states are taken unless given here.

        Raises:
            TensorsimError: an unknown name, weights that cannot be fetched, or a file that is damaged, unsafe or
                not of this network; see :func:`tensorsim.weights.load_state_dict`.
        """
        from tensorsim.files import reading
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict, read_metadata

        path = locate(source, cls.__name__)
        stated = read_metadata(path)
        with reading(path, "weights of RTMDet"):  # those of other networks have other metadata
            kinds = {"input_size": int, "nms_iou": float}
            options = {name: kinds[name](stated[name]) for name in kinds if name in stated} | options
        if path.suffix == ".onnx":
            from tensorsim.vision.detection.rtmdet_onnx import read_convolutions, unfold

            convolutions = read_convolutions(path)
            named = {"backbone.stem.0.conv.weight": convolutions[0].weight} if convolutions else {}
            named.update({conv.name: conv.weight for conv in convolutions})
            detector = cls(variant or variant_of(named, path), **options).eval()
            state = unfold(detector, convolutions, path)
        else:
            state = load_state_dict(path)
            detector = cls(variant or variant_of(state, path), **options).eval()
        load_strict(detector, state, path)
        return detector

    def forward(self, images: Tensor) -> Detections:
        """Find objects.

        Args:
            images: (B, 3, H, W) RGB, floating point in [0, 1] or uint8.

        Returns:
            Detections padded to K = ``max_detections``, best first: boxes (B, K, 4) in pixels of the images
            (they may reach past the right and bottom edges), scores, labels and valid (B, K).

        Raises:
            TensorsimError: another shape or dtype, an empty batch, values far from [0, 1], NaN.
        """
        logits, distances = self.dense(self.preprocess(images))
        return self.select(logits, distances, images.shape[-2], images.shape[-1])

    @torch.jit.export
    def preprocess(self, images: Tensor) -> Tensor:
        """Letterbox, normalise and reorder to BGR: (B, 3, H, W) -> (B, 3, input_size, input_size)."""
        check_images(images)
        # Channels last, because the convolutions of the CPU run faster on it.
        x = self.normalise(letterbox(images, self.input_size))
        return x.contiguous(memory_format=torch.channels_last)

    @torch.jit.export
    def normalise(self, square: Tensor) -> Tensor:
        """RGB (B, 3, h, w) from 0 to 255 to BGR without the mean and deviation of the training pictures."""
        return ((square.to(self.mean.dtype) - self.mean) / self.std).flip(1)

    @torch.jit.export
    def dense(self, x: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """The network: dense predictions for every cell of the three levels, strides 8, 16, 32.

        Args:
            x: (B, 3, h, w) normalised BGR as ``preprocess`` returns it; h and w multiples of 32.

        Returns:
            Per level class logits (B, classes, h / stride, w / stride) and distances (B, 4, ...) in pixels of
            ``x`` from the cell's corner ``stride`` (column, row) to the left, top, right and bottom edge.
        """
        logits, raw = self.bbox_head(self.neck(self.backbone(x)))
        distances: list[Tensor] = []
        for i, level in enumerate(raw):
            distances.append((level.exp() if self.exp_on_reg else level) * self.strides[i])
        return logits, distances

    @torch.jit.export
    def select(self, logits: list[Tensor], distances: list[Tensor], height: int, width: int) -> Detections:
        """Decode dense predictions, undo the letterbox of (height, width) images, suppress duplicates."""
        boxes_of_levels: list[Tensor] = []
        scores_of_levels: list[Tensor] = []
        labels_of_levels: list[Tensor] = []
        for i, level in enumerate(logits):
            classes = level.shape[1]
            # Every pair of a cell and a class is a candidate of its own.
            scores = level.sigmoid().permute(0, 2, 3, 1).flatten(1)
            scores, index = scores.topk(min(self.nms_pre, scores.shape[1]), 1)
            cells = torch.div(index, classes, rounding_mode="floor").unsqueeze(-1).expand(-1, -1, 4)
            boxes_of_levels.append(distances_to_boxes(distances[i], self.strides[i]).gather(1, cells))
            scores_of_levels.append(scores)
            labels_of_levels.append(index % classes)
        side = float(self.input_size)
        boxes = undo_letterbox(torch.cat(boxes_of_levels, 1).clamp(0.0, side), height, width, self.input_size)
        scores, labels = torch.cat(scores_of_levels, 1), torch.cat(labels_of_levels, 1)
        # Distances may be negative; the corners of such boxes are in the wrong order.
        valid = (scores > self.score_threshold) & (boxes[..., :2] < boxes[..., 2:]).all(-1)

        index, found = non_maximum_suppression(
            boxes, scores, labels, valid, self.nms_iou, self.max_detections
        )
        kept = boxes.gather(1, index.unsqueeze(-1).expand(-1, -1, 4))
        return Detections(
            boxes=kept.masked_fill(~found.unsqueeze(-1), 0.0),
            scores=scores.gather(1, index).masked_fill(~found, 0.0),
            labels=labels.gather(1, index).masked_fill(~found, 0),
            valid=found,
        )


def variant_of(state_dict: dict[str, Tensor], source: str | os.PathLike[str]) -> str:
    """The variant whose stem width, number of classes and kind of convolution a state dict has.

    Raises:
        TensorsimError: no variant has them.
    """
    stem, head = state_dict.get("backbone.stem.0.conv.weight"), state_dict.get("bbox_head.rtm_cls.0.weight")
    if stem is None or head is None:
        raise TensorsimError(
            f"{source}: got no backbone.stem.0 and bbox_head.rtm_cls.0, expected weights of RTMDet"
        )
    # Every variant has depthwise 5x5 convolutions; only those with separable convolutions throughout have 3x3 ones.
    depthwise = any(tensor.shape[1:] == (1, 3, 3) for tensor in state_dict.values())
    for variant, size in RTMDET_SIZES.items():
        if (stem.shape[0], head.shape[0], depthwise) == (
            int(64 * size.widen // 2),
            size.num_classes,
            size.depthwise,
        ):
            return variant
    raise TensorsimError(
        f"{source}: got {stem.shape[0]} channels in the stem and {head.shape[0]} classes, "
        f"expected those of one of {', '.join(RTMDET_SIZES)}"
    )

"""The ACF detector of people: boosted trees of depth two on aggregate channel features, in a soft cascade.

Source: see :mod:`tensorsim.vision.detection.acf_features`; P. Dollár, R. Appel, W. Kienzle, "Crosstalk cascades for
frame-rate pedestrian detection", ECCV 2012, for the constant cascade. Only people who stand or walk upright are found.
"""

import math
import os

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_count, check_images
from tensorsim.geometry.boxes import box_area, box_intersection
from tensorsim.types import Detections
from tensorsim.vision.detection.acf_features import CELL, CHANNELS, pyramid

#: Cells of a window, and pixels of the person in the middle of it.
ROWS, COLUMNS = 32, 16
PERSON_HEIGHT, PERSON_WIDTH = 100.0, 41.0
#: Trees that are evaluated before rejected windows are dropped.
_BLOCK = 32


def evaluate_trees(
    features: Tensor, base: Tensor, place: Tensor, threshold: Tensor, leaf: Tensor, score: Tensor
) -> Tensor:
    """Sums of trees of depth two after each of T trees, for W windows.

    A tree goes left where its feature is at most its threshold; leaves are left-left, left-right, right-left,
    right-right.

    Args:
        features: (C) values of a level, flattened.
        base: (W,) where each window begins in them.
        place: (T, 3) offsets of the features of the root and of its left and right child.
        threshold: (T, 3).
        leaf: (T, 4).
        score: (W,) sum of earlier trees.

    Returns:
        (W, T).
    """
    right = (features[base.unsqueeze(1) + place[:, 0]] > threshold[:, 0]).to(torch.int64)
    tree = torch.arange(len(place), device=place.device)
    value = features[base.unsqueeze(1) + place[tree, 1 + right]]
    end = 2 * right + (value > threshold[tree, 1 + right]).to(torch.int64)
    return score.unsqueeze(1) + leaf[tree, end].cumsum(1)


def suppress(boxes: Tensor, scores: Tensor, overlap: float, most: int) -> Tensor:
    """Indices of boxes (N, 4), best first, at most ``most``.

    None overlaps a better one by more than ``overlap`` of the area of the smaller of the two.
    """
    order: list[int] = scores.argsort(dim=0, descending=True, stable=True).tolist()
    kept: list[int] = []
    left = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    for i in order:
        if len(kept) < most and bool(left[i]):
            kept.append(i)
            smaller = torch.minimum(box_area(boxes), box_area(boxes[i]))
            left = left & (box_intersection(boxes, boxes[i]) <= overlap * smaller)
    return torch.tensor(kept, dtype=torch.int64, device=boxes.device)


class AcfDetector(nn.Module):
    """Finds upright people, with the interface of :class:`~tensorsim.vision.RTMDet`.

    Windows of 128x64 pixels, 4 apart, at eight scales per octave. A window is rejected as soon as the sum of its trees
    falls below ``cascade``. The score is ``sigmoid(sum - offset)``.

    Args:
        trees: number of trees; those of a new detector are empty, :meth:`from_pretrained` and training fill them.
        cascade: the sum below which a window is rejected.
        octaves_up: how often the image is first doubled in size: 0 finds people from 100 pixels tall on, 1 from 50.
        overlap: largest share of the smaller of two boxes that may overlap.
        score_threshold: detections score more than this.
        max_detections: K, the padded count.

    Shapes: images (B, 3, H, W) RGB, uint8 or float in [0, 1] -> :class:`~tensorsim.types.Detections` (B, K), boxes in
    pixels of the images. Not differentiable (trees).

    Raises:
        TensorsimError: settings out of range; another shape or dtype, an empty batch, values far from [0, 1], NaN.
    """

    feature: Tensor
    threshold: Tensor
    leaf: Tensor
    offset: Tensor

    def __init__(
        self,
        trees: int = 512,
        cascade: float = -1.0,
        octaves_up: int = 0,
        overlap: float = 0.65,
        score_threshold: float = 0.05,
        max_detections: int = 100,
    ) -> None:
        super().__init__()
        for name, count, least in (
            ("trees", trees, 1),
            ("max_detections", max_detections, 1),
            ("octaves_up", octaves_up, 0),
        ):
            check_count(count, f"AcfDetector.{name}", least)
        for name, share in (("overlap", overlap), ("score_threshold", score_threshold)):
            if not 0 <= share <= 1:
                raise TensorsimError(f"AcfDetector.{name}: got {share}, expected a number from 0 to 1")
        if math.isnan(cascade):
            raise TensorsimError("AcfDetector.cascade: got nan, expected a number")
        self.cascade, self.overlap, self.score_threshold = float(cascade), overlap, score_threshold
        self.octaves_up, self.max_detections = octaves_up, max_detections
        self.rows, self.columns, self.cell, self.block = ROWS, COLUMNS, CELL, _BLOCK
        self.left, self.top = (CELL * COLUMNS - PERSON_WIDTH) / 2, (CELL * ROWS - PERSON_HEIGHT) / 2
        self.person_width, self.person_height = PERSON_WIDTH, PERSON_HEIGHT
        self.register_buffer("feature", torch.zeros(trees, 3, dtype=torch.int64))
        self.register_buffer("threshold", torch.zeros(trees, 3))
        self.register_buffer("leaf", torch.zeros(trees, 4))
        self.register_buffer("offset", torch.zeros(1))

    def forward(self, images: Tensor) -> Detections:
        """People in images."""
        check_images(images)
        scaled = images.to(self.leaf.dtype) / (1.0 if images.is_floating_point() else 255.0)
        boxes = scaled.new_zeros(len(images), self.max_detections, 4)
        scores = scaled.new_zeros(len(images), self.max_detections)
        levels, scales = pyramid(scaled, self.rows, self.columns, self.octaves_up)
        for b in range(len(images)):
            found, score = self.windows([level[b] for level in levels], scales)
            score = torch.sigmoid(score - self.offset)
            sure = score > self.score_threshold
            found, score = found[sure], score[sure]
            best = suppress(found, score, self.overlap, self.max_detections)
            boxes[b, : len(best)], scores[b, : len(best)] = found[best], score[best]
        labels = torch.zeros(scores.shape, dtype=torch.int64, device=scores.device)
        return Detections(boxes, scores, labels, scores > 0)

    @torch.jit.export
    def windows(self, levels: list[Tensor], scales: list[float]) -> tuple[Tensor, Tensor]:
        """Boxes (N, 4) and sums (N,) of the windows of levels (10, h, w) that pass the whole cascade."""
        boxes = [self.leaf.new_zeros(0, 4)]
        sums = [self.leaf.new_zeros(0)]
        for level, scale in zip(levels, scales):  # noqa: B905  # TorchScript has no strict zip
            height, width = level.shape[-2], level.shape[-1]
            rows = torch.arange(height - self.rows + 1, device=level.device)
            columns = torch.arange(width - self.columns + 1, device=level.device)
            base = (rows.unsqueeze(1) * width + columns).flatten()
            alive, score = self.pass_cascade(level, base)
            row, column = torch.div(alive, width, rounding_mode="floor"), alive % width
            left, top = self.cell * column + self.left, self.cell * row + self.top
            corners = torch.stack([left, top, left + self.person_width, top + self.person_height], -1)
            boxes.append(corners.to(score.dtype) / scale)
            sums.append(score)
        return torch.cat(boxes), torch.cat(sums)

    def pass_cascade(self, level: Tensor, base: Tensor) -> tuple[Tensor, Tensor]:
        """Of windows that begin at ``base`` in a level (10, h, w), those that pass, and their sums."""
        height, width = level.shape[-2], level.shape[-1]
        cells = self.rows * self.columns
        channel = torch.div(self.feature, cells, rounding_mode="floor")
        row = torch.div(self.feature % cells, self.columns, rounding_mode="floor")
        place = (channel * height + row) * width + self.feature % self.columns
        values = level.flatten()
        score = torch.zeros(len(base), dtype=self.leaf.dtype, device=base.device)
        for first in range(0, len(place), self.block):
            last = first + self.block
            sums = evaluate_trees(
                values, base, place[first:last], self.threshold[first:last], self.leaf[first:last], score
            )
            kept = sums.amin(1) > self.cascade
            base, score = base[kept], sums[:, -1][kept]
        return base, score

    @classmethod
    def from_pretrained(
        cls, source: str | os.PathLike[str] | None = None, octaves_up: int = 0
    ) -> "AcfDetector":
        """The detector of a weight file, in evaluation mode.

        Args:
            source: a path, or a name from ``tensorsim models list``; None: the shipped weights.
            octaves_up: see the class.

        Raises:
            TensorsimError: no such file or name, or weights of another detector.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, cls.__name__)
        weights = load_state_dict(path)
        leaf = weights.get("leaf")
        if leaf is None or leaf.dim() != 2 or leaf.shape[1] != 4:
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of an AcfDetector"
            )
        detector = cls(len(leaf), octaves_up=octaves_up)
        load_strict(detector, weights, path)
        if int(detector.feature.min()) < 0 or int(detector.feature.max()) >= CHANNELS * ROWS * COLUMNS:
            raise TensorsimError(
                f"{path}: got features outside of a window, expected those of an AcfDetector"
            )
        return detector.eval()

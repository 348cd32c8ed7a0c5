"""RTMPose and other SimCC networks in ONNX files: each coordinate is found by classification.

T. Jiang et al., "RTMPose: Real-Time Multi-Person Pose Estimation based on MMPose" (arXiv 2303.07399); Y. Li et al.,
"SimCC: a Simple Coordinate Classification Perspective for Human Pose Estimation" (ECCV 2022).
"""

import os
from pathlib import Path

import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import MIRRORED
from tensorsim.config import COCO_KEYPOINTS
from tensorsim.errors import TensorsimError, check_floating
from tensorsim.vision.pose2d.onnx_file import OnnxFile, is_size, open_session
from tensorsim.vision.pose2d.topdown import TopDownPose


def has_simcc(path: str | os.PathLike[str]) -> bool:
    """Whether an ONNX file has the outputs of RTMPose.

    Raises:
        TensorsimError: no ONNX Runtime, or a file that it cannot read.
    """
    return {"simcc_x", "simcc_y"} <= {output.name for output in open_session(Path(path)).get_outputs()}


class RtmPose(TopDownPose):
    """RTMPose as mmdeploy exports it, run by ONNX Runtime, with the interface of :class:`TopDownPose`.

    Args:
        path: the ``.onnx`` file, with outputs ``simcc_x`` and ``simcc_y`` of 17 keypoints.
        flip_test: average with the mirror image: more accurate, at twice the cost.
        padding: boxes are enlarged by this factor; 1.25 as in training.
        crops_per_batch: largest number of crops in one batch of the network.

    Shapes: images (B, 3, H, W) RGB, uint8 or float in [0, 1], boxes (B, P, 4) ``xyxy`` pixels, valid (B, P) bool ->
    keypoints (B, P, 17, 2), ``uv`` pixels of the image, and scores (B, P, 17), from 0; both zero where not valid.

    Raises:
        TensorsimError: a file that is missing, unreadable or of another layout, arguments out of range; see
            :class:`TopDownPose` for those of forward.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        flip_test: bool = False,
        padding: float = 1.25,
        crops_per_batch: int = 32,
    ) -> None:
        network = OnnxSimcc(path, flip_test)
        super().__init__(
            network,
            SimccDecoder(network.bins_x, network.split),
            padding=padding,
            crops_per_batch=crops_per_batch,
        )


class OnnxSimcc(OnnxFile):
    """Crops (N, 3, H, W) RGB in [0, 1] -> scores (N, 17, X + Y) of X columns, then of Y rows.

    Column b is at b / split pixels of the crop, rows likewise.

    Args:
        path: the ``.onnx`` file.
        flip_test: average with the scores of the mirror image. Pixel u of the crop is W - 1 - u there, so that columns
            flipped back are ``split - 1`` too far to the right.

    Attributes:
        bins_x: X.
        split: columns per pixel, 2 for RTMPose.

    Raises:
        TensorsimError: see :class:`~tensorsim.vision.pose2d.onnx_file.OnnxFile`; outputs of another layout.
    """

    mirrored: Tensor

    def __init__(self, path: str | os.PathLike[str], flip_test: bool = False) -> None:
        super().__init__(
            path, "simcc_x (N or 1, 17, a multiple of W) and simcc_y (N or 1, 17, as many times H)"
        )
        shapes = {output.name: output.shape for output in self.session.get_outputs()}
        if not {"simcc_x", "simcc_y"} <= set(shapes):
            self.refuse()
        height, width = self.input_size
        x, y = shapes["simcc_x"], shapes["simcc_y"]
        fits = len(x) == len(y) == 3 and isinstance(x[2], int) and isinstance(y[2], int)
        if not fits or not all(is_size(shape[1], len(COCO_KEYPOINTS)) for shape in (x, y)):
            self.refuse()
        self.bins_x, self.bins_y, self.split = x[2], y[2], x[2] // width
        if self.split < 1 or (self.bins_x, self.bins_y) != (self.split * width, self.split * height):
            self.refuse()
        self.flip_test = flip_test
        self.register_buffer("mirrored", torch.tensor(MIRRORED), persistent=False)

    def forward(self, crops: Tensor) -> Tensor:
        """(N, 3, H, W) RGB in [0, 1] -> (N, 17, X + Y), of the crops' type and device."""
        self.check_crops(crops)
        if crops.shape[0] == 0:
            return crops.new_zeros(0, len(COCO_KEYPOINTS), self.bins_x + self.bins_y)
        x, y = self.run_on(crops, ["simcc_x", "simcc_y"])
        if self.flip_test:
            turned_x, turned_y = self.run_on(crops.flip(-1), ["simcc_x", "simcc_y"])
            late = self.split - 1
            turned_x = turned_x.flip(-1).index_select(1, self.mirrored)
            turned_x = torch.cat([turned_x[..., late:], turned_x[..., turned_x.shape[-1] - late :]], -1)
            x, y = (x + turned_x) / 2, (y + turned_y.index_select(1, self.mirrored)) / 2
        return torch.cat([x, y], -1)

    def extra_repr(self) -> str:
        """Whether mirror images are used, which the submodules do not show."""
        return f"flip_test={self.flip_test}"


class SimccDecoder(nn.Module):
    """Scores of columns and rows to points: the best of each, as in mmpose's ``get_simcc_maximum``.

    Args:
        bins_x: columns; the rest are rows.
        split: columns per pixel.

    Shapes:
        (..., X + Y) -> points (..., 2), ``uv`` in pixels of the crop, and scores (...), the lower one of the two,
        at least 0. Only the scores are differentiable.

    Raises:
        TensorsimError: no floats, or no rows.
    """

    def __init__(self, bins_x: int, split: int = 2) -> None:
        super().__init__()
        self.bins_x, self.split = bins_x, split

    def forward(self, scores: Tensor) -> tuple[Tensor, Tensor]:
        """(..., X + Y) -> points (..., 2) and scores (...)."""
        check_floating(scores, "SimccDecoder scores")
        if scores.shape[-1] <= self.bins_x:
            raise TensorsimError(
                f"SimccDecoder scores: got shape {list(scores.shape)}, expected more than {self.bins_x} columns and "
                "rows"
            )
        best_x, x = scores[..., : self.bins_x].max(dim=-1)
        best_y, y = scores[..., self.bins_x :].max(dim=-1)
        points = torch.stack([x, y], dim=-1).to(scores.dtype) / self.split
        return points, torch.minimum(best_x, best_y).clamp(min=0.0)

"""A small network for pictures whose columns are time, of any length."""

import os

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError


class PictureNet(nn.Module):
    """Four convolutions, then mean and maximum along time: when in a clip something happens matters little.

    Args:
        classes: number of classes.
        rows: height of the pictures, at least 8.
        channels: of the input.
        width: channels of the first convolution; the last has four times as many.

    Shapes: pictures (B, channels, rows, columns), any number of columns from 8 on -> logits (B, classes).
    Differentiable.

    Raises:
        TensorsimError: sizes that are too small; pictures of another shape.
    """

    def __init__(self, classes: int, rows: int, channels: int = 1, width: int = 16) -> None:
        super().__init__()
        if min(classes, channels, width) < 1 or rows < 8:
            raise TensorsimError(
                f"PictureNet: got {classes} classes, {rows} rows, {channels} channels and width {width}, expected at "
                f"least 1, 8, 1 and 1"
            )
        self.rows, self.channels = rows, channels
        sizes = [channels, width, 2 * width, 3 * width, 4 * width]
        layers: list[nn.Module] = []
        for i in range(4):
            layers.append(nn.Conv2d(sizes[i], sizes[i + 1], 3, padding=1, bias=False))
            layers += [nn.BatchNorm2d(sizes[i + 1]), nn.ReLU()]
            if i < 3:
                layers.append(nn.MaxPool2d(2))
        self.features = nn.Sequential(*layers)
        self.drop = nn.Dropout(0.3)
        self.head = nn.Linear(2 * sizes[-1] * (rows // 8), classes)

    def forward(self, pictures: Tensor) -> Tensor:
        """Pictures (B, C, H, W) to logits (B, classes)."""
        shape = list(pictures.shape)
        if len(shape) != 4 or shape[1] != self.channels or shape[2] != self.rows or shape[3] < 8:
            raise TensorsimError(
                f"pictures: got shape {shape}, expected (B, {self.channels}, {self.rows}, at least 8)"
            )
        maps = self.features(pictures)
        both = torch.cat([maps.mean(-1), maps.amax(-1)], dim=1).flatten(1)
        return self.head(self.drop(both))

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str]) -> "PictureNet":
        """Build the network that a weight file holds, in evaluation mode.

        Args:
            source: a path, or a name of ``tensorsim models list``.

        Raises:
            TensorsimError: no such file or name, or weights of another network.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, "PictureNet")
        weights = load_state_dict(path)
        first, last = weights.get("features.0.weight"), weights.get("head.weight")
        if first is None or first.dim() != 4 or last is None or last.dim() != 2:
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of a PictureNet"
            )
        width, channels = first.shape[:2]
        network = cls(last.shape[0], last.shape[1] // width, channels, width)
        load_strict(network, weights, path)
        return network.eval()

"""What the classifiers of map images share: their checks, their padding, and layers that several of them use."""

import os
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_floating,
    check_like_weights,
    check_not_empty,
)

Network = TypeVar("Network", bound="ImageClassifier")


def centred(pictures: Tensor, mean: Tensor, name: str) -> Tensor:
    """Images (..., C, H, W) as a batch (B, C, H, W), minus the mean (C,) of each channel.

    Raises:
        TensorsimError: another number of channels, dtype or device than that of the mean, no images, NaN.
    """
    check_floating(pictures, name)
    check_like_weights(pictures, mean, name)
    channels = mean.shape[0]
    if pictures.dim() < 3 or pictures.shape[-3] != channels:
        raise TensorsimError(
            f"{name}: got shape {list(pictures.shape)}, expected (..., {channels} channels, height, width)"
        )
    check_not_empty(pictures, name)
    check_finite(pictures, name)
    return pictures.reshape(-1, channels, pictures.shape[-2], pictures.shape[-1]) - mean.view(-1, 1, 1)


def as_pictures(logits: Tensor, pictures: Tensor) -> Tensor:
    """Logits (B, classes) with the leading dimensions of the images (..., C, H, W)."""
    shape = list(pictures.shape[:-3])
    shape.append(logits.shape[-1])
    return logits.reshape(shape)


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Padding (before, after) for an output of ``ceil(size / stride)``, as MATLAB's "same": an odd pixel goes after."""
    total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


class SameConv(nn.Module):
    """A 3x3 convolution whose output is ``ceil(size / stride)``.

    Args:
        in_channels, out_channels, stride, groups: of the convolution.
        padding: ``"matlab"``: see :func:`same_padding` (even sizes at stride 2: none before, one after);
            ``"torch"``: one on every side.
    """

    def __init__(
        self, in_channels: int, out_channels: int, stride: int = 1, groups: int = 1, padding: str = "matlab"
    ) -> None:
        super().__init__()
        self.matlab = padding == "matlab" and stride > 1  # both are equal at stride 1
        self.stride = stride
        self.conv = nn.Conv2d(
            in_channels, out_channels, 3, stride, padding=0 if self.matlab else 1, groups=groups
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', ceil(H / stride), ceil(W / stride))."""
        if self.matlab:
            top, bottom = same_padding(x.shape[-2], 3, self.stride)
            left, right = same_padding(x.shape[-1], 3, self.stride)
            x = F.pad(x, [left, right, top, bottom])
        return self.conv(x)


def glorot(layer: nn.Conv2d | nn.Linear) -> None:
    """Initial weights as in MATLAB: Glorot's uniform distribution for each group, bias 0."""
    weight = layer.weight
    receptive = weight[0, 0].numel()
    groups = layer.groups if isinstance(layer, nn.Conv2d) else 1
    inputs = weight.shape[1] * receptive
    outputs = weight.shape[0] // groups * receptive
    bound = (6 / (inputs + outputs)) ** 0.5
    nn.init.uniform_(weight, -bound, bound)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


def conv_norm(
    in_channels: int, out_channels: int, kernel: int, stride: int = 1, groups: int = 1, relu: bool = True
) -> nn.Sequential:
    """Convolution without bias, normalisation, and optionally ReLU."""
    layers: list[nn.Module] = [
        nn.Conv2d(in_channels, out_channels, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(out_channels),
    ]
    if relu:
        layers.append(nn.ReLU())
    return nn.Sequential(*layers)


class ChannelGate(nn.Module):
    """Weights of channels in (0, 1) from their means: squeeze and excitation, with biases.

    Source: J. Hu, L. Shen, G. Sun, "Squeeze-and-excitation networks", CVPR 2018.
    """

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(channels, hidden)
        self.excite = nn.Linear(hidden, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to weights (B, C, 1, 1)."""
        weights = torch.sigmoid(self.excite(torch.relu(self.squeeze(x.mean((-2, -1))))))
        return weights.unsqueeze(-1).unsqueeze(-1)


class ImageClassifier(nn.Module):
    """Images of radar maps to logits of activities: the checks and shapes of every classifier.

    A subclass calls this constructor, defines :meth:`logits`, and ends in a linear layer ``head``.

    Args:
        num_classes: number of classes.
        in_channels: 1 for one map, 2 for a range-time and a Doppler-time map, 3 for a colour image.

    Attributes:
        mean: (C,) mean of each channel over the training images, which is subtracted; part of the weights.

    Shapes: images (..., C, H, W) in [0, 1] -> logits (..., num_classes). Differentiable.

    Raises:
        TensorsimError: fewer than one class or channel; images with another number of channels, or NaN.
    """

    mean: Tensor

    def __init__(self, num_classes: int, in_channels: int) -> None:
        super().__init__()
        self.name = type(self).__name__
        check_count(num_classes, f"{self.name}.num_classes")
        check_count(in_channels, f"{self.name}.in_channels")
        self.num_classes, self.in_channels = num_classes, in_channels
        self.register_buffer("mean", torch.zeros(in_channels))

    def forward(self, pictures: Tensor) -> Tensor:
        """Images (..., C, H, W) to logits (..., num_classes)."""
        return as_pictures(self.logits(centred(pictures, self.mean, self.name)), pictures)

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, H, W) to logits (B, num_classes)."""
        raise NotImplementedError

    @classmethod
    def arguments(cls, weights: dict[str, Tensor]) -> dict[str, Any]:
        """Arguments of the constructor for these weights; KeyError or IndexError for weights of another network."""
        return {"num_classes": weights["head.weight"].shape[0], "in_channels": weights["mean"].shape[0]}

    @classmethod
    def from_pretrained(cls: type[Network], source: str | os.PathLike[str]) -> Network:
        """Build the network of a weight file, in evaluation mode.

        Args:
            source: a path, or a name from ``tensorsim models list``.

        Raises:
            TensorsimError: no such file or name, or weights of another network.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, cls.__name__)
        weights = load_state_dict(path)
        try:
            network = cls(**cls.arguments(weights))
        except (KeyError, IndexError):
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of {cls.__name__}"
            ) from None
        load_strict(network, weights, path)
        return network.eval()

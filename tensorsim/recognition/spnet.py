"""SPNet: the hybrid parallel-serial network, three blocks of six parallel branches, from a map's image to an activity.

Source: RadHARSimulator V2 (arXiv 2511.09022) and the layer list published with it. That list has no activations, so
that in evaluation mode the network is an affine function of the pixels; ``activation="none"`` builds exactly that, the
default has ReLU at the usual places.
"""

import os

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import TensorsimError, check_finite, check_floating, check_not_empty


def centred(pictures: Tensor, mean: Tensor, name: str) -> Tensor:
    """Images (..., C, H, W) as a batch (B, C, H, W), less the mean (C,) of each channel.

    Raises:
        TensorsimError: another number of channels, no images, NaN.
    """
    check_floating(pictures, name)
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


class ParallelBlock(nn.Module):
    """Normalisation, six parallel branches of three serial 3x3 convolutions, their fusion, and a shortcut.

    Branch i gives ``p_i = conv(conv(y))`` and ``q_i = conv(p_i)``; the twelve are concatenated and fused by a 1x1
    convolution. The six branches are computed as one convolution in six groups. Halves the size.
    """

    branches = 6

    def __init__(self, channels: int, out_channels: int, activation: str, padding: str) -> None:
        super().__init__()
        wide = self.branches * channels
        self.norm = nn.BatchNorm2d(channels)
        self.enter = nn.Conv2d(channels, channels, 1)
        self.halve = SameConv(channels, wide, stride=2, padding=padding)
        self.first = SameConv(wide, wide, groups=self.branches)
        self.second = SameConv(wide, wide, groups=self.branches)
        self.fuse = nn.Conv2d(2 * wide, out_channels, 1)
        self.shortcut = SameConv(channels, out_channels, stride=2, padding=padding)
        self.act: nn.Module = nn.ReLU() if activation == "relu" else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H / 2, W / 2)."""
        x = self.act(self.norm(x))
        p = self.act(self.first(self.act(self.halve(self.act(self.enter(x))))))
        q = self.act(self.second(p))
        return self.shortcut(x) + self.fuse(torch.cat([p, q], dim=1))


class SPNet(nn.Module):
    """SPNet: images of radar maps to activities.

    Args:
        num_classes: number of classes.
        in_channels: 1 for one map, 2 for a range-time and a Doppler-time map, 3 for a colour image.
        activation: ``"relu"``, or ``"none"`` for the published layer list, which is affine in evaluation mode.
        padding: ``"matlab"``, or ``"torch"`` for symmetric padding; see :class:`SameConv`.

    Attributes:
        mean: (C,) mean of each channel over the training images, which is subtracted; part of the weights.

    Shapes: images (..., C, H, W) in [0, 1], 224x224 in the paper -> logits (..., num_classes). Differentiable.
    11 055 660 parameters for 12 classes and 3 channels.

    Example:
        >>> SPNet(num_classes=12)(torch.rand(2, 1, 112, 112)).shape
        torch.Size([2, 12])

    Raises:
        TensorsimError: fewer than one class or channel, an unknown activation or padding; images with another number
            of channels, or NaN.
    """

    mean: Tensor

    def __init__(
        self, num_classes: int = 12, in_channels: int = 1, activation: str = "relu", padding: str = "matlab"
    ) -> None:
        super().__init__()
        if num_classes < 1 or in_channels < 1:
            raise TensorsimError(
                f"SPNet: got {num_classes} classes and {in_channels} channels, expected at least one of each"
            )
        if activation not in ("relu", "none"):
            raise TensorsimError(f"SPNet.activation: got {activation!r}, expected 'relu' or 'none'")
        if padding not in ("matlab", "torch"):
            raise TensorsimError(f"SPNet.padding: got {padding!r}, expected 'matlab' or 'torch'")
        self.num_classes, self.in_channels = num_classes, in_channels
        self.register_buffer("mean", torch.zeros(in_channels))
        self.conv1 = SameConv(in_channels, 12, stride=2, padding=padding)
        self.conv2 = SameConv(12, 24, stride=2, padding=padding)
        self.block1 = ParallelBlock(24, 96, activation, padding)
        self.block2 = ParallelBlock(96, 192, activation, padding)
        self.block3 = ParallelBlock(192, 384, activation, padding)
        self.conv6 = nn.Conv2d(384, 1024, 1)
        self.fc1 = nn.Linear(1024, 1024)
        self.fc2 = nn.Linear(1024, num_classes)
        self.act: nn.Module = nn.ReLU() if activation == "relu" else nn.Identity()
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                _glorot(module)

    def forward(self, pictures: Tensor) -> Tensor:
        """Images (..., C, H, W) to logits (..., num_classes)."""
        x = centred(pictures, self.mean, "SPNet")
        x = self.conv2(self.act(self.conv1(x)))
        x = self.act(self.block3(self.block2(self.block1(x))))
        x = self.act(self.conv6(x)).mean((-2, -1))
        return as_pictures(self.fc2(self.act(self.fc1(x))), pictures)

    @classmethod
    def from_pretrained(cls, source: str | os.PathLike[str] | None = None) -> "SPNet":
        """Build the network of a weight file, in evaluation mode.

        Args:
            source: a path, a name from ``tensorsim models list``, or None for the shipped weights.

        Raises:
            TensorsimError: no such file or name, or weights of another network.
        """
        from tensorsim.registry import locate
        from tensorsim.weights import load_state_dict, load_strict

        path = locate(source, "SPNet")
        weights = load_state_dict(path)
        first, last = weights.get("conv1.conv.weight"), weights.get("fc2.weight")
        if first is None or first.dim() != 4 or last is None or last.dim() != 2:
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of an SPNet"
            )
        network = cls(last.shape[0], first.shape[1])
        load_strict(network, weights, path)
        return network.eval()


def _glorot(layer: nn.Conv2d | nn.Linear) -> None:
    """Initial weights as in MATLAB: Glorot's uniform distribution for each branch, bias 0."""
    weight = layer.weight
    receptive = weight[0, 0].numel()
    groups = layer.groups if isinstance(layer, nn.Conv2d) else 1
    inputs = weight.shape[1] * receptive
    outputs = weight.shape[0] // groups * receptive
    bound = (6 / (inputs + outputs)) ** 0.5
    nn.init.uniform_(weight, -bound, bound)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)

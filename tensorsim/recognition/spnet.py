"""SPNet: the hybrid parallel-serial network, three blocks of six parallel branches, from a map's image to an activity.

Source: RadHARSimulator V2 (arXiv 2511.09022) and the layer list published with it. That list has no activations, so
that in evaluation mode the network is an affine function of the pixels; ``activation="none"`` builds exactly that, the
default has ReLU at the usual places.
"""

import os

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_choice, check_count
from tensorsim.recognition.blocks import SameConv, as_pictures, centred, glorot


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
        metadata: activation and padding, for the header of a weight file.

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
        check_count(num_classes, "SPNet.num_classes")
        check_count(in_channels, "SPNet.in_channels")
        check_choice(activation, ("relu", "none"), "SPNet.activation")
        check_choice(padding, ("matlab", "torch"), "SPNet.padding")
        self.num_classes, self.in_channels = num_classes, in_channels
        self.metadata = {"activation": activation, "padding": padding}
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
                glorot(module)

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
        from tensorsim.weights import load_state_dict, load_strict, read_metadata

        path = locate(source, "SPNet")
        weights = load_state_dict(path)
        first, last = weights.get("conv1.conv.weight"), weights.get("fc2.weight")
        if first is None or first.dim() != 4 or last is None or last.dim() != 2:
            raise TensorsimError(
                f"{path}: got the weights {', '.join(sorted(weights)[:3])}, ..., expected those of an SPNet"
            )
        stated = read_metadata(path)
        activation, padding = stated.get("activation", "relu"), stated.get("padding", "matlab")
        network = cls(last.shape[0], first.shape[1], activation, padding)
        load_strict(network, weights, path)
        return network.eval()

"""DIAT-RadHARNet: a small network of depthwise separable convolutions of several kernel sizes.

Source: M. Chakraborty, H. C. Kumawat, S. V. Dhavale, A. A. B. Raj, "DIAT-RadHARNet: A Lightweight DCNN for Radar Based
Classification of Human Suspicious Activities", IEEE Transactions on Instrumentation and Measurement 71 (2022), doi
10.1109/TIM.2022.3154832. Published (abstract): depthwise separable convolutions, kernels of several sizes on the same
input, channel weights, 213 793 parameters for 6 classes. Reconstructed: all sizes, chosen to give 213 783 parameters.
"""

import itertools

import torch
from torch import Tensor, nn

from tensorsim.recognition.blocks import ChannelGate, ImageClassifier, conv_norm


class SeparableBlock(nn.Module):
    """Depthwise convolutions 3x3, 5x5 and 7x7 of one input, weighted by channel, joined by a 1x1. Halves the size."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.depthwise = nn.ModuleList(
            [conv_norm(in_channels, in_channels, kernel, 2, in_channels) for kernel in (3, 5, 7)]
        )
        wide = 3 * in_channels
        self.gate = ChannelGate(wide, max(wide // 16, 4))
        self.pointwise = conv_norm(wide, out_channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H / 2, W / 2)."""
        scales: list[Tensor] = []
        for layer in self.depthwise:
            scales.append(layer(x))
        joined = torch.cat(scales, dim=1)
        return self.pointwise(joined * self.gate(joined))


class DIATRadHARNet(ImageClassifier):
    """DIAT-RadHARNet: a stem and five separable blocks.

    Args:
        num_classes: number of classes.
        in_channels: number of channels C of the images.

    Shapes: images (..., C, H, W) in [0, 1], 224x224 in the source -> logits (..., num_classes). Differentiable.
    213 783 parameters for 6 classes and 3 channels, 214 941 for 12.

    Raises:
        TensorsimError: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.
    """

    def __init__(self, num_classes: int = 12, in_channels: int = 1) -> None:
        super().__init__(num_classes, in_channels)
        widths = (32, 40, 56, 80, 144, 192)
        blocks = [SeparableBlock(a, b) for a, b in itertools.pairwise(widths)]
        self.body = nn.Sequential(conv_norm(in_channels, widths[0], 3, 2), *blocks)
        self.head = nn.Linear(widths[-1], num_classes)

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, H, W) to logits (B, num_classes)."""
        return self.head(self.body(x).mean((-2, -1)))

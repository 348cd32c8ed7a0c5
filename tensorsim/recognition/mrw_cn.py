"""MRW-CN: residual networks of three kernel sizes side by side, their channels and time steps weighted.

Source: Sensors 25 (2025) 197, doi 10.3390/s25010197. Published (abstract): parallel large-, medium- and small-scale
residual networks, weights over time and channels, contrastive pre-training and fine-tuning with few labels.
Reconstructed: kernels 7, 5 and 3, widths 16 to 128, two layers per residual block, the form of both weights. Trained
here on labels alone, as in the comparison of RadHARSimulator V2; the contrastive stage is left out.
"""

import torch
from torch import Tensor, nn

from tensorsim.recognition.blocks import ChannelGate, ImageClassifier, conv_norm


class ResidualLayer(nn.Module):
    """``relu(skip(x) + conv(relu(conv(x))))``, each convolution with normalisation."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int, stride: int) -> None:
        super().__init__()
        self.first = conv_norm(in_channels, out_channels, kernel, stride)
        self.second = conv_norm(out_channels, out_channels, kernel, relu=False)
        self.skip: nn.Module = nn.Identity()
        if stride > 1 or in_channels != out_channels:
            self.skip = conv_norm(in_channels, out_channels, 1, stride, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H / stride, W / stride)."""
        return torch.relu(self.skip(x) + self.second(self.first(x)))


class TimeChannelWeights(nn.Module):
    """Weights channels, then time steps (the last dimension), by gates in (0, 1)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channel = ChannelGate(channels, channels // 8)
        self.time = nn.Conv1d(2, 1, 7, padding=3)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same shape."""
        x = x * self.channel(x)
        outline = torch.stack([x.mean((1, 2)), x.amax((1, 2))], dim=1)
        return x * torch.sigmoid(self.time(outline)).unsqueeze(1)


class MRWCN(ImageClassifier):
    """MRW-CN, the multi-scale residual weighted classification network.

    Args:
        num_classes: number of classes.
        in_channels: number of channels C of the images.

    Shapes: images (..., C, H, W) in [0, 1], columns in time -> logits (..., num_classes). Differentiable.
    2 777 689 parameters for 12 classes and 3 channels.

    Raises:
        TensorsimError: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.
    """

    def __init__(self, num_classes: int = 12, in_channels: int = 1) -> None:
        super().__init__(num_classes, in_channels)
        self.branches = nn.ModuleList([self._branch(in_channels, kernel) for kernel in (7, 5, 3)])
        self.head = nn.Linear(3 * 128, num_classes)

    @staticmethod
    def _branch(in_channels: int, kernel: int) -> nn.Sequential:
        layers = [conv_norm(in_channels, 16, kernel, 2), nn.MaxPool2d(3, 2, 1)]
        channels = 16
        for width, stride in ((16, 1), (32, 2), (64, 2), (128, 2)):
            layers.append(ResidualLayer(channels, width, kernel, stride))
            channels = width
        return nn.Sequential(*layers, TimeChannelWeights(channels))

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, H, W) to logits (B, num_classes)."""
        scales: list[Tensor] = []
        for branch in self.branches:
            scales.append(branch(x).mean((-2, -1)))
        return self.head(torch.cat(scales, dim=1))

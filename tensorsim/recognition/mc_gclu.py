"""MC-GCLU: masked concatenation, then gated convolutions and a gated linear unit.

Based on the name alone: RadHARSimulator V2 (arXiv 2511.09022) compares with a "masked concatenation with gated
convolution and linear unit", of which no publication was found. Everything here is a reconstruction.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.recognition.blocks import ImageClassifier


class GatedConv(nn.Module):
    """``a * sigmoid(g)``, a and g the halves of one normalised 3x3 convolution."""

    def __init__(self, in_channels: int, out_channels: int, stride: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, 2 * out_channels, 3, stride, 1, bias=False)
        self.norm = nn.BatchNorm2d(2 * out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, C', H / stride, W / stride)."""
        return F.glu(self.norm(self.conv(x)), dim=1)


class MCGCLU(ImageClassifier):
    """MC-GCLU: the image, the image with patches masked, and the mask, through eight gated convolutions.

    In training a patch of 16x16 pixels is masked with a probability of 0.3, in evaluation none is.

    Args:
        num_classes: number of classes.
        in_channels: number of channels C of the images.

    Shapes: images (..., C, H, W) in [0, 1] -> logits (..., num_classes). Differentiable. 2 483 404 parameters for 12
    classes and 3 channels.

    Raises:
        TensorsimError: see :class:`~tensorsim.recognition.blocks.ImageClassifier`.
    """

    def __init__(self, num_classes: int = 12, in_channels: int = 1) -> None:
        super().__init__(num_classes, in_channels)
        self.patch, self.drop = 16, 0.3
        layers: list[nn.Module] = []
        channels = 2 * in_channels + 1
        for width in (32, 64, 128, 256):
            layers += [GatedConv(channels, width, 2), GatedConv(width, width, 1)]
            channels = width
        self.body = nn.Sequential(*layers)
        self.unit = nn.Linear(channels, 512)
        self.head = nn.Linear(256, num_classes)

    def mask(self, x: Tensor) -> Tensor:
        """Mask of the visible pixels of images (B, C, H, W): (B, 1, H, W) of 0 and 1."""
        height, width = x.shape[-2], x.shape[-1]
        if not self.training:
            return torch.ones_like(x[:, :1])
        rows, columns = -(-height // self.patch), -(-width // self.patch)
        kept = (torch.rand([x.shape[0], 1, rows, columns], device=x.device) >= self.drop).to(x.dtype)
        return kept.repeat_interleave(self.patch, 2).repeat_interleave(self.patch, 3)[..., :height, :width]

    def logits(self, x: Tensor) -> Tensor:
        """Centred images (B, C, H, W) to logits (B, num_classes)."""
        seen = self.mask(x)
        features = self.body(torch.cat([x, x * seen, seen], dim=1)).mean((-2, -1))
        return self.head(F.glu(self.unit(features), dim=1))

"""The network of RTMDet: CSPNeXt backbone, CSPNeXt-PAFPN neck, and a head with separate batch norms.

Lyu et al., "RTMDet: An Empirical Study of Designing Real-Time Object Detectors", 2022. Submodules carry the
names of the published checkpoints, and forward calls convolutions in the order of the published graphs.
Shapes: B images, c channels, h x w cells of a feature map.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class RTMDetSize(NamedTuple):
    """The numbers that define a variant.

    Attributes:
        deepen: factor on the number of blocks.
        widen: factor on the number of channels.
        num_classes: classes of the head.
        exp_on_reg: the head predicts the logarithm of the distances.
        depthwise: 3x3 convolutions are depthwise separable (the stem's are not).
        share_conv: the head's 3x3 convolutions are one for the three levels; their batch norms are not.
        input_size: side of the square input in pixels.
    """

    deepen: float
    widen: float
    num_classes: int
    exp_on_reg: bool
    depthwise: bool
    share_conv: bool
    input_size: int = 640


RTMDET_SIZES = {
    "nano-person": RTMDetSize(
        0.33, 0.25, 1, exp_on_reg=False, depthwise=True, share_conv=False, input_size=320
    ),
    # Not a published one: trains as fast as nano, with more capacity.
    "small-person": RTMDetSize(
        0.167, 0.25, 1, exp_on_reg=True, depthwise=False, share_conv=True, input_size=320
    ),
    "tiny": RTMDetSize(0.167, 0.375, 80, exp_on_reg=False, depthwise=False, share_conv=True),
    "s": RTMDetSize(0.33, 0.5, 80, exp_on_reg=False, depthwise=False, share_conv=True),
    "m": RTMDetSize(0.67, 0.75, 80, exp_on_reg=True, depthwise=False, share_conv=True),
    "l": RTMDetSize(1.0, 1.0, 80, exp_on_reg=True, depthwise=False, share_conv=True),
    "x": RTMDetSize(1.33, 1.25, 80, exp_on_reg=True, depthwise=False, share_conv=True),
    "m-person": RTMDetSize(0.67, 0.75, 1, exp_on_reg=True, depthwise=False, share_conv=True),
}


class ConvModule(nn.Module):
    """Convolution without bias, batch norm, SiLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
        # The published configurations override the 1e-3 of the classes they instantiate.
        self.bn = nn.BatchNorm2d(outputs, eps=1e-5)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) -> (B, outputs, h / stride, w / stride)."""
        return F.silu(self.bn(self.conv(x)), inplace=True)


class DepthwiseSeparable(nn.Module):
    """A convolution per channel, then one across channels, each with batch norm and SiLU."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.depthwise_conv = ConvModule(inputs, inputs, kernel, stride, groups=inputs)
        self.pointwise_conv = ConvModule(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) -> (B, outputs, h / stride, w / stride)."""
        return self.pointwise_conv(self.depthwise_conv(x))


def conv3x3(inputs: int, outputs: int, stride: int, depthwise: bool) -> nn.Module:
    """The 3x3 convolution of a variant."""
    if depthwise:
        return DepthwiseSeparable(inputs, outputs, 3, stride)
    return ConvModule(inputs, outputs, 3, stride)


class CSPNeXtBlock(nn.Module):
    """3x3, then depthwise separable 5x5, with the input added if ``identity``."""

    def __init__(self, channels: int, identity: bool, depthwise: bool) -> None:
        super().__init__()
        self.conv1 = conv3x3(channels, channels, 1, depthwise)
        self.conv2 = DepthwiseSeparable(channels, channels, 5)
        self.identity = identity

    def forward(self, x: Tensor) -> Tensor:
        """(B, c, h, w) -> the same."""
        y = self.conv2(self.conv1(x))
        if self.identity:
            y = y + x
        return y


class ChannelAttention(nn.Module):
    """Weights each channel by a gate, a function of the means of all channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, c, h, w) -> the same."""
        return x * F.hardsigmoid(self.fc(F.adaptive_avg_pool2d(x, 1)))


class CSPLayer(nn.Module):
    """Cross-stage partial layer: half the channels through the blocks, half past them."""

    def __init__(
        self, inputs: int, outputs: int, blocks: int, identity: bool, attention: bool, depthwise: bool
    ) -> None:
        super().__init__()
        middle = outputs // 2
        self.main_conv = ConvModule(inputs, middle, 1)
        self.short_conv = ConvModule(inputs, middle, 1)
        self.blocks = nn.Sequential(*[CSPNeXtBlock(middle, identity, depthwise) for _ in range(blocks)])
        self.attention = ChannelAttention(2 * middle) if attention else nn.Identity()
        self.final_conv = ConvModule(2 * middle, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, h, w) -> (B, outputs, h, w)."""
        short = self.short_conv(x)
        main = self.blocks(self.main_conv(x))
        return self.final_conv(self.attention(torch.cat([main, short], 1)))


class SPPBottleneck(nn.Module):
    """Spatial pyramid pooling: maxima over 5, 9 and 13 cells side by side."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = ConvModule(channels, channels // 2, 1)
        self.conv2 = ConvModule(2 * channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, c, h, w) -> the same."""
        x = self.conv1(x)
        # Chained maxima over 5 cells are the maxima over 9 and 13.
        pool5 = F.max_pool2d(x, 5, 1, 2)
        pool9 = F.max_pool2d(pool5, 5, 1, 2)
        pool13 = F.max_pool2d(pool9, 5, 1, 2)
        return self.conv2(torch.cat([x, pool5, pool9, pool13], 1))


class CSPNeXt(nn.Module):
    """Backbone: features at strides 8, 16 and 32 with ``channels``."""

    def __init__(self, size: RTMDetSize) -> None:
        super().__init__()
        c0, c1, c2, c3, c4 = [int(base * size.widen) for base in (64, 128, 256, 512, 1024)]
        n1, n2, n3, n4 = [max(round(n * size.deepen), 1) for n in (3, 6, 6, 3)]
        half = int(64 * size.widen // 2)
        depthwise = size.depthwise
        self.stem = nn.Sequential(
            ConvModule(3, half, 3, 2), ConvModule(half, half, 3), ConvModule(half, c0, 3)
        )
        self.stage1 = nn.Sequential(
            conv3x3(c0, c1, 2, depthwise), CSPLayer(c1, c1, n1, True, True, depthwise)
        )
        self.stage2 = nn.Sequential(
            conv3x3(c1, c2, 2, depthwise), CSPLayer(c2, c2, n2, True, True, depthwise)
        )
        self.stage3 = nn.Sequential(
            conv3x3(c2, c3, 2, depthwise), CSPLayer(c3, c3, n3, True, True, depthwise)
        )
        self.stage4 = nn.Sequential(
            conv3x3(c3, c4, 2, depthwise), SPPBottleneck(c4), CSPLayer(c4, c4, n4, False, True, depthwise)
        )
        self.channels = (c2, c3, c4)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, 3, h, w) -> (B, c2, h / 8, w / 8), (B, c3, h / 16, w / 16), (B, c4, h / 32, w / 32)."""
        c2 = self.stage2(self.stage1(self.stem(x)))
        c3 = self.stage3(c2)
        return c2, c3, self.stage4(c3)


class CSPNeXtPAFPN(nn.Module):
    """Neck: mixes the three levels top-down, then bottom-up; every level leaves with c2 channels."""

    def __init__(self, channels: tuple[int, int, int], size: RTMDetSize) -> None:
        super().__init__()
        c2, c3, c4 = channels
        n, depthwise = max(round(3 * size.deepen), 1), size.depthwise
        self.reduce_layers = nn.ModuleList([ConvModule(c4, c3, 1), ConvModule(c3, c2, 1)])
        self.top_down_blocks = nn.ModuleList(
            [
                CSPLayer(2 * c3, c3, n, False, False, depthwise),
                CSPLayer(2 * c2, c2, n, False, False, depthwise),
            ]
        )
        self.downsamples = nn.ModuleList([conv3x3(c2, c2, 2, depthwise), conv3x3(c3, c3, 2, depthwise)])
        self.bottom_up_blocks = nn.ModuleList(
            [
                CSPLayer(2 * c2, c3, n, False, False, depthwise),
                CSPLayer(2 * c3, c4, n, False, False, depthwise),
            ]
        )
        self.out_convs = nn.ModuleList([conv3x3(c, c2, 1, depthwise) for c in channels])

    def forward(self, features: tuple[Tensor, Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """(B, c2, h / 8, w / 8) and so on -> the same with c2 channels each."""
        p2, p3, p4 = features
        top = self.reduce_layers[0](p4)
        p3 = self.top_down_blocks[0](torch.cat([F.interpolate(top, scale_factor=2.0), p3], 1))
        middle = self.reduce_layers[1](p3)
        p2 = self.top_down_blocks[1](torch.cat([F.interpolate(middle, scale_factor=2.0), p2], 1))
        p3 = self.bottom_up_blocks[0](torch.cat([self.downsamples[0](p2), middle], 1))
        p4 = self.bottom_up_blocks[1](torch.cat([self.downsamples[1](p3), top], 1))
        return self.out_convs[0](p2), self.out_convs[1](p3), self.out_convs[2](p4)


class RTMDetSepBNHead(nn.Module):
    """Head: class logits and raw distances to left, top, right and bottom of every cell of every level."""

    def __init__(self, channels: int, size: RTMDetSize) -> None:
        super().__init__()
        self.cls_convs = self._towers(channels, size)
        self.reg_convs = self._towers(channels, size)
        self.rtm_cls = nn.ModuleList([nn.Conv2d(channels, size.num_classes, 1) for _ in range(3)])
        self.rtm_reg = nn.ModuleList([nn.Conv2d(channels, 4, 1) for _ in range(3)])
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.normal_(module.weight, std=0.01)
        prior = (
            0.01  # a fresh network takes one place in a hundred for an object (focal loss paper, section 4.1)
        )
        for name, parameter in self.rtm_cls.named_parameters():
            if name.endswith("bias"):
                nn.init.constant_(parameter, -math.log((1 - prior) / prior))

    @staticmethod
    def _towers(channels: int, size: RTMDetSize) -> nn.ModuleList:
        towers = [[conv3x3(channels, channels, 1, size.depthwise) for _ in range(2)] for _ in range(3)]
        if size.share_conv:
            for tower in towers[1:]:
                for module, first in zip(tower, towers[0], strict=True):
                    module.conv = first.conv
        return nn.ModuleList([nn.Sequential(*tower) for tower in towers])

    def forward(self, features: tuple[Tensor, Tensor, Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Three of (B, c, h, w) -> three of (B, classes, h, w), three of (B, 4, h, w)."""
        logits: list[Tensor] = []
        distances: list[Tensor] = []
        for cls_conv, reg_conv, rtm_cls, rtm_reg, x in zip(  # noqa: B905, TorchScript has no strict
            self.cls_convs, self.reg_convs, self.rtm_cls, self.rtm_reg, features
        ):
            logits.append(rtm_cls(cls_conv(x)))
            distances.append(rtm_reg(reg_conv(x)))
        return logits, distances

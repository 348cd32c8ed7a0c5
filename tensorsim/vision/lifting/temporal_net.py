"""The network of :class:`~tensorsim.vision.lifting.temporal_lifter.TemporalLifter`: dilated convolutions along time."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.vision.lifting.sight import FEATURES, Sight

#: Frames between the taps of each block's convolution.
DILATIONS = (1, 2, 4, 8, 8, 4)
#: Angular size of a body (:attr:`Sight.size`) at a distance of one body height, on average.
_MEAN_SIZE = 0.26


class Located(NamedTuple):
    """Joints in front of the camera, in the frame that faces the person, in body heights.

    Attributes:
        joints: (S, T, 14, 3) from the camera: to the right, away along the floor, up.
        log_spread: (S, T, 14, 2) logarithms of the mean absolute errors of joints about the hips, across the line of
            sight and along it, in body heights.
        log_range_spread: (S, T) the same of the logarithm of the distance of the hips.
    """

    joints: Tensor
    log_spread: Tensor
    log_range_spread: Tensor


class TimeBlock(nn.Module):
    """A convolution over three frames, ``dilation`` apart, and a linear layer per frame, with a shortcut."""

    def __init__(self, channels: int, dilation: int) -> None:
        super().__init__()
        self.dilation = dilation
        self.norm = nn.LayerNorm(channels)
        self.mix = nn.Linear(3 * channels, channels)
        self.out = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(S, T, channels) -> (S, T, channels)."""
        d, frames = self.dilation, x.shape[1]
        y = F.pad(self.norm(x), [0, 0, d, d])
        y = torch.cat([y[:, :frames], y[:, d : d + frames], y[:, 2 * d :]], dim=-1)
        return x + self.out(F.gelu(self.mix(y), approximate="tanh"))


class TemporalNet(nn.Module):
    """Maps tracks as a level camera sees them to joints in body heights; see :class:`Located`.

    Every joint lies on its line of sight, which the network may move a little (much where the keypoint is hidden or
    wrong), at the depth that the network gives. Each frame is estimated from ``reach`` frames before and after it.

    Args:
        channels: width; 256 makes 1.6 million parameters.
        dilations: of the blocks.

    Shapes:
        :class:`~tensorsim.vision.lifting.sight.Sight` of S tracks and T frames -> :class:`Located`. Differentiable.
    """

    def __init__(self, channels: int = 256, dilations: tuple[int, ...] = DILATIONS) -> None:
        super().__init__()
        self.reach = sum(dilations)
        self.enter = nn.Linear(FEATURES, channels)
        self.blocks = nn.ModuleList([TimeBlock(channels, dilation) for dilation in dilations])
        self.norm = nn.LayerNorm(channels)
        self.leave = nn.Linear(channels, 28 + 14 + 1 + 28 + 1)
        self.log_mean_size = math.log(_MEAN_SIZE)
        nn.init.zeros_(self.leave.weight)
        nn.init.zeros_(self.leave.bias)

    def forward(self, sight: Sight) -> Located:
        """Sight to Located."""
        # Sums over the blocks keep full precision where matrix products have a reduced one.
        x = self.enter(sight.features).to(sight.size.dtype)
        for block in self.blocks:
            x = block(x)
        shift, depth, size, spread, range_spread = self.leave(self.norm(x)).to(sight.size.dtype).split(
            [28, 14, 1, 28, 1], dim=-1
        )  # fmt: skip
        depth = depth - 0.5 * (depth[..., 8:9] + depth[..., 11:12])
        hips = ((size[..., 0] + self.log_mean_size).exp() / sight.size).clamp(0.1, 200.0)
        away = (hips[..., None] + depth).clamp(min=0.05)
        place = (sight.joints + shift.unflatten(-1, [14, 2])) * sight.size[..., None, None]
        joints = torch.stack(
            [place[..., 0] * away, away, (place[..., 1] + sight.elevation[..., None]) * away], dim=-1
        )
        spread = spread.clamp(-5.0, 5.0) - 3.0
        return Located(joints, spread.unflatten(-1, [14, 2]), range_spread[..., 0].clamp(-5.0, 5.0) - 3.0)

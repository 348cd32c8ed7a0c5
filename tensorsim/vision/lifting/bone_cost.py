"""The cost of distances along lines of sight for a body whose bones keep their length.

With r(t, j) the distance of joint j from the camera, r' that of the lifter, h that of the middle of the hips,
unknown bone lengths L and Cauchy's loss c(x) = log(1 + x^2), which limits the influence of large errors of the lifter:

    sum over t  sum over bones (|Xa - Xb| - L)^2 / sb^2  +  |r(t-1) - 2 r(t) + r(t+1)|^2 / (sa(t, j) dt^2)^2
                + w c(((r - h) - (r' - h')) / sl)  +  w c((h - h') / sh)       + sum over lengths log(L / L0)^2 / sL^2

If height and tilt of the camera are known, joints below the floor cost as well, and so does the distance of the lowest
joint from the height at which it rests.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.proportions import (
    FOREARM,
    HALF_HIPS,
    HALF_SHOULDERS,
    NOSE_FORWARD,
    NOSE_UP,
    SHANK,
    THIGH,
    TRUNK,
    UPPER_ARM,
)
from tensorsim.body.skeleton import BONES

#: Which of ``LENGTH_SHARES`` each of ``tensorsim.body.skeleton.BONES`` has: left and right limbs are equally long.
LENGTH_OF_BONE = (0, 1, 2, 3, 2, 3, 4, 5, 6, 5, 6, 7)
#: Neck to nose, shoulders, upper arm, forearm, hips, thigh, shank and trunk as shares of the standing height.
LENGTH_SHARES = (
    math.hypot(NOSE_FORWARD, NOSE_UP), 2 * HALF_SHOULDERS, UPPER_ARM, FOREARM, 2 * HALF_HIPS, THIGH, SHANK, TRUNK,
)  # fmt: skip
#: The joints whose distances are unknown: all but the neck, which is the middle of the shoulders.
FREE_JOINTS = (0, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13)


def expected_acceleration(across: Tensor, noise: Tensor, fps: float, least: float, ratio: float) -> Tensor:
    """Expected accelerations of joints along their lines of sight, from those across.

    Args:
        across: (S, T, J, 3) positions in metres, of which the component along the line of sight is unknown, T >= 3.
        noise: (S) standard deviation of each coordinate.
        fps: frames per second.
        least: m/s^2 of joints that rest in the image.
        ratio: of the expected acceleration to the root mean square of that across, of joint and body together.

    Returns:
        (S, T, J) m/s^2, smoothed over a fifteenth of a second.
    """
    square = (across[:, 2:] - 2 * across[:, 1:-1] + across[:, :-2]).square().sum(dim=-1)
    sigma = fps / 15.0
    radius = int(3 * sigma) + 1
    kernel = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, device=across.device) / sigma).square())
    kernel = (kernel / kernel.sum()).to(across.dtype)
    rows = square.transpose(1, 2).flatten(0, 1)[:, None]
    rows = F.conv1d(F.pad(rows, [radius + 1, radius + 1], mode="replicate"), kernel[None, None])
    smooth = rows.reshape(square.shape[0], square.shape[2], -1).transpose(1, 2)
    # Noise of variance s^2 has second differences of 6 s^2, in each of the two directions across.
    smooth = (smooth - 12 * noise.square()[:, None, None]).clamp(min=0.0) * fps**4
    return (least**2 + ratio**2 * (smooth + smooth.mean(dim=-1, keepdim=True))).sqrt()


class BoneClip(NamedTuple):
    """What is known about S people in T frames, for the 13 joints of ``FREE_JOINTS``.

    Attributes:
        lines: (S, T, 13, 3) unit lines of sight.
        given: (S, T, 13) distances of the lifter.
        lengths: (S, 8) expected lengths in metres, in the order of ``LENGTH_SHARES``.
        height: (S, T, 13, 2) of joints above where they rest on the floor: at distance 0, and the increase per metre.
        stiffness: (S, T + 2, 13) weights of squared second differences that end in a frame; 0 where there is none.
        footing: (S, T, 13) weights of squared heights of the lowest joint; 0 for hidden joints.
        hidden: (S, T, 12) additional variance in m^2 of bones to hidden joints.
    """

    lines: Tensor
    given: Tensor
    lengths: Tensor
    height: Tensor
    stiffness: Tensor
    footing: Tensor
    hidden: Tensor


class BoneCost(nn.Module):
    """The sum of the module's docstring and the terms of its gradient and Hessian (Gauss-Newton's).

    Args:
        length_share: sL, relative deviation of bodies from ``LENGTH_SHARES``.
        depth_m: sl, deviation of the given depths relative to the hips.
        range_m: sh, deviation of the given distance of the hips.
        trust: w, weight of what is given.
        floor_m: deviation of joints that are below the floor.
        has_floor: whether the floor is known.

    Shapes:
        clip, distances r (S, T, 13), logarithms of relative lengths ``stretch`` (S, 8), deviation of bones ``bone_m``
        (S) -> (S). Differentiable.
    """

    spread: Tensor
    bones: Tensor
    length_of_bone: Tensor

    def __init__(
        self,
        length_share: float,
        depth_m: float,
        range_m: float,
        trust: float,
        floor_m: float,
        has_floor: bool,
    ) -> None:
        super().__init__()
        self.length_share, self.depth_m, self.range_m = length_share, depth_m, range_m
        self.trust, self.floor_m, self.has_floor = trust, floor_m, has_floor
        self.floor_reach_m = 0.03  # a lowest joint further off the floor than this is probably in the air
        # All 14 joints and the middle of the hips from the 13 that are free.
        spread = torch.zeros(15, 13, dtype=torch.float64)
        for column, joint in enumerate(FREE_JOINTS):
            spread[joint, column] = 1.0
        spread[1], spread[14] = (spread[2] + spread[5]) / 2, (spread[8] + spread[11]) / 2
        bones = torch.stack([spread[a] - spread[b] for a, b in BONES])
        self.register_buffer("spread", spread, persistent=False)
        self.register_buffer("bones", bones, persistent=False)
        self.register_buffer("length_of_bone", torch.tensor(LENGTH_OF_BONE), persistent=False)

    def forward(self, clip: BoneClip, r: Tensor, stretch: Tensor, bone_m: Tensor) -> Tensor:
        """The cost (S)."""
        bend = (r[:, 2:] - 2 * r[:, 1:-1] + r[:, :-2]).square() * clip.stiffness[:, 2:-2]
        error = self.bone_errors(clip, r, stretch, bone_m)[2]
        cost = error.square().sum(dim=(1, 2)) + bend.sum(dim=(1, 2)) + self.given(clip, r)[2]
        cost = cost + (stretch / self.length_share).square().sum(dim=1)
        return cost + self.floor(clip, r)[2] if self.has_floor else cost

    def bone_errors(
        self, clip: BoneClip, r: Tensor, stretch: Tensor, bone_m: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Directions (S, T, 12, 3) of bones, expected lengths (S, 12), errors and their deviations (S, T, 12)."""
        vectors = torch.matmul(self.bones, r[..., None] * clip.lines)
        lengths = vectors.square().sum(dim=-1).clamp(min=1e-12).sqrt()
        expected = (clip.lengths * stretch.exp())[:, self.length_of_bone]
        deviation = (bone_m.square()[:, None, None] + clip.hidden).sqrt()
        return vectors / lengths[..., None], expected, (lengths - expected[:, None]) / deviation, deviation

    def given(self, clip: BoneClip, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Half the gradient (S, T, 13) and Hessian (S, T, 13, 13) of deviations from what is given, and cost (S)."""
        hips = self.spread[14]
        relative = torch.eye(13, dtype=hips.dtype, device=hips.device) - hips
        rows = torch.cat([relative, hips[None]])
        off = torch.matmul(r - clip.given, rows.t())
        scale = torch.cat([torch.full_like(hips, self.depth_m), hips.new_full((1,), self.range_m)])
        square = (off / scale).square()
        weight = self.trust / scale.square() / (1 + square)  # iteratively reweighted least squares
        hessian = torch.matmul(rows.t(), weight[..., None] * rows)
        return torch.matmul(weight * off, rows), hessian, self.trust * torch.log1p(square).sum(dim=(1, 2))

    def floor(self, clip: BoneClip, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Half the gradient and the diagonal of the Hessian (S, T, 13) of heights over the floor, and cost (S)."""
        over = clip.height[..., 0] + clip.height[..., 1] * r
        square = (over / self.floor_reach_m).square()
        # Geman and McClure's loss for the lowest joint, as none rests in a jump; others count only below the floor.
        lowest = F.one_hot(over.argmin(dim=-1), 13) * clip.footing
        sunk = ((over < 0) & (clip.footing > 0)).to(r.dtype) / self.floor_m**2
        weight = lowest / (1 + square).square() + sunk
        loss = lowest * self.floor_reach_m**2 * square / (1 + square) + sunk * over.square()
        slope = clip.height[..., 1]
        return weight * over * slope, weight * slope.square(), loss.sum(dim=(1, 2))

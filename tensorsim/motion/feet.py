"""Standing feet: inverse kinematics of the legs for given ankles, with constant bone lengths."""

from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.config import JOINTS
from tensorsim.motion.timing import minimum_jerk

RIGHT_LEG, LEFT_LEG = JOINTS.index("right_hip"), JOINTS.index("left_hip")

#: Up to the first fraction of its length a leg reaches exactly. Beyond it the leg straightens ever more slowly, since
#: with exact geometry the knee would snap, and never further than the sum of both numbers.
_EXACT_REACH, _LAST_STRETCH = 0.985, 0.0125


def soft_reach(wanted: Tensor, length: Tensor) -> Tensor:
    """Actual hip-to-ankle distance in m of a leg of this length, for a wanted distance."""
    excess = (wanted / length - _EXACT_REACH).clamp(min=0.0)
    stretch = _LAST_STRETCH * torch.tanh(excess / _LAST_STRETCH)
    return torch.minimum(wanted, _EXACT_REACH * length) + length * stretch


def two_bone_leg(hip: Tensor, ankle: Tensor, towards: Tensor, thigh: Tensor, shank: Tensor) -> Tensor:
    """A leg from the hip to an ankle (intersection of two circles, law of cosines).

    Args:
        hip, ankle: (..., 3) m; an ankle out of reach is approached along the straight line.
        towards: (..., 3) direction in which the knee points.
        thigh, shank: (...) m.

    Returns:
        (..., 3, 3) hip, knee and ankle.
    """
    line = ankle - hip
    wanted = line.norm(dim=-1)
    line = line / wanted[..., None]
    reach = soft_reach(wanted, thigh + shank)
    along = (thigh**2 - shank**2 + reach**2) / (2 * reach)
    beside = (thigh**2 - along**2).clamp(min=0.0).sqrt()
    bend = towards - (towards * line).sum(dim=-1, keepdim=True) * line
    bend = bend / bend.norm(dim=-1, keepdim=True)
    knee = hip + along[..., None] * line + beside[..., None] * bend
    return torch.stack([hip, knee, hip + reach[..., None] * line], dim=-2)


def place_ankles(joints: Tensor, ankles: Tensor, forward: Tensor, thigh: Tensor, shank: Tensor) -> Tensor:
    """Bend the legs of bodies (..., 14, 3) so that their ankles are at ``ankles`` (..., 2, 3), right and left.

    Knees keep their direction; straight legs bend ``forward`` (..., 3).
    """
    legs = []
    for side, first in ((0, RIGHT_LEG), (1, LEFT_LEG)):
        hip, knee, ankle = joints[..., first : first + 3, :].unbind(-2)
        towards = 2 * knee - hip - ankle + 0.1 * thigh[..., None] * forward
        legs.append(two_bone_leg(hip, ankles[..., side, :], towards, thigh, shank))
    return torch.cat([joints[..., :RIGHT_LEG, :], *legs], dim=-2)


class Tread(NamedTuple):
    """Steps of both feet, right and left.

    Attributes:
        hold: (B, T, 2) in [0, 1], weight with which a foot is fixed to the floor.
        since: (B, T, 2) cycles since (or, if negative, until) the nearest middle of a stance phase.
        step: (B, T, 2) int64, number of that step.
        other: (B, T, 2) int64, number of the step after it or, before its middle, of the step before it.
        moment: (B, K, 2) time of the middle of each step, with one extra step at either end.
    """

    hold: Tensor
    since: Tensor
    step: Tensor
    other: Tensor
    moment: Tensor


def tread(time: Tensor, cycle_s: Tensor, phase: Tensor, middle: float, hold: float, blend: float) -> Tread:
    """Stance times of the feet in a periodic gait.

    Args:
        time: (B, T) s.
        cycle_s: (B,) length of a cycle.
        phase: (B,) phase in cycles of the right leg at time 0; the left leg is half a cycle apart.
        middle: phase of the middle of stance.
        hold, blend: fractions of a cycle for which the foot is fixed, and over which its weight rises and
            falls; ``hold + 2 blend <= 1``.
    """
    begin = phase[:, None] + torch.tensor([0.0, 0.5], dtype=time.dtype) - middle  # (B, 2) at time 0
    cycles = (time / cycle_s[:, None])[..., None] + begin[:, None]
    number = torch.floor(cycles + 0.5)
    since = cycles - number
    share = ((hold / 2 + blend - since.abs()) / blend).clamp(0.0, 1.0)
    first = number.amin(dim=1, keepdim=True) - 1
    step = (number - first).to(torch.int64)
    numbers = first + torch.arange(int(step.max()) + 2, dtype=time.dtype)[:, None]
    other = torch.where(since < 0, step - 1, step + 1)
    moment = (numbers - begin[:, None]) * cycle_s[:, None, None]
    return Tread(minimum_jerk(share), since, step, other, moment)

"""A movement at given times, and the building blocks of activity scripts.

Here everybody is right-handed, starts at the origin and faces +y; times are in seconds, angles in degrees.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.body.gait import Gait, boulic_gait, cycle_s
from tensorsim.body.kinematics import BodyPose
from tensorsim.motion.feet import tread
from tensorsim.motion.people import People

_DEGREE = math.pi / 180
Pair = tuple[Tensor | float, Tensor | float]

#: Slightly bent hips and knees of quiet standing.
REST_HIP, REST_KNEE = 7.0, 14.0
#: How far walking lowers the hips so that both legs reach the floor, in leg lengths, and how much more per leg length
#: per second above a certain speed.
_WALKING_DROP, _FAST_DROP, _FAST = 0.018, 0.08, 2.2
#: Gait phase at which the body is over the standing foot.
STANDING = 0.24
#: Clearance of a swinging foot above the floor, in body heights.
SWING_LIFT = 0.03


class Act(NamedTuple):
    """A movement at given times (B, T).

    Attributes:
        pose: angles of the body.
        stance: angles that support the body: its ankles, weighted by ``support``, stay at the origin.
        support: (B, T, 2) weight on the right and left ankle, sum 1.
        offset: (B, T, 3) m, further displacement of the hips: right, forward, up.
        path: (B, T) m walked.
        hold: (B, T, 2) weight with which each foot is fixed to the floor, 0 to 1.
        moment: (B, K, 2) times that define where the feet are held, step by step.
        step: (B, T, 2) int64, index of the step at each time.
        other: (B, T, 2) int64, the step that the foot comes from or goes to.
        progress: (B, T, 2) towards that step, as a fraction of the way; None for feet that do not walk.
        lift: (B, T, 2) body heights by which a foot moving to another place is raised at the floor, less when it is
            higher up.
        level: (B, T, 2) 1 if a held foot stands on the floor, 0 if the body lies or the foot kicks.
    """

    pose: BodyPose
    stance: BodyPose
    support: Tensor
    offset: Tensor
    path: Tensor
    hold: Tensor
    moment: Tensor
    step: Tensor
    other: Tensor
    progress: Tensor | None
    lift: Tensor
    level: Tensor


class Vary:
    """Varies the numbers of a script, each with its own deviation per person, as columns (B, 1)."""

    def __init__(self, who: People) -> None:
        self.factor, self.used = who.factor, 0

    def __call__(self, nominal: float) -> Tensor:
        """The next number, varied."""
        self.used += 1
        return nominal * self.factor[:, self.used - 1 : self.used]


def share_of(who: People, factor: float) -> Tensor:
    """A pseudo-random number (B, 1) in [0, 1) for each person; different for each ``factor``."""
    return torch.remainder(who.gait_phase * factor, 1.0)[:, None]


def make_pose(
    time: Tensor,
    who: People,
    *,
    turn: Tensor | float = 0.0,
    lean: Tensor | float = 0.0,
    pitch: Tensor | float = 0.0,
    twist: Tensor | float = 0.0,
    nod: Tensor | float = 0.0,
    look: Tensor | float = 0.0,
    hip: Pair = (REST_HIP, REST_HIP),
    knee: Pair = (REST_KNEE, REST_KNEE),
    flexion: Pair = (2.0, 2.0),
    abduction: Pair = (8.0, 8.0),
    inward: Pair = (15.0, 15.0),
    elbow: Pair = (12.0, 12.0),
) -> BodyPose:
    """A pose (B, T) from angles in degrees; breathing moves the trunk by half a degree."""

    def angle(value: Tensor | float) -> Tensor:
        return torch.as_tensor(value, dtype=time.dtype).expand(time.shape) * _DEGREE

    def stack(*values: Tensor | float) -> Tensor:
        return torch.stack([angle(value) for value in values], dim=-1)

    breath = 0.5 * torch.sin(2 * math.pi * (0.25 * time + who.gait_phase[:, None]))
    arms = [stack(flexion[i], abduction[i], inward[i]) for i in (0, 1)]
    return BodyPose(
        heading=angle(turn),
        lean=angle(lean),
        roll=angle(0.0),
        trunk=stack(breath + pitch, 0.0, twist),
        pelvis=stack(0.0, 0.0),
        head=stack(nod, look),
        shoulder=torch.stack(arms, dim=-2),
        elbow=stack(*elbow),
        hip=torch.stack([stack(hip[0], 0.0), stack(hip[1], 0.0)], dim=-2),
        knee=stack(*knee),
    )


def on_the_spot(time: Tensor, pose: BodyPose) -> Act:
    """Both feet stay where they are."""
    pair = torch.ones((*time.shape, 2), dtype=time.dtype)
    zero = torch.zeros_like(time)
    return Act(
        pose,
        pose,
        support=pair / 2,
        offset=torch.zeros((*time.shape, 3), dtype=time.dtype),
        path=zero,
        hold=pair,
        moment=0 * pair[:, :1],
        step=torch.zeros_like(pair, dtype=torch.int64),
        other=torch.zeros_like(pair, dtype=torch.int64),
        progress=None,
        lift=0 * pair,
        level=pair,
    )


def upright_for(act: Act, share: Tensor) -> Act:
    """A movement whose feet carry the body only as far as ``share`` (B, T) is 1; otherwise the body lies."""
    feet = share[..., None]
    return act._replace(hold=act.hold * feet, lift=act.lift * feet, level=act.level * feet)


def tip_over(pose: BodyPose, tilt: Tensor, way: Tensor) -> BodyPose:
    """A pose tilted as a whole about its feet, without rotation about its long axis.

    Args:
        pose: pose of an upright body facing +y.
        tilt: (B, T) degrees from the vertical.
        way: direction of the tilt in radians, broadcastable to it: 0 ahead, a quarter turn to the right.
    """
    tilt = torch.deg2rad(tilt)
    right, ahead = torch.sin(way), torch.cos(way)
    # Rodrigues' rotation about the horizontal axis perpendicular to ``way``, as heading, roll and lean.
    back = 1 - torch.cos(tilt)
    return pose._replace(
        heading=torch.atan2(-back * right * ahead, 1 - back * right.square()),
        roll=torch.asin(right * torch.sin(tilt)),
        lean=torch.atan2(ahead * torch.sin(tilt), torch.cos(tilt)),
    )


def arms_on_floor(
    way: Tensor, spread: Tensor, overhead: Tensor | bool = False
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Flexion and abduction in degrees that lay the arms on the floor plane, for a body tipped over by a right angle.

    Args:
        way: as in :func:`tip_over`.
        spread: degrees between an arm and the long axis of the body.
        overhead: bool, whether the arms are stretched out over the head instead of beside the body.
    """
    spread = torch.deg2rad(spread) * torch.where(torch.cos(way) < 0, -1.0, 1.0)
    across = torch.atan2(torch.sin(way) * torch.sin(spread), torch.cos(spread))
    flexion = [
        torch.rad2deg(torch.where(torch.as_tensor(overhead), math.pi - x, x)) for x in (-across, across)
    ]
    abduction = torch.rad2deg(torch.asin(torch.cos(way) * torch.sin(spread)))
    return (flexion[0], flexion[1]), (abduction, abduction)


def _reach_ahead(who: People, gait: Gait) -> Tensor:
    """How far the ankles (B, T, 2) are ahead of a hip moving at constant speed, in leg lengths."""
    sizes = who.proportions
    thigh = torch.as_tensor(sizes.thigh / (sizes.thigh + sizes.shank))[:, None, None]
    leg = thigh * torch.sin(gait.hip) + (1 - thigh) * torch.sin(gait.hip - gait.knee)
    return leg + gait.translation[..., 1:2]


def with_gait(time: Tensor, who: People, base: BodyPose, pace: Tensor, path: Tensor) -> Act:
    """Add walking to another movement, with weight ``pace`` (B, T) between 0 and 1."""
    leg = (who.proportions.thigh + who.proportions.shank) * who.height_m
    relative_speed = who.speed_m_s / leg
    cycle = cycle_s(relative_speed)[:, None]
    phase = time / cycle + who.gait_phase[:, None]
    gait = boulic_gait(relative_speed, phase)
    rest = 1 - pace[..., None]
    share = pace[..., None]
    bend = torch.tensor([REST_HIP, 0.0], dtype=time.dtype) * _DEGREE
    hip = base.hip + share[..., None] * (torch.stack([gait.hip, 0 * gait.hip], dim=-1) - bend)
    hang = torch.stack([gait.shoulder, 0 * gait.shoulder, 0 * gait.shoulder], dim=-1)
    pose = base._replace(
        hip=hip,
        knee=base.knee + share * (gait.knee - REST_KNEE * _DEGREE),
        shoulder=base.shoulder + share[..., None] * hang,
        elbow=base.elbow * (rest + share * 0.3) + share * gait.elbow,
        trunk=base.trunk + share * gait.trunk,
        pelvis=base.pelvis + share * gait.pelvis,
        head=base.head - share * torch.stack([0 * phase, gait.trunk[..., 2]], dim=-1),
    )
    act = on_the_spot(time, base)
    further = _FAST_DROP * (relative_speed - _FAST).clamp(min=0.0)[:, None, None]
    drop = (_WALKING_DROP + further) * torch.tensor([0.0, 0.0, 1.0], dtype=time.dtype)
    # A foot is flat on the floor from 0.09 to 0.39 of its cycle; then the heel rises.
    steps = tread(time, cycle[:, 0], who.gait_phase, STANDING, 0.30, 0.17)
    # Between two steps the foot moves as in steady walking: with the hips, and ahead of or behind them.
    ahead = _reach_ahead(who, gait)
    still = boulic_gait(relative_speed, torch.full_like(time[:, :1], STANDING))
    ahead_still = _reach_ahead(who, still)[:, :, :1]
    stride = who.speed_m_s[:, None, None] * cycle[..., None]
    progress = steps.since + (ahead - ahead_still) * leg[:, None, None] / stride
    return act._replace(
        pose=pose,
        stance=base,
        offset=share * (gait.translation - drop) * leg[:, None, None],
        path=path,
        hold=steps.hold,
        moment=steps.moment,
        step=steps.step,
        other=steps.other,
        progress=torch.where(steps.since < 0, -progress, progress),
        lift=(SWING_LIFT + (leg / who.height_m)[:, None, None] * further) * (1 - steps.hold) ** 2,
    )

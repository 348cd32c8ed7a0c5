"""A seeded sampler of human poses as in activity videos, family by family.

The shipped pose library is built from it and from the activities (``tensorsim library build --generate N``).
"""

import math
from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.proportions import Proportions
from tensorsim.body.skeleton import mirror
from tensorsim.errors import TensorsimError

_DEGREE = math.pi / 180


class _Draw:
    """Seeded random numbers for ``count`` poses at once; angles in degrees in, radians out."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count, self.generator = count, generator

    def number(self, low: float, high: float, *tail: int) -> Tensor:
        u = torch.rand(self.count, *tail, generator=self.generator, dtype=torch.float64)
        return low + (high - low) * u

    def angle(self, low: float, high: float, *tail: int) -> Tensor:
        return self.number(low, high, *tail) * _DEGREE

    def jitter(self, degrees: float, *tail: int) -> Tensor:
        z = torch.randn(self.count, *tail, generator=self.generator, dtype=torch.float64)
        return degrees * _DEGREE * z

    def deviation(self, standard: float) -> Tensor:
        """One relative deviation per segment, (count, 7)."""
        tail = (self.count, len(Proportions._fields))
        z = torch.randn(*tail, generator=self.generator, dtype=torch.float64)
        return standard * z.clamp(-2, 2)

    def stack(self, *ranges: tuple[float, float], tail: tuple[int, ...] = ()) -> Tensor:
        """Angles (count, *tail, len(ranges)), each from its own range."""
        return torch.stack([self.angle(low, high, *tail) for low, high in ranges], dim=-1)


def _gait(
    draw: _Draw,
    stride: Tensor,
    swing_knee: Tensor,
    elbow: tuple[float, float],
    pitch: tuple[float, float],
) -> BodyPose:
    """A random phase of a gait cycle with hip excursion ``stride`` and flexion ``swing_knee`` in swing."""
    right = draw.number(0.0, 1.0)
    phase = torch.stack([right, right + 0.5], dim=-1)  # the legs are half a cycle apart

    def bump(centre: float, sharpness: float) -> Tensor:
        return torch.exp(sharpness * (torch.cos(2 * math.pi * (phase - centre)) - 1))

    # Phase 0 is heel strike: the thigh is in front, the knee flexes a little, then bends to swing through.
    swing = torch.cos(2 * math.pi * (phase - 0.95))
    hip = stride[:, None] * (0.2 + swing)
    knee = 4 * _DEGREE + 0.25 * swing_knee[:, None] * bump(0.14, 6.0) + swing_knee[:, None] * bump(0.73, 3.0)
    arm_swing = -draw.number(0.3, 1.2)[:, None] * stride[:, None] * swing
    pose = BodyPose.standing((draw.count,))
    shoulder = torch.stack(
        [arm_swing, draw.angle(2, 15, 1).expand(-1, 2), draw.angle(0, 35, 1).expand(-1, 2)], dim=-1
    )
    return pose._replace(
        hip=torch.stack([hip, draw.jitter(2.0, 2)], dim=-1),
        knee=knee,
        shoulder=shoulder,
        elbow=draw.angle(elbow[0], elbow[1], 1) + 0.4 * arm_swing.clamp(min=0),
        trunk=torch.stack(
            [draw.angle(*pitch) + 0.1 * stride, draw.jitter(2.0), -0.15 * (hip[:, 0] - hip[:, 1])], dim=-1
        ),
        pelvis=torch.stack([draw.jitter(2.0), 0.1 * (hip[:, 0] - hip[:, 1])], dim=-1),
    )


def _walk(draw: _Draw) -> BodyPose:
    return _gait(draw, draw.angle(8, 32), draw.angle(25, 70), (3, 40), (-14, 10))


def _run(draw: _Draw) -> BodyPose:
    return _gait(draw, draw.angle(28, 55), draw.angle(70, 125), (40, 115), (-8, 14))


def _any_arms(draw: _Draw) -> tuple[Tensor, Tensor]:
    """Shoulders (count, 2, 3) and elbows (count, 2) over the whole range, low and bent ones more often."""
    flexion = draw.angle(-45, 175, 2) * draw.number(0, 1, 2).sqrt()
    abduction = draw.angle(0, 110, 2) * draw.number(0, 1, 2)
    return torch.stack([flexion, abduction, draw.angle(-30, 80, 2)], dim=-1), draw.angle(0, 140, 2)


def _stand(draw: _Draw) -> BodyPose:
    knee = draw.angle(0, 15, 2)
    return BodyPose.standing((draw.count,))._replace(
        hip=torch.stack([0.5 * knee + draw.jitter(3.0, 2), draw.angle(0, 14, 2)], dim=-1),
        knee=knee,
        shoulder=draw.stack((-15, 25), (3, 25), (-10, 50), tail=(2,)),
        elbow=draw.angle(0, 50, 2),
        trunk=draw.stack((-12, 12), (-4, 4), (-8, 8)),
    )


def _reach(draw: _Draw) -> BodyPose:
    shoulder, elbow = _any_arms(draw)
    return _stand(draw)._replace(
        shoulder=shoulder, elbow=elbow, trunk=draw.stack((-5, 40), (-12, 12), (-30, 30))
    )


def _walk_and_reach(draw: _Draw) -> BodyPose:
    shoulder, elbow = _any_arms(draw)
    return _walk(draw)._replace(shoulder=shoulder, elbow=elbow)


def _punch(draw: _Draw) -> BodyPose:
    extended = draw.number(0, 1)  # 0 guard, 1 fist out; the other arm guards
    flexion = torch.stack([35 + 50 * extended, draw.number(25, 55)], dim=-1) * _DEGREE
    elbow = torch.stack([115 - 105 * extended, draw.number(90, 135)], dim=-1) * _DEGREE
    stance = draw.angle(0, 25)
    shoulder = torch.stack([flexion, draw.angle(0, 40, 2), draw.angle(0, 50, 2)], dim=-1)
    return BodyPose.standing((draw.count,))._replace(
        hip=torch.stack([torch.stack([-stance, stance], -1) + 8 * _DEGREE, draw.angle(2, 15, 2)], dim=-1),
        knee=draw.angle(5, 35, 2),
        shoulder=shoulder,
        elbow=elbow,
        trunk=torch.stack([draw.angle(0, 20), draw.jitter(4.0), 30 * _DEGREE * extended], dim=-1),
    )


def _kick(draw: _Draw) -> BodyPose:
    hip = torch.stack([draw.angle(-30, 110), draw.angle(-15, 15)], dim=-1)
    arms, elbow = _any_arms(draw)
    return BodyPose.standing((draw.count,))._replace(
        hip=torch.stack([hip, torch.stack([draw.angle(-10, 50), draw.angle(0, 15)], -1)], dim=-1),
        knee=torch.stack([draw.angle(0, 120), draw.angle(0, 35)], dim=-1),
        shoulder=arms * 0.6,
        elbow=elbow,
        trunk=draw.stack((-25, 20), (-15, 15), (-25, 25)),
    )


def _sit(draw: _Draw) -> BodyPose:
    down = draw.number(0, 1)  # 0 standing, 1 seated; the trunk bows on the way
    bow = 40 * torch.sin(math.pi * down) * draw.number(0.3, 1.3)
    hip = (95 * down[:, None] + draw.number(-8, 8, 2)) * _DEGREE
    knee = (92 * down[:, None] + 20 * torch.sin(math.pi * down)[:, None] + draw.number(-12, 12, 2)) * _DEGREE
    return BodyPose.standing((draw.count,))._replace(
        hip=torch.stack([hip, draw.angle(0, 18, 2)], dim=-1),
        knee=knee.clamp(min=0.0),
        shoulder=draw.stack((0, 70), (0, 25), (0, 50), tail=(2,)),
        elbow=draw.angle(0, 100, 2),
        trunk=torch.stack([bow * _DEGREE + draw.jitter(6.0), draw.jitter(4.0), draw.jitter(8.0)], dim=-1),
    )


def _squat(draw: _Draw) -> BodyPose:
    shoulder, elbow = _any_arms(draw)
    depth = draw.number(0, 1)
    return BodyPose.standing((draw.count,))._replace(
        hip=torch.stack([110 * _DEGREE * depth[:, None] + draw.jitter(8, 2), draw.angle(0, 25, 2)], dim=-1),
        knee=(130 * _DEGREE * depth[:, None] + draw.jitter(8, 2)).clamp(min=0.0),
        shoulder=shoulder,
        elbow=elbow,
        trunk=torch.stack([draw.angle(0, 50), draw.jitter(5.0), draw.jitter(12.0)], dim=-1),
    )


def _bend(draw: _Draw) -> BodyPose:
    return _stand(draw)._replace(
        trunk=draw.stack((15, 105), (-10, 10), (-25, 25)),
        shoulder=draw.stack((-10, 130), (0, 35), (-10, 50), tail=(2,)),
        hip=draw.stack((-15, 30), (0, 15), tail=(2,)),
        knee=draw.angle(0, 45, 2),
    )


def _fall(draw: _Draw) -> BodyPose:
    shoulder, elbow = _any_arms(draw)
    return BodyPose.standing((draw.count,))._replace(
        lean=draw.angle(-95, 95),
        roll=draw.jitter(25.0),
        hip=draw.stack((-15, 90), (0, 25), tail=(2,)) * draw.number(0, 1, 1, 1),
        knee=draw.angle(0, 115, 2) * draw.number(0, 1, 1),
        shoulder=shoulder,
        elbow=elbow * 0.7,
        trunk=draw.stack((-15, 50), (-12, 12), (-15, 15)),
    )


def _kneel(draw: _Draw) -> BodyPose:
    return BodyPose.standing((draw.count,))._replace(
        lean=draw.angle(0, 80),
        hip=draw.stack((0, 110), (0, 25), tail=(2,)),
        knee=draw.angle(30, 130, 2),
        shoulder=draw.stack((20, 130), (0, 40), (-10, 40), tail=(2,)),
        elbow=draw.angle(0, 90, 2),
        trunk=draw.stack((-20, 30), (-10, 10), (-12, 12)),
    )


def _jump(draw: _Draw) -> BodyPose:
    arms = draw.stack((-50, 180), (0, 50), (-20, 40), tail=(1,)).expand(-1, 2, -1)
    folded = draw.number(0, 1, 1)
    return BodyPose.standing((draw.count,))._replace(
        hip=torch.stack([70 * _DEGREE * folded + draw.jitter(8, 2), draw.angle(0, 15, 2)], dim=-1),
        knee=(100 * _DEGREE * folded + draw.jitter(10, 2)).clamp(min=0.0),
        shoulder=arms + draw.jitter(8.0, 2, 3),
        elbow=draw.angle(0, 60, 1) + draw.angle(0, 15, 2),
        trunk=torch.stack([draw.angle(-10, 35), draw.jitter(3.0), draw.jitter(5.0)], dim=-1),
    )


#: Families of poses in activity videos, and the relative frequency with which the sampler draws them.
_FAMILIES: tuple[tuple[Callable[[_Draw], BodyPose], float], ...] = (
    (_walk, 0.18),
    (_walk_and_reach, 0.08),
    (_run, 0.10),
    (_stand, 0.06),
    (_reach, 0.16),
    (_punch, 0.07),
    (_kick, 0.10),
    (_sit, 0.08),
    (_squat, 0.05),
    (_bend, 0.03),
    (_fall, 0.04),
    (_kneel, 0.02),
    (_jump, 0.03),
)


#: Number of families that :func:`sample_angles` knows.
FAMILIES = len(_FAMILIES)


def sample_angles(family: int, count: int, generator: torch.Generator) -> BodyPose:
    """Joint angles (count,) of random poses of one family, 0 to ``FAMILIES - 1``."""
    draw = _Draw(count, generator)
    pose = _FAMILIES[family][0](draw)
    return pose._replace(
        trunk=pose.trunk + draw.jitter(3.0, 3),
        head=pose.head + draw.jitter(10.0, 2),
        hip=pose.hip + draw.jitter(1.5, 2, 2),
        shoulder=pose.shoulder + draw.jitter(2.0, 2, 3),
    )


def sample_poses(count: int, seed: int = 0, limb_deviation: float = 0.0) -> Tensor:
    """Random human poses: gait phases, standing, reaching, punching, kicking, sitting, falling, jumping.

    Args:
        count: number of poses, at least one per family (13).
        seed: the same seed gives the same poses.
        limb_deviation: standard deviation of each segment length, relative to it, cut at 2 deviations.

    Returns:
        (count, 14, 3) float64 in body heights of the mean body, facing +y, relative to the middle of the hips.
    """
    if count < len(_FAMILIES):
        raise TensorsimError(f"sample_poses: got count {count}, expected at least {len(_FAMILIES)}")
    generator = torch.Generator().manual_seed(seed)
    edges = [0]
    for _, share in _FAMILIES:
        edges.append(edges[-1] + 1 + int(share * (count - len(_FAMILIES))))
    edges[-1] = count
    poses = []
    for family, (start, stop) in enumerate(pairwise(edges)):
        pose = sample_angles(family, stop - start, generator)
        draw = _Draw(stop - start, generator)
        limbs = (1 + draw.deviation(limb_deviation)).unbind(-1)
        body = Proportions(*(mean * limb for mean, limb in zip(Proportions(), limbs, strict=True)))
        poses.append(mirrored_half(forward_kinematics(pose, proportions=body)))
    return torch.cat(poses)


def mirrored_half(joints: Tensor) -> Tensor:
    """Replace every second pose of (L, 14, 3) by its mirror image, so that neither hand is preferred."""
    odd = torch.arange(joints.shape[0], device=joints.device)[:, None, None] % 2 == 1
    return torch.where(odd, mirror(joints), joints)

"""The twelve activities as moving bodies: joints in metres at any rate, seeded, batched."""

import math
from collections.abc import Callable
from numbers import Integral
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.body.kinematics import forward_kinematics, rotation
from tensorsim.body.proportions import ANKLE_HEIGHT, FLESH, Proportions
from tensorsim.body.skeleton import mirror
from tensorsim.config import ACTIVITIES
from tensorsim.config.documents import suggestion
from tensorsim.errors import TensorsimError, check_count, check_positive
from tensorsim.motion.act import Act
from tensorsim.motion.feet import LEFT_LEG, RIGHT_LEG, place_ankles
from tensorsim.motion.people import People, PeopleConfig, draw_people
from tensorsim.motion.resample import evaluate_cubic, natural_spline_curvature
from tensorsim.motion.scripts import SCRIPTS

#: Joints are computed at this rate and interpolated by a C2 spline: bone lengths are kept to micrometres.
_KNOT_HZ = 240.0
#: Extra knots beyond both ends of a clip, so that the spline's end conditions have no effect.
_MARGIN = 12
#: Sharpness of the contact with the floor, 1/m: bodies sink or float by less than a centimetre.
_FLOOR_SHARPNESS = 150.0
#: Swinging feet sink into the floor by no more than this.
_SINK_M = 0.003


class GeneratedMotion(NamedTuple):
    """Generated people in motion.

    Attributes:
        joints: (B, T, 14, 3) float64 world metres (x right, y away from the radar, z up), order of
            ``tensorsim.JOINTS``. If nobody is there (S1 Empty), a placeholder that stands still.
        valid: (B, T) bool, whether somebody is there.
        activity: (B,) int64 index into ``tensorsim.ACTIVITIES``.
        people: the people, to reproduce the motion.
    """

    joints: Tensor
    valid: Tensor
    activity: Tensor
    people: People


def activity_index(name: str) -> int:
    """Index of a class by its full name, its number ("S8") or its words alone, in any case.

    Raises:
        TensorsimError: no such class; the message lists them.
    """
    if not isinstance(name, str):
        raise TensorsimError(f"activity: got {name!r}, expected a name")
    wanted = name.strip().lower()
    for i, full in enumerate(ACTIVITIES):
        if wanted in (full.lower(), full.lower().split(" ", 1)[1], full.lower().split(" ", 1)[0]):
            return i
    words = [full.lower().split(" ", 1)[1] for full in ACTIVITIES]
    raise TensorsimError(
        f"activity: got {name!r}, expected one of {', '.join(ACTIVITIES)}{suggestion(wanted, words)}"
    )


def _carried(act: Act, who: People) -> Tensor:
    """Joints (B, T, 14, 3) of bodies resting on the floor, before their feet are fixed in place."""
    height = who.height_m[:, None]
    sizes = Proportions(*(torch.as_tensor(p)[:, None] for p in who.proportions))
    standing = forward_kinematics(act.stance, height, sizes)
    ankles = standing[..., (RIGHT_LEG + 2, LEFT_LEG + 2), :]
    anchor = (act.support[..., None] * ankles).sum(dim=-2)
    room = torch.full((14,), FLESH, dtype=standing.dtype)
    room[[RIGHT_LEG + 2, LEFT_LEG + 2]] = ANKLE_HEIGHT
    lack = room * height[..., None] - standing[..., 2]
    # Smooth maximum, exact for two feet side by side.
    lift = (torch.logsumexp(_FLOOR_SHARPNESS * lack, dim=-1) - math.log(2)) / _FLOOR_SHARPNESS
    spot = torch.stack([-anchor[..., 0], -anchor[..., 1], lift], dim=-1)
    turned = (rotation(2, act.pose.heading) @ act.offset[..., None])[..., 0]
    zero = torch.zeros_like(act.path)
    root = spot + turned + torch.stack([zero, act.path, zero], dim=-1)
    moving = standing if act.pose is act.stance else forward_kinematics(act.pose, height, sizes)
    return moving + root[..., None, :]


def _of_step(spots: Tensor, step: Tensor) -> Tensor:
    """Pick from the spots (B, K, 3) the one for the step (B, T) at each time."""
    return spots.gather(1, step[..., None].expand(-1, -1, 3))


def perform(script: Callable[[Tensor, People], Act], time: Tensor, who: People) -> Tensor:
    """Joints of people who follow a script, at the origin and facing +y, with feet that do not slide.

    While a script holds a foot, its ankle is moved to its position at the middle of the stance phase, on the floor,
    and the leg bends to reach it.

    Args:
        script: such as one of ``SCRIPTS``.
        time: (B, T) s.
        who: B people.

    Returns:
        (B, T, 14, 3) m.
    """
    act = script(time, who)
    joints = _carried(act, who)
    height = who.height_m[:, None]
    floor = (ANKLE_HEIGHT * height).expand_as(time)
    places = []
    for side, ankle in ((0, RIGHT_LEG + 2), (1, LEFT_LEG + 2)):
        then = script(act.moment[..., side], who)
        spots = _carried(then, who)[..., ankle, :]
        ground = torch.lerp(spots[..., 2], floor[:, :1].expand_as(spots[..., 2]), then.level[..., side])
        spots = torch.cat([spots[..., :2], ground[..., None]], dim=-1)
        held = _of_step(spots, act.step[..., side])
        swung = joints[..., ankle, :]
        place = swung[..., :2]
        lift = torch.zeros_like(time)
        if act.progress is not None:
            other = _of_step(spots, act.other[..., side])
            way = torch.lerp(held, other, act.progress[..., side, None])[..., :2]
            place = torch.lerp(place, way, act.level[..., side, None])
            steps_out = 1 - torch.exp(-(((other - held)[..., :2] / 0.1).square().sum(dim=-1)))
            near_floor = torch.exp((floor - swung[..., 2]) / (0.04 * height))
            lift = act.lift[..., side] * height * steps_out * near_floor
        # A swinging foot does not go through the floor either.
        above = floor + torch.nn.functional.celu(swung[..., 2] + lift - floor, alpha=_SINK_M)
        swung = torch.cat([place, above[..., None]], dim=-1)
        places.append(torch.lerp(swung, held, act.hold[..., side, None]))
    forward = (rotation(2, act.pose.heading) @ rotation(0, -act.pose.lean))[..., 1]
    thigh = torch.as_tensor(who.proportions.thigh)[:, None] * height
    shank = torch.as_tensor(who.proportions.shank)[:, None] * height
    return place_ankles(joints, torch.stack(places, dim=-2), forward, thigh, shank)


class ActivityGenerator:
    """Generates people who do one of the twelve activities.

    A data source, not a stage: it draws at random, computes in float64 on the CPU, and cannot be scripted. The
    same seed gives the same people and motion, whatever the rate.

    Movements are timed for a clip of 4 s. In longer clips walking, punching, kicking, grabbing and rotating continue;
    in the other activities people stay as they ended.

    Args:
        people: the distributions to draw from.

    Example:
        >>> motion = ActivityGenerator().generate("walking", batch=8, seed=1, rate_hz=30.0)
        >>> motion.joints.shape
        torch.Size([8, 120, 14, 3])
    """

    def __init__(self, people: PeopleConfig | None = None) -> None:
        self.config = PeopleConfig() if people is None else people

    def generate(
        self,
        activity: str | int | Tensor,
        batch: int | None = None,
        seed: int | torch.Generator = 0,
        duration_s: float = 4.0,
        rate_hz: float = 30.0,
        people: People | None = None,
    ) -> GeneratedMotion:
        """Motion of ``batch`` people.

        Args:
            activity: name ("S8 Walking", "walking", "S8") or index of a class for all, or one index per person,
                an integer tensor (B,), which then sets the batch.
            batch: number of people; default 1 unless ``activity`` is a tensor or ``people`` is given.
            seed: random seed, or a generator to draw from.
            duration_s: length of the clip.
            rate_hz: frame k is at ``k / rate_hz``; there are ``round(duration_s * rate_hz)`` frames.
            people: people to use instead of drawing them.

        Raises:
            TensorsimError: an unknown activity, a number that is not positive, a clip without a frame, different
                numbers of people, activities and ``batch``, or a speed beyond 3 leg lengths per second.
        """
        check_positive(duration_s, "duration_s")
        check_positive(rate_hz, "rate_hz")
        frames = round(duration_s * rate_hz)
        if frames < 1:
            raise TensorsimError(f"generate: got {duration_s} s at {rate_hz} Hz, expected at least one frame")
        if people is not None:
            people = people.double()
            if batch not in (None, people.height_m.shape[0]):
                raise TensorsimError(f"batch: got {batch} for {people.height_m.shape[0]} people")
            batch = people.height_m.shape[0]
        classes = self._classes(activity, batch)
        if people is None:
            generator = seed if isinstance(seed, torch.Generator) else torch.Generator().manual_seed(seed)
            people = draw_people(classes.shape[0], self.config, generator)
        # Knots cover the clip to its end, so that the path in range does not depend on the rate.
        knots = round(duration_s * _KNOT_HZ) + 1 + 2 * _MARGIN
        time = (torch.arange(knots, dtype=torch.float64) - _MARGIN) / _KNOT_HZ
        joints = torch.empty((classes.shape[0], knots, 14, 3), dtype=torch.float64)
        for index in classes.unique().tolist():
            chosen = torch.nonzero(classes == index)[:, 0]
            joints[chosen] = perform(SCRIPTS[index], time.expand(len(chosen), -1), people.take(chosen))
        joints = self._placed(joints, people)
        at = torch.arange(frames, dtype=torch.float64) * (_KNOT_HZ / rate_hz) + _MARGIN
        joints = evaluate_cubic(joints, natural_spline_curvature(joints, 1 / _KNOT_HZ), 1 / _KNOT_HZ, at)
        valid = (classes != 0)[:, None].expand(-1, frames).clone()
        return GeneratedMotion(joints, valid, classes, people)

    def _classes(self, activity: str | int | Tensor, batch: int | None) -> Tensor:
        if isinstance(activity, str):
            activity = activity_index(activity)
        if not isinstance(activity, Tensor):
            if not isinstance(activity, Integral) or isinstance(activity, bool):
                raise TensorsimError(
                    f"activity: got {activity!r}, expected a name, an index, or a tensor of indices"
                )
            count = 1 if batch is None else batch
            check_count(count, "batch")
            activity = torch.full((count,), int(activity), dtype=torch.int64)
        if activity.dtype not in (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64) or (
            activity.dim() != 1 or activity.shape[0] == 0
        ):
            raise TensorsimError(
                f"activity: got a tensor of {activity.dtype} and shape {list(activity.shape)}, expected (B,) integers"
            )
        if batch not in (None, activity.shape[0]):
            raise TensorsimError(f"generate: got {batch} people for {activity.shape[0]} activities")
        if not bool(((activity >= 0) & (activity < len(SCRIPTS))).all()):
            raise TensorsimError(
                f"activity: got indices {activity.tolist()}, expected 0 to {len(SCRIPTS) - 1}"
            )
        return activity.to(torch.int64).cpu()

    def _placed(self, joints: Tensor, people: People) -> Tensor:
        """Mirror left-handed people, then turn and place everybody in the world."""
        joints = torch.where(people.left_handed[:, None, None, None], mirror(joints), joints)
        turn = rotation(2, people.heading_rad)[:, None, None]
        joints = (turn @ joints[..., None])[..., 0]
        hips = joints[:, _MARGIN:-_MARGIN, (RIGHT_LEG, LEFT_LEG), :2].mean(dim=-2)
        near, far = self.config.keep_range_m
        y = hips[..., 1] + people.start_m[:, None, 1]
        closest, farthest = y.amin(dim=-1), y.amax(dim=-1)
        shift = (near - closest).clamp(min=0.0) - (farthest - far).clamp(min=0.0).minimum(
            (closest - near).clamp(min=0.0)
        )
        middle = (hips[..., 0].amin(dim=-1) + hips[..., 0].amax(dim=-1)) / 2
        place = torch.stack(
            [people.start_m[:, 0] - middle, people.start_m[:, 1] + shift, torch.zeros_like(shift)], dim=-1
        )
        return joints + place[:, None, None]

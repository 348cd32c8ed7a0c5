"""The twelve activities as people do them in daily life: any heading, place, time and speed, in many variants."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.config import ACTIVITIES
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured.motions import (
    KNOT_HZ,
    Draw,
    Unrest,
    act_out,
    add_unrest,
    along,
    at_instants,
    smooth_noise,
    to_and_fro,
)
from tensorsim.motion import everyday, exercises, martial_arts, scripts
from tensorsim.motion.act import Act
from tensorsim.motion.footwork import step_about
from tensorsim.motion.people import People, PeopleConfig, draw_people
from tensorsim.motion.timing import bell, segment

#: Bodies and ways of moving: untrained people, in all headings.
PEOPLE = PeopleConfig(
    height_m=(1.5, 1.95), speed_m_s=(0.6, 1.7), heading_rad=math.pi, variation=0.18, tempo=(0.55, 1.05)
)
#: Bounds of the middle of a path in metres: x to either side, and nearest and farthest y.
SIDE_M, RANGE_M = 1.2, (2.2, 6.5)
#: Shares of people who walk in curves, who walk round corners, and who walk round and round a room.
_STROLLING, _CORNERING, _ROUND = 0.2, 0.15, 0.35
#: Shortest and longest length of both sides of the paths of people who walk round and round, in metres.
_ROOM_M = ((0.8, 3.5), (0.5, 2.5))
#: Slowest and fastest clock of falls, whose speed is set by gravity.
_FALLING = (0.8, 1.05)
#: Steps per second of people who step about while doing something else.
_STEPS_HZ = 1.0


class Variant(NamedTuple):
    """A way to do an activity.

    Attributes:
        script: what is done.
        first_s: time of the script at which the movement begins.
        lasts_s: how long it takes; None for movements without end.
        share: share of the clips of its activity.
        rate: lowest and highest speed of the script's clock.
        steps: share of people who step about meanwhile.
        lunges: share of people who step far forward into the first blow, at time 0 of the script.
    """

    script: Callable[[Tensor, People], Act]
    first_s: float
    lasts_s: float | None
    share: float
    rate: tuple[float, float] = (0.75, 1.2)
    steps: float = 0.0
    lunges: float = 0.0


#: Variants by index of the activity; the first is the empty scene.
VARIANTS: tuple[tuple[Variant, ...], ...] = (
    (),
    (
        Variant(scripts.punch, 0.4, None, 0.25, (0.6, 1.2), steps=0.5),
        Variant(exercises.box, 0.0, None, 0.2, (0.6, 1.2), steps=0.5),
        Variant(martial_arts.swing_fist, 0.0, None, 0.3, (0.5, 1.2), steps=0.4),
        Variant(martial_arts.punch_once, 0.0, 1.0, 0.25, (0.6, 1.2), steps=0.5, lunges=0.6),
    ),
    (
        Variant(scripts.kick, 0.4, None, 0.4, (0.6, 1.2), steps=0.5),
        Variant(martial_arts.kick_round, 0.0, 1.2, 0.32, (0.6, 1.2), steps=0.5),
        Variant(everyday.juggle_ball, 0.0, None, 0.13, (0.6, 1.15), steps=0.5),
        # Few: a run-up to a ball looks like a walk.
        Variant(everyday.kick_ball, -0.8, 1.6, 0.15, (0.4, 1.15)),
    ),
    (
        Variant(scripts.grab, 0.3, None, 0.4, steps=0.2),
        Variant(exercises.pick_up, 0.0, 2.5, 0.6, (0.9, 2.8), 0.2),
    ),
    (Variant(scripts.sit_down, 0.8, 1.9, 1.0, (0.8, 1.7)),),
    (Variant(scripts.stand_up, 0.7, 2.0, 1.0, (0.8, 1.7)),),
    (Variant(scripts.rotate, 0.0, None, 1.0, (0.7, 1.3)),),
    (
        Variant(scripts.walk, 0.0, None, 0.65),
        Variant(everyday.walk_and_stop, -1.6, 2.6, 0.25, (0.8, 1.2)),
        Variant(everyday.walk_with_still_arms, 0.0, None, 0.1, (0.8, 1.2)),
    ),
    (Variant(scripts.sit_to_walk, 0.4, 2.4, 1.0, (0.75, 1.15)),),
    (Variant(scripts.walk_to_sit, 0.8, 2.8, 1.0, (0.8, 1.15)),),
    (Variant(scripts.fall_to_walk, 0.25, 2.6, 1.0, (0.7, 1.2)),),
    (
        Variant(scripts.walk_to_fall, 1.3, 1.8, 0.12, _FALLING),
        Variant(everyday.walk_and_fall_any_way, -0.2, 1.8, 0.21, _FALLING),
        Variant(everyday.walk_and_slip, -0.8, 2.2, 0.12, _FALLING),
        Variant(everyday.fall_any_way, 0.0, 1.8, 0.27, _FALLING),
        Variant(everyday.fall_onto_seat, 0.0, 1.4, 0.14, _FALLING),
        Variant(everyday.fall_on_knees, 0.0, 1.8, 0.14, _FALLING),
    ),
)


def _began(variant: Variant, duration_s: Tensor, rate: Tensor, draw: Draw) -> Tensor:
    """Start times (N, 1) in s, such that nearly all of the movement lies in the clip."""
    if variant.lasts_s is None:
        return draw(-1.5, 0.6)
    spare = (duration_s - 0.9 * variant.lasts_s / rate).clamp(min=0.1)
    return draw(0.0, 1.0) * spare + draw(-0.1, 0.0)


def _stroll(time: Tensor, people: People, draw: Draw) -> Tensor:
    """Joints (N, K, 14, 3) of people who walk in curves, some in circles, at a varying pace."""
    knots = time.shape[1]
    band = torch.full((len(time), 1), 0.15, dtype=torch.float64)
    bent, unsteady = smooth_noise(draw, knots, KNOT_HZ, band, 2).unbind(-1)
    rate = draw(-0.7, 0.7) + draw(0.0, 0.6) * bent  # rad/s
    heading = torch.cumsum(rate, dim=1) / KNOT_HZ
    pace = (1 - draw(0.0, 0.4) * unsteady).clamp(0.3, 1.25)
    return along(scripts.walk, heading, pace, people)


def _with_turns(
    time: Tensor,
    people: People,
    heading: Tensor | float,
    start: Tensor,
    lasts: Tensor,
    angle: Tensor,
    slower: Tensor,
) -> Tensor:
    """Joints (N, K, 14, 3) of people who walk straight and turn C times.

    Args:
        time: (N, K) seconds.
        people: N people.
        heading: (N, 1) initial heading relative to their own, in radians.
        start, lasts: (N, C) seconds.
        angle: (N, C) radians, counter-clockwise.
        slower: (N, C) share of the speed that is lost in the middle of a turn.
    """
    headings, pace = heading + torch.zeros_like(time), torch.ones_like(time)
    for c in range(start.shape[1]):
        first = start[:, c, None]
        last = first + lasts[:, c, None]
        headings = headings + segment(time, first, last) * angle[:, c, None]
        pace = pace - bell(time, first, last) * slower[:, c, None]
    return along(scripts.walk, headings, pace, people)


def _round_corners(time: Tensor, people: People, draw: Draw) -> Tensor:
    """Joints (N, K, 14, 3) of people who walk straight and turn at corners, as round a table or from room to room."""
    corners = 5
    start = torch.cumsum(draw(0.8, 3.0, corners), dim=1) - draw(0.0, 2.5)
    lasts = draw(0.4, 1.0, corners)
    # Most turn to the same side each time.
    side = torch.where(draw(0.0, 1.0) < 0.5, -1.0, 1.0) * torch.where(
        draw(0.0, 1.0, corners) < 0.8, 1.0, -1.0
    )
    angle = side * draw(0.6, 2.2, corners)
    return _with_turns(time, people, 0.0, start, lasts, angle, draw(0.0, 0.45, corners))


def _round_and_round(time: Tensor, people: People, draw: Draw) -> Tensor:
    """Joints (N, K, 14, 3) of people who walk round a room, most along its walls, which are square to the radar."""
    corners = 12
    side = torch.where(draw(0.0, 1.0) < 0.5, -1.0, 1.0).double()
    turns_s = draw(0.4, 1.1)
    walks_s = [torch.maximum(draw(*long_m) / people.speed_m_s[:, None], turns_s) for long_m in _ROOM_M]
    slower = draw(0.0, 0.4)
    along_walls = torch.round(draw(0.0, 4.0)) * (math.pi / 2) + draw(-0.3, 0.3) - people.heading_rad[:, None]
    heading = torch.where(draw(0.0, 1.0) < 0.7, along_walls, 0.0)
    first = -draw(0.0, 1.0) * (walks_s[0] + walks_s[1])
    middles = torch.cumsum(torch.cat([first, *(walks_s[c % 2] for c in range(corners - 1))], dim=1), dim=1)
    turns_s, angle, slower = (x.expand(-1, corners) for x in (turns_s, side * (math.pi / 2), slower))
    return _with_turns(time, people, heading, middles - turns_s / 2, turns_s, angle, slower)


def _with_pauses(clock: Tensor, draw: Draw) -> Tensor:
    """Clocks (N, K), half of which run unevenly: the person slows down or pauses now and then."""
    band = draw(0.2, 0.5)
    uneven = smooth_noise(draw, clock.shape[1], KNOT_HZ, band, 1)[..., 0]
    pace = torch.where(draw(0.0, 1.0) < 0.5, (0.8 + 0.6 * uneven).clamp(0.0, 1.2), 1.0)
    ticks = torch.diff(clock, dim=1, prepend=clock[:, :1]) * pace
    return clock[:, :1] + torch.cumsum(ticks, dim=1)


def _acted(variant: Variant, time: Tensor, duration_s: Tensor, people: People, draw: Draw) -> Tensor:
    """Joints (N, K, 14, 3) at ``KNOT_HZ`` near the origin, turned to the people's headings."""
    if variant.script is scripts.walk:
        # Half of those who walk in a straight line keep going, half turn round within a few metres.
        long = torch.where(draw(0.0, 1.0) < 0.5, 20.0, draw(1.5, 4.5))
        first = torch.where(long > 10, 0.0 * long, draw(0.0, 1.0) * long)
        straight = to_and_fro(variant.script, time, people, draw, long, draw(0.7, 1.6), first)
        way = draw(0.0, 1.0)[..., None, None]
        bent = torch.where(way < _STROLLING, _stroll(time, people, draw), _round_corners(time, people, draw))
        bent = torch.where(way < _STROLLING + _CORNERING, bent, _round_and_round(time, people, draw))
        return torch.where(way < _STROLLING + _CORNERING + _ROUND, bent, straight)
    rate = draw(*variant.rate)
    began = _began(variant, duration_s, rate, draw)
    clock = (time - began) * rate + variant.first_s
    if variant.lasts_s is None:
        clock = _with_pauses(clock, draw)
    joints = act_out(variant.script, clock, people)
    if variant.steps == 0 and variant.lunges == 0:
        return joints
    steps = round(_STEPS_HZ * float(duration_s.max()))
    # Mostly along the heading, to and fro.
    angle = people.heading_rad[:, None] + draw(-0.6, 0.6, steps)
    length = draw(-0.5, 0.8, steps) * draw(0.2, 1.0) * (draw(0.0, 1.0) < variant.steps)
    start = (torch.arange(steps) + draw(0.0, 0.5, steps)) / _STEPS_HZ
    lasts = draw(0.35, 0.7, steps)
    if variant.lunges > 0:
        lunges = draw(0.0, 1.0) < variant.lunges
        blow = began - variant.first_s / rate
        length = torch.where(lunges & ((start - blow).abs() < 1.0), 0.0, length)
        # The front foot comes down about when the fist arrives.
        angle = torch.cat([people.heading_rad[:, None], angle], 1)
        length = torch.cat([lunges * draw(0.4, 1.4), length], 1)
        start = torch.cat([blow - draw(0.25, 0.5) / rate, start], 1)
        lasts = torch.cat([draw(0.6, 0.85) / rate, lasts], 1)
    ahead = torch.stack([-torch.sin(angle), torch.cos(angle)], dim=-1)
    return step_about(joints, time, start, lasts, length[..., None] * ahead)


def everyday_motion(
    activity: int, count: int, duration_s: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """People who do an activity, each with their own variant, heading, place and time.

    Args:
        activity: index into ``tensorsim.ACTIVITIES``, except the empty scene.
        count: N people.
        duration_s: (N,) length of each clip.
        generator: random generator of everything.

    Returns:
        Joints (N, K, 14, 3) m at ``KNOT_HZ`` for the longest clip, z up from the floor, and heights (N,) m.

    Raises:
        TensorsimError: the empty scene, or no such activity.
    """
    if not 0 < activity < len(ACTIVITIES):
        raise TensorsimError(f"activity: got {activity}, expected 1 to {len(ACTIVITIES) - 1}")
    draw = Draw(count, generator)
    people = draw_people(count, PEOPLE, generator)
    variants = VARIANTS[activity]
    shares = torch.tensor([variant.share for variant in variants])
    kind = torch.multinomial(shares, count, replacement=True, generator=generator)
    knots = round(float(duration_s.max()) * KNOT_HZ) + 8
    time = torch.arange(knots, dtype=torch.float64) / KNOT_HZ
    joints = torch.empty(count, knots, 14, 3, dtype=torch.float64)
    for k in kind.unique().tolist():
        chosen = torch.nonzero(kind == k)[:, 0]
        some = Draw(len(chosen), generator)
        lengths = duration_s[chosen, None].double()
        joints[chosen] = _acted(variants[k], time.expand(len(chosen), -1), lengths, people.take(chosen), some)
    hips = joints[:, :, (8, 11), :2].mean(2)
    middle = (hips.amin(1) + hips.amax(1)) / 2
    spot = torch.cat([draw(-SIDE_M, SIDE_M), draw(*RANGE_M)], 1)
    # Nobody comes closer than 1.2 m.
    nearest = (hips[..., 1] - middle[:, None, 1] + spot[:, None, 1]).amin(1)
    spot[:, 1] += (1.2 - nearest).clamp(min=0.0)
    shift = torch.nn.functional.pad(spot - middle, (0, 1))
    joints = add_unrest(joints + shift[:, None, None], draw, Unrest((0.0, 0.01), (0.0, 0.03)))
    return joints, people.height_m


def at_rate(joints: Tensor, frames: int, rate_hz: float) -> Tensor:
    """Motion (K, 14, 3) at ``KNOT_HZ`` to (frames, 14, 3) at another rate."""
    return at_instants(joints[None], torch.arange(frames, dtype=torch.float64) / rate_hz)[0]


def bystander(duration_s: float, generator: torch.Generator) -> Tensor:
    """A bystander who stands or sits and hardly moves: joints (K, 14, 3) m at ``KNOT_HZ``."""
    draw = Draw(1, generator)
    people = draw_people(1, PEOPLE, generator)
    knots = round(duration_s * KNOT_HZ) + 8
    seated = bool(draw(0.0, 1.0) < 0.5)
    clock = torch.full((1, knots), 10.0 if seated else 0.0, dtype=torch.float64)
    joints = act_out(scripts.sit_down if seated else scripts.stand, clock, people)
    hips = joints[:, :1, (8, 11), :2].mean(2)
    spot = torch.cat([draw(-2.5, 2.5), draw(3.5, 7.0)], 1)[:, None]
    joints = joints + torch.nn.functional.pad(spot - hips, (0, 1))[:, :, None]
    return add_unrest(joints, draw, Unrest((0.003, 0.02), (0.0, 0.06)))[0]

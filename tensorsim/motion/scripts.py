"""What each of the activities does: joint angles over time, one function per class (see :mod:`.act`)."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from tensorsim.body.kinematics import BodyPose
from tensorsim.motion.act import (
    REST_HIP,
    REST_KNEE,
    SWING_LIFT,
    Act,
    Vary,
    make_pose,
    on_the_spot,
    upright_for,
    with_gait,
)
from tensorsim.motion.feet import tread
from tensorsim.motion.people import People
from tensorsim.motion.timing import bell, minimum_jerk, segment, there_and_back, toppling_angles, travel


def _repeated(time: Tensor, start: Tensor, period: Tensor) -> Tensor:
    """Seconds since the latest start of a repeating movement; negative before the first."""
    since = time - start
    return torch.where(since < 0, since, torch.remainder(since, period))


def stand(time: Tensor, who: People) -> Act:
    """Standing still, for a class in which nobody is seen."""
    return on_the_spot(time, make_pose(time, who))


def punch(time: Tensor, who: People) -> Act:
    """On guard; right and left fists shoot out alternately, every 0.6 s."""
    v = Vary(who)
    guard, fold, out, straight = v(35.0), v(115.0), v(85.0), v(10.0)
    turn, extend, back, every, first = v(25.0), v(0.16), v(0.28), v(0.6), v(0.4)
    extend, back, every = (duration / who.tempo[:, None] for duration in (extend, back, every))

    def fist(start: Tensor) -> Tensor:
        since = _repeated(time, start, 2 * every)
        return there_and_back(since, extend, 0.02, back)

    right, left = fist(first), fist(first + every)
    twist = turn * (right - left)
    bent = v(20.0)
    pose = make_pose(
        time,
        who,
        pitch=v(8.0),
        twist=twist,
        look=-twist,
        hip=(bent / 2, bent / 2),
        knee=(bent, bent),
        flexion=(guard + (out - guard) * right, guard + (out - guard) * left),
        abduction=(14 * (1 - right), 14 * (1 - left)),
        inward=(25 * (1 - right), 25 * (1 - left)),
        elbow=(fold + (straight - fold) * right, fold + (straight - fold) * left),
    )
    return on_the_spot(time, pose)


def kick(time: Tensor, who: People) -> Act:
    """The right leg is chambered, shot forward, drawn back and set down, every 1.8 s."""
    v = Vary(who)
    chamber, extend, recoil, lower = v(0.32), v(0.20), v(0.26), v(0.40)
    start, every, high, folded, more = v(0.4), v(1.8), v(75.0), v(105.0), v(15.0)
    since = who.tempo[:, None] * _repeated(time, start, every / who.tempo[:, None])
    t1 = chamber
    t2, t3 = t1 + extend, t1 + extend + recoil
    t4 = t3 + lower
    up = segment(since, 0 * t1, t1) - segment(since, t3, t4)
    shot = segment(since, t1, t2) - segment(since, t2, t3)
    poised = segment(since, 0 * t1, t1) - segment(since, t3, t4 + 0.1)
    swing = v(25.0) * poised
    pose = make_pose(
        time,
        who,
        pitch=-v(12.0) * poised,
        hip=(REST_HIP + (high - REST_HIP) * up + more * shot, REST_HIP),
        knee=(REST_KNEE + (folded - REST_KNEE) * up + (15 - folded) * shot, REST_KNEE),
        flexion=(10 - swing, 10 + swing),
        abduction=(18.0, 18.0),
        elbow=(50.0, 50.0),
    )
    act = on_the_spot(time, pose)
    aloft = segment(since, 0.0 * t1, 0.5 * t1) - segment(since, t4 - 0.5 * lower, t4)
    hold = torch.stack([1 - aloft, torch.ones_like(time)], dim=-1)
    support = torch.stack([0 * time, 0 * time + 1], dim=-1)
    # The hips shift over the standing foot.
    width = (who.proportions.half_hips * who.height_m)[:, None]
    zero = torch.zeros_like(time)
    offset = torch.stack([-0.7 * width * poised, zero, zero], dim=-1)
    return act._replace(hold=hold, support=support, offset=offset)


def grab(time: Tensor, who: People) -> Act:
    """Leans and reaches forward, holds, and draws the hands back with bent elbows."""
    v = Vary(who)
    reach, hold, back, start = v(0.9), v(0.35), v(1.0), v(0.3)
    since = _repeated(time, start, reach + hold + back + v(0.3))
    zero = torch.zeros_like(reach)
    drawn = segment(since, reach + hold, reach + hold + back)
    out = segment(since, zero, reach) - drawn
    pull = bell(since, reach + hold, reach + hold + back)
    arm, bow, bent, fold = v(80.0), v(35.0), v(16.0), v(82.0)
    knee = REST_KNEE + (bent - REST_KNEE) * out
    elbow = 12 + fold * pull
    pose = make_pose(
        time,
        who,
        pitch=bow * out,
        nod=-0.4 * bow * out,
        twist=10 * out,
        hip=(knee / 2 + 4 * out, knee / 2 + 4 * out),
        knee=(knee, knee),
        flexion=(2 + (arm - 2) * out, 2 + 0.85 * (arm - 2) * out),
        elbow=(elbow, elbow),
    )
    return on_the_spot(time, pose)


def _seat(time: Tensor, who: People, v: Vary, seated: Tensor, bow: Tensor) -> BodyPose:
    """Between standing (``seated`` 0) and sitting (1), the trunk leaning forward on the way."""
    passing = 4 * seated * (1 - seated)
    hip = REST_HIP + (90 - REST_HIP) * seated
    knee = REST_KNEE + (90 - REST_KNEE) * seated + v(16.0) * passing
    arm, elbow = 2 + (v(25.0) - 2) * seated, 12 + (v(60.0) - 12) * seated
    return make_pose(
        time,
        who,
        pitch=6 * seated + v(38.0) * bow,
        nod=-0.5 * v(30.0) * bow,
        hip=(hip, hip),
        knee=(knee, knee),
        flexion=(arm, arm),
        elbow=(elbow, elbow),
    )


def sit_down(time: Tensor, who: People) -> Act:
    """Sits down in 1.9 s."""
    v = Vary(who)
    start = v(0.8)
    end = start + v(1.9)
    return on_the_spot(time, _seat(time, who, v, segment(time, start, end), bell(time, start, end)))


def stand_up(time: Tensor, who: People) -> Act:
    """Stands up in 1.7 s; the trunk leans forward 0.3 s before the legs move."""
    v = Vary(who)
    start = v(1.0)
    end, lead = start + v(1.7), v(0.3)
    seated = 1 - segment(time, start, end)
    return on_the_spot(time, _seat(time, who, v, seated, bell(time, start - lead, end - lead)))


def rotate(time: Tensor, who: People) -> Act:
    """Full turns of 4 s each, stepping on the spot."""
    v = Vary(who)
    last, step = v(4.0), v(1 / 0.9)
    turns = time / last
    whole = torch.floor(turns)
    turn = 360 * (whole + minimum_jerk(turns - whole))
    phase = torch.stack([time / step, time / step + 0.5], dim=-1) + who.gait_phase[:, None, None]
    cycle = torch.remainder(phase, 1.0)
    lift = torch.sin(2 * math.pi * (cycle - 0.5)).square() * (cycle > 0.5)
    hip = (REST_HIP + v(15.0) * lift[..., 0], REST_HIP + v(15.0) * lift[..., 1])
    knee = (REST_KNEE + v(35.0) * lift[..., 0], REST_KNEE + v(35.0) * lift[..., 1])
    stance = make_pose(time, who, turn=turn, abduction=(15.0, 15.0))
    pose = make_pose(time, who, turn=turn, abduction=(15.0, 15.0), hip=hip, knee=knee)
    steps = tread(time, step[:, 0], who.gait_phase, 0.25, 0.25, 0.25)
    gone = minimum_jerk(((steps.since.abs() - 0.1) / 0.8).clamp(min=0.0))
    zero = torch.zeros_like(time)
    sway = 0.03 * torch.sin(2 * math.pi * phase[..., 0])  # over the standing foot
    return on_the_spot(time, pose)._replace(
        stance=stance,
        offset=torch.stack([sway, zero, zero], dim=-1),
        hold=steps.hold,
        moment=steps.moment,
        step=steps.step,
        other=steps.other,
        progress=gone,
        lift=SWING_LIFT * (1 - steps.hold),
    )


def walk(time: Tensor, who: People) -> Act:
    """Walks at a constant mean speed."""
    pace = torch.ones_like(time)
    return with_gait(time, who, make_pose(time, who), pace, who.speed_m_s[:, None] * time)


def sit_to_walk(time: Tensor, who: People) -> Act:
    """Rises from a seat and walks off."""
    v = Vary(who)
    start, end = v(0.4), v(1.9)
    seated = 1 - segment(time, start, end)
    base = _seat(time, who, v, seated, bell(time, start - 0.25, end - 0.25))
    go = end - 0.3
    pace = segment(time, go - 0.1, go + 0.7)
    return with_gait(time, who, base, pace, who.speed_m_s[:, None] * travel(time, go, go + 1.0))


def walk_to_sit(time: Tensor, who: People) -> Act:
    """Comes to a halt and sits down."""
    v = Vary(who)
    halt, last = v(1.0), v(1.7)
    still = halt + 1.0
    seated, bow = segment(time, still, still + last), bell(time, still, still + last)
    pace = 1 - segment(time, halt + 0.2, still + 0.05)
    path = who.speed_m_s[:, None] * (time - travel(time, halt, still))
    return with_gait(time, who, _seat(time, who, v, seated, bow), pace, path)


def over_the_knees(time: Tensor, who: People, v: Vary, down: Tensor, kneel: Tensor) -> BodyPose:
    """Between standing (``down`` 0) and lying prone (1), by way of the knees and hands where ``kneel`` is 1."""
    arms = 2 + 170 * down - 60 * kneel
    rest = 1 - 0.4 * down  # unloaded legs straighten
    return make_pose(
        time,
        who,
        lean=88 * down,
        pitch=v(20.0) * kneel,
        nod=-40 * down,
        hip=(rest * REST_HIP + v(95.0) * kneel, rest * REST_HIP + v(70.0) * kneel),
        knee=(rest * REST_KNEE + v(110.0) * kneel, rest * REST_KNEE + v(100.0) * kneel),
        flexion=(arms, arms),
        elbow=(12 + 20 * kneel, 12 + 20 * kneel),
    )


def fall_to_walk(time: Tensor, who: People) -> Act:
    """Lies prone, gets up by way of the knees and walks off."""
    v = Vary(who)
    start = v(0.25)
    end = start + v(1.6)
    down = 1 - segment(time, start, end)
    base = over_the_knees(time, who, v, down, bell(time, start, end))
    go = end + 0.15
    act = with_gait(
        time, who, base, segment(time, go, go + 1.0), who.speed_m_s[:, None] * travel(time, go, go + 1.0)
    )
    return upright_for(act, segment(time, end - 0.35, end))


_TOPPLING_STEP_S = 0.00025
_TOPPLING = toppling_angles(_TOPPLING_STEP_S, smooth_s=0.125)


def toppling(since: Tensor, height_m: Tensor) -> Tensor:
    """Degrees from the vertical, ``since`` seconds (B, T) after the start of a fall, for body heights (B,)."""
    at = since / (height_m[:, None] / 1.75).sqrt() / _TOPPLING_STEP_S
    at = at.clamp(0.0, len(_TOPPLING) - 1.001)
    before = torch.floor(at).long()
    return torch.lerp(_TOPPLING[before], _TOPPLING[before + 1], at - before)


def fall_tempo(who: People) -> Tensor:
    """Tempo (B, 1) of falls, limited to that of a fall without resistance."""
    return who.tempo[:, None].clamp(max=1.0)


def walk_to_fall(time: Tensor, who: People) -> Act:
    """Walks, stumbles, topples forward like a rod about the feet, and stays down."""
    v = Vary(who)
    trip, tempo = v(1.55), fall_tempo(who)
    down = toppling(tempo * (time - trip), who.height_m) / 88
    give = bell(time, trip, trip + 1.1 / tempo)
    arms = 2 + 170 * minimum_jerk(down)
    rest = 1 - 0.4 * down
    base = make_pose(
        time,
        who,
        lean=88 * down,
        nod=-40 * down,
        hip=(rest * REST_HIP + v(25.0) * give, rest * REST_HIP + v(25.0) * give),
        knee=(rest * REST_KNEE + v(45.0) * give, rest * REST_KNEE + v(45.0) * give),
        flexion=(arms, arms),
    )
    pace = 1 - segment(time, trip - 0.45, trip + 0.25)
    path = who.speed_m_s[:, None] * (time - travel(time, trip - 0.45, trip + 0.25))
    act = with_gait(time, who, base, pace, path)
    return upright_for(act, 1 - segment(time, trip + 0.4 / tempo, trip + 0.9 / tempo))


#: The scripts in the order of ``tensorsim.ACTIVITIES``.
SCRIPTS: tuple[Callable[[Tensor, People], Act], ...] = (
    stand,
    punch,
    kick,
    grab,
    sit_down,
    stand_up,
    rotate,
    walk,
    sit_to_walk,
    walk_to_sit,
    fall_to_walk,
    walk_to_fall,
)

"""Everyday variants of the twelve activities: falls in any direction, walks that come to a stop, kicks of balls.

Scripts as in :mod:`.scripts`. Those with a beginning begin at time 0; before that the person stands or walks up.
"""

import math

import torch
from torch import Tensor

from tensorsim.body.gait import cycle_s
from tensorsim.motion.act import (
    REST_HIP,
    REST_KNEE,
    STANDING,
    Act,
    Vary,
    arms_on_floor,
    make_pose,
    on_the_spot,
    share_of,
    tip_over,
    upright_for,
    with_gait,
)
from tensorsim.motion.people import People
from tensorsim.motion.scripts import fall_tempo, toppling
from tensorsim.motion.timing import GRAVITY, bell, landing, minimum_jerk, segment, there_and_back, travel


def fall_any_way(time: Tensor, who: People) -> Act:
    """Collapses and topples like a rod about the feet in any direction; stays down.

    Some sink first, with the knees strongly bent, and some fall stiffly; some stretch out their arms, and some keep
    them at their sides.
    """
    v = Vary(who)
    tempo = fall_tempo(who)
    tilt = toppling(tempo * time, who.height_m)
    down = tilt / 88
    way = 2 * math.pi * share_of(who, 7.0)
    sinking = share_of(who, 13.0)
    give = bell(time, 0.0 * v(1.0), v(1.3) / tempo)
    overhead = (share_of(who, 29.0) < 0.6) & (torch.cos(way) > 0)
    flexion, abduction = arms_on_floor(way, v(30.0), overhead)
    # People lying on their back have their knees up and their arms bent.
    supine = 0.5 * (1 - torch.cos(way))
    fold = v(50.0) * supine.square()
    bent = v(35.0) * supine * down
    knee = REST_KNEE * (1 - down) + 100 * sinking * give + 1.8 * bent
    hip = REST_HIP * (1 - down) + 55 * sinking * give + bent
    pose = make_pose(
        time,
        who,
        pitch=v(25.0) * sinking * give,
        nod=-30 * torch.cos(way) * down,
        hip=(hip, v(0.9) * hip),
        knee=(knee, v(0.9) * knee),
        flexion=(2 + (flexion[0] - 2) * down, 2 + (flexion[1] - 2) * down),
        abduction=(8 + (abduction[0] - 8) * down, 8 + (abduction[1] - 8) * down),
        elbow=(12 + (fold - 12) * down, 12 + (0.8 * fold - 12) * down),
    )
    act = on_the_spot(time, tip_over(pose, tilt, way))
    return upright_for(act, 1 - segment(time, 0.0 * tempo + 0.3, 0.9 / tempo))


def fall_on_knees(time: Tensor, who: People) -> Act:
    """Drops onto the knees, then forward onto the hands or the chest; stays down."""
    v = Vary(who)
    tempo = fall_tempo(who)
    drop, wait, over = v(0.55) / tempo, v(0.25), v(0.7) / tempo
    kneel = landing(time / drop)
    prone = minimum_jerk(((time - 1.2 * drop - wait) / over).clamp(0.0, 1.0))
    # Ends on hands and knees, or flat.
    on_hands = share_of(who, 13.0) < 0.3
    lean, bent, knees, arms, elbows = (
        torch.where(on_hands, one, other)
        for one, other in ((75.0, 88.0), (75.0, 3.0), (90.0, 6.0), (70.0, 168.0), (30.0, 10.0))
    )
    hip = REST_HIP + v(12.0) * kneel
    knee = REST_KNEE + (v(100.0) - REST_KNEE) * kneel
    arm, elbow = 2 + v(25.0) * kneel, 12 + v(30.0) * kneel
    arm, elbow = arm + (arms - arm) * prone, elbow + (elbows - elbow) * prone
    spread = 8 + v(20.0) * prone * torch.where(on_hands, 0.0, 1.0)
    pose = make_pose(
        time,
        who,
        lean=lean * prone,
        pitch=v(20.0) * kneel * (1 - prone),
        nod=-30 * prone,
        hip=(hip + (bent - hip) * prone, v(1.1) * hip + (bent - v(1.1) * hip) * prone),
        knee=(knee + (knees - knee) * prone, knee + (knees - knee) * prone),
        flexion=(arm, arm),
        abduction=(spread, spread),
        elbow=(elbow, elbow),
    )
    return upright_for(on_the_spot(time, pose), 1 - segment(time, 0.0 * drop, drop))


def fall_onto_seat(time: Tensor, who: People) -> Act:
    """The knees buckle; the person lands on the bottom and rolls onto the back, some to a side; stays down.

    This is how people fall when they know that there is a mat behind them.
    """
    v = Vary(who)
    tempo = fall_tempo(who)
    drop, over = v(0.75) / tempo, v(0.6) / tempo
    seated = landing(time / drop)
    lying = minimum_jerk(((time - 0.9 * drop) / over).clamp(0.0, 1.0))
    way = math.pi + math.radians(60.0) * (2 * share_of(who, 7.0) - 1) ** 3 * lying
    flexion, abduction = arms_on_floor(way, v(40.0))
    raised = v(25.0)
    hip = torch.lerp(REST_HIP + (v(100.0) - REST_HIP) * seated, raised.expand_as(seated), lying)
    knee = torch.lerp(REST_KNEE + (v(95.0) - REST_KNEE) * seated, 1.8 * raised.expand_as(seated), lying)
    back, spread = v(30.0) * seated, 8 + v(20.0) * seated
    fold = 12 + v(30.0) * seated
    pose = make_pose(
        time,
        who,
        pitch=v(30.0) * seated * (1 - lying),
        nod=v(15.0) * seated,
        hip=(hip, v(0.95) * hip),
        knee=(knee, v(0.95) * knee),
        flexion=(torch.lerp(2 - back, flexion[0], lying), torch.lerp(2 - v(0.9) * back, flexion[1], lying)),
        abduction=(torch.lerp(spread, abduction[0], lying), torch.lerp(spread, abduction[1], lying)),
        elbow=(fold, fold),
    )
    act = on_the_spot(time, tip_over(pose, 28 * seated + 60 * lying, way))
    return upright_for(act, 1 - segment(time, 0.3 * drop, drop))


def walk_and_fall_any_way(time: Tensor, who: People) -> Act:
    """Walks up, loses balance at time 0 and falls forward or to a side; stays down."""
    v = Vary(who)
    tempo = fall_tempo(who)
    tilt = toppling(tempo * time, who.height_m)
    down = tilt / 88
    way = math.pi * (share_of(who, 7.0) - 0.5)
    give = bell(time, 0.0 * v(1.0), v(1.2) / tempo)
    bent = v(60.0) * share_of(who, 13.0) * give
    rest = 1 - 0.8 * down
    reach = minimum_jerk(down)
    flexion, abduction = arms_on_floor(way, v(20.0), overhead=True)
    base = make_pose(
        time,
        who,
        nod=-30 * torch.cos(way) * down,
        hip=(rest * REST_HIP + 0.6 * bent, rest * REST_HIP + 0.5 * bent),
        knee=(rest * REST_KNEE + bent, rest * REST_KNEE + 0.9 * bent),
        flexion=(2 + (flexion[0] - 2) * reach, 2 + (flexion[1] - 2) * reach),
        abduction=(8 + (abduction[0] - 8) * reach, 8 + (abduction[1] - 8) * reach),
    )
    pace = 1 - segment(time, -0.45 + 0.0 * tempo, 0.25 + 0.0 * tempo)
    path = who.speed_m_s[:, None] * (time - travel(time, -0.45 + 0.0 * tempo, 0.25 + 0.0 * tempo))
    act = with_gait(time, who, tip_over(base, tilt, way), pace, path)
    return upright_for(act, 1 - segment(time, 0.4 / tempo, 0.9 / tempo))


def walk_and_slip(time: Tensor, who: People) -> Act:
    """Walks up and slips at time 0: the feet slide ahead and up; the person lands on the bottom, then on the back.

    The arms are flung up; the body keeps part of its walking speed for a moment.
    """
    v = Vary(who)
    tempo = fall_tempo(who)
    free_fall = (2 * 0.45 * who.height_m[:, None] / GRAVITY).sqrt()
    drop, over = torch.maximum(v(0.6) / tempo, 1.35 * free_fall), v(0.5) / tempo
    seated = landing(time / drop)
    lying = minimum_jerk(((time - drop) / over).clamp(0.0, 1.0))
    flung = bell(time, 0.0 * v(1.0), v(1.6) / tempo)
    one, other = v(65.0) * flung, v(40.0) * flung
    rest = 1 - seated
    bent = v(30.0) * lying * share_of(who, 13.0)
    way = math.pi + math.radians(50.0) * (2 * share_of(who, 7.0) - 1) ** 3 * lying
    flexion, abduction = arms_on_floor(way, v(35.0))
    spread, fold = 8 + v(40.0) * flung, 12 + v(30.0) * flung
    base = make_pose(
        time,
        who,
        pitch=v(25.0) * flung,
        nod=v(20.0) * seated,
        hip=(REST_HIP * rest + one + 0.6 * bent, REST_HIP * rest + other + 0.5 * bent),
        knee=(REST_KNEE * rest + 0.4 * one + bent, REST_KNEE * rest + 0.5 * other + 0.9 * bent),
        flexion=(
            2 + (flexion[0] - 2) * lying + v(100.0) * flung,
            2 + (flexion[1] - 2) * lying + v(90.0) * flung,
        ),
        abduction=(torch.lerp(spread, abduction[0], lying), torch.lerp(spread, abduction[1], lying)),
        elbow=(fold, fold),
    )
    start = -0.25 + 0.0 * tempo
    pace = 1 - segment(time, start, 0.3 + 0.0 * tempo)
    path = who.speed_m_s[:, None] * (time - travel(time, start, 0.7 + 0.0 * tempo))
    act = with_gait(time, who, tip_over(base, 45 * seated + 43 * lying, way), pace, path)
    # The hips come down about where they were: the feet, the pivot of the lean, slide ahead.
    slide = (0.35 + 0.25 * share_of(who, 29.0)) * who.height_m[:, None] * seated
    act = act._replace(offset=act.offset + torch.nn.functional.pad(slide[..., None], (1, 1)))
    return upright_for(act, 1 - segment(time, 0.0 * tempo, 0.25 + 0.0 * tempo))


def walk_and_stop(time: Tensor, who: People) -> Act:
    """Walks up, comes to a halt within 0.7 to 1.5 s from time 0, and stands."""
    start = torch.zeros_like(who.tempo[:, None])
    halt = 0.7 + 0.8 * share_of(who, 17.0)
    pace = 1 - segment(time, start, halt)
    path = who.speed_m_s[:, None] * (time - travel(time, start, halt))
    return with_gait(time, who, make_pose(time, who), pace, path)


def walk_with_still_arms(time: Tensor, who: People) -> Act:
    """Walks without swinging the arms: they hang, are folded, or hold something."""
    up, bent = 25.0 * share_of(who, 19.0), 110.0 * share_of(who, 23.0)
    base = make_pose(time, who, flexion=(up, up), abduction=(12.0, 12.0), elbow=(bent, 0.9 * bent))
    path = who.speed_m_s[:, None] * time
    act = with_gait(time, who, base, torch.ones_like(time), path)
    return act._replace(pose=act.pose._replace(shoulder=base.shoulder, elbow=base.elbow))


def kick_ball(time: Tensor, who: People) -> Act:
    """Walks or runs up to a ball, kicks it at time 0 with a straight swing of the leg, and stops or runs on a little.

    In captured ball kicks people run up for half a second to two seconds, most of them ever faster, with the kicking
    side turned back by 30 to 60 degrees until the leg swings through; at the kick the hips move at 2 to 3.5 m/s and
    the foot at 10 m/s, and people come to rest within a second. At a lower ``tempo`` the leg swings less far in the
    same time.
    """
    v = Vary(who)
    far = who.tempo[:, None].clamp(max=1.0)
    leg_m = (who.proportions.thigh + who.proportions.shank) * who.height_m
    # The gait model is valid up to 3 leg lengths per second.
    quick = torch.minimum(who.speed_m_s * (1.1 + share_of(who, 29.0)[:, 0]), 2.9 * leg_m)
    cycle = cycle_s(quick / leg_m)[:, None]
    # The left foot is planted beside the ball; half a cycle earlier the right one stood.
    planted = 0.06
    runner = who._replace(speed_m_s=quick, gait_phase=STANDING - 0.5 - planted / cycle[:, 0])
    lifted, back, through = planted - 0.35 * cycle, -v(0.08), v(0.22)
    landed = through + v(0.32)
    drawn = segment(time, lifted, back) - segment(time, back, through - 0.1)
    shot = segment(time, back, through) - segment(time, through, landed)
    # The knee bends first, and stays bent until the thigh is past the vertical.
    folded = segment(time, lifted - 0.08, back - 0.04) - segment(time, back + 0.04, through)
    poised = bell(time, lifted, landed)
    swing = v(6.0) * (shot - drawn)
    angled = 45.0 * share_of(who, 31.0)
    base = make_pose(
        time,
        who,
        turn=angled * (segment(time, back - 0.1, landed) - 1),
        pitch=v(12.0) * poised - v(15.0) * far * shot,
        twist=v(10.0) * (drawn - shot),
        hip=(REST_HIP - v(15.0) * far * drawn + v(45.0) * far * shot, REST_HIP + 5 * poised),
        knee=(REST_KNEE + v(45.0) * far * folded, REST_KNEE + v(12.0) * poised),
        flexion=(2 - swing, 2 + swing),
        abduction=(8 + v(10.0) * poised, 8 + v(15.0) * poised),
        elbow=(12 + 20 * poised, 12 + 20 * poised),
    )
    start = -0.8 - 1.9 * share_of(who, 7.0)
    top = torch.lerp(start + 0.5, -0.2 + 0 * start, share_of(who, 19.0))  # some run faster and faster
    stop, still = -0.2 + 0 * back, 0.4 + 0.6 * share_of(who, 13.0)
    pace = segment(time, start, top) - segment(time, stop, still)
    gone_s = travel(time, start, top) - travel(time, stop, still)
    act = with_gait(time, runner, base, pace, quick[:, None] * gone_s)
    aloft = segment(time, lifted, lifted + 0.1) - segment(time, landed - 0.1, landed)
    free = torch.stack([1 - aloft, torch.ones_like(aloft)], dim=-1)
    # The kicking foot makes its step where it comes down.
    kicks = (act.moment > planted) & (act.moment < landed[..., None]) & torch.tensor([True, False])
    return act._replace(
        hold=act.hold * free,
        lift=act.lift * free,
        level=free,
        moment=torch.where(kicks, landed[..., None], act.moment),
        # The standing leg carries the body, not the kicking one.
        support=torch.tensor([0.0, 1.0], dtype=time.dtype).expand_as(act.support),
    )


def juggle_ball(time: Tensor, who: People) -> Act:
    """Keeps a ball up all the time with small kicks ahead; some use both feet in turn, and some only one."""
    v = Vary(who)
    lift, lower = v(0.22), v(0.28)
    every = lift + lower + 0.05 + 0.5 * share_of(who, 17.0)
    both = (share_of(who, 31.0) < 0.6).to(time.dtype)
    period = every * (1 + both)
    high, folded = v(28.0) + 40 * share_of(who, 13.0), v(45.0)

    def foot(start: Tensor, share: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Angles of hip and knee, and how far the foot is off the floor, 0 to 1; at rest where ``share`` is 0."""
        since = torch.remainder(time - start, period)
        zero = 0 * lift
        up = share * there_and_back(since, lift, 0.03, lower)
        # The knee bends first; the foot meets the ball with the shank swinging ahead.
        fold = share * bell(since, zero, 1.3 * lift)
        aloft = segment(since, zero, 0.4 * lift) - segment(since, lift + 0.5 * lower, lift + 0.03 + lower)
        return REST_HIP + high * up, REST_KNEE + folded * fold + 0.3 * high * up, share * aloft

    right_hip, right_knee, right = foot(0 * every, torch.ones_like(both))
    left_hip, left_knee, left = foot(every, both)
    arms = v(22.0)
    pose = make_pose(
        time,
        who,
        pitch=v(6.0) - 4 * (right + left),
        nod=20.0,
        hip=(right_hip, left_hip),
        knee=(right_knee, left_knee),
        flexion=(8 - v(6.0) * (right - left), 8 + v(6.0) * (right - left)),
        abduction=(arms, arms),
        elbow=(v(35.0), v(35.0)),
    )
    act = on_the_spot(time, pose)
    aloft = torch.stack([right, left], dim=-1)
    width = (who.proportions.half_hips * who.height_m)[:, None]
    zero = torch.zeros_like(time)
    # The other leg carries the body, and the hips shift over it.
    sway = torch.stack([0.5 * width * (left - right), zero, zero], dim=-1)
    return act._replace(hold=1 - aloft, support=0.5 + 0.5 * (aloft.flip(-1) - aloft), offset=sway)

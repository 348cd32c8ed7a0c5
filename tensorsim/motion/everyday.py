"""Movements of everyday people that count as one of the twelve activities: falls any way, walks that end, balls kicked.

Scripts as in :mod:`.scripts`. Each happens from time 0 on; before it the person stands, or walks up.
"""

import math

import torch
from torch import Tensor

from tensorsim.motion.act import REST_HIP, REST_KNEE, Act, Vary, make_pose, on_the_spot, share_of, with_gait
from tensorsim.motion.people import People
from tensorsim.motion.scripts import toppling
from tensorsim.motion.timing import bell, minimum_jerk, segment, travel


def fall_any_way(time: Tensor, who: People) -> Act:
    """Gives way and topples like a rod about the feet in any direction; stays down.

    Some sink first, with the knees far bent, and some fall stiff; some catch themselves with their arms.
    """
    v = Vary(who)
    tempo = who.tempo[:, None]
    down = toppling(tempo * time, who.height_m) / 88
    way = 2 * math.pi * share_of(who, 7.0)
    sinking = share_of(who, 13.0)
    give = bell(time, 0.0 * v(1.0), v(1.3) / tempo)
    arms = v(100.0) * share_of(who, 29.0)
    bent = 100 * sinking * give + v(30.0) * down
    hip = REST_HIP * (1 - down) + 0.55 * bent
    pose = make_pose(
        time,
        who,
        lean=88 * torch.cos(way) * down,
        pitch=v(25.0) * sinking * give,
        nod=-20 * torch.cos(way) * down,
        hip=(hip, v(0.9) * hip),
        knee=(REST_KNEE * (1 - down) + bent, REST_KNEE * (1 - down) + v(0.9) * bent),
        flexion=(2 + arms * down, 2 + v(0.8) * arms * down),
        abduction=(8 + v(30.0) * down, 8 + v(25.0) * down),
        elbow=(12 + v(40.0) * down, 12 + v(40.0) * down),
    )
    pose = pose._replace(roll=pose.roll + math.radians(88.0) * torch.sin(way) * down)
    upright = 1 - segment(time, 0.0 * v(1.0) + 0.3, 0.9 / tempo)
    act = on_the_spot(time, pose)
    return act._replace(hold=upright[..., None].expand_as(act.hold), level=upright)


def fall_on_knees(time: Tensor, who: People) -> Act:
    """Drops onto the knees, then forward onto the hands or the chest; stays down."""
    v = Vary(who)
    tempo = who.tempo[:, None]
    drop, wait, over = v(0.55) / tempo, v(0.25), v(0.7) / tempo
    kneel = ((time / drop).clamp(0.0, 1.0)) ** 2
    prone = minimum_jerk(((time - drop - wait) / over).clamp(0.0, 1.0))
    far = 0.55 + 0.45 * (share_of(who, 13.0) > 0.3)
    arms = 2 + v(25.0) * kneel + v(110.0) * prone
    pose = make_pose(
        time,
        who,
        lean=88 * far * prone,
        pitch=v(20.0) * kneel * (1 - prone),
        nod=-30 * prone,
        hip=(REST_HIP + v(10.0) * kneel * (1 - prone), REST_HIP + v(14.0) * kneel * (1 - prone)),
        knee=(
            REST_KNEE + (v(100.0) - REST_KNEE) * kneel * (1 - 0.8 * prone),
            REST_KNEE + (v(100.0) - REST_KNEE) * kneel * (1 - 0.8 * prone),
        ),
        flexion=(arms, arms),
        elbow=(12 + v(30.0) * kneel, 12 + v(30.0) * kneel),
    )
    act = on_the_spot(time, pose)
    upright = 1 - segment(time, 0.0 * drop, drop)
    return act._replace(hold=upright[..., None].expand_as(act.hold), level=upright)


def fall_onto_seat(time: Tensor, who: People) -> Act:
    """The knees give way, the person lands on the seat and rolls onto the back or a side; stays down.

    So people fall who know the mat behind them.
    """
    v = Vary(who)
    tempo = who.tempo[:, None]
    drop, over = v(0.75) / tempo, v(0.6) / tempo
    seated = ((time / drop).clamp(0.0, 1.0)) ** 2
    lying = minimum_jerk(((time - 0.9 * drop) / over).clamp(0.0, 1.0))
    aside = 2 * share_of(who, 7.0) - 1
    hip = REST_HIP + (v(100.0) - REST_HIP) * seated - v(60.0) * lying
    knee = REST_KNEE + (v(95.0) - REST_KNEE) * seated - v(45.0) * lying
    back, spread = v(30.0) * seated * (1 - lying), v(20.0) * seated + v(40.0) * lying
    pose = make_pose(
        time,
        who,
        lean=-(28 * seated + 60 * lying) * (1 - 0.3 * aside.square()),
        pitch=v(30.0) * seated * (1 - lying),
        nod=v(15.0) * seated,
        hip=(hip, v(0.95) * hip),
        knee=(knee, v(0.95) * knee),
        flexion=(2 - back, 2 - v(0.9) * back),
        abduction=(8 + spread, 8 + v(0.8) * spread),
        elbow=(12 + v(30.0) * seated, 12 + v(30.0) * seated),
    )
    pose = pose._replace(roll=pose.roll + math.radians(70.0) * aside**3 * lying)
    upright = 1 - segment(time, 0.3 * drop, drop)
    act = on_the_spot(time, pose)
    return act._replace(hold=upright[..., None].expand_as(act.hold), level=upright)


def walk_and_fall_any_way(time: Tensor, who: People) -> Act:
    """Walks up, loses hold at time 0 and falls forward or to a side; stays down."""
    v = Vary(who)
    tempo = who.tempo[:, None]
    down = toppling(tempo * time, who.height_m) / 88
    way = math.pi * (share_of(who, 7.0) - 0.5)
    give = bell(time, 0.0 * v(1.0), v(1.2) / tempo)
    bent = v(60.0) * share_of(who, 13.0) * give
    rest = 1 - 0.4 * down
    arms = 2 + v(110.0) * minimum_jerk(down)
    base = make_pose(
        time,
        who,
        lean=88 * torch.cos(way) * down,
        nod=-30 * down,
        hip=(rest * REST_HIP + 0.6 * bent, rest * REST_HIP + 0.5 * bent),
        knee=(rest * REST_KNEE + bent, rest * REST_KNEE + 0.9 * bent),
        flexion=(arms, arms),
    )
    base = base._replace(roll=base.roll + math.radians(88.0) * torch.sin(way) * down)
    pace = 1 - segment(time, -0.45 + 0.0 * tempo, 0.25 + 0.0 * tempo)
    path = who.speed_m_s[:, None] * (time - travel(time, -0.45 + 0.0 * tempo, 0.25 + 0.0 * tempo))
    act = with_gait(time, who, base, pace, path)
    upright = 1 - segment(time, 0.4 / tempo, 0.9 / tempo)
    return act._replace(hold=act.hold * upright[..., None], lift=act.lift * upright[..., None], level=upright)


def walk_and_slip(time: Tensor, who: People) -> Act:
    """Walks up, slips at time 0: the feet slide ahead and up, the person lands on the seat and then on the back.

    The arms are flung up; whoever falls keeps a part of the speed of the walk for a moment.
    """
    v = Vary(who)
    tempo = who.tempo[:, None]
    drop, over = v(0.55) / tempo, v(0.5) / tempo
    seated = ((time / drop).clamp(0.0, 1.0)) ** 2
    lying = minimum_jerk(((time - 0.8 * drop) / over).clamp(0.0, 1.0))
    flung = bell(time, 0.0 * v(1.0), v(1.6) / tempo)
    one, other = v(65.0) * flung, v(40.0) * flung
    rest = 1 - seated
    bent = v(30.0) * lying * share_of(who, 13.0)
    base = make_pose(
        time,
        who,
        lean=-(45 * seated + 43 * lying),
        pitch=v(25.0) * flung,
        nod=v(20.0) * seated,
        hip=(REST_HIP * rest + one + 0.6 * bent, REST_HIP * rest + other + 0.5 * bent),
        knee=(REST_KNEE * rest + 0.4 * one + bent, REST_KNEE * rest + 0.5 * other + 0.9 * bent),
        flexion=(2 + v(100.0) * flung, 2 + v(90.0) * flung),
        abduction=(8 + v(40.0) * flung + v(30.0) * lying, 8 + v(40.0) * flung + v(25.0) * lying),
        elbow=(12 + v(30.0) * flung, 12 + v(30.0) * flung),
    )
    base = base._replace(roll=base.roll + math.radians(50.0) * (2 * share_of(who, 7.0) - 1) ** 3 * lying)
    start = -0.25 + 0.0 * tempo
    pace = 1 - segment(time, start, 0.3 + 0.0 * tempo)
    path = who.speed_m_s[:, None] * (time - travel(time, start, 0.7 + 0.0 * tempo))
    act = with_gait(time, who, base, pace, path)
    # The hips come down about where they were: the feet, about which the body leans, slide ahead.
    slide = (0.35 + 0.25 * share_of(who, 29.0)) * who.height_m[:, None] * seated
    offset = act.offset + torch.nn.functional.pad(slide[..., None], (1, 1))
    upright = 1 - segment(time, 0.0 * tempo, 0.25 + 0.0 * tempo)
    hold, lift = act.hold * upright[..., None], act.lift * upright[..., None]
    return act._replace(offset=offset, hold=hold, lift=lift, level=upright)


def walk_and_stop(time: Tensor, who: People) -> Act:
    """Walks up, comes to a halt from time 0 on, within 0.7 to 1.5 s, and stands."""
    start = torch.zeros_like(who.tempo[:, None])
    halt = 0.7 + 0.8 * share_of(who, 17.0)
    pace = 1 - segment(time, start, halt)
    path = who.speed_m_s[:, None] * (time - travel(time, start, halt))
    return with_gait(time, who, make_pose(time, who), pace, path)


def walk_with_still_arms(time: Tensor, who: People) -> Act:
    """Walks without a swing of the arms: they hang, are folded, or hold something."""
    up, bent = 25.0 * share_of(who, 19.0), 110.0 * share_of(who, 23.0)
    base = make_pose(time, who, flexion=(up, up), abduction=(12.0, 12.0), elbow=(bent, 0.9 * bent))
    path = who.speed_m_s[:, None] * time
    act = with_gait(time, who, base, torch.ones_like(time), path)
    return act._replace(pose=act.pose._replace(shoulder=base.shoulder, elbow=base.elbow))


def kick_ball(time: Tensor, who: People) -> Act:
    """Walks or runs up to a ball, kicks it at time 0 with a straight swing of the leg, and stops or runs on a little.

    In captured kicks of a ball people run up for one to two seconds, the hips at 2 to 3.5 m/s at the kick, the
    foot at 10 m/s, and come to rest within a second.
    """
    v = Vary(who)
    tempo = who.tempo[:, None]
    back, through, down = v(0.30) / tempo, v(0.22) / tempo, v(0.5) / tempo
    drawn = segment(time, -back - 0.1, 0 * back - 0.1) - segment(time, 0 * back - 0.1, through - 0.1)
    shot = segment(time, 0 * back - 0.1, through) - segment(time, through, through + down)
    poised = bell(time, -back - 0.1, through + down)
    swing = v(20.0) * (shot - drawn)
    base = make_pose(
        time,
        who,
        pitch=v(12.0) * poised - v(15.0) * shot,
        twist=v(15.0) * (drawn - shot),
        hip=(REST_HIP - v(28.0) * drawn + v(55.0) * shot, REST_HIP + 5 * poised),
        knee=(REST_KNEE + v(75.0) * drawn, REST_KNEE + v(12.0) * poised),
        flexion=(2 - swing, 2 + swing),
        abduction=(8 + v(15.0) * poised, 8 + v(25.0) * poised),
        elbow=(12 + 20 * poised, 12 + 20 * poised),
    )
    leg_m = (who.proportions.thigh + who.proportions.shank) * who.height_m
    quick = who.speed_m_s * (1 + share_of(who, 29.0)[:, 0])
    # The gait is known up to 3 leg lengths a second.
    runner = who._replace(speed_m_s=torch.minimum(quick, 2.9 * leg_m))
    start = -1.2 - 1.5 * share_of(who, 7.0) + 0.0 * back
    stop, still = -back - 0.2, 0.1 + 0.9 * share_of(who, 13.0) + 0.0 * back
    pace = segment(time, start, start + 0.5) - segment(time, stop, still)
    gone_s = travel(time, start, start + 0.5) - travel(time, stop, still)
    act = with_gait(time, runner, base, pace, runner.speed_m_s[:, None] * gone_s)
    aloft = segment(time, -back - 0.15, -back) - segment(time, through + 0.6 * down, through + down)
    free = torch.stack([1 - aloft, torch.ones_like(aloft)], dim=-1)
    # The standing leg carries the body, not the one that kicks.
    support = torch.stack([0 * time, 0 * time + 1], dim=-1)
    return act._replace(hold=act.hold * free, lift=act.lift * free, support=support, level=1 - aloft)

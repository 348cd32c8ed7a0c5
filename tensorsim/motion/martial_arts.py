"""Punches and kicks of trained people: swung fists, single blows with a step, roundhouse kicks.

Scripts as in :mod:`.scripts`. The first blow begins at time 0; before that the person stands or is on guard.
"""

import math

import torch
from torch import Tensor

from tensorsim.motion.act import REST_HIP, REST_KNEE, Act, Vary, make_pose, on_the_spot, share_of
from tensorsim.motion.people import People
from tensorsim.motion.timing import bell, segment, there_and_back


def _seldom(time: Tensor, who: People, shortest_s: float) -> Tensor:
    """Seconds since the latest blow, from -0.5 before a repeated one; half of the people strike only once."""
    period = shortest_s * (1 + 1.5 * share_of(who, 17.0)) / who.tempo[:, None]
    again = torch.where(time < 0, time, torch.remainder(time + 0.5, period) - 0.5)
    return torch.where(share_of(who, 31.0) < 0.5, time, again)


def swing_fist(time: Tensor, who: People) -> Act:
    """Swings a fist out sideways (backfist) or round to the front (hook), the trunk turning along, and back.

    Some use one arm all the time and some alternate.
    """
    v = Vary(who)
    every = v(1.5) / who.tempo[:, None]
    both = share_of(who, 13.0) < 0.5
    hook = share_of(who, 29.0) < 0.4

    def fist(start: Tensor) -> Tensor:
        since = time - start
        since = torch.where(since < 0, since, torch.remainder(since, torch.where(both, 2 * every, every)))
        out, back = 0.16 * every, 0.26 * every
        return there_and_back(since, out, 0.1 * every, back)

    right = fist(0 * every)
    left = torch.where(both, fist(every), 0 * right)
    twist = v(35.0) * (left - right) * torch.where(hook, -1.0, 1.0)
    guard, fold = v(45.0), v(120.0)
    bent = v(20.0)
    aside, ahead = torch.where(hook, v(35.0), v(80.0)), torch.where(hook, v(75.0), v(20.0))
    straight = torch.where(hook, v(75.0), v(15.0))
    pose = make_pose(
        time,
        who,
        pitch=v(6.0),
        twist=twist,
        look=-twist,
        hip=(bent / 2, bent / 2),
        knee=(bent, bent),
        flexion=(guard + (ahead - guard) * right, guard + (ahead - guard) * left),
        abduction=(14 + (aside - 14) * right, 14 + (aside - 14) * left),
        inward=(25 * (1 - right), 25 * (1 - left)),
        elbow=(fold + (straight - fold) * right, fold + (straight - fold) * left),
    )
    return on_the_spot(time, pose)


def punch_once(time: Tensor, who: People) -> Act:
    """A single straight blow of the right fist with the whole body behind it, and back; some start with hanging arms.

    The feet stay in place here; steps are added by :func:`~tensorsim.motion.footwork.step_about`.
    """
    v = Vary(who)
    tempo = who.tempo[:, None]
    since = _seldom(time, who, 2.5)
    load, out, back = v(0.2) / tempo, v(0.17) / tempo, v(0.45) / tempo
    stay = 0.6 * share_of(who, 7.0)
    load = load.clamp(max=0.45)
    ready = segment(since, -load, 0 * load) - segment(since, out + stay, out + stay + back)
    shot = there_and_back(since, out, stay, back)
    # On guard all the time, or only for the blow.
    guard = torch.where(share_of(who, 13.0) < 0.5, torch.ones_like(ready), ready)
    bent = REST_KNEE + v(14.0) * guard + v(12.0) * shot
    twist = v(40.0) * shot - v(15.0) * (ready - shot)
    arm, fold = 2 + v(33.0) * guard, 12 + v(100.0) * guard
    pose = make_pose(
        time,
        who,
        pitch=v(5.0) * guard + v(12.0) * shot,
        twist=twist,
        look=-twist,
        hip=(bent / 2, bent / 2),
        knee=(bent, bent),
        flexion=(arm + (v(85.0) - arm) * shot, arm),
        abduction=(14 * (1 - shot), 14.0),
        inward=(25 * (1 - shot), 25.0),
        elbow=(fold + (v(10.0) - fold) * shot, fold),
    )
    return on_the_spot(time, pose)


def kick_round(time: Tensor, who: People) -> Act:
    """Turns on the standing leg, snaps the other in an arc from the side, knee raised, and sets it down."""
    v = Vary(who)
    tempo = who.tempo[:, None]
    since = _seldom(time, who, 2.2)
    t1 = v(0.32) / tempo
    t2 = t1 + v(0.16) / tempo
    t3 = t2 + v(0.24) / tempo
    t4 = t3 + v(0.42) / tempo
    up = segment(since, 0 * t1, t1) - segment(since, t3, t4)
    shot = segment(since, t1 - 0.05, t2) - segment(since, t2, t3)
    poised = segment(since, 0 * t1, t1) - segment(since, t3, t4 + 0.1)
    high, fold = v(58.0), v(110.0)
    pose = make_pose(
        time,
        who,
        turn=v(60.0) * (0.6 * poised + 0.4 * shot),
        twist=-v(25.0) * poised,
        look=-v(30.0) * poised,
        hip=(REST_HIP + high * up + v(20.0) * shot, REST_HIP),
        knee=(REST_KNEE + (fold - REST_KNEE) * up + (v(12.0) - fold) * shot, REST_KNEE + 6 * poised),
        flexion=(v(30.0) - v(30.0) * shot, v(30.0) + v(15.0) * shot),
        abduction=(18 + v(20.0) * shot, 18.0),
        elbow=(80.0, 80.0),
    )
    side = torch.stack([v(45.0) * up, 0 * up], dim=-1) * (math.pi / 180)
    away = math.pi / 180 * v(22.0) * poised
    # The trunk leans away from the kicking leg, over the standing foot.
    pose = pose._replace(
        hip=torch.stack([pose.hip[..., 0], pose.hip[..., 1] + side], dim=-1),
        trunk=pose.trunk - torch.stack([0 * away, away, 0 * away], dim=-1),
    )
    act = on_the_spot(time, pose)
    aloft = segment(since, 0.0 * t1, 0.5 * t1) - segment(since, t4 - 0.5 * (t4 - t3), t4)
    hold = torch.stack([1 - aloft, torch.ones_like(time)], dim=-1)
    support = torch.stack([0 * time, 0 * time + 1], dim=-1)
    width = (who.proportions.half_hips * who.height_m)[:, None]
    zero = torch.zeros_like(time)
    sway = torch.stack([-0.7 * width * bell(since, 0 * t1, t4), zero, zero], dim=-1)
    return act._replace(hold=hold, support=support, offset=sway)

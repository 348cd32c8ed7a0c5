"""Movements beyond the twelve activities: everyday ones, kinds of gait, and gymnastics.

Scripts as in :mod:`.scripts`: joint angles over time, one function per movement. They accept any times: movements
that happen once begin at 0 and stay as they ended; the others continue indefinitely.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from tensorsim.body.kinematics import BodyPose
from tensorsim.motion.act import REST_HIP, REST_KNEE, Act, Vary, make_pose, on_the_spot, upright_for
from tensorsim.motion.feet import soft_reach
from tensorsim.motion.people import People
from tensorsim.motion.scripts import fall_tempo, over_the_knees, toppling
from tensorsim.motion.timing import GRAVITY, bell, minimum_jerk, segment, there_and_back

#: Metres around take-off and landing over which the heels leave the floor.
_HEEL_M = 0.015


def _cycle_share(time: Tensor, period: Tensor, who: People) -> Tensor:
    """A person's phase in a repeating movement, in [0, 1)."""
    return torch.remainder(time / period + who.gait_phase[:, None], 1.0)


def pick_up(time: Tensor, who: People) -> Act:
    """Picks something up from the floor and stands again; some stoop and some squat."""
    v = Vary(who)
    down = there_and_back(time, v(1.1), v(0.3), v(1.2))
    squat = (0.5 + (v(1.0) - 1) / 0.25).clamp(0.0, 1.0)
    knee = REST_KNEE + (v(50.0) + 75 * squat - REST_KNEE) * down
    # The hips move back as the trunk bends forward, so that the body stays over the feet.
    hip = 0.5 * knee + (12 + 8 * squat) * down
    bow = v(100.0) - 38 * squat
    pose = make_pose(
        time,
        who,
        pitch=bow * down,
        nod=-0.3 * bow * down,
        hip=(hip, hip),
        knee=(knee, knee),
        flexion=(2 + v(20.0) * down, 2 + v(10.0) * down),
        elbow=(12 - 7 * down, 12 + v(20.0) * down),
    )
    return on_the_spot(time, pose)


def drink(time: Tensor, who: People) -> Act:
    """Lifts a cup to the mouth, tips head and cup back, and lowers the hand again."""
    v = Vary(who)
    out, hold, back = v(1.0), v(1.2), v(1.0)
    up = there_and_back(time, out, hold, back)
    tip = bell(time, 0.8 * out, out + hold + 0.2 * back)
    pose = make_pose(
        time,
        who,
        pitch=v(10.0) * up - v(10.0) * tip,
        twist=v(12.0) * up,
        nod=-v(18.0) * tip,
        flexion=(2 + v(48.0) * up + v(12.0) * tip, 2.0),
        abduction=(8 + v(15.0) * up, 8.0),
        inward=(15 + v(30.0) * up, 15.0),
        elbow=(12 + v(112.0) * up + 6 * tip, 12.0),
    )
    return on_the_spot(time, pose)


def fall_down(time: Tensor, who: People) -> Act:
    """Falls from standing: the knees buckle and the body topples forward like a rod about the feet; stays down."""
    v = Vary(who)
    tempo = fall_tempo(who)
    down = toppling(tempo * time, who.height_m) / 88
    give = bell(time, 0.0 * v(1.0), v(1.1) / tempo)
    arms = 2 + 170 * minimum_jerk(down)
    rest = 1 - 0.4 * down
    pose = make_pose(
        time,
        who,
        lean=88 * down,
        pitch=v(12.0) * give,
        nod=-40 * down,
        hip=(rest * REST_HIP + v(25.0) * give, rest * REST_HIP + v(22.0) * give),
        knee=(rest * REST_KNEE + v(45.0) * give, rest * REST_KNEE + v(40.0) * give),
        flexion=(arms, arms),
    )
    return upright_for(on_the_spot(time, pose), 1 - segment(time, 0.0 * tempo + 0.3, v(0.9) / tempo))


def bend(time: Tensor, who: People) -> Act:
    """Bends down with nearly straight legs, hands at the shins, and comes up again."""
    v = Vary(who)
    down = there_and_back(time, v(1.0), v(0.4), v(1.0))
    arms = 2 + v(10.0) * down
    # The hips move back, so that the body stays over the feet.
    hip = REST_HIP + 10 * down
    pose = make_pose(time, who, pitch=v(82.0) * down, nod=-20 * down, hip=(hip, hip), flexion=(arms, arms))
    return on_the_spot(time, pose)


def lie_down(time: Tensor, who: People) -> Act:
    """Lies down by way of the knees and hands, and stays prone."""
    v = Vary(who)
    end = v(2.4)
    pose = over_the_knees(time, who, v, segment(time, 0 * end, end), bell(time, 0 * end, end))
    return upright_for(on_the_spot(time, pose), 1 - segment(time, 0 * end, 0 * end + 0.35))


def get_up(time: Tensor, who: People) -> Act:
    """Lies prone, gets up by way of the knees and stands."""
    v = Vary(who)
    end = v(2.0)
    pose = over_the_knees(time, who, v, 1 - segment(time, 0 * end, end), bell(time, 0 * end, end))
    act = upright_for(on_the_spot(time, pose), segment(time, end - 0.35, end))
    return act._replace(moment=end[..., None].expand_as(act.moment))  # feet are held where they stand then


def squat(time: Tensor, who: People) -> Act:
    """Repeated knee bends with the arms stretched forward."""
    v = Vary(who)
    down = torch.sin(math.pi * _cycle_share(time, v(2.9), who)).square()
    knee, hip = REST_KNEE + v(85.0) * down, REST_HIP + v(62.0) * down
    pose = make_pose(
        time,
        who,
        pitch=v(24.0) * down,
        hip=(hip, hip),
        knee=(knee, knee),
        flexion=(2 + v(80.0) * down, 2 + v(80.0) * down),
    )
    return on_the_spot(time, pose)


def _leg_angles(ahead: Tensor, down: Tensor, thigh: Tensor, shank: Tensor) -> tuple[Tensor, Tensor]:
    """Flexion of hip and knee in degrees of a leg whose ankle is ``ahead`` of and ``down`` from the hip, in m."""
    apart = soft_reach((ahead.square() + down.square()).sqrt(), thigh + shank).square()
    knee = torch.acos(((apart - thigh.square() - shank.square()) / (2 * thigh * shank)).clamp(-1.0, 1.0))
    hip = torch.atan2(ahead, down) + torch.atan2(shank * torch.sin(knee), thigh + shank * torch.cos(knee))
    return torch.rad2deg(hip), torch.rad2deg(knee)


def _hopped(since: Tensor, period: Tensor, flight: Tensor) -> Tensor:
    """Height of the hips in m above take-off: a parabola, and on the floor a dip after landing and before take-off.

    Args:
        since: (B, T) s since take-off, within the period.
        period, flight: (B, 1) s from one take-off to the next, and spent in the air.
    """
    speed = GRAVITY * flight / 2
    half = (period - flight) / 2
    on_floor = (since - flight).minimum(period - since).clamp(min=0.0)
    dip = speed * on_floor * (1 - on_floor / half).square()
    return torch.where(since < flight, (speed - GRAVITY / 2 * since) * since, -dip)


def _hop(time: Tensor, who: People, height_m: Tensor, pose: BodyPose, widest: Tensor) -> Act:
    """A pose whose hips rise and sink by ``height_m`` (B, T): the knees bend, and the heels rise as the feet take off.

    The hips are only as high as legs abducted by ``widest`` (B, 1) radians reach.
    """
    thigh, shank = (torch.as_tensor(x)[:, None] * who.height_m[:, None] for x in who.proportions[1::-1])
    standing = (thigh + shank) * math.cos(math.radians(REST_KNEE / 2)) * torch.cos(widest)
    lift = torch.nn.functional.softplus(height_m / _HEEL_M) * _HEEL_M
    length = (standing + height_m - lift) / torch.cos(pose.hip[..., 0, 1])
    hip, knee = _leg_angles(torch.zeros_like(time), length, thigh, shank)
    bent = torch.stack([torch.deg2rad(hip), torch.deg2rad(hip)], dim=-1)
    pose = pose._replace(
        hip=torch.stack([bent, pose.hip[..., 1]], dim=-1),
        knee=torch.deg2rad(torch.stack([knee, knee], dim=-1)),
    )
    zero = torch.zeros_like(time)
    act = upright_for(on_the_spot(time, pose), zero)
    return act._replace(offset=torch.stack([zero, zero, lift], dim=-1))


def jump(time: Tensor, who: People) -> Act:
    """Repeated jumps on the spot: bends the knees, takes off, lands."""
    v = Vary(who)
    flight = (8 * v(0.1) / GRAVITY).sqrt()
    period = v(0.95)
    rise = _hopped(period * _cycle_share(time, period, who), period, flight)
    swing = v(60.0) * rise
    pose = make_pose(
        time, who, pitch=v(4.0) - v(30.0) * rise, flexion=(2 + swing, 2 + swing), elbow=(35.0, 35.0)
    )
    return _hop(time, who, rise, pose, 0 * period)


def jumping_jack(time: Tensor, who: People) -> Act:
    """Jumping jacks: arms and legs go apart and together, the arms meeting over the head."""
    v = Vary(who)
    period = v(1.05)
    flight = (8 * v(0.04) / GRAVITY).sqrt()
    since = period * _cycle_share(time, period, who)
    arms = 8 + v(140.0) * torch.sin(math.pi * since / period).square()
    # The legs move apart and together while in the air.
    apart = segment(since, 0 * flight, flight) - segment(since, period / 2, period / 2 + flight)
    widest = torch.deg2rad(v(19.0))
    pose = make_pose(time, who, abduction=(arms, arms), inward=(0.0, 0.0), elbow=(18.0, 18.0))
    legs = torch.stack([widest * apart, widest * apart], dim=-1)
    pose = pose._replace(hip=torch.stack([pose.hip[..., 0], legs], dim=-1))
    return _hop(time, who, _hopped(torch.remainder(since, period / 2), period / 2, flight), pose, widest)


def box(time: Tensor, who: People) -> Act:
    """Boxes: alternating straight right and left punches from a low stance, the trunk turning and swaying along."""
    v = Vary(who)
    every = v(0.55) / who.tempo[:, None]
    beat = torch.remainder(time + 2 * every * who.gait_phase[:, None], 2 * every)

    def fist(start: Tensor | float) -> Tensor:
        since = torch.remainder(beat - start, 2 * every)
        out, back = 0.34 * every, 0.46 * every
        return there_and_back(since, out, 0.0, back)

    right, left = fist(0.0), fist(every)
    twist = v(28.0) * (right - left)
    bent = v(24.0)
    sway = v(0.08) * torch.sin(math.pi * time / every + 2 * math.pi * who.gait_phase[:, None])
    guard, fold = v(40.0), v(118.0)
    pose = make_pose(
        time,
        who,
        pitch=v(10.0) + 4 * (right + left),
        twist=twist,
        look=-twist,
        hip=(bent / 2, bent / 2),
        knee=(bent, bent),
        flexion=(guard + 48 * right, guard + 48 * left),
        abduction=(14 * (1 - right), 14 * (1 - left)),
        inward=(25 * (1 - right), 25 * (1 - left)),
        elbow=(fold - 105 * right, fold - 105 * left),
    )
    zero = torch.zeros_like(time)
    return on_the_spot(time, pose)._replace(offset=torch.stack([zero, sway, zero], dim=-1))


def _stepped(at: Tensor, stance: float) -> Tensor:
    """How far a foot is ahead of the hips, from 1 to -1 half steps, by phase of its cycle, which begins at touch-down.

    It moves back at constant speed while it stands; in the rest of the cycle it comes forward along a cubic that
    matches that speed at both ends.
    """
    swung = ((at - stance) / (1 - stance)).clamp(min=0.0)
    slope = -2 * (1 - stance) / stance
    forward = -1 + slope * swung + (6 - 3 * slope) * swung**2 + (2 * slope - 4) * swung**3
    return torch.where(at < stance, 1 - 2 * at / stance, forward)


def _step_out(
    time: Tensor,
    who: People,
    cycle_s: Tensor,
    *,
    lift: Tensor,
    bent: Tensor,
    arms: Tensor,
    elbow: Tensor,
    pitch: Tensor,
    stance: float,
) -> Act:
    """A gait along +y at the person's speed.

    A standing foot stays where it is. The hips are highest over it, except in a gait with flight phases, where they
    follow a parabola in the air and a half-sine dip on the ground that joins it at the same speed. The legs reach from
    the hips to the feet.

    Args:
        time: (B, T) s.
        who: B people.
        cycle_s: (B, 1) length of a cycle, two steps; shortened if the legs do not reach that far.
        lift: (B, 1) body heights by which the swinging foot is raised.
        bent: (B, 1) knee angle in degrees as a foot comes down.
        arms: (B, 1) degrees by which the upper arms swing forward and back.
        elbow, pitch: (B, 1) degrees.
        stance: fraction of a cycle for which a foot stands; below one half there are flight phases.
    """
    height, speed = who.height_m[:, None], who.speed_m_s[:, None]
    thigh, shank = (torch.as_tensor(x)[:, None] * height for x in who.proportions[1::-1])
    leg = thigh + shank
    cycle_s = torch.minimum(cycle_s, 1.24 * leg / (stance * speed))
    phase = torch.stack([time / cycle_s, time / cycle_s + 0.5], dim=-1) + who.gait_phase[:, None, None]
    at = torch.remainder(phase, 1.0)
    half = 0.5 * stance * speed * cycle_s
    length = (leg.square() - 2 * thigh * shank * (1 - torch.cos(torch.deg2rad(bent)))).sqrt()
    low = (length.square() - half.square()).sqrt()
    step = torch.remainder(at[..., 0], 0.5)
    if stance < 0.5:
        flown = (step - stance) * cycle_s
        start = GRAVITY / 2 * (0.5 - stance) * cycle_s
        dip = start * stance * cycle_s / math.pi * torch.sin(math.pi * step / stance)
        rise = torch.where(flown < 0, -dip, (start - GRAVITY / 2 * flown) * flown)
    else:
        rise = 0.3 * (length - low) * torch.cos(2 * math.pi * (step - stance / 2)).square()
    ahead = half[..., None] * _stepped(at, stance)
    swung = ((at - stance) / (1 - stance)).clamp(min=0.0)
    down = (low + rise)[..., None] - (lift * height)[..., None] * (1 - (2 * swung - 1) ** 4).square()
    hip, knee = _leg_angles(ahead, down, thigh[..., None], shank[..., None])
    back = arms[..., None] * torch.cos(2 * math.pi * phase)
    twist = 0.2 * arms * torch.cos(2 * math.pi * phase[..., 0])
    pose = make_pose(
        time,
        who,
        pitch=pitch,
        twist=twist,
        look=-twist,
        hip=(hip[..., 0], hip[..., 1]),
        knee=(knee[..., 0], knee[..., 1]),
        flexion=(5 - back[..., 0], 5 - back[..., 1]),
        elbow=(elbow, elbow),
    )
    zero = torch.zeros_like(time)
    return on_the_spot(time, pose)._replace(
        stance=make_pose(time, who, hip=(0.0, 0.0), knee=(0.0, 0.0)),
        offset=torch.stack([zero, zero, low + rise - leg], dim=-1),
        path=speed * time,
        hold=torch.zeros_like(at),
    )


def run(time: Tensor, who: People) -> Act:
    """Runs: short ground contact, swinging legs strongly bent, elbows bent."""
    v = Vary(who)
    return _step_out(
        time, who, v(0.72), lift=v(0.16), bent=v(24.0), arms=v(30.0), elbow=v(85.0), pitch=v(9.0), stance=0.36
    )


def stride(time: Tensor, who: People) -> Act:
    """Strides: long, brisk steps with widely swinging arms."""
    v = Vary(who)
    cycle = v(1.1) * (1.7 / who.speed_m_s[:, None]).clamp(0.7, 1.3)
    return _step_out(
        time, who, cycle, lift=v(0.09), bent=v(14.0), arms=v(36.0), elbow=v(22.0), pitch=v(4.0), stance=0.58
    )


def creep(time: Tensor, who: People) -> Act:
    """Sneaks: short, slow steps on bent knees, leaning forward, arms still."""
    v = Vary(who)
    cycle = v(1.15) * (0.75 / who.speed_m_s[:, None]).clamp(0.7, 1.4)
    return _step_out(
        time, who, cycle, lift=v(0.07), bent=v(30.0), arms=v(5.0), elbow=v(45.0), pitch=v(18.0), stance=0.62
    )


def crawl(time: Tensor, who: People) -> Act:
    """Crawls on hands and knees, each hand moving with the opposite knee."""
    v = Vary(who)
    swing, stance = v(18.0), 0.6
    # The supporting knee stays where it is while the hips pass over it; the other one is lifted to the side.
    reach_m = (
        torch.as_tensor(who.proportions.thigh)[:, None]
        * who.height_m[:, None]
        * torch.sin(torch.deg2rad(swing))
    )
    cycle = 2 * reach_m / (stance * who.speed_m_s[:, None])
    at = torch.remainder(_cycle_share(time, cycle, who)[..., None] + torch.tensor([0.0, 0.5]), 1.0)
    knee = _stepped(at, stance)
    ahead = torch.rad2deg(torch.asin(torch.sin(torch.deg2rad(swing))[..., None] * knee))
    lifted = torch.sin(math.pi * ((at - stance) / (1 - stance)).clamp(min=0.0)).square()
    lean, arms, elbow = 75.0, 70.0, v(35.0)
    pose = make_pose(
        time,
        who,
        lean=lean,
        nod=-v(30.0),
        hip=(lean + ahead[..., 0], lean + ahead[..., 1]),
        knee=(90 + ahead[..., 0], 90 + ahead[..., 1]),
        flexion=(arms + ahead[..., 1], arms + ahead[..., 0]),
        elbow=(elbow + 25 * lifted[..., 1], elbow + 25 * lifted[..., 0]),
    )
    aside = torch.deg2rad(v(28.0))[..., None] * lifted
    pose = pose._replace(hip=torch.stack([pose.hip[..., 0], aside], dim=-1))
    zero = torch.zeros_like(time)
    # The body is positioned by the midpoint of the ankles, which do not move at constant speed.
    return upright_for(on_the_spot(time, pose), zero)._replace(
        path=who.speed_m_s[:, None] * time,
        offset=torch.stack([zero, reach_m * knee.mean(dim=-1), zero], dim=-1),
    )


#: The movements in this file, by name.
EXERCISES: dict[str, Callable[[Tensor, People], Act]] = {
    "picking up": pick_up,
    "drinking": drink,
    "bending": bend,
    "falling": fall_down,
    "lying down": lie_down,
    "getting up": get_up,
    "squats": squat,
    "jumping": jump,
    "jumping jacks": jumping_jack,
    "boxing": box,
    "running": run,
    "striding": stride,
    "creeping": creep,
    "crawling": crawl,
}

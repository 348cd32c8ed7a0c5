"""Everyday variants: bones keep their length, nobody is too fast, people who fall end up lying, blows return."""

import pytest
import torch

from tensorsim.body.kinematics import forward_kinematics
from tensorsim.body.proportions import ANKLE_HEIGHT
from tensorsim.config import JOINTS
from tensorsim.motion import everyday, martial_arts
from tensorsim.motion.act import arms_on_floor, make_pose, tip_over
from tensorsim.motion.activities import perform
from tensorsim.motion.exercises import fall_down
from tensorsim.motion.people import PeopleConfig, draw_people, nominal_people
from tensorsim.training import lifter_motion

RATE = 120.0
FALLS = ("fall_any_way", "fall_on_knees", "fall_onto_seat", "walk_and_fall_any_way", "walk_and_slip")
BLOWS = ("swing_fist", "punch_once", "kick_round")
WALKS = ("walk_and_stop", "walk_with_still_arms")
BONES = [("right_hip", "right_knee"), ("left_knee", "left_ankle"), ("neck", "right_shoulder"),
         ("left_elbow", "left_wrist")]  # fmt: skip


def script(name):
    return getattr(martial_arts if name in BLOWS else everyday, name)


def joint(joints, name):
    return joints[..., JOINTS.index(name), :]


@pytest.fixture(scope="module")
def moved(request):
    """Sixteen people from 1.5 s before the movement begins to 4 s after."""
    people = draw_people(16, PeopleConfig(tempo=(0.6, 0.9)), torch.Generator().manual_seed(5))
    time = torch.arange(round(5.5 * RATE), dtype=torch.float64) / RATE - 1.5
    return request.param, people, perform(script(request.param), time.expand(16, -1), people)


@pytest.mark.parametrize("moved", [*FALLS, *BLOWS, *WALKS, "kick_ball", "juggle_ball"], indirect=True)
def test_bones_keep_their_length_and_nobody_is_too_fast(moved):
    _, _, joints = moved
    for a, b in BONES:
        length = (joint(joints, a) - joint(joints, b)).norm(dim=-1)
        assert float((length.amax(1) - length.amin(1)).max()) < 1e-9
    speed = joints.diff(dim=1).norm(dim=-1) * RATE
    # The foot of a ball player reaches 15 m/s.
    assert 1.5 < float(speed.amax((1, 2)).max()) < 15
    assert float(joints[..., 2].min()) > 0.0


@pytest.mark.parametrize("moved", FALLS, indirect=True)
def test_who_falls_ends_on_the_floor_and_stays(moved):
    _, people, joints = moved
    head, hips = joint(joints, "head")[..., 2], joint(joints, "right_hip")[..., 2]
    standing = round(1.4 * RATE)
    assert bool((head[:, standing] > 0.8 * people.height_m).all())
    # On the knees and hands, at the highest.
    assert bool((head[:, -1] < 0.62 * people.height_m).all())
    assert bool((hips[:, -1] < 0.45 * people.height_m).all())
    late = joints[:, -round(0.3 * RATE) :]
    assert float((late.diff(dim=1).norm(dim=-1) * RATE).max()) < 0.1


@pytest.mark.parametrize("moved", ["walk_and_stop"], indirect=True)
def test_who_stops_walks_up_and_then_stands_with_both_feet_below_the_body(moved):
    _, people, joints = moved
    hips = (joint(joints, "right_hip") + joint(joints, "left_hip")) / 2
    begins, stands = round(1.5 * RATE), round(3.7 * RATE)
    before = (hips[:, begins - round(1.0 * RATE), 1] - hips[:, 0, 1]) / 0.5
    torch.testing.assert_close(before, people.speed_m_s, rtol=0.25, atol=0)
    assert float((joints[:, stands:].diff(dim=1).norm(dim=-1) * RATE).max()) < 0.05
    for side in ("right", "left"):
        astray = (joint(joints, f"{side}_ankle") - joint(joints, f"{side}_hip"))[:, stands:, :2]
        assert float(astray.norm(dim=-1).max()) < 0.15


@pytest.mark.parametrize("moved", ["walk_with_still_arms"], indirect=True)
def test_still_arms_do_not_swing_and_differ_between_people(moved):
    _, _, joints = moved
    # In the frame of the trunk; the chest only breathes and turns with the gait.
    upper = joint(joints, "left_elbow") - joint(joints, "left_shoulder")
    assert float(upper.std(dim=1).max()) < 0.05
    legs = joint(joints, "left_ankle") - joint(joints, "left_hip")
    assert float(legs.std(dim=1).amax(-1).min()) > 0.1
    height = (joint(joints, "left_wrist") - joint(joints, "left_shoulder"))[..., 2].mean(1)
    assert float(height.std()) > 0.08


@pytest.mark.parametrize(
    "script", [*(getattr(everyday, name) for name in FALLS), fall_down, lifter_motion.fall_any_way]
)
def test_who_has_fallen_lies_on_the_floor_from_head_to_foot(script):
    people = draw_people(80, PeopleConfig(tempo=(0.6, 1.0)), torch.Generator().manual_seed(9))
    time = torch.full((80, 1), 8.0, dtype=torch.float64)
    height = perform(script, time, people)[:, 0, :, 2] / people.height_m[:, None]
    lowest_of = {part: height[:, [i for i, name in enumerate(JOINTS) if part in name]].amin(1)
                 for part in ("hip", "knee", "ankle")}  # fmt: skip
    assert float(torch.stack(list(lowest_of.values())).amin(0).max()) < 0.1
    assert float(lowest_of["ankle"].max()) < 0.11
    # Some are on hands and knees.
    on_hands = height[:, JOINTS.index("neck")] > 0.18
    assert bool((lowest_of["hip"][~on_hands] < 0.11).all())
    assert bool((lowest_of["knee"][on_hands] < 0.06).all())
    wrists = torch.maximum(height[:, JOINTS.index("right_wrist")], height[:, JOINTS.index("left_wrist")])
    assert bool((wrists[on_hands] < 0.1).all())
    assert bool(on_hands.any()) == (script is everyday.fall_on_knees)


@pytest.mark.parametrize(
    "script", [*(getattr(everyday, name) for name in FALLS), fall_down, lifter_motion.fall_any_way]
)
def test_who_falls_lands_without_a_step_in_speed_and_no_faster_than_gravity_lets(script):
    people = draw_people(12, PeopleConfig(tempo=(0.6, 1.5)), torch.Generator().manual_seed(9))
    rate = 1000.0
    time = torch.arange(2000, dtype=torch.float64) / rate
    hips = perform(script, time.expand(12, -1), people)[:, :, (8, 11)].mean(2)
    # A step in speed would be an acceleration of thousands of m/s^2.
    acceleration = hips.diff(n=2, dim=1) * rate**2
    assert float(acceleration.norm(dim=-1).max()) < 400
    height = hips[:, ::20, 2]
    sinking = height.diff(n=2, dim=1) * 50.0**2
    in_the_air = height[:, 1:-1] > 0.2 * people.height_m[:, None]
    assert float(sinking[in_the_air].min()) > -1.5 * 9.81


def test_bodies_tip_over_by_an_angle_in_any_direction_without_turning_about_their_length():
    way = torch.linspace(-3.1, 3.1, 32, dtype=torch.float64)[:, None]
    people = nominal_people(32)
    tilt = torch.full_like(way, 88.0)
    flexion, abduction = arms_on_floor(way, torch.full_like(way, 30.0))
    pose = make_pose(0 * way, people, flexion=flexion, abduction=abduction, hip=(0.0, 0.0), knee=(0.0, 0.0))
    joints = forward_kinematics(tip_over(pose, tilt, way))
    up = joint(joints, "neck") / joint(joints, "neck").norm(dim=-1, keepdim=True)
    ahead = torch.sin(torch.deg2rad(tilt))[..., None] * torch.stack([torch.sin(way), torch.cos(way)], dim=-1)
    torch.testing.assert_close(up[..., :2], ahead)
    torch.testing.assert_close(up[..., 2], torch.cos(torch.deg2rad(tilt)))
    across = joint(joints, "right_hip") - joint(joints, "left_hip")
    torch.testing.assert_close(across[..., 2] / 0.12, -torch.sin(way) * torch.sin(torch.deg2rad(tilt)))
    for side in ("right", "left"):
        arm = joint(joints, f"{side}_elbow") - joint(joints, f"{side}_shoulder")
        assert float(arm[..., 2].abs().max()) < 0.01


def test_people_fall_to_all_sides():
    people = draw_people(40, PeopleConfig(), torch.Generator().manual_seed(0))
    time = torch.tensor([0.0, 4.0], dtype=torch.float64).expand(40, -1)
    joints = perform(everyday.fall_any_way, time, people)
    over = (joint(joints, "head") - joint(joints, "right_ankle"))[:, 1, :2]
    angle = torch.atan2(over[:, 1], over[:, 0])
    assert {int(q) for q in torch.floor((angle + torch.pi) / (torch.pi / 2)).clamp(max=3)} == {0, 1, 2, 3}


def test_a_ball_is_kicked_after_walking_up():
    people = draw_people(8, PeopleConfig(), torch.Generator().manual_seed(1))
    time = torch.arange(round(3.5 * RATE), dtype=torch.float64) / RATE - 2.0
    joints = perform(everyday.kick_ball, time.expand(8, -1), people)
    way = joint(joints, "neck")[..., 1]
    assert bool((way[:, round(1.8 * RATE)] - way[:, 0] > 0.4).all())
    # Captured people who kick a ball: hips at 1 to 3.5 m/s, wrists at 3 to 5.
    hips = (joint(joints, "right_hip") + joint(joints, "left_hip")) / 2
    assert 1.0 < float((hips.diff(dim=1).norm(dim=-1) * RATE).amax(1).median()) < 3.5
    wrist = joint(joints, "left_wrist").diff(dim=1).norm(dim=-1) * RATE
    assert float(wrist.median()) < 3.0
    assert float(wrist.max()) < 8.0
    foot = joint(joints, "right_ankle").diff(dim=1).norm(dim=-1) * RATE
    kick = foot[:, round(1.8 * RATE) : round(2.4 * RATE)].amax(1)
    assert bool((kick > 3.0).all())
    resting = joint(joints, "neck").diff(dim=1).norm(dim=-1)[:, -12:] * RATE
    assert float(resting.max()) < 0.3


def test_a_ball_is_kicked_from_a_foot_that_stands_beside_it():
    people = draw_people(40, PeopleConfig(tempo=(0.6, 1.0)), torch.Generator().manual_seed(7))
    time = (torch.arange(round(4.5 * RATE), dtype=torch.float64) / RATE - 3.0).expand(40, -1)
    joints, act = perform(everyday.kick_ball, time, people), everyday.kick_ball(time, people)
    ankles = torch.stack([joint(joints, "right_ankle"), joint(joints, "left_ankle")], dim=-2)
    height = ankles[..., 2] / people.height_m[:, None, None]
    assert float(height.min()) > ANKLE_HEIGHT - 0.0022
    held = (act.hold > 0.9999)[:, 1:] & (act.hold > 0.9999)[:, :-1]
    assert float((ankles.diff(dim=1).norm(dim=-1) * RATE)[held].max()) < 0.35
    at = (time[0] > -0.05) & (time[0] < 0.12)
    # The left foot stands from before the kick until after it, at most half a leg length from below the hips.
    assert float(height[:, at, 1].max()) < ANKLE_HEIGHT + 0.006
    hips = (joint(joints, "right_hip") + joint(joints, "left_hip")) / 2
    assert float((hips - ankles[..., 1, :])[:, at, 1].abs().max()) < 0.55
    now = round(3.0 * RATE)
    speed = hips.diff(dim=1).norm(dim=-1)[:, now] * RATE
    assert 1.4 < float(speed.median()) < 3.5
    foot = (ankles[..., 0, :].diff(dim=1).norm(dim=-1) * RATE).amax(1)
    assert 7.0 < float(foot.median()) < 10.5
    assert float(foot.max()) < 13.0


def test_the_kicking_side_is_turned_back_until_the_leg_swings_through():
    people = draw_people(40, PeopleConfig(), torch.Generator().manual_seed(3))
    time = (torch.arange(round(3.5 * RATE), dtype=torch.float64) / RATE - 2.5).expand(40, -1)
    joints = perform(everyday.kick_ball, time, people)
    right = (joint(joints, "right_hip") - joint(joints, "left_hip"))[..., :2]
    turn_deg = torch.rad2deg(torch.atan2(right[..., 1], right[..., 0]))  # 0 faces along the run-up
    before, after = turn_deg[:, round(2.3 * RATE)], turn_deg[:, -1]
    assert float(before.median()) < -10
    assert float(before.min()) > -70
    assert float(after.abs().max()) < 10
    # Some are ever faster until they kick, some run at one speed.
    hips = (joint(joints, "right_hip") + joint(joints, "left_hip"))[..., 1] / 2
    gone = hips[:, round(2.3 * RATE)] - hips[:, 0]
    late = hips[:, round(2.3 * RATE)] - hips[:, round(1.9 * RATE)]
    assert float((late / gone).min()) < 0.4 < 0.7 < float((late / gone).max())


def test_who_juggles_a_ball_kicks_low_with_one_foot_or_both_in_turn():
    people = draw_people(24, PeopleConfig(), torch.Generator().manual_seed(4))
    time = (torch.arange(round(6 * RATE), dtype=torch.float64) / RATE).expand(24, -1)
    joints, act = perform(everyday.juggle_ball, time, people), everyday.juggle_ball(time, people)
    ankles = torch.stack([joint(joints, "right_ankle"), joint(joints, "left_ankle")], dim=-2)
    height = ankles[..., 2] / people.height_m[:, None, None]
    assert float(height.min()) > ANKLE_HEIGHT - 0.0022
    highest = height.amax(1)
    assert bool(((highest[:, 0] > 0.08) & (highest[:, 0] < 0.45)).all())
    uses_left = highest[:, 1] > 0.08
    assert 6 < int(uses_left.sum()) < 20
    # One foot is always on the floor, and does not slide.
    assert float(height.amin(-1).max()) < ANKLE_HEIGHT + 0.02
    held = (act.hold > 0.9999)[:, 1:] & (act.hold > 0.9999)[:, :-1]
    assert float((ankles.diff(dim=1).norm(dim=-1) * RATE)[held].max()) < 0.2
    foot = ankles[..., 0, :].diff(dim=1).norm(dim=-1) * RATE
    assert 1.5 < float(foot.amax(1).median()) < 7.0
    # The foot meets the ball ahead of the body.
    ahead = (ankles[..., 0, 1] - joint(joints, "right_hip")[..., 1]) / people.height_m[:, None]
    top = height[..., 0].argmax(1, keepdim=True)
    assert float(ahead.gather(1, top).median()) > 0.1


def test_the_trunk_of_who_kicks_round_leans_over_the_standing_foot():
    people = draw_people(12, PeopleConfig(), torch.Generator().manual_seed(7))
    time = torch.arange(round(1.5 * RATE), dtype=torch.float64) / RATE
    joints = perform(martial_arts.kick_round, time.expand(12, -1), people)
    hips = (joint(joints, "right_hip") + joint(joints, "left_hip")) / 2
    leg = hips - joint(joints, "left_ankle")
    assert float((leg[..., :2].norm(dim=-1) / leg[..., 2]).max()) < 0.15
    trunk = joint(joints, "neck") - hips
    assert float((trunk[..., :2].norm(dim=-1) / trunk[..., 2]).amax(1).min()) > 0.25
    assert float(joint(joints, "head").diff(dim=1).norm(dim=-1).max() * RATE) < 3.0


def test_a_fist_is_swung_out_and_back():
    people = draw_people(8, PeopleConfig(), torch.Generator().manual_seed(2))
    time = torch.arange(round(3 * RATE), dtype=torch.float64) / RATE - 0.5
    joints = perform(martial_arts.swing_fist, time.expand(8, -1), people)
    reach = torch.stack(
        [(joint(joints, f"{side}_wrist") - joint(joints, "neck")).norm(dim=-1) for side in ("right", "left")]
    ).amax(0)
    assert bool((reach.amax(1) > reach[:, 0] + 0.1).all())
    still = joint(joints, "right_ankle").diff(dim=1).norm(dim=-1)
    assert float(still.max()) < 1e-6


def test_who_lands_on_the_seat_is_low_before_the_head_is():
    people = draw_people(12, PeopleConfig(), torch.Generator().manual_seed(3))
    time = torch.arange(round(3 * RATE), dtype=torch.float64) / RATE
    joints = perform(everyday.fall_onto_seat, time.expand(12, -1), people)
    hips, head = joint(joints, "right_hip")[..., 2], joint(joints, "head")[..., 2]
    landed = (hips < 0.25 * people.height_m[:, None]).double().argmax(1)
    assert bool((head.gather(1, landed[:, None])[:, 0] > 0.3 * people.height_m).all())
    assert bool((head[:, -1] < 0.25 * people.height_m).all())


def test_who_slips_lands_on_the_seat_with_the_feet_ahead_and_up():
    people = draw_people(12, PeopleConfig(), torch.Generator().manual_seed(3))
    time = torch.arange(round(4 * RATE), dtype=torch.float64) / RATE - 1.0
    joints = perform(everyday.walk_and_slip, time.expand(12, -1), people)
    hips, head = (joint(joints, name)[..., 2] for name in ("right_hip", "head"))
    landed = (hips < 0.15 * people.height_m[:, None]).double().argmax(1)
    assert bool((landed > round(1.3 * RATE)).all())
    rows = torch.arange(12)
    assert bool((head[rows, landed] > 0.25 * people.height_m).all())
    ahead = torch.maximum(joint(joints, "right_ankle")[..., 1], joint(joints, "left_ankle")[..., 1])
    assert bool(((ahead - joint(joints, "right_hip")[..., 1])[rows, landed] > 0.2 * people.height_m).all())
    raised = torch.maximum(joint(joints, "right_ankle")[..., 2], joint(joints, "left_ankle")[..., 2])
    assert bool((raised.amax(1) > 0.15 * people.height_m).all())
    assert bool((head[:, -1] < 0.25 * people.height_m).all())


def test_single_blows_hit_once_or_seldom_and_come_back():
    people = draw_people(24, PeopleConfig(), torch.Generator().manual_seed(4))
    time = torch.arange(round(9 * RATE), dtype=torch.float64) / RATE - 1.0
    reach = {}
    for name, end, root in (("punch_once", "wrist", "shoulder"), ("kick_round", "ankle", "hip")):
        joints = perform(script(name), time.expand(24, -1), people)
        speed = joint(joints, f"right_{end}").diff(dim=1).norm(dim=-1) * RATE
        assert bool((speed[:, round(RATE) : round(2 * RATE)].amax(1) > 3.5).all())
        late = speed[:, round(4 * RATE) :].amax(1)
        # Some strike again, some do not.
        assert bool((late < 0.5).any())
        assert bool((late > 3.5).any())
        apart = joint(joints, f"right_{end}") - joint(joints, f"right_{root}")
        reach[name] = (apart[..., 2], apart[..., :2].norm(dim=-1))
    # The fist goes out level with the shoulder, the foot knee high or higher, to the side of the leg that stands.
    drop, out = reach["punch_once"]
    assert bool((drop.gather(1, out.argmax(1, keepdim=True)).abs() < 0.35).all())
    drop, out = reach["kick_round"]
    assert bool((drop.gather(1, out.argmax(1, keepdim=True))[:, 0] > -0.35 * people.height_m).all())
    assert bool((out.amax(1) > 0.3 * people.height_m).all())

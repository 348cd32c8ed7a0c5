"""The further movements: no joint is too fast, feet stay on or above the floor, bones keep their length."""

import pytest
import torch

from tensorsim.body.proportions import ANKLE_HEIGHT
from tensorsim.config import JOINTS
from tensorsim.motion.activities import perform
from tensorsim.motion.exercises import EXERCISES
from tensorsim.motion.people import PeopleConfig, draw_people, nominal_people
from tensorsim.motion.scripts import grab

RATE = 200.0
SPEEDS = {"running": (2.0, 3.4), "striding": (1.3, 2.0), "creeping": (0.4, 1.1), "crawling": (0.3, 0.7)}
BONES = [("right_hip", "right_knee"), ("left_knee", "left_ankle"), ("neck", "right_shoulder"),
         ("left_elbow", "left_wrist")]  # fmt: skip


def joint(joints, name):
    return joints[..., JOINTS.index(name), :]


@pytest.fixture(scope="module", params=EXERCISES)
def moved(request):
    generator = torch.Generator().manual_seed(3)
    people = draw_people(12, PeopleConfig(), generator)
    if request.param in SPEEDS:
        low, high = SPEEDS[request.param]
        people = people._replace(speed_m_s=torch.linspace(low, high, 12, dtype=torch.float64))
    time = torch.arange(round(4 * RATE), dtype=torch.float64) / RATE
    joints = perform(EXERCISES[request.param], time.expand(12, -1), people)
    return request.param, people, joints


def test_nothing_is_faster_than_people_are(moved):
    _, _, joints = moved
    speed = joints.diff(dim=1).norm(dim=-1) * RATE
    assert float(speed.max()) < 12
    assert float(speed.max()) > 0.5


def test_feet_stand_on_the_floor(moved):
    name, people, joints = moved
    height = people.height_m[:, None]
    ankles = torch.stack([joint(joints, f"{side}_ankle") for side in ("right", "left")], dim=-2)[..., 2]
    lowest = ankles.amin(-1) / height
    assert float(lowest.min()) > ANKLE_HEIGHT - 0.006
    if name == "falling":
        assert float(joint(joints, "head")[:, -1, 2].max()) < 0.6
    elif name == "lying down":
        assert float(joint(joints, "head")[:, -1, 2].max()) < 0.3
    elif name == "getting up":
        assert float(joint(joints, "head")[:, 0, 2].max()) < 0.3
        assert float((joint(joints, "head")[:, -1, 2] / people.height_m).min()) > 0.75
        torch.testing.assert_close(
            lowest[:, -1], torch.full_like(lowest[:, -1], ANKLE_HEIGHT), rtol=0, atol=0.002
        )
    elif name in ("jumping", "jumping jacks", "running"):
        assert bool((lowest.amin(dim=1) < ANKLE_HEIGHT + 0.012).all())
        assert float(lowest.max()) > ANKLE_HEIGHT + 0.015
    else:
        assert float(lowest.max()) < ANKLE_HEIGHT + (0.035 if name == "crawling" else 0.012)
    assert float(joints[..., 2].min()) > 0.0


def test_bones_keep_their_length(moved):
    _, _, joints = moved
    for a, b in BONES:
        length = (joint(joints, a) - joint(joints, b)).norm(dim=-1)
        torch.testing.assert_close(length, length[:, :1].expand_as(length), rtol=5e-3, atol=0)


def test_gaits_go_at_their_speed_and_the_rest_stays(moved):
    name, people, joints = moved
    hips = 0.5 * (joint(joints, "right_hip") + joint(joints, "left_hip"))
    gone = hips[:, -1, 1] - hips[:, 0, 1]
    if name in SPEEDS:
        torch.testing.assert_close(gone, people.speed_m_s * (4 - 1 / RATE), rtol=0.02, atol=0.05)
    else:
        assert float(gone.abs().max()) < 1.2


def test_standing_feet_do_not_slide_far():
    """Of a gait: the slower ankle is nearly still at any time at which a foot carries."""
    generator = torch.Generator().manual_seed(0)
    people = draw_people(6, PeopleConfig(), generator)._replace(
        speed_m_s=torch.linspace(0.5, 1.0, 6, dtype=torch.float64)
    )
    time = torch.arange(800, dtype=torch.float64) / RATE
    joints = perform(EXERCISES["creeping"], time.expand(6, -1), people)
    ankles = torch.stack([joint(joints, "right_ankle"), joint(joints, "left_ankle")], dim=-2)[..., 1]
    slower = (ankles.diff(dim=1) * RATE).abs().amin(-1)
    assert float((slower / people.speed_m_s[:, None]).median()) < 0.35


def test_squats_and_jumps_have_their_size():
    people = draw_people(4, PeopleConfig(variation=0.0), torch.Generator().manual_seed(1))
    time = (torch.arange(800, dtype=torch.float64) / RATE).expand(4, -1)
    hips = {name: joint(perform(EXERCISES[name], time, people), "right_hip")[..., 2] for name in EXERCISES}
    assert bool((hips["squats"].amax(1) - hips["squats"].amin(1) > 0.25).all())
    rise = hips["jumping"].amax(1) - hips["jumping"][:, :1].amin(1)
    assert bool((rise < 0.35).all())
    assert bool((hips["drinking"].amax(1) - hips["drinking"].amin(1) < 0.05).all())


def test_hands_and_knees_carry_who_crawls():
    """Knees and hands are at the floor, the back is level, and a knee hardly moves while it carries."""
    people = draw_people(4, PeopleConfig(variation=0.0), torch.Generator().manual_seed(1))
    people = people._replace(speed_m_s=torch.linspace(0.3, 0.6, 4, dtype=torch.float64))
    time = (torch.arange(800, dtype=torch.float64) / RATE).expand(4, -1)
    joints = perform(EXERCISES["crawling"], time, people)
    height = people.height_m[:, None]
    for name, most in (("knee", 0.1), ("wrist", 0.14)):
        up = torch.stack([joint(joints, f"right_{name}"), joint(joints, f"left_{name}")], dim=-1)[..., 2, :]
        assert float((up / height[..., None]).max()) < most
        # One carries and the other is lifted.
        assert float((up / height[..., None]).amin(-1).max()) < 0.07
        assert float((up / height[..., None]).amax(-1).max()) > 0.06
    fall = joint(joints, "neck")[..., 2] - joint(joints, "right_hip")[..., 2]
    assert float(fall.abs().max()) < 0.2
    knees = torch.stack([joint(joints, "right_knee"), joint(joints, "left_knee")], dim=-2)[..., 1]
    slower = (knees.diff(dim=1) * RATE).amin(-1)
    assert float((slower.abs() / people.speed_m_s[:, None]).median()) < 0.15


def test_hands_of_who_bends_come_to_the_shins():
    people = draw_people(4, PeopleConfig(variation=0.0), torch.Generator().manual_seed(1))
    time = (torch.arange(500, dtype=torch.float64) / RATE).expand(4, -1)
    joints = perform(EXERCISES["bending"], time, people)
    wrist, knee = joint(joints, "right_wrist")[..., 2], joint(joints, "right_knee")[..., 2]
    assert bool((wrist.amin(1) < knee.amin(1)).all())
    assert bool((wrist[:, -1] > knee[:, -1] + 0.2).all())


@pytest.mark.parametrize("name", ["bending", "picking up", "grabbing"])
def test_who_bows_moves_the_hips_back_and_stays_over_the_feet(name):
    people = draw_people(24, PeopleConfig(), torch.Generator().manual_seed(11))
    time = (torch.arange(80, dtype=torch.float64) / 20).expand(24, -1)
    joints = (
        perform({**EXERCISES, "grabbing": grab}[name], time, people) / people.height_m[:, None, None, None]
    )
    hips, neck = (joint(joints, "right_hip") + joint(joints, "left_hip")) / 2, joint(joints, "neck")
    feet = (joint(joints, "right_ankle") + joint(joints, "left_ankle")) / 2
    assert float((hips - hips[:, :1])[..., 1].amin(1).max()) < -0.025
    # Of the trunk; toes are 0.12 body heights ahead of the ankles.
    assert float(((neck + hips) / 2 - feet)[..., 1].max()) < 0.12
    wrist = torch.minimum(joint(joints, "right_wrist"), joint(joints, "left_wrist"))[..., 2].amin(1)
    if name == "picking up":
        # The hand is a tenth of the height below.
        assert float(wrist.max()) < 0.22
        assert float(wrist.min()) > 0.04


@pytest.mark.parametrize("name", ["running", "jumping", "jumping jacks"])
def test_who_is_in_the_air_falls_freely_and_takes_off_without_a_step_in_speed(name):
    rate = 1000.0
    people = draw_people(6, PeopleConfig(), torch.Generator().manual_seed(3))
    people = people._replace(speed_m_s=torch.linspace(2.0, 3.4, 6, dtype=torch.float64))
    time = (torch.arange(1600, dtype=torch.float64) / rate).expand(6, -1)
    joints = perform(EXERCISES[name], time, people)
    hips = (joint(joints, "right_hip") + joint(joints, "left_hip"))[..., 2] / 2
    acceleration = hips.diff(n=2, dim=1) * rate**2
    ankles = torch.minimum(joint(joints, "right_ankle")[..., 2], joint(joints, "left_ankle")[..., 2])
    aloft = (ankles - ANKLE_HEIGHT * people.height_m[:, None])[:, 1:-1] > 0.03
    assert bool(aloft.any(1).all())
    # The hips of who spreads the legs in the air, or breathes, are not quite the centre of mass.
    torch.testing.assert_close(
        acceleration[aloft], torch.full_like(acceleration[aloft], -9.81), rtol=0, atol=2.5
    )
    # A step in speed would be an acceleration of hundreds of m/s^2.
    assert float(acceleration.abs().max()) < 30


@pytest.mark.parametrize("name", ["running", "striding", "creeping"])
def test_feet_that_carry_stand_still_at_any_speed(name):
    people = draw_people(12, PeopleConfig(), torch.Generator().manual_seed(3))
    low, high = SPEEDS[name]
    people = people._replace(speed_m_s=torch.linspace(low, high, 12, dtype=torch.float64))
    time = (torch.arange(800, dtype=torch.float64) / RATE).expand(12, -1)
    joints = perform(EXERCISES[name], time, people)
    ankles = torch.stack([joint(joints, "right_ankle"), joint(joints, "left_ankle")], dim=-2)
    on_floor = ankles[..., 2] < (ANKLE_HEIGHT * people.height_m)[:, None, None] + 0.002
    on_floor = on_floor[:, 1:] & on_floor[:, :-1]
    speed = ankles.diff(dim=1).norm(dim=-1) * RATE
    assert float(on_floor.double().mean()) > 0.3
    assert float(speed[on_floor].mean()) < 0.05
    assert float(speed[on_floor].median()) < 0.01


@pytest.mark.parametrize("name", ["boxing", "falling"])
def test_a_lower_tempo_is_slower(name):
    time = (torch.arange(round(3 * RATE), dtype=torch.float64) / RATE)[None]
    fastest = {}
    for tempo in (0.5, 1.0):
        people = nominal_people(1)._replace(tempo=torch.full((1,), tempo, dtype=torch.float64))
        joints = perform(EXERCISES[name], time, people)
        fastest[tempo] = float((joint(joints, "right_wrist").diff(dim=1).norm(dim=-1) * RATE).max())
    assert fastest[0.5] < 0.7 * fastest[1.0]

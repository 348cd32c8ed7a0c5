"""The twelve activities: bodies stay plausible, feet stand, speeds are human, seeds are reproducible."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import quad, solve_ivp
from torch import Tensor

from tensorsim.body import proportions
from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.proportions import Proportions
from tensorsim.body.skeleton import body_to_coco, coco_to_body, mirror
from tensorsim.config import ACTIVITIES, COCO_KEYPOINTS, JOINTS, RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator, GeneratedMotion, activity_index, perform
from tensorsim.motion.feet import tread, two_bone_leg
from tensorsim.motion.people import VARIED_NUMBERS, PeopleConfig, draw_people, nominal_people
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.motion.scripts import SCRIPTS
from tensorsim.motion.timing import bell, segment, toppling_angles, travel
from tensorsim.radar.simulator import RadarSimulator

BONES = [
    ("head", "neck"),
    ("right_shoulder", "left_shoulder"),
    ("right_shoulder", "right_elbow"),
    ("right_elbow", "right_wrist"),
    ("left_shoulder", "left_elbow"),
    ("left_elbow", "left_wrist"),
    ("right_hip", "left_hip"),
    ("right_hip", "right_knee"),
    ("right_knee", "right_ankle"),
    ("left_hip", "left_knee"),
    ("left_knee", "left_ankle"),
]
RATE = 250.0


def at(joints: Tensor, name: str) -> Tensor:
    if name == "pelvis":
        return (at(joints, "right_hip") + at(joints, "left_hip")) / 2
    return joints[..., JOINTS.index(name), :]


@cache
def nominal(index: int) -> GeneratedMotion:
    return ActivityGenerator().generate(index, people=nominal_people(1), rate_hz=RATE)


@cache
def crowd() -> GeneratedMotion:
    """Three drawn people per class."""
    return ActivityGenerator().generate(torch.arange(36) % 12, seed=11, rate_hz=RATE)


def velocity(x: Tensor) -> Tensor:
    return (x[:, 1:] - x[:, :-1]) * RATE


# ---- bodies ----------------------------------------------------------------------------------------------


def test_bones_keep_their_length() -> None:
    joints = ActivityGenerator().generate(torch.arange(24) % 12, seed=2, rate_hz=397.0).joints
    for a, b in BONES:
        length = (at(joints, a) - at(joints, b)).norm(dim=-1)
        assert float((length.amax(dim=-1) - length.amin(dim=-1)).max()) < 1e-5, (a, b)


def test_nobody_sinks_or_floats() -> None:
    lowest = crowd().joints[..., 2].amin(dim=-1)
    assert float(lowest.min()) > 0
    ankle_height = proportions.ANKLE_HEIGHT * crowd().people.height_m[:, None]
    clearance = proportions.FLESH * crowd().people.height_m[:, None]
    assert float((lowest - ankle_height).min()) > -0.015
    assert float((lowest - clearance).max()) < 0.03  # between heel strike and heel off both ankles are up


def test_accelerations_are_those_of_a_body() -> None:
    joints = crowd().joints
    acceleration = (joints[:, 2:] - 2 * joints[:, 1:-1] + joints[:, :-2]) * RATE**2
    assert bool(joints.isfinite().all())
    assert float(acceleration.norm(dim=-1).max()) < 300
    # Also across the repeats of a longer clip.
    joints = ActivityGenerator().generate(torch.arange(12), seed=4, duration_s=9.0, rate_hz=RATE).joints
    acceleration = (joints[:, 2:] - 2 * joints[:, 1:-1] + joints[:, :-2]) * RATE**2
    assert float(acceleration.norm(dim=-1).max()) < 300


def test_feet_do_not_slide() -> None:
    """Where a script holds a foot, its ankle is still, and a person on their feet has an ankle there."""
    people = crowd().people
    time = torch.arange(1000, dtype=torch.float64) / RATE
    for i, name in enumerate(ACTIVITIES):
        who = people.take(torch.arange(36)[torch.arange(36) % 12 == i])
        times = time.expand(3, -1)
        joints, act = perform(SCRIPTS[i], times, who), SCRIPTS[i](times, who)
        for side, ankle in ((0, "right_ankle"), (1, "left_ankle")):
            speed = velocity(at(joints, ankle)).norm(dim=-1)
            held = (act.hold[..., side] > 0.9999) & (act.level[..., side] > 0.9999)
            assert float((speed * held[:, 1:] * held[:, :-1]).max()) < 0.12, name
            # And mostly much less: the heel lifts only as the leg runs out of length.
            assert float(speed[held[:, 1:] & held[:, :-1]].mean()) < 0.02, name
        standing = act.level.amin(dim=-1) > 0.9999
        assert bool((act.hold.amax(dim=-1) > 0.2)[standing].all()), name


def test_feet_on_their_way_are_in_the_air() -> None:
    """An ankle at its standing height that neither rises nor falls moves at most for the moment of take-off."""
    joints, height = crowd().joints, crowd().people.height_m[:, None]
    for name in ("right_ankle", "left_ankle"):
        v = velocity(at(joints, name))
        low = (at(joints, name)[:, 1:, 2] - proportions.ANKLE_HEIGHT * height).abs() < 0.006
        scuffs = v[..., :2].norm(dim=-1) * (low & (v[..., 2].abs() < 0.05))
        assert float(scuffs.max()) < 0.7
        # People who walk do lift their feet.
        walking = (
            at(joints, name)[crowd().activity == 7][..., 2]
            - proportions.ANKLE_HEIGHT * height[crowd().activity == 7]
        )
        assert float(walking.amax(dim=-1).min()) > 0.1


def test_a_foot_stays_on_its_place_for_a_third_of_the_cycle() -> None:
    """Measured on the joints: while walking, each ankle rests within a centimetre for that long, step by step."""
    ankle = at(nominal(7).joints, "right_ankle")[0]
    slow = velocity(ankle[None])[0].norm(dim=-1) < 0.1
    starts = torch.nonzero(slow[1:] & ~slow[:-1])[:, 0] + 1
    ends = torch.nonzero(~slow[1:] & slow[:-1])[:, 0] + 1
    starts = starts[: len(ends)] if ends[0] > starts[0] else starts
    whole = [
        (s, e) for s in starts.tolist() for e in ends.tolist() if e > s and e == min(x for x in ends if x > s)
    ]
    long = [(s, e) for s, e in whole if e - s > 0.25 * 1.19 * RATE]
    assert len(long) >= 2
    for s, e in long:
        spread = ankle[s:e].amax(dim=0) - ankle[s:e].amin(dim=0)
        assert float(spread.max()) < 0.01
    places = [float(ankle[s:e, 1].mean()) for s, e in long]
    assert abs(places[1] - places[0]) == pytest.approx(1.31, abs=0.02)


# ---- speeds ----------------------------------------------------------------------------------------------

PEAK_SPEEDS = {
    2: {"wrist": 5.4, "head": 0.5},
    3: {"ankle": 8.0, "head": 0.9},
    4: {"wrist": 2.1, "head": 0.9},
    5: {"pelvis": 0.69, "head": 0.92},
    6: {"pelvis": 0.68, "head": 1.1},
    7: {"wrist": 1.1, "ankle": 0.5},
    8: {"pelvis": 1.3, "ankle": 4.3, "wrist": 2.4},
    9: {"pelvis": 1.3, "ankle": 4.3, "wrist": 2.4},
    10: {"pelvis": 1.3, "ankle": 4.3, "wrist": 2.4},
    11: {"head": 2.4},
    12: {"head": 5.8, "pelvis": 3.2},
}


@pytest.mark.parametrize("number", PEAK_SPEEDS)
def test_peak_speeds_of_the_mean_person(number: int) -> None:
    v = nominal(number - 1).joints
    for part, expected in PEAK_SPEEDS[number].items():
        names = [part] if part in ("head", "pelvis") else [f"{side}_{part}" for side in ("right", "left")]
        peak = max(float(velocity(at(v, name)).norm(dim=-1).max()) for name in names)
        assert peak == pytest.approx(expected, rel=0.25), part


@pytest.mark.parametrize(("number", "part"), [(2, "right_wrist"), (3, "right_ankle"), (12, "head")])
def test_tempo_slows_punches_kicks_and_falls(number: int, part: str) -> None:
    peaks = []
    for tempo in (1.0, 0.6):
        who = nominal_people(1)._replace(tempo=torch.tensor([tempo], dtype=torch.float64))
        motion = ActivityGenerator().generate(number - 1, duration_s=8.0, rate_hz=RATE, people=who)
        peaks.append(float(velocity(at(motion.joints, part)).norm(dim=-1).max()))
    assert peaks[1] / peaks[0] == pytest.approx(0.6, abs=0.08)


def test_tempo_leaves_walking_alone() -> None:
    who = nominal_people(1)
    slow = who._replace(tempo=0.6 * who.tempo)
    walks = [ActivityGenerator().generate("walking", people=p).joints for p in (who, slow)]
    assert torch.equal(*walks)


def test_heights_of_the_hips() -> None:
    z = {i: at(nominal(i - 1).joints, "pelvis")[0, :, 2] for i in range(1, 13)}
    for sits in (5, 10):
        assert float(z[sits][-1]) == pytest.approx(0.50, abs=0.02)
    for sits in (6, 9):
        assert float(z[sits][0]) == pytest.approx(0.50, abs=0.02)
    for stands in (z[1][0], z[5][0], z[6][-1]):
        assert float(stands) == pytest.approx(0.93, abs=0.02)
    assert float(z[11][0]) == pytest.approx(0.10, abs=0.04)
    assert float(z[12][-1]) == pytest.approx(0.10, abs=0.04)
    assert float(z[11][-1]) > 0.85
    assert float(z[12][0]) > 0.85


def test_walking_speed_is_the_drawn_one() -> None:
    people = draw_people(6, PeopleConfig(), torch.Generator().manual_seed(1))
    motion = ActivityGenerator().generate("walking", people=people, duration_s=12.0, rate_hz=50.0)
    hips = at(motion.joints, "pelvis")[..., :2]
    # Over whole cycles nothing is left but the mean.
    leg = (people.proportions.thigh + people.proportions.shank) * people.height_m
    for i in range(6):
        cycle = 1.346 / math.sqrt(float(people.speed_m_s[i] / leg[i]))
        steps = round(8 * cycle * 50)
        moved = float((hips[i, steps] - hips[i, 0]).norm())
        assert moved / (steps / 50) == pytest.approx(float(people.speed_m_s[i]), rel=0.01)


def test_walker_lights_up_the_doppler_of_its_speed() -> None:
    """Torso near 2 v / lambda, positive when approaching and negative when leaving; feet up to 4 times that."""
    radar = RadarConfig(carrier_hz=10e9, bandwidth_hz=1e9, prf_hz=1024.0)
    expected = 2 * 1.1 / radar.doppler_wavelength_m
    for heading, sign in ((math.pi, 1.0), (0.0, -1.0)):
        people = nominal_people(1)._replace(heading_rad=torch.tensor([heading], dtype=torch.float64))
        motion = ActivityGenerator().generate("walking", people=people, duration_s=2.4, rate_hz=radar.prf_hz)
        fade = motion.valid[:, None].double()
        positions, rcs = JointScatterers()(motion.joints[:, None], fade)
        simulator = RadarSimulator(radar, snr_db=None)
        with torch.no_grad():
            dtm = simulator(positions, rcs).doppler_time[0]
        frequency = simulator.doppler.doppler_hz
        strongest = frequency[dtm.argmax(dim=0)]
        assert float(strongest.median()) == pytest.approx(sign * expected, rel=0.25)
        power = dtm.square().mean(dim=-1)
        fast = power[(sign * frequency > 3 * expected) & (sign * frequency < 4.2 * expected)].sum()
        wrong = power[sign * frequency < -1.5 * expected].sum()
        assert float(fast) > 10 * float(wrong)


# ---- what a class is -------------------------------------------------------------------------------------


def test_empty_has_nobody_and_the_others_have_somebody() -> None:
    motion = crowd()
    assert not motion.valid[motion.activity == 0].any()
    assert motion.valid[motion.activity != 0].all()
    still = ActivityGenerator().generate("Empty", people=nominal_people(1)).joints
    assert float((still - still[:, :1]).abs().max()) < 0.01


def test_fists_alternate_and_hands_mirror() -> None:
    joints = nominal(1).joints[0]
    hips = at(joints, "pelvis")[:, 1]
    reach = {s: hips - at(joints, f"{s}_wrist")[:, 1] for s in ("right", "left")}  # the radar is towards -y
    first_right, first_left = (int((reach[s] > 0.5).float().argmax()) for s in ("right", "left"))
    assert first_left - first_right == pytest.approx(0.6 * RATE, abs=3)
    left_handed = nominal_people(1)._replace(left_handed=torch.tensor([True]))
    other = ActivityGenerator().generate(1, people=left_handed, rate_hz=RATE).joints[0]
    # Facing the radar, the mirrored movement is the mirror image in the plane x = 0.
    torch.testing.assert_close(other, mirror(joints), rtol=0, atol=1e-9)


def test_rotation_turns_the_body_once() -> None:
    joints = nominal(6).joints[0]
    across = at(joints, "right_shoulder") - at(joints, "left_shoulder")
    angle = np.unwrap(torch.atan2(across[:, 1], across[:, 0]).numpy())
    assert angle[-1] - angle[0] == pytest.approx(2 * math.pi, abs=0.02)
    assert float((at(joints, "pelvis")[:, :2] - at(joints, "pelvis")[0, :2]).norm(dim=-1).max()) < 0.08


@pytest.mark.parametrize("number", [11, 12])
def test_lying_is_prone_and_flat(number: int) -> None:
    joints = nominal(number - 1).joints[0]
    lying = joints[0] if number == 11 else joints[-1]
    assert float(lying[:, 2].max()) < 0.3
    assert float((at(lying, "neck") - at(lying, "right_ankle")).norm()) > 1.2


# ---- sampling --------------------------------------------------------------------------------------------


def test_seeds_repeat() -> None:
    make = ActivityGenerator().generate
    first = make("kicking", batch=3, seed=5)
    assert torch.equal(first.joints, make("kicking", batch=3, seed=5).joints)
    assert not torch.equal(first.joints, make("kicking", batch=3, seed=6).joints)
    assert torch.equal(first.joints, make("kicking", people=first.people).joints)
    generator = torch.Generator().manual_seed(5)
    assert torch.equal(first.joints, make("kicking", batch=3, seed=generator).joints)
    assert not torch.equal(first.joints, make("kicking", batch=3, seed=generator).joints)  # it goes on


def test_batch_equals_loop() -> None:
    classes = torch.tensor([7, 0, 11, 7, 2, 8])
    whole = ActivityGenerator().generate(classes, seed=3)
    for i, index in enumerate(classes.tolist()):
        one = ActivityGenerator().generate(index, people=whole.people.take(torch.tensor([i])))
        torch.testing.assert_close(one.joints[0], whole.joints[i], rtol=0, atol=1e-9)
        assert torch.equal(one.valid[0], whole.valid[i])


def test_any_rate_samples_the_same_motion() -> None:
    make = ActivityGenerator().generate
    classes = torch.arange(12)
    slow = make(classes, seed=1, rate_hz=30.0)
    fast = make(classes, seed=1, rate_hz=990.0)
    assert slow.joints.shape == (12, 120, 14, 3)
    assert fast.joints.shape == (12, 3960, 14, 3)
    torch.testing.assert_close(fast.joints[:, ::33], slow.joints, rtol=0, atol=1e-9)
    # And its knots are dense enough: between them, the motion follows the script.
    time = torch.arange(4000, dtype=torch.float64)[None].expand(12, -1) / 1000.3 + 0.0007
    people = nominal_people(12)._replace(heading_rad=torch.zeros(12, dtype=torch.float64))
    motion = make(classes, people=people, rate_hz=1000.3, duration_s=4.0)
    for i in (1, 2, 7, 11):
        who = people.take(torch.tensor([i]))
        exact = perform(SCRIPTS[i], time[:1] - 0.0007, who)
        moved = motion.joints[i, :3900] - exact[0, :3900]
        assert float((moved - moved[0]).abs().max()) < 1e-4, ACTIVITIES[i]


def test_names_numbers_and_indices() -> None:
    assert activity_index("S8 Walking") == activity_index("walking") == activity_index("s8") == 7
    assert activity_index(" Sitting to Walking ") == 8
    make = ActivityGenerator().generate
    assert torch.equal(make("walking", seed=2).joints, make(7, seed=2).joints)
    assert torch.equal(make("walking", seed=2).joints, make(torch.tensor([7]), seed=2).joints)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"activity": "walkin"}, "got 'walkin', .* perhaps 'walking'"),
        ({"activity": "xyz"}, "expected one of S1 Empty, "),
        ({"activity": 12}, r"got indices \[12\], expected 0 to 11"),
        ({"activity": -1}, r"got indices \[-1\]"),
        ({"activity": torch.zeros(2)}, "got a tensor of torch.float32"),
        ({"activity": torch.zeros(0, dtype=torch.int64)}, r"shape \[0\]"),
        ({"activity": torch.tensor(3)}, r"shape \[\]"),
        ({"activity": 3.7}, "activity: got 3.7, expected a name, an index, or a tensor of indices"),
        ({"activity": True}, "activity: got True"),
        ({"activity": [1, 2]}, r"activity: got \[1, 2\]"),
        ({"activity": None}, "activity: got None"),
        ({"activity": torch.tensor([True])}, "got a tensor of torch.bool"),
        ({"activity": 1, "batch": 0}, "batch: got 0"),
        ({"activity": 1, "batch": 5, "people": nominal_people(3)}, "batch: got 5 for 3 people"),
        ({"activity": torch.tensor([1, 2]), "batch": 5}, "got 5 people for 2 activities"),
        ({"activity": 1, "rate_hz": 0.0}, "rate_hz: got 0.0"),
        ({"activity": 1, "duration_s": -1.0}, "duration_s: got -1.0"),
        ({"activity": 1, "duration_s": 0.001}, "at least one frame"),
        (
            {"activity": torch.tensor([1, 2]), "people": nominal_people(3)},
            "got 3 people for 2 activities",
        ),
    ],
)
def test_generator_refuses(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        ActivityGenerator().generate(**arguments)


# ---- people ----------------------------------------------------------------------------------------------


def test_people_follow_their_distributions() -> None:
    config = PeopleConfig()
    people = draw_people(4000, config, torch.Generator().manual_seed(0))
    for values, (low, high) in (
        (people.height_m, config.height_m),
        (people.speed_m_s, config.speed_m_s),
        (people.start_m[:, 1], config.start_range_m),
    ):
        assert low <= float(values.min()) < low + 0.01 * (high - low)
        assert high - 0.01 * (high - low) < float(values.max()) <= high
        assert float(values.mean()) == pytest.approx((low + high) / 2, rel=0.02)
    index = people.mass_kg / people.height_m**2
    assert float(index.mean()) == pytest.approx(23.5, abs=0.2)
    assert float(index.std()) == pytest.approx(3.0, abs=0.15)
    for share in (people.female, people.left_handed, people.heading_rad > math.pi / 2):
        assert float(share.double().mean()) == pytest.approx(0.5, abs=0.03)
    turned = torch.remainder(people.heading_rad + math.pi / 2, math.pi) - math.pi / 2
    assert math.pi / 6 - 0.01 < float(turned.abs().max()) <= math.pi / 6
    assert people.factor.shape == (4000, VARIED_NUMBERS)
    assert 0.149 < float((people.factor - 1).abs().max()) <= 0.15
    thigh = torch.as_tensor(people.proportions.thigh) / proportions.THIGH
    assert float(thigh.std()) == pytest.approx(0.03, abs=0.003)
    shoulders = torch.as_tensor(people.proportions.half_shoulders)
    assert float(shoulders[people.female].mean()) < float(shoulders[~people.female].mean())


def test_paths_stay_in_sight() -> None:
    motion = ActivityGenerator().generate("walking", batch=40, seed=9)
    hips = at(motion.joints, "pelvis")
    assert float(hips[..., 1].min()) >= 1.5 - 0.01
    assert float(hips[..., 1].max()) <= 7.0 + 0.2
    middle = (hips[..., 0].amin(dim=-1) + hips[..., 0].amax(dim=-1)) / 2
    assert float(middle.abs().max()) < 0.32
    # People who fit in start where they were drawn.
    standing = ActivityGenerator().generate("punching", batch=20, seed=9)
    start = at(standing.joints, "pelvis")[:, 0, 1]
    torch.testing.assert_close(start, standing.people.start_m[:, 1], rtol=0, atol=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"height_m": (1.9, 1.5)}, r"height_m: got \(1.9, 1.5\), expected an ascending range"),
        ({"height_m": (0.1, 1.5)}, "height_m"),
        ({"speed_m_s": (0.0, 1.0)}, "speed_m_s"),
        ({"tempo": (0.1, 1.0)}, "tempo: got"),
        ({"speed_m_s": (float("nan"), 1.0)}, "speed_m_s"),
        ({"start_range_m": (1.0, float("inf"))}, "start_range_m"),
        ({"start_side_m": float("inf")}, "start_side_m: got inf"),
        ({"body_mass_index": (10.0, 5.0)}, "body_mass_index"),
        ({"female_share": 1.5}, "female_share: got 1.5, expected a number from 0 to 1"),
        ({"variation": 0.5}, "variation: got 0.5"),
        ({"limb_deviation": -0.1}, "limb_deviation"),
        ({"height_m": 1.75}, "height_m: got 1.75, expected an ascending range within 0.5 to 2.5"),
        ({"speed_m_s": (1.0,)}, r"speed_m_s: got \(1.0,\)"),
        ({"tempo": (1, 2, 3)}, r"tempo: got \(1, 2, 3\)"),
        ({"body_mass_index": 23}, "body_mass_index: got 23"),
        ({"heading_rad": "x"}, "heading_rad: got 'x', expected a number from 0 to"),
    ],
)
def test_people_config_refuses(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        PeopleConfig(**arguments)


def test_people_config_takes_numbers_of_numpy() -> None:
    numbers: dict[str, Any] = {
        "body_mass_index": (np.float32(22.0), np.int64(2)),
        "female_share": np.float32(0.5),
    }
    assert PeopleConfig(**numbers) == PeopleConfig(body_mass_index=(22.0, 2.0), female_share=0.5)


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        ("height_m", 0.5, 2.5),
        ("speed_m_s", 0.2, 2.0),
        ("tempo", 0.3, 1.5),
        ("start_range_m", 0.0, 1e6),
        ("keep_range_m", 0.0, 1e6),
    ],
)
def test_people_config_takes_the_whole_range_that_it_names(name: str, least: float, most: float) -> None:
    assert getattr(PeopleConfig(**{name: (least, most)}), name) == (least, most)
    for beyond in ((least - 1e-6, most), (least, most * (1 + 1e-6))):
        with pytest.raises(TensorsimError, match=f"{name}: got .* within {least} to {most}"):
            PeopleConfig(**{name: beyond})


def test_nobody_walks_faster_than_the_gait_is_known() -> None:
    dashing = nominal_people(1, height_m=0.8, speed_m_s=2.0)
    with pytest.raises(TensorsimError, match="at most 3 leg lengths per second"):
        ActivityGenerator().generate("walking", people=dashing)


def test_people_of_other_dtypes_move_alike() -> None:
    people = nominal_people(2)
    alike = people._replace(height_m=people.height_m.float(), tempo=people.tempo.float())
    one, other = (ActivityGenerator().generate("punching", people=who).joints for who in (people, alike))
    assert other.dtype == torch.float64
    torch.testing.assert_close(one, other, rtol=0, atol=1e-6)


def test_people_do_not_depend_on_the_default_dtype() -> None:
    drawn = [draw_people(4, PeopleConfig(), torch.Generator().manual_seed(0))]
    torch.set_default_dtype(torch.float64)
    try:
        drawn.append(draw_people(4, PeopleConfig(), torch.Generator().manual_seed(0)))
    finally:
        torch.set_default_dtype(torch.float32)
    one, other = (torch.as_tensor(people.proportions.half_hips) for people in drawn)
    assert torch.equal(one, other)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((0,), "count: got 0"), ((1, -1.0), "height_m: got -1.0"), ((1, 1.7, 0.0), "speed_m_s: got 0.0")],
)
def test_nominal_people_refuses(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        nominal_people(*arguments)


def test_only_names_have_an_index() -> None:
    with pytest.raises(TensorsimError, match="activity: got 3, expected a name"):
        activity_index(3)  # type: ignore[arg-type]


def test_nobody_cannot_be_drawn() -> None:
    with pytest.raises(TensorsimError, match="count: got 0"):
        draw_people(0, PeopleConfig(), torch.Generator())


# ---- parts -----------------------------------------------------------------------------------------------


def test_proportions_change_the_bones_they_name() -> None:
    pose = BodyPose.standing((2,))
    sizes = Proportions(thigh=torch.tensor([0.2, 0.3], dtype=torch.float64), half_hips=0.1)
    joints = forward_kinematics(pose, 2.0, sizes)
    thigh = (at(joints, "left_hip") - at(joints, "left_knee")).norm(dim=-1)
    torch.testing.assert_close(thigh, torch.tensor([0.4, 0.6], dtype=torch.float64))
    hips = (at(joints, "left_hip") - at(joints, "right_hip")).norm(dim=-1)
    torch.testing.assert_close(hips, torch.tensor([0.4, 0.4], dtype=torch.float64))
    assert torch.equal(forward_kinematics(pose, 2.0), forward_kinematics(pose, 2.0, Proportions()))


def test_face_of_a_standing_body() -> None:
    """Facing +y: eyes above and beside the nose, left on the left, ears behind, all level."""
    points = body_to_coco(forward_kinematics(BodyPose.standing(), 1.75))
    face = {name: points[COCO_KEYPOINTS.index(name)] - points[0] for name in COCO_KEYPOINTS[1:5]}
    for name, p in face.items():
        assert float(p[0]) * (1 if name.startswith("right") else -1) > 0.02
        assert float(p[1]) < 0 < float(p[2])
    assert float((face["left_eye"] - face["right_eye"]).norm()) == pytest.approx(0.063, abs=0.003)
    assert float((face["left_ear"] - face["right_ear"]).norm()) == pytest.approx(0.15, abs=0.01)
    assert float(face["left_ear"][1]) < float(face["left_eye"][1])


def test_coco_points_move_with_the_head_and_undo_to_the_body() -> None:
    joints = crowd().joints[:, ::100]
    points = body_to_coco(joints)
    assert points.shape == (36, 10, 17, 3)
    flat, _ = coco_to_body(points[..., (0, 2)], torch.ones(points.shape[:-1], dtype=torch.float64))
    kept = [i for i, name in enumerate(JOINTS) if name != "neck"]
    torch.testing.assert_close(flat[..., kept, :], joints[..., kept, :][..., (0, 2)])
    reach = (points[..., 1:5, :] - points[..., :1, :]).norm(dim=-1)
    torch.testing.assert_close(reach, reach[:, :1].expand_as(reach), rtol=0, atol=1e-6)
    # Turning the body turns the face.
    turned = forward_kinematics(BodyPose.standing()._replace(heading=torch.tensor(math.pi).double()))
    assert float(body_to_coco(turned)[1, 0]) > 0


def test_leg_reaches_with_bones_unchanged() -> None:
    generator = torch.Generator().manual_seed(0)
    hip = torch.zeros(50, 3, dtype=torch.float64)
    direction = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    ankle = direction * (0.3 + 0.6 * torch.rand(50, 1, generator=generator, dtype=torch.float64))
    towards = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    thigh, shank = torch.full((50,), 0.43).double(), torch.full((50,), 0.42).double()
    leg = two_bone_leg(hip, ankle, towards, thigh, shank)
    torch.testing.assert_close((leg[:, 1] - leg[:, 0]).norm(dim=-1), thigh)
    torch.testing.assert_close((leg[:, 2] - leg[:, 1]).norm(dim=-1), shank)
    near = ankle.norm(dim=-1) < 0.985 * 0.85
    torch.testing.assert_close(leg[near, 2], ankle[near])
    assert bool((((leg[:, 1] - hip) * towards).sum(-1) > (leg[:, 2] * 0.5 * towards).sum(-1)).all())
    assert float(leg[:, 2].norm(dim=-1).max()) < 0.85
    assert 5 < int(near.sum()) < 50


def test_treading_foot_stands_around_the_middle() -> None:
    phase = torch.tensor([[0.0, 0.1, 0.24, 0.38, 0.46, 0.6, 0.8, 1.24]], dtype=torch.float64)
    cycle, begin = torch.tensor([2.0]).double(), torch.tensor([0.1]).double()
    steps = tread((phase - 0.1) * 2, cycle, begin, 0.24, 0.28, 0.16)
    right = steps.hold[0, :, 0]
    np.testing.assert_allclose(right[[1, 2, 3, 7]].numpy(), 1.0)
    np.testing.assert_allclose(right[[4, 6]].numpy(), [0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(steps.since[0, [0, 2, 4, 7], 0].numpy(), [-0.24, 0, 0.22, 0], atol=1e-7)
    # Steps are counted, and each knows its time: phase 0.24 (right) and 0.74 (left) of cycles of 2 s.
    moments = steps.moment.gather(1, steps.step)[0]
    np.testing.assert_allclose(moments[[2, 7], 0].numpy(), [0.28, 2.28], atol=1e-6)
    np.testing.assert_allclose(moments[5:7, 1].numpy(), [1.28, 1.28], atol=1e-6)
    assert int(steps.step.min()) >= 1
    assert int(steps.step.max()) + 1 < steps.moment.shape[1]


def test_courses_in_time() -> None:
    start, end = torch.tensor(1.0).double(), torch.tensor(3.0).double()
    time = torch.linspace(0, 4, 401, dtype=torch.float64)
    rise = segment(time, start, end)
    np.testing.assert_allclose(rise[[0, 100, 200, 300, 400]].numpy(), [0, 0, 0.5, 1, 1], atol=1e-12)
    assert float(rise.diff().max()) / 0.01 == pytest.approx(1.875 / 2, rel=1e-3)
    hump = bell(time, start, end)
    np.testing.assert_allclose(hump[[0, 100, 150, 200, 400]].numpy(), [0, 0, 0.5, 1, 0], atol=1e-12)
    for stop in (1.7, 3.5):
        expected, _ = quad(
            lambda t: float(segment(torch.tensor(t).double(), start, end)), 0, stop, points=[1, 3]
        )
        assert float(travel(torch.tensor(stop).double(), start, end)) == pytest.approx(expected, abs=1e-8)


def test_toppling_is_the_falling_rod() -> None:
    """Against SciPy's solver: 0.87 s from 4 to 88 degrees."""

    def rod(_: float, state: np.ndarray) -> list[float]:
        return [state[1], 1.5 * 9.81 / (0.95 * 1.75) * math.sin(state[0]) - 0.25 * state[1]]

    def lying(_: float, state: np.ndarray) -> float:
        return float(state[0]) - math.radians(88)

    lying.terminal = True  # type: ignore[attr-defined]
    truth = solve_ivp(
        rod, (0, 3), [math.radians(4), 0.6], events=lying, rtol=1e-9, atol=1e-9, dense_output=True
    )
    assert truth.t[-1] == pytest.approx(0.87, abs=0.02)
    step = 0.0005
    angles = toppling_angles(step, smooth_s=0.01).numpy()
    assert angles[0] == 0
    assert angles[-1] == pytest.approx(88)
    assert bool((np.diff(angles) > -1e-9).all())
    assert float(np.abs(np.diff(angles, 2)).max()) / step**2 < 100_000
    begin = int(np.argmax(angles > 10))
    offset = begin * step - float(np.interp(math.radians(10), truth.y[0], truth.t))
    for degrees in (20.0, 45.0, 80.0):
        expected = float(
            np.interp(
                math.radians(degrees),
                truth.sol(np.linspace(0, truth.t[-1], 20000))[0],
                np.linspace(0, truth.t[-1], 20000),
            )
        )
        assert int(np.argmax(angles > degrees)) * step - offset == pytest.approx(expected, abs=0.004)

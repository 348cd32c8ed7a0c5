"""Ranges from the floor, against bodies whose place is known."""

import math

import pytest
import torch
from torch import Tensor

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.skeleton import lowest_ankle, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.types import Lifted
from tensorsim.vision.lifting.floor import (
    floor_under,
    fused_range,
    looks_bent,
    lowered,
    on_the_same_floor,
    range_on_floor,
    upright_share,
)
from tensorsim.vision.lifting.metric_pose import MetricPose
from tests.vision.lifting.test_metric_pose import FPS, HEIGHT, TALL, WIDTH, film, place

CAMERA = CameraConfig(position_m=(0.0, 0.0, 1.8), pitch_rad=-math.radians(10))


def squat(frames: int = 90) -> Tensor:
    """World joints (T, 14, 3) of a person who stands for a second and then squats, feet in place."""
    e = ((torch.arange(frames, dtype=torch.float64) - 30) / 30).clamp(0, 1)
    pose = BodyPose.standing((frames,))._replace(
        hip=torch.stack([e[:, None].expand(-1, 2) * 1.9, torch.zeros(frames, 2).double()], dim=-1),
        knee=e[:, None].expand(-1, 2) * 2.3,
        trunk=torch.stack([e * 0.7, 0 * e, 0 * e], dim=-1),
    )
    joints = forward_kinematics(pose, TALL)
    ankles = joints[:, (10, 13)].mean(dim=1)
    way = torch.tensor([0.3, 4.0, 0.0], dtype=torch.float64) - ankles
    way[:, 2] = -lowest_ankle(joints)
    return joints + way[:, None]


def test_lowest_joint_rests_on_the_floor() -> None:
    """A camera 1.5 m above the floor; lines of sight that fall by 0.3 and by 0.5 per metre meet it at 5 and 3 m."""
    rise = torch.full((14,), -0.3, dtype=torch.float64)
    rise[0] = 0.1  # above the horizon
    depth, seen = torch.zeros(14, dtype=torch.float64), torch.ones(14, dtype=torch.bool)
    floor = torch.tensor(-1.5, dtype=torch.float64)
    y, gain = range_on_floor(rise, depth, floor, seen)
    assert float(y) == pytest.approx(5.0)
    assert float(gain) == pytest.approx(1 / 0.3)
    rise[4] = -0.5
    assert float(range_on_floor(rise, depth, floor, seen)[0]) == pytest.approx(3.0)
    depth[4] = -0.5  # nearer than the hips
    assert float(range_on_floor(rise, depth, floor, seen)[0]) == pytest.approx(3.5)
    seen[4] = False
    assert float(range_on_floor(rise, depth, floor, seen)[0]) == pytest.approx(5.0)
    for nothing in (
        range_on_floor(rise, depth, -floor, seen),
        range_on_floor(rise, depth, floor, seen & False),
    ):
        assert nothing[0].isinf()
        assert nothing[1].isinf()


def test_size_counts_while_upright_and_floor_and_last_stand_otherwise() -> None:
    size, upright = torch.full((4,), 4.0), torch.tensor([1.0, 0.0, 0.0, 0.0])
    floor, gain = torch.tensor([3.0, 3.0, math.inf, 3.0]), torch.tensor([2.0, 2.0, math.inf, 2.0])
    stood = torch.tensor([3.5, 3.5, 3.5, math.inf])
    y, share, precision = fused_range(size, upright, floor, gain, stood, torch.full((4,), 1.8))
    # Precisions of the size of a bent body and of the floor, both half a metre from the stand, and of the stand.
    tails = 1 + (math.log(4.0 / 3.5) / 0.15) ** 2
    by_size, by_floor, by_stand = 1 / 0.6**2 / tails, 1 / (2.0**2 * 2 * 0.06**2), 1 / 0.54**2
    all_three, two = by_size + by_floor + by_stand, by_size + by_stand
    assert share.tolist() == pytest.approx([1.0, by_size / all_three, by_size / two, 1.0])
    mean = (4.0 * by_size + 3.0 * by_floor + 3.5 * by_stand) / all_three
    assert y.tolist() == pytest.approx([4.0, mean, (4.0 * by_size + 3.5 * by_stand) / two, 4.0])
    assert precision.tolist() == pytest.approx([1.0, 0.12**2 * all_three, 0.12**2 * two, 0.04])


def test_range_does_not_jump_as_the_floor_moves_away() -> None:
    """With a limit on the distance from the last stand, a lying person was moved by 1.6 m at once."""
    floor = torch.linspace(2.0, 9.0, 701, dtype=torch.float64)
    one = torch.ones_like(floor)
    y = fused_range(4.2 * one, 0.0 * one, floor, 3.7 * one, 4.4 * one, 1.75 * one)[0]
    assert float(y.diff().abs().max()) < 0.01, "never by more than the floor"
    assert 3.8 < float(y.amin()) < float(y.amax()) < 4.8


def test_upright_share_of_a_squat() -> None:
    share = upright_share(squat(), torch.tensor(TALL, dtype=torch.float64))
    assert share[:30].eq(1).all()
    assert share[-10:].eq(0).all()


@pytest.mark.parametrize("error", [0.7, 1.3])
def test_a_wrong_size_of_somebody_who_squats_does_not_move_them(error: float) -> None:
    world = squat()
    image, lifted = film(world, CAMERA)
    share = upright_share(world, torch.tensor(TALL, dtype=torch.float64))
    wrong = Lifted(lifted.depth, lifted.scale * torch.where(share < 0.5, error, 1.0), *lifted[2:])
    placed = place(MetricPose(CAMERA, (TALL,)), image, wrong)
    # The size alone would be wrong by 4 m / 0.7 - 4 m or 4 m - 4 m / 1.3, 0.9 m and more.
    assert float((mid_hips(placed) - mid_hips(world))[:, 1].abs().max()) < 0.2
    assert float(lowest_ankle(placed).abs().max()) < 0.1


def test_the_range_of_a_squat_follows_that_of_the_stands_around_it() -> None:
    """The size is wrong by a fifth in the deep part, with the feet out of sight; of 1 m a tenth remains."""
    world = torch.cat([squat()[:52], squat()[:52].flip(0)])
    deep = upright_share(world, torch.tensor(TALL, dtype=torch.float64)) < 0.5
    image, lifted = film(world, CAMERA)
    wrong = lifted._replace(scale=lifted.scale * torch.where(deep, 0.8, 1.0))
    scores = torch.ones(image.shape[:-1], dtype=torch.float64)
    scores[:, [10, 13]] = 0.0
    fields = Lifted(*(field[None, None] for field in wrong))
    there = torch.ones(1, 1, len(world), dtype=torch.bool)
    placed, _ = MetricPose(CAMERA, (TALL,))(
        image[None, None], scores[None, None], fields, there, HEIGHT, WIDTH, FPS
    )
    assert bool(deep.any())
    assert float((mid_hips(placed[0, 0]) - mid_hips(world))[:, 1].abs().max()) < 0.15


def test_somebody_who_is_not_upright_is_near_where_they_stood() -> None:
    size, stood = torch.tensor([9.0, 9.0, 9.0, 1.0]), torch.full((4,), 4.0)
    upright, nothing = torch.tensor([0.0, 0.5, 1.0, 0.0]), torch.full((4,), math.inf)
    found = fused_range(size, upright, nothing, nothing, stood, torch.full((4,), 1.8))[0]
    # Of the size, good to 15 % or, half upright, to 9 %, with long tails; the stand is good to 0.54 m and then has
    # half its say.
    bent, half, near = (
        1 / off**2 / (1 / off**2 + (1 + say * (math.log(ratio) / 0.15) ** 2) * say / 0.54**2)
        for off, say, ratio in ((1.35, 1, 9 / 4), (0.81, 0.5, 9 / 4), (0.15, 1, 1 / 4))
    )
    assert found.tolist() == pytest.approx([4 + 5 * bent, 4 + 5 * half, 9.0, 4 - 3 * near])


def test_somebody_who_lies_is_on_the_floor() -> None:
    """Standing for a second, then lying across the picture, found at 0.6 of the true size."""
    joints = forward_kinematics(BodyPose.standing((60,)), TALL)
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)
    lying = (joints - mid_hips(joints)[:, None]) @ turn.T
    world = torch.where(torch.arange(60)[:, None, None] < 30, joints, lying)
    world = (
        world
        - torch.stack([0 * world[:, 0, 0], 0 * world[:, 0, 0], world[..., 2].amin(dim=1)], dim=-1)[:, None]
    )
    world = world + torch.tensor([0.0, 4.0, 0.0], dtype=torch.float64)
    image, lifted = film(world, CAMERA)
    size = torch.where(torch.arange(60) < 30, 1.0, 0.6)
    placed = place(MetricPose(CAMERA, (TALL,)), image, lifted._replace(scale=lifted.scale * size))
    assert float((mid_hips(placed) - mid_hips(world))[:, 1].abs().max()) < 0.15
    assert float(placed[..., 2].min()) > -0.1
    assert float(placed[35:, :, 2].max()) < 0.7


@pytest.mark.parametrize("feet", [True, False])
def test_somebody_who_lies_is_near_where_they_stood_even_if_feet_were_out_of_sight(feet: bool) -> None:
    """The size of the lying body is wrong by a half; without feet no floor is known, but where they stood is."""
    joints = forward_kinematics(BodyPose.standing((60,)), TALL)
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], dtype=torch.float64)
    lying = (joints - mid_hips(joints)[:, None]) @ turn.T
    world = torch.where(torch.arange(60)[:, None, None] < 30, joints, lying)
    lowest = torch.zeros(60, 3, dtype=torch.float64)
    lowest[:, 2] = world[..., 2].amin(dim=1)
    world = world - lowest[:, None] + torch.tensor([0.0, 4.0, 0.0], dtype=torch.float64)
    image, lifted = film(world, CAMERA)
    size = torch.where(torch.arange(60) < 30, 1.0, 1 / 1.5)
    fields = Lifted(*(field[None, None] for field in lifted._replace(scale=lifted.scale * size)))
    scores = torch.ones(1, 1, 60, 14, dtype=torch.float64)
    scores[..., :30, [10, 13]] = float(feet)
    there = scores[..., 0] > 0
    placed, _ = MetricPose(CAMERA, (TALL,))(image[None, None], scores, fields, there, HEIGHT, WIDTH, FPS)
    off = (mid_hips(placed[0, 0]) - mid_hips(world))[40:, 1]
    # By its size alone the body would be 2 m too far away.
    assert float(off.abs().max()) < (0.15 if feet else 0.7)


# ---- thresholds, from both sides -----------------------------------------------------------------------------


def in_picture(
    trunk_px: float = 60.0, lean_deg: float = 0.0, bones: tuple[float, float] = (1.0, 1.0)
) -> Tensor:
    """Joints (14, 2) with legs 100 px long from hip to ankle, whose bones are ``bones`` times as long."""
    joints = torch.zeros(14, 2, dtype=torch.float64)
    lean = math.radians(lean_deg)
    joints[1] = trunk_px * torch.tensor([math.sin(lean), -math.cos(lean)])
    for first, longer in zip((8, 11), bones, strict=True):
        joints[first + 1] = torch.tensor([50 * math.sqrt(longer**2 - 1), 50.0])
        joints[first + 2] = torch.tensor([0.0, 100.0])
    return joints + 300.0


@pytest.mark.parametrize(
    ("image", "bent"),
    [
        (in_picture(), False),
        (in_picture(trunk_px=41.0), False),
        (in_picture(trunk_px=39.0), True),
        (in_picture(trunk_px=89.0), False),
        (in_picture(trunk_px=91.0), True),
        (in_picture(lean_deg=39.0), False),
        (in_picture(lean_deg=-41.0), True),
        (in_picture(bones=(1.24, 1.24)), False),
        (in_picture(bones=(1.26, 1.26)), True),
        (in_picture(bones=(2.0, 1.0)), False),
        (in_picture(bones=(1.0, 2.0)), False),
        (-in_picture(), True),  # legs up
    ],
)
def test_what_does_not_look_like_a_stand_is_bent(image: Tensor, bent: bool) -> None:
    seen = torch.ones(14, dtype=torch.bool)
    assert bool(looks_bent(image, seen)) is bent
    for joint in range(14):
        hidden = seen.clone()
        hidden[joint] = False
        matters = joint == 1 or joint >= 8
        assert bool(looks_bent(image, hidden)) is (bent and not matters)


def test_upright_share_between_its_ends() -> None:
    joints = torch.zeros(4, 14, 3, dtype=torch.float64)
    joints[:, 3, 2] = torch.tensor([0.5, 0.6, 0.69, 0.78]).double() * 1.8
    share = upright_share(joints, torch.full((4,), 1.8, dtype=torch.float64))
    assert share.tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0], abs=1e-6)


def test_only_lines_that_fall_by_three_hundredths_meet_the_floor() -> None:
    depth, floor = torch.zeros(14, dtype=torch.float64), torch.tensor(-1.5, dtype=torch.float64)
    seen = torch.ones(14, dtype=torch.bool)
    flat = torch.full((14,), -0.029, dtype=torch.float64)
    assert range_on_floor(flat, depth, floor, seen)[0].isinf()
    assert float(range_on_floor(flat - 0.002, depth, floor, seen)[0]) == pytest.approx(1.5 / 0.031)


@pytest.mark.parametrize(("by_floor", "counts"), [(0.29, False), (0.31, True), (99.0, True), (101.0, False)])
def test_floors_from_30_cm_to_100_m_count(by_floor: float, counts: bool) -> None:
    def one(value: float) -> torch.Tensor:
        return torch.tensor([value], dtype=torch.float64)

    _, share, precision = fused_range(one(4.0), one(0.5), one(by_floor), one(2.0), one(4.0), one(1.8))
    size = 1 / (4.0 * 0.09) ** 2
    floor = 0.5 / (2.0**2 * (0.06**2 + (0.12 * (by_floor - 4.0)) ** 2)) if counts else 0.0
    total = size + floor + 0.5 / 0.54**2
    assert float(share) == pytest.approx(size / total)
    assert float(precision) == pytest.approx(min(0.12**2 * total, 1.0))


def test_near_ranges_are_good_to_a_centimetre_and_no_precision_is_below_a_thousandth() -> None:
    far = torch.tensor([math.inf], dtype=torch.float64)
    zero, one = torch.zeros(1, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    near = fused_range(0.05 * one, zero, far, far, far, one)[2]
    assert float(near) == pytest.approx(1.0), "both are held at 1 cm"
    large = fused_range(0.2 * one, zero, far, far, far, one)[2]
    assert float(large) == pytest.approx(1e-4 / 0.03**2)


@pytest.mark.parametrize(
    ("camera_m", "tall", "person"),
    [
        (1.5, 0.58, False),
        (1.5, 0.62, True),
        (1.5, 0.9, True),
        (0.5, 0.4, True),
        (4.0, 0.9, True),
        (4.0, 0.58, False),
    ],
)
def test_who_would_be_less_than_a_third_as_tall_on_the_floor_is_nobody(
    camera_m: float, tall: float, person: bool
) -> None:
    """By its size a thing of 0.58 m is 3.1 times as far away as it is, and its feet 3.1 times as far below the camera.

    Of a camera near the floor that is less than two metres.
    """
    times = 1.8 / tall
    level = torch.tensor([-camera_m, -camera_m * times, 5.0], dtype=torch.float64)[:, None].expand(3, 9)
    away = torch.tensor([4.0, 4.5 * times, 1.0], dtype=torch.float64)[:, None].expand(3, 9)
    valid = torch.tensor([True, True, False])[:, None].expand(3, 9)
    assert on_the_same_floor(level, away, valid)[:2].tolist() == [True, person]
    assert on_the_same_floor(level[1:], away[1:], valid[1:])[0], "alone it may be anybody"
    assert on_the_same_floor(-level, away, valid)[:2].all(), "feet above the camera tell nothing"
    assert on_the_same_floor(level[:0], away[:0], valid[:0]).shape == (0,)


def test_floor_is_a_low_quantile_of_the_lower_ankle() -> None:
    """Ankles at 0.1 m but for a jump of 1.4 s, in a window of 3 s: the floor stays; what is lower for long counts."""
    joints = torch.ones(120, 14, 3, dtype=torch.float64)
    joints[:, (10, 13), 2] = 0.1
    joints[:, 13, 2] += 0.3  # the lower one counts
    joints[40:82, (10, 13), 2] += 0.5
    there = torch.ones(120, dtype=torch.bool)
    torch.testing.assert_close(floor_under(joints, there, 30.0, 3.0), torch.full((120,), 0.1).double())
    once = joints.clone()
    once[20:24, 10, 2] = -1.0  # four frames of ninety are less than 15 %
    torch.testing.assert_close(floor_under(once, there, 30.0, 3.0)[30:90], torch.full((60,), 0.1).double())
    there[20:24] = False
    torch.testing.assert_close(floor_under(once, there, 30.0, 0.2), floor_under(joints, there, 30.0, 0.2))
    down = lowered(joints, torch.full((120,), 0.25, dtype=torch.float64))
    torch.testing.assert_close(joints - down, torch.tensor([0.0, 0.0, 0.25]).double().expand(120, 14, 3))


def at_once() -> tuple[Tensor, Tensor]:
    """World joints (90, 14, 3) of 45 frames of a stand and 45 of a squat, and the frames of the squat."""
    deep = torch.arange(90) >= 45
    both = squat()
    return torch.where(deep[:, None, None], both[-1], both[0]), deep


def on_floor(world: Tensor, by_size: Tensor) -> tuple[Tensor, ...]:
    """Ranges of the hips, usable frames, who stands, and precisions, for a level camera 1.8 m above the floor."""
    camera = CameraConfig(position_m=(0.0, 0.0, 1.8), focal_px=900.0, center_px=(640.0, 360.0))
    image, lifted = film(world, camera)
    module = MetricPose(camera, (TALL,))
    ones = torch.ones(1, len(world), dtype=torch.float64)
    return module._on_floor(
        by_size[None], image[None], TALL * lifted.depth[None], 900.0 * ones, torch.tensor([640.0, 360.0]).double(),
        module.pinhole.pose, torch.full((1, 1), TALL, dtype=torch.float64), ones[..., None].expand(1, -1, 14) > 0,
        ones > 0, FPS,
    )  # fmt: skip


def test_size_floor_and_stand_are_weighed_by_their_precisions() -> None:
    world, deep = at_once()
    true = mid_hips(world)[:, 1]
    stood = float(true[0])
    by_size = torch.where(deep, 1.3 * true, true)
    ranges, tells, stands, _ = on_floor(world, by_size)
    ankle = world[:, (10, 13)].mean(dim=1)
    size = 1 / (0.15 * by_size).square() / (1 + ((by_size / stood).log() / 0.15).square())
    floor = 1 / ((ankle[:, 1] / 1.8).square() * (0.06**2 + (0.12 * (true - stood)).square()))
    place = 1 / (0.3 * TALL) ** 2
    expected = (size * by_size + floor * true + place * stood) / (size + floor + place)
    torch.testing.assert_close(ranges[0, deep], expected[deep], atol=2e-3, rtol=0)
    torch.testing.assert_close(ranges[0, ~deep], true[~deep], atol=1e-3, rtol=0)
    assert bool(tells.all())
    assert torch.equal(stands[0], ~deep)


def test_feet_at_the_lower_edge_of_the_picture_stand_on_nothing() -> None:
    """From 0.97 of the picture's height on a foot may be cut off: the range is then that of the size."""
    camera = CameraConfig(position_m=(0.0, 0.0, 1.8), focal_px=900.0, center_px=(640.0, 360.0))
    world = squat()
    deep = upright_share(world, torch.tensor(TALL, dtype=torch.float64)) < 0.5
    image, lifted = film(world, camera)
    wrong = lifted._replace(scale=lifted.scale * torch.where(deep, 1 / 1.4, 1.0))
    fields = Lifted(*(field[None, None] for field in wrong))
    ones, feet = torch.ones(1, 1, 90, 14, dtype=torch.float64), image[:, (10, 13), 1]
    for height, near in ((float(feet.max()) / 0.965, True), (float(feet.min()) / 0.975, False)):
        placed, _ = MetricPose(camera, (TALL,))(
            image[None, None], ones, fields, ones[..., 0] > 0, height, WIDTH, FPS
        )
        off = (mid_hips(placed[0, 0]) - mid_hips(world))[80:, 1].abs()
        assert bool((off < 0.2).all() if near else (off > 0.4).all())


def test_who_is_nine_tenths_upright_stands() -> None:
    world = squat()
    share = upright_share(world, torch.tensor(TALL, dtype=torch.float64))
    assert share[43:45].tolist() == pytest.approx([0.95, 0.86], abs=0.01), "on both sides"
    assert torch.equal(on_floor(world, mid_hips(world)[:, 1])[2][0], share >= 0.9)

"""Everyday motion as films show it: in every heading, with errors of networks, and what the pipeline makes of it."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tensorsim.body.kinematics import rotation
from tensorsim.config import ACTIVITIES, CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.evaluation.measured.motions import KNOT_HZ, Draw
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.motion.people import People, draw_people
from tensorsim.training import everyday
from tensorsim.training.everyday import at_rate, bystander, everyday_motion
from tensorsim.training.keypoint_errors import (
    FilmedMotion,
    Filming,
    draw_camera,
    find_keypoints,
    project_keypoints,
)


def motion(activity: int, count: int = 6, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return everyday_motion(activity, count, torch.full((count,), 4.0), generator)


def test_every_activity_but_the_empty_one_has_variants():
    assert len(everyday.VARIANTS) == len(ACTIVITIES)
    assert everyday.VARIANTS[0] == ()
    for variants in everyday.VARIANTS[1:]:
        assert sum(variant.share for variant in variants) == pytest.approx(1.0)


def test_no_clock_makes_falls_faster_than_gravity_does():
    assert all(variant.rate[1] <= 1.05 for variant in everyday.VARIANTS[11])
    joints, _ = motion(11, 40)
    hips = joints[:, :, (8, 11), 2].mean(2)
    lag = max(1, round(KNOT_HZ / 25))
    sinking = hips[:, ::lag].diff(n=2, dim=1) * (KNOT_HZ / lag) ** 2
    assert float(sinking.amin(1).median()) > -9.81
    assert float(sinking.amin(1).min()) > -1.7 * 9.81


def test_walks_have_all_headings_and_half_of_them_turn():
    joints, _ = motion(7, 60)
    hips = joints[:, :, (8, 11), :2].mean(2)
    step = hips[:, 60] - hips[:, 0]
    angle = torch.atan2(step[:, 1], step[:, 0]) + math.pi
    assert {int(q) for q in torch.floor(angle / (math.pi / 2)).clamp(max=3)} == {0, 1, 2, 3}
    way = hips.diff(dim=1).norm(dim=-1).sum(1)
    straight = (hips[:, -1] - hips[:, 0]).norm(dim=-1)
    turned = straight < 0.8 * way
    assert 0.2 < float(turned.double().mean()) < 0.8
    assert float(hips[..., 1].min()) > 1.0


def way_and_turns(hips, step):
    """Ways (N, n, 2) of hips (N, K, 2) over every ``step`` frames, and the angles (N, n - 1) from one to the next."""
    way = hips[:, step::step] - hips[:, :-step:step]
    heading = torch.atan2(way[..., 1], way[..., 0])
    return way, torch.remainder(heading.diff(dim=1) + math.pi, 2 * math.pi) - math.pi


def walkers(walk: Callable[[Tensor, People, Draw], Tensor], count: int, seconds: int) -> Tensor:
    """Joints (N, K, 14, 3) of people who walk in one of the everyday ways."""
    generator = torch.Generator().manual_seed(0)
    people = draw_people(count, everyday.PEOPLE, generator)
    time = torch.arange(seconds * 120, dtype=torch.float64).expand(count, -1) / KNOT_HZ
    return walk(time, people, Draw(count, generator))


def test_those_who_stroll_walk_in_curves_and_go_where_they_face():
    joints = walkers(everyday._stroll, 12, 4)
    hips = joints[:, :, (8, 11), :2].mean(2)
    # Over a second, so that the hips' own to and fro is left out.
    way, turned = way_and_turns(hips, 120)
    assert float(turned.abs().mean(1).median()) > 0.2
    across = joints[:, 60::120, 8, :2] - joints[:, 60::120, 11, :2]
    facing = torch.stack([-across[..., 1], across[..., 0]], dim=-1)[:, : way.shape[1]]
    assert float(torch.nn.functional.cosine_similarity(facing, way, dim=-1).min()) > 0.8


def test_who_lunges_goes_forward_and_the_front_foot_lands_with_the_blow():
    generator = torch.Generator().manual_seed(1)
    people = draw_people(16, everyday.PEOPLE, generator)
    time = torch.arange(4 * KNOT_HZ, dtype=torch.float64).expand(16, -1) / KNOT_HZ
    blow = next(v for v in everyday.VARIANTS[1] if v.lunges > 0)._replace(lunges=1.0, steps=0.0)
    joints = everyday._acted(blow, time, torch.full((16, 1), 4.0).double(), people, Draw(16, generator))
    angle = people.heading_rad
    ahead = torch.stack([-torch.sin(angle), torch.cos(angle), torch.zeros_like(angle)], dim=-1)
    hips = joints[:, :, (8, 11)].mean(2)
    gone = ((hips[:, -1] - hips[:, 0]) * ahead).sum(-1)
    assert float(gone.min()) > 0.3
    assert float(gone.max()) < 1.5
    strikes = (joints[:, :, 4] - joints[:, :, 2]).diff(dim=1).norm(dim=-1).argmax(1)
    foot = joints[:, :, 10, :2].diff(dim=1).norm(dim=-1).cumsum(1)
    at_the_blow = foot.gather(1, strikes[:, None])[:, 0] / foot[:, -1]
    assert float(at_the_blow.median()) > 0.6, (
        "most of the way is behind the front foot when the fist is fastest"
    )
    for upper, lower in ((8, 9), (9, 10), (11, 12), (12, 13)):
        bone = (joints[:, :, upper] - joints[:, :, lower]).norm(dim=-1)
        torch.testing.assert_close(bone, bone[:, :1].expand_as(bone))


def test_half_of_those_who_repeat_slow_down_or_hold_still():
    clock = torch.arange(6 * KNOT_HZ, dtype=torch.float64).expand(40, -1) / KNOT_HZ - 1.0
    uneven = everyday._with_pauses(clock, Draw(40, torch.Generator().manual_seed(0)))
    torch.testing.assert_close(uneven[:, 0], clock[:, 0])
    ticks = uneven.diff(dim=1) * KNOT_HZ
    assert float(ticks.min()) >= 0.0
    assert float(ticks.max()) <= 1.2 + 1e-9
    even = (uneven - clock).abs().amax(1) < 1e-9
    assert 8 < int(even.sum()) < 32
    assert bool((ticks[~even].amin(1) < 0.7).all())


@pytest.mark.parametrize(("activity", "change"), [(4, -0.3), (5, 0.3), (11, -0.8)])
def test_heads_go_down_and_up_as_the_activity_says(activity, change):
    joints, height = motion(activity, 24)
    moved = (joints[:, -1, 0, 2] - joints[:, 0, 0, 2]) / height
    assert float(moved.median()) * math.copysign(1, change) > 0.5 * abs(change)


def test_one_seed_gives_one_motion():
    torch.testing.assert_close(motion(3, 2)[0], motion(3, 2)[0], rtol=0, atol=0)
    assert not torch.equal(motion(3, 2)[0], motion(3, 2, seed=1)[0])


def test_bystanders_stay_where_they_are():
    joints = bystander(4.0, torch.Generator().manual_seed(0))
    assert float((joints.amax(0) - joints.amin(0)).max()) < 0.4


def test_refuses_the_empty_scene():
    with pytest.raises(TensorsimError, match="activity: got 0, expected 1 to 11"):
        motion(0)


@pytest.fixture(scope="module")
def standing() -> Tensor:
    """Joints (80, 14, 3) of a rotating person at 20 frames per second."""
    return at_rate(motion(6, 1)[0][0], 80, 20.0)


def test_keypoints_are_near_the_true_ones(standing):
    camera = CameraConfig(position_m=(0.0, 0.0, 1.5))
    filming = Filming(camera, camera, 360, 640)
    errors = []
    for seed in range(12):
        draw = Draw(1, torch.Generator().manual_seed(seed))
        seen = find_keypoints(standing, 1.75, 20.0, filming, draw)
        other = find_keypoints(
            standing, 1.75, 20.0, filming, Draw(1, torch.Generator().manual_seed(seed + 100))
        )
        errors.append((seen.keypoints - other.keypoints).norm(dim=-1).median())
        assert seen.scores.min() >= 0
        assert seen.scores.max() <= 1
    span = 640 / 2 / math.tan(math.pi / 6) * 1.75 / float(standing[:, 8, 1].mean())
    # Two finds differ by some hundredths of the body's height.
    assert 0.008 < float(torch.stack(errors).median()) / span < 0.06


def test_limbs_jump_for_a_moment_and_their_scores_hardly_fall(standing):
    """As in real films: 1.9 % of the steps of elbows and knees and 2.4 % of those of wrists and ankles."""
    camera = CameraConfig(position_m=(0.0, 0.0, 1.5))
    filming = Filming(camera, camera, 360, 640)
    moves, scores = [], []
    for seed in range(40):
        seen = find_keypoints(standing, 1.75, 20.0, filming, Draw(1, torch.Generator().manual_seed(seed)))
        size = (seen.keypoints[:, 5] - seen.keypoints[:, 15]).norm(dim=-1).median()
        moves.append(seen.keypoints.diff(dim=0).norm(dim=-1) / size)
        scores.append(seen.scores[1:])
    far, sure = torch.stack(moves) > 0.2, torch.stack(scores) > 0.3
    trunk, limbs, ends = (
        far[..., ids].double().mean() for ids in ((5, 6, 11, 12), (7, 8, 13, 14), (9, 10, 15, 16))
    )
    assert float(trunk) < 0.006
    assert 0.01 < float(limbs) < 0.03
    assert 0.015 < float(ends) < 0.04
    assert float(sure[far].double().mean()) > 0.7


def share_reduced_to_legs(joints: Tensor) -> float:
    """How often people with these joints are found as hips and legs alone in a quarter of the frames or more."""
    camera = CameraConfig(position_m=(0.0, 0.0, 1.5))
    filming = Filming(camera, camera, 360, 640)
    times = 0
    for seed in range(60):
        seen = find_keypoints(joints, 1.75, 20.0, filming, Draw(1, torch.Generator().manual_seed(seed)))
        legs, others = seen.keypoints[:, 11:], seen.keypoints[:, :11]
        within = (others >= legs.amin(1, keepdim=True)) & (others <= legs.amax(1, keepdim=True))
        times += float(within.all(-1).all(-1).double().mean()) > 0.25
    return times / 60


def test_some_who_lie_are_reduced_to_their_legs(standing):
    """As in films where the detector finds only these; nobody who stands is."""
    hips = standing[:, (8, 11)].mean(1, keepdim=True)
    # On the back, across the line of sight, 0.15 m above the floor.
    lying = (
        (standing - hips)[..., [2, 1, 0]]
        + hips * torch.tensor([1.0, 1.0, 0.0])
        + torch.tensor([0.0, 0.0, 0.15])
    )
    assert 0.08 < share_reduced_to_legs(lying) < 0.35
    assert share_reduced_to_legs(standing) == 0


def longest_lead(keypoints: Tensor) -> int:
    """For how many frames in a row the same ankle of keypoints (T, 17, 2) is ahead in the picture."""
    ahead = keypoints[:, 15, 0] > keypoints[:, 16, 0]
    changes = torch.nonzero(ahead.diff())[:, 0]
    return int(torch.cat([torch.tensor([-1]), changes, torch.tensor([len(ahead) - 1])]).diff().amax())


def test_the_leg_that_is_ahead_is_called_left_or_right_throughout_in_some_walks_across_the_picture():
    """Networks do so in films. A step takes 11 to 13 frames."""
    camera = CameraConfig(position_m=(0.0, 0.0, 1.0))
    filming = Filming(camera, camera, 360, 640)
    walk = ActivityGenerator().generate("walking", seed=2, duration_s=4.0, rate_hz=20.0).joints[0].double()
    walk = walk - walk[:, 8:9].mean(dim=0) * torch.tensor([1.0, 1.0, 0.0])
    joints = walk @ rotation(2, torch.tensor(math.pi / 2, dtype=torch.float64)).mT
    joints = joints + torch.tensor([0.0, 5.0, 0.0])
    leads = [
        longest_lead(
            find_keypoints(
                joints, 1.75, 20.0, filming, Draw(1, torch.Generator().manual_seed(seed))
            ).keypoints
        )
        for seed in range(60)
    ]
    assert longest_lead(project_keypoints(joints, filming)[0]) < 15
    assert 0.1 < sum(lead > 18 for lead in leads) / 60 < 0.5  # 0.03 by other errors


def test_those_who_walk_round_corners_walk_straight_between_them():
    hips = walkers(everyday._round_corners, 40, 5)[:, :, (8, 11), :2].mean(2)
    turned = way_and_turns(hips, 60)[1].abs()
    assert 0.2 < float((turned < 0.15).double().mean()) < 0.8
    assert float(turned.amax(1).median()) > 0.5
    assert float(turned.amax()) < 2.4


def test_those_who_walk_round_a_room_come_round_one_way_mostly_along_its_walls():
    hips = walkers(everyday._round_and_round, 60, 12)[:, :, (8, 11), :2].mean(2)
    way, turned = way_and_turns(hips, 60)
    # People who turn left keep turning left, by more than half a turn in 12 s; hips sway a little the other way.
    one_way = turned.sum(1).abs()
    assert float(one_way.min()) > math.pi
    assert float((one_way / turned.abs().sum(1)).min()) > 0.5
    # Seven of ten walk nearly along or across the line of sight between their turns.
    straight = turned.abs() < 0.1
    angle = torch.atan2(way[:, 1:, 0], way[:, 1:, 1])
    off = (torch.remainder(angle + math.pi / 4, math.pi / 2) - math.pi / 4).abs()
    square = ((off * straight).sum(1) / straight.sum(1).clamp(min=1)) < 0.4
    assert 0.6 < float(square[straight.any(1)].double().mean()) < 0.95


def test_cameras_have_people_in_view_and_are_known_to_some_degrees(standing):
    hips = (standing[:, 8] + standing[:, 11]) / 2
    wrong = []
    for seed in range(40):
        filming = draw_camera(hips, Draw(1, torch.Generator().manual_seed(seed)))
        seen = find_keypoints(standing, 1.75, 20.0, filming, Draw(1, torch.Generator().manual_seed(seed)))
        assert float((seen.scores[:, 11:13] > 0).double().mean()) > 0.6
        wrong.append(filming.camera.pitch_rad - filming.believed.pitch_rad)
    assert 2.0 < math.degrees(float(torch.tensor(wrong).std())) < 6.5


def test_the_pipeline_finds_the_person_again(standing):
    found, valid = FilmedMotion()(
        [(standing, 1.75), (standing + 0.5, 1.75)], 20.0, torch.Generator().manual_seed(3)
    )
    assert found.shape == (2, 80, 14, 3)
    assert valid.shape == (2, 80)
    assert float(valid.double().mean()) > 0.5
    assert bool(torch.isfinite(found).all())
    hips = found[0, valid[0]][:, 8]
    assert float((hips - standing[valid[0]][:, 8]).norm(dim=-1).median()) < 1.2
    assert float((found[0].diff(dim=0).norm(dim=-1) * 20).max()) < 12.5


def test_motion_at_a_rate_goes_through_the_knots(standing):
    joints, _ = motion(6, 1)
    torch.testing.assert_close(at_rate(joints[0], 40, KNOT_HZ / 4), joints[0, :160:4])

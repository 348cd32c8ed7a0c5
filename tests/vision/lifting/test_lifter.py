"""Nearest-match lifting, against brute force in NumPy, closed-form fits and real motion."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.skeleton import body_height, mid_hips, mirror
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError
from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.types import Lifted
from tensorsim.vision.lifting.lifter import NearestPoseLifter, fit_poses, smooth_assignment
from tensorsim.vision.lifting.pose_library import all_headings, load_pose_library, standardise_poses
from tensorsim.vision.lifting.pose_search import PoseSearch
from tensorsim.vision.smoothing.along_time import nearest_valid
from tests.stage import StageTester

LIBRARY = sample_poses(60, seed=1)


def projected(poses: Tensor, scale: float = 170.0) -> Tensor:
    """Poses (..., 14, 3) seen along y, in pixels with v down."""
    return scale * torch.stack([poses[..., 0], -poses[..., 2]], dim=-1) + 200.0


class TestNearestPoseLifter(StageTester):
    batched_arguments = (0, 1)
    gradient_arguments = (0, 1)

    def make(self) -> nn.Module:
        return NearestPoseLifter(LIBRARY, yaws=6, neighbours=5)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        poses = sample_poses(20, seed=2)[torch.randint(0, 20, (*batch, 6), generator=generator)]
        keypoints = projected(poses) + 4 * torch.randn(*batch, 6, 14, 2, generator=generator, dtype=dtype)
        weights = 0.2 + 0.8 * torch.rand(*batch, 6, 14, generator=generator, dtype=dtype)
        if dtype == torch.float32:
            weights[..., 2, :] = 0.0  # not where differences are taken: weights below 0 are refused
        return keypoints.to(dtype), weights

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        k, w = torch.zeros(4, 14, 2), torch.ones(4, 14)
        return [
            ((torch.zeros(4, 17, 2), torch.ones(4, 17)), r"expected \(\.\.\., T, 14, 2\)"),
            ((torch.zeros(14, 2), torch.ones(14)), r"expected \(\.\.\., T, 14, 2\)"),
            ((torch.zeros(4, 14, 3), w), r"expected \(\.\.\., T, 14, 2\)"),
            ((k, torch.ones(4, 13)), r"weights: got shape \[4, 13\], expected \[4, 14\]"),
            ((k * float("nan"), w), "keypoints: got NaN"),
            ((k, w * float("nan")), "weights: got NaN"),
            ((k, -w), "weights: got negative"),
            ((k[:0], w[:0]), "at least 1 frame"),
            ((k.long(), w), "dtype"),
        ]

    def test_scripted_refuses_bad_input(self) -> None:
        scripted = torch.jit.script(self.make())
        with pytest.raises(Exception, match="weights: got negative"):
            scripted(torch.zeros(4, 14, 2), -torch.ones(4, 14))

    def test_no_people_give_nothing(self) -> None:
        lifted = self.make()(torch.zeros(2, 0, 5, 14, 2), torch.zeros(2, 0, 5, 14))
        assert lifted.depth.shape == (2, 0, 5, 14)
        assert lifted.scale.shape == (2, 0, 5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"library": torch.zeros(0, 14, 3)}, "library"),
        ({"library": LIBRARY, "yaws": 0}, "yaws: got 0"),
        ({"library": LIBRARY, "neighbours": 0}, "neighbours: got 0"),
        ({"library": LIBRARY, "yaws": 1, "neighbours": 61}, "neighbours: got 61, expected at most 60"),
        ({"library": LIBRARY, "tolerance": 0.0}, "tolerance"),
        ({"library": LIBRARY, "temporal": -1.0}, "temporal"),
        ({"library": LIBRARY, "chunk": 0}, "chunk"),
        (
            {"library": LIBRARY, "search_joints": 15},
            "search_joints: got 15, expected an integer from 1 to 14",
        ),
        ({"library": LIBRARY, "pitch_rad": math.nan}, "pitch_rad: got nan"),
        ({"library": LIBRARY, "roll_rad": math.inf}, "roll_rad: got inf"),
    ],
)
def test_refuses_bad_settings(options: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        NearestPoseLifter(**options)


# ---- the fit ---------------------------------------------------------------------------------------------


def test_a_pose_that_fits_only_upside_down_is_no_match() -> None:
    library = standardise_poses(sample_poses(400, seed=8))
    upside_down = projected(library[:1]) * -1.0
    index = PoseSearch(library, 1, 1, 1000)(upside_down, torch.ones(1, 14, dtype=torch.float64))
    scale, _, distance = fit_poses(upside_down, torch.ones(1, 14, dtype=torch.float64), library[:1])
    assert int(index) != 0
    assert float(scale) == 0.0
    assert float(distance) == pytest.approx(1.0)


def test_fit_is_the_closed_form_similarity() -> None:
    pose = standardise_poses(sample_poses(13, seed=8))
    shifted = 120.0 * torch.stack([pose[..., 0], -pose[..., 2]], dim=-1) + torch.tensor([30.0, -70.0])
    weights = torch.rand(13, 14, dtype=torch.float64)
    scale, placed, distance = fit_poses(shifted, weights, pose)
    torch.testing.assert_close(scale, torch.full((13,), 120.0, dtype=torch.float64))
    torch.testing.assert_close(placed, shifted)
    assert float(distance.max()) < 1e-12


# ---- conventions ---------------------------------------------------------------------------------------


def test_depth_is_positive_away_from_the_camera_in_body_heights() -> None:
    pose = BodyPose.standing()
    hip = pose.hip.clone()
    hip[0, 0] = math.pi / 4  # the right leg goes forward; the body faces +y, away from the camera
    pose = pose._replace(hip=hip)
    library = torch.cat([forward_kinematics(pose, 1.75)[None], 1.75 * LIBRARY])
    image = projected(forward_kinematics(pose)[None])
    lifted = NearestPoseLifter(library, yaws=1, neighbours=1)(image, torch.ones(1, 14, dtype=torch.float64))
    assert int(lifted.nearest) == 0
    expected = forward_kinematics(pose)[None, :, 1]
    torch.testing.assert_close(lifted.depth, expected, atol=1e-9, rtol=0)
    assert float(lifted.depth[0, JOINTS.index("right_ankle")]) > 0.2


def test_scale_is_pixels_per_standing_body_height_in_any_pose() -> None:
    folded = sample_poses(200, seed=1)
    lifter = NearestPoseLifter(folded, yaws=4, neighbours=1)
    lifted = lifter(projected(folded, 300.0), torch.ones(200, 14, dtype=torch.float64))
    own = lifted.nearest // 4 == torch.arange(200)
    assert float(own.double().mean()) > 0.95
    torch.testing.assert_close(
        lifted.scale[own], torch.full_like(lifted.scale[own], 300.0), rtol=1e-6, atol=0
    )


def test_index_counts_headings_within_poses() -> None:
    library = standardise_poses(sample_poses(30, seed=9))
    turned = all_headings(library, 5)
    lifted = NearestPoseLifter(library, yaws=5, neighbours=1)(
        projected(turned[[17 * 5 + 3]]), torch.ones(1, 14, dtype=torch.float64)
    )
    assert int(lifted.nearest) == 17 * 5 + 3


def test_hidden_joints_get_a_place_from_the_found_pose() -> None:
    image = projected(LIBRARY)
    weights = torch.ones(60, 14, dtype=torch.float64)
    weights[:, JOINTS.index("left_wrist")] = 0.0
    garbled = image.clone()
    garbled[:, JOINTS.index("left_wrist")] = 0.0
    lifted = NearestPoseLifter(LIBRARY, yaws=1, neighbours=1)(garbled, weights)
    own = lifted.nearest == torch.arange(60)
    assert float(own.double().mean()) > 0.9
    torch.testing.assert_close(lifted.keypoints[own], image[own], atol=1e-6, rtol=0)


# ---- neighbours and time -------------------------------------------------------------------------------


def test_posterior_is_that_of_all_paths() -> None:
    generator = torch.Generator().manual_seed(1)
    emission = torch.randn(2, 4, 3, generator=generator, dtype=torch.float64)
    transition = torch.randn(2, 3, 3, 3, generator=generator, dtype=torch.float64)
    expected = torch.zeros(2, 4, 3, dtype=torch.float64)
    for s in range(2):
        for path in itertools.product(range(3), repeat=4):
            log = sum(emission[s, t, k] for t, k in enumerate(path))
            log = log + sum(transition[s, t, path[t], path[t + 1]] for t in range(3))
            for t, k in enumerate(path):
                expected[s, t, k] += torch.exp(log)
    expected /= expected.sum(dim=-1, keepdim=True)
    torch.testing.assert_close(smooth_assignment(emission, transition), expected)


def test_one_frame_and_no_temporal_weight_are_the_same() -> None:
    image = projected(sample_poses(20, seed=3))[:1]
    weights = torch.ones(1, 14, dtype=torch.float64)
    with_time = NearestPoseLifter(LIBRARY, neighbours=7)(image, weights)
    without = NearestPoseLifter(LIBRARY, neighbours=7, temporal=0.0)(image, weights)
    torch.testing.assert_close(with_time.depth, without.depth)


def test_temporal_weight_keeps_depths_from_flipping() -> None:
    """A straight leg seen from the front swings forward or backward: the picture hardly shows which."""
    swing = 0.5 * torch.sin(torch.linspace(0, 6, 60, dtype=torch.float64))
    hip = torch.zeros(60, 2, 2, dtype=torch.float64)
    hip[:, 0, 0] = swing
    true = forward_kinematics(BodyPose.standing((60,))._replace(hip=hip))
    ambiguous = torch.cat([true, true * torch.tensor([1.0, -1.0, 1.0])])  # every pose and its depth mirror
    image = projected(true)
    image = image + 1.0 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0)).double()
    weights = torch.ones(60, 14, dtype=torch.float64)

    def jumps(**options: Any) -> float:
        depth = NearestPoseLifter(ambiguous, yaws=1, **options)(image, weights).depth
        return float((depth[1:] - depth[:-1]).abs().amax(dim=-1).mean())

    nearest, smooth = jumps(neighbours=1), jumps(neighbours=24)
    assert nearest > 0.05  # body heights: it does flip
    assert smooth < 0.3 * nearest


def test_a_body_half_out_of_the_picture_keeps_the_pose_of_its_better_frames() -> None:
    """From a head and two shoulders alone, the rest is unknown: a lying person would fit as well."""
    pose = sample_poses(2000)[1].float().expand(5, 14, 3)
    keypoints, weights = projected(pose), torch.ones(5, 14)
    weights[2, 3:] = 0.0
    lifter = NearestPoseLifter(temporal=0.0)
    lifted, whole = lifter(keypoints, weights), lifter(keypoints, torch.ones(5, 14))
    assert torch.allclose(lifted.depth[[0, 1, 3, 4]], whole.depth[[0, 1, 3, 4]], atol=1e-5)
    careless = NearestPoseLifter(temporal=0.0, search_joints=2)(keypoints, weights)
    error, guess = ((x.depth[2] - whole.depth[2]).abs().max() for x in (lifted, careless))
    assert error < 0.05
    assert guess > 3 * error


def test_deviation_is_the_spread_of_the_poses_that_fit() -> None:
    """A pose and its mirror image along depth look alike: half of each, no depth, and that of one as deviation."""
    poses = standardise_poses(sample_poses(20, seed=3))[:4]
    library = torch.cat([poses, poses * torch.tensor([1.0, -1.0, 1.0])])
    lifted = NearestPoseLifter(library, yaws=1, neighbours=2, temporal=0.0)(
        projected(poses), torch.ones(4, 14)
    )
    torch.testing.assert_close(
        lifted.deviation, poses[..., 1].abs().to(lifted.deviation), atol=1e-5, rtol=1e-4
    )
    assert float(lifted.depth.abs().max()) < 1e-5
    single = NearestPoseLifter(library, yaws=1, neighbours=1)(projected(poses), torch.ones(4, 14))
    assert float(single.deviation.max()) < 1e-5


def test_frames_without_joints_take_their_neighbours() -> None:
    image = projected(sample_poses(20, seed=3))[:6]
    weights = torch.ones(6, 14, dtype=torch.float64)
    weights[2:4] = 0.0
    lifted = NearestPoseLifter(LIBRARY, neighbours=1)(image, weights)
    assert torch.equal(lifted.nearest[2], lifted.nearest[1])
    assert torch.equal(lifted.nearest[3], lifted.nearest[4])
    for field in NearestPoseLifter(LIBRARY)(image, 0 * weights):
        assert bool(torch.isfinite(field.double()).all())


def test_nearest_valid_frame() -> None:
    valid = torch.tensor([[0, 1, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0, 0]]) > 0
    expected = [[1, 1, 1, 1, 5, 5, 5], [0, 1, 2, 3, 4, 5, 6]]
    assert nearest_valid(valid).tolist() == expected


# ---- real motion ---------------------------------------------------------------------------------------


def film(joints: Tensor, yaw: float, noise_px: float) -> tuple[Tensor, Tensor]:
    """Keypoints of a body of 1.75 m that stays 4 m in front of a pinhole camera, and its relative depths."""
    body = 1.75 * (joints - mid_hips(joints)[:, None]) / body_height(joints).mean()
    c, s = math.cos(yaw), math.sin(yaw)
    x = c * body[..., 0] - s * body[..., 1]
    y = s * body[..., 0] + c * body[..., 1]
    image = 685.7 * torch.stack([x, -body[..., 2]], dim=-1) / (4.0 + y)[..., None]  # 300 px for 1.75 m
    noise = torch.randn(image.shape, generator=torch.Generator().manual_seed(0), dtype=image.dtype)
    return image + noise_px * noise, y


def errors(lifted: Lifted, depth: Tensor) -> tuple[float, float]:
    """Mean error of depth and of its change from frame to frame, in cm."""
    wrong = 175 * lifted.depth - 100 * depth
    return float(wrong.abs().mean()), float((wrong[1:] - wrong[:-1]).abs().mean())


@pytest.mark.parametrize("pool", ["other clips", "shipped"])
def test_lifts_motion_capture_that_it_has_not_seen(shared_data: Path, pool: str) -> None:
    clips = np.load(shared_data / "mocap" / "cmu_14joints_120hz.npz")
    thirty = {name: torch.tensor(clips[name][::4]) for name in clips.files}
    totals = np.zeros((2, 2))
    tried = ("walking_1", "running_3", "soccer_1")
    for name in tried:
        if pool == "shipped":
            library = load_pose_library()
        else:
            library = torch.cat([standardise_poses(clip)[::3] for n, clip in thirty.items() if n != name])
            library = torch.cat([library, mirror(library)])
        image, depth = film(thirty[name][:90], yaw=2.5, noise_px=2.0)
        for row, options in enumerate(({"neighbours": 1}, {})):
            lifted = NearestPoseLifter(library, **options)(image, torch.ones(image.shape[:2]))
            totals[row] += np.array(errors(lifted, depth)) / len(tried)
    nearest, default = totals
    assert default[0] < (9.0 if pool == "other clips" else 13.0)
    assert default[0] < nearest[0]
    assert default[1] < 0.6 * nearest[1]


@pytest.mark.parametrize("there", [(True, True, True), (True, False, True), (False, False, True)])
def test_shares_are_those_of_all_sequences(there: tuple[bool, ...]) -> None:
    """Probabilities of candidates by enumeration of all 3^3 sequences; poses of the first two frames are the same."""
    generator = torch.Generator().manual_seed(0)
    lifter = NearestPoseLifter(standardise_poses(sample_poses(20)), yaws=1, neighbours=3, tolerance=0.1)
    poses = 0.01 * torch.randn(1, 3, 3, 14, 3, generator=generator, dtype=torch.float64)
    poses[:, 1] = poses[:, 0]
    scale = 200 + torch.rand(1, 3, 3, generator=generator, dtype=torch.float64)
    distance = 0.02 * torch.rand(1, 3, 3, generator=generator, dtype=torch.float64)
    found = lifter._share(poses, scale, distance, torch.tensor([there]))

    weight = np.zeros((3, 3, 3))
    # The worse the nearest pose fits, the less the differences between poses count.
    variance = 0.1**2 + 0.3 * distance[0].amin(dim=1).numpy()
    size = lifter.change / lifter.size_change * np.log(scale[0].numpy())
    for path in np.ndindex(3, 3, 3):
        total = sum(-0.5 / variance[t] * float(distance[0, t, path[t]]) * there[t] for t in range(3))
        for t in range(2):
            a, b = poses[0, t, path[t]].numpy(), poses[0, t + 1, path[t + 1]].numpy()
            change = np.sum((a - b) ** 2) / 14 + (size[t, path[t]] - size[t + 1, path[t + 1]]) ** 2
            kept = t == 0 and not (there[0] and there[1])  # a frame without a pose has that of its neighbour
            moved = 0.0 if path[t] == path[t + 1] else -np.inf
            total += moved if kept else -0.5 / lifter.change**2 * change
        weight[path] = np.exp(total)
    weight /= weight.sum()
    expected = np.stack([weight.sum(axis=tuple({0, 1, 2} - {t})) for t in range(3)])
    np.testing.assert_allclose(found[0].numpy(), expected, atol=1e-6)

"""Depths from bones that keep their length: against SciPy's least squares, and against bodies that are known."""

from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.optimize import least_squares
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.vision.lifting.block_tridiagonal import solve_block_tridiagonal
from tensorsim.vision.lifting.bone_branches import choose_branches, smoothest_sequence
from tensorsim.vision.lifting.bone_cost import BoneClip, BoneCost, expected_acceleration
from tensorsim.vision.lifting.bone_descent import BoneDescent, second_difference_hessian
from tensorsim.vision.lifting.bone_fit import BoneFit
from tests.stage import StageTester

CAMERA = (0.1, -2.0, 1.1)
#: Bones by their ends, 14 the middle of the hips, and which length each has: nose to neck, shoulders, upper arm,
#: forearm, hips, thigh, shank, trunk as shares of the standing height (Winter, after Drillis and Contini).
BONES = [
    (0, 1),
    (2, 5),
    (2, 3),
    (3, 4),
    (5, 6),
    (6, 7),
    (8, 11),
    (8, 9),
    (9, 10),
    (11, 12),
    (12, 13),
    (1, 14),
]
LENGTH_OF_BONE = [0, 1, 2, 3, 2, 3, 4, 5, 6, 5, 6, 7]
LENGTH_SHARES = [0.1253, 0.210, 0.186, 0.146, 0.12, 0.245, 0.246, 0.288]
FREE = [0, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13]
FPS = 30.0


def moving(frames: int, seed: int = 5) -> tuple[Tensor, float]:
    """A person who walks, (frames, 14, 3), and their height."""
    motion = ActivityGenerator().generate("walking", seed=seed, duration_s=frames / FPS, rate_hz=FPS)
    return motion.joints[0], float(motion.people.height_m[0])


def misplaced(joints: Tensor, deviation_m: float = 0.08, seed: int = 0) -> Tensor:
    """Joints moved along their lines of sight, each by an error that stays."""
    generator = torch.Generator().manual_seed(seed)
    sight = joints - joints.new_tensor(CAMERA)
    off = deviation_m * torch.randn(1, 14, 1, generator=generator, dtype=joints.dtype)
    return joints + off * sight / sight.norm(dim=-1, keepdim=True)


class Fit(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.stage = BoneFit(CAMERA, (1.8, 1.7), True, bone_m=0.02, steps=(1, 1), rounds=1)

    def forward(self, joints: Tensor, seen: Tensor) -> Tensor:
        return self.stage(joints, seen, 30.0)


class TestBoneFit(StageTester):
    batched_arguments = (0, 1)
    batch_atol = 1e-6

    def make(self) -> nn.Module:
        return Fit()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        body = misplaced(moving(7)[0])
        noise = torch.randn(*batch, 2, 7, 14, 3, generator=generator, dtype=torch.float64)
        seen = torch.rand(*batch, 2, 7, 14, generator=generator) > 0.05
        seen &= torch.rand(*batch, 2, 7, 1, generator=generator) > 0.2
        return (body + 0.02 * noise).to(dtype), seen

    @pytest.mark.slow  # thousands of small operations
    def test_exports(self) -> None:
        super().test_exports()

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints, seen = self.inputs((), torch.float32)
        return [
            ((joints[..., :13, :], seen), r"expected \(\.\.\., P, T, 14, 3\)"),
            ((joints[..., :2], seen), r"expected \(\.\.\., P, T, 14, 3\)"),
            ((joints * float("nan"), seen), "joints: got NaN"),
            (
                (joints, seen[..., :3]),
                r"got torch.bool of shape \[2, 7, 3\], expected bool of shape \[2, 7, 14\]",
            ),
            ((joints, seen.float()), "seen: got torch.float32"),
        ]


def test_block_tridiagonal_systems_as_dense_ones() -> None:
    generator = torch.Generator().manual_seed(0)
    half = torch.randn(2, 12, 12, generator=generator, dtype=torch.float64)
    matrix = half @ half.mT + 12 * torch.eye(12)
    block = torch.arange(12) // 3
    matrix = matrix * ((block[:, None] - block).abs() <= 1)
    matrix = matrix + 40 * torch.eye(12)
    right = torch.randn(2, 12, 2, generator=generator, dtype=torch.float64)
    diagonal = torch.stack([matrix[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(4)], 1)
    below = torch.stack([matrix[:, 3 * k + 3 : 3 * k + 6, 3 * k : 3 * k + 3] for k in range(3)], 1)
    solved = solve_block_tridiagonal(diagonal, below, right.reshape(2, 4, 3, 2)).reshape(2, 12, 2)
    np.testing.assert_allclose(solved, np.linalg.solve(matrix.numpy(), right.numpy()), rtol=1e-9)


@pytest.mark.parametrize("frames", [6, 7])
@pytest.mark.parametrize("calibrated", [False, True])
def test_minimum_is_that_of_scipy(frames: int, calibrated: bool) -> None:
    joints, height = moving(frames)
    given = misplaced(joints, 0.03).numpy()
    seen = np.ones((frames, 14), bool)
    seen[2, 10] = False
    stage = BoneFit(CAMERA, (height,), calibrated, bone_m=0.02, steps=(30, 60), rounds=0)
    fitted = stage(torch.from_numpy(given)[None], torch.from_numpy(seen)[None], FPS)[0]

    sight = given - np.array(CAMERA)
    distance = np.linalg.norm(sight, axis=-1)
    lines = sight / distance[..., None]
    d = np.diff(lines[:, FREE], 4, axis=0)
    d[:, ~seen[:, FREE].all(0)] = 0.0  # a joint that is not seen throughout has no jitter in so few frames
    shake = (1.4826 / 70**0.5 * np.quantile(np.abs(d), 0.5, axis=0, method="lower")).mean()
    away = distance[:, FREE].mean()
    bone_m = np.hypot(0.02, 2 * shake * away)
    # What is seen of the acceleration, smoothed by a Gaussian of two frames.
    square = (np.diff(away * lines[:, FREE], 2, axis=0) ** 2).sum(-1)
    kernel = np.exp(-0.5 * (np.arange(-7, 8) / 2) ** 2)
    smooth = ndimage.correlate1d(
        np.pad(square, ((1, 1), (0, 0)), "edge"), kernel / kernel.sum(), 0, mode="nearest"
    )
    speed = np.linalg.norm(np.gradient(away * lines[:, FREE], axis=0), axis=-1)[1:-1] * FPS
    speed = np.pad(speed, ((1, 1), (0, 0)), "edge")
    smooth = np.maximum(smooth - 12 * (shake * away) ** 2, 0) * FPS**4
    acceleration = np.sqrt(16 + 9 * (smooth + smooth.mean(1, keepdims=True)))

    # The right ankle ends the tenth bone, of the right shank, alone.
    deviation = np.hypot(bone_m, np.where((np.arange(12) == 8)[:, None] & ~seen[:, 10], 0.1, 0.0))

    def points(r: np.ndarray) -> np.ndarray:
        x = np.zeros((frames, 15, 3))
        x[:, FREE] = np.array(CAMERA) + r[..., None] * lines[:, FREE]
        x[:, 1], x[:, 14] = (x[:, 2] + x[:, 5]) / 2, (x[:, 8] + x[:, 11]) / 2
        return x

    def cauchy(x: np.ndarray) -> np.ndarray:
        return np.sign(x) * np.sqrt(0.3 * np.log1p(x**2))

    def errors(unknown: np.ndarray) -> np.ndarray:
        r, stretch = unknown[:-8].reshape(frames, 13), unknown[-8:]
        x, off = points(r), r - distance[:, FREE]
        length = height * np.array(LENGTH_SHARES) * np.exp(stretch)
        bones = [
            np.linalg.norm(x[:, a] - x[:, b], axis=-1) - length[i]
            for (a, b), i in zip(BONES, LENGTH_OF_BONE, strict=True)
        ]
        hips = (off[:, FREE.index(8)] + off[:, FREE.index(11)]) / 2
        parts = [
            np.array(bones) / deviation, stretch / 0.025, np.diff(r, 2, axis=0) * FPS**2 / acceleration[1:-1],
            cauchy((off - hips[:, None]) / 0.05), cauchy(hips / 0.3),
        ]  # fmt: skip
        if calibrated:
            ankle = np.isin(FREE, (10, 13))
            over = x[:, FREE, 2] - np.where(ankle, 0.039, 0.045) * height
            rest_m = np.where(ankle, np.hypot(0.002, 0.02 * speed), 0.005)
            lowest = np.arange(frames), over.argmin(axis=1)
            low = over[lowest] / 0.03
            weight = seen[:, FREE][lowest] * 0.03 / rest_m[lowest]
            parts += [weight * low / np.sqrt(1 + low**2), seen[:, FREE] * np.minimum(over, 0) / 0.005]
        return np.concatenate([p.ravel() for p in parts])

    # There are several minima: the lower one of those found by SciPy from the given start and from our result.
    found = np.linalg.norm(fitted.numpy() - np.array(CAMERA), axis=-1)[:, FREE]
    best = min(
        (
            least_squares(errors, np.r_[r.ravel(), np.zeros(8)], xtol=1e-12, ftol=1e-12, gtol=1e-12)
            for r in (distance[:, FREE], found)
        ),
        key=lambda result: result.cost,
    )
    np.testing.assert_allclose(fitted.numpy(), points(best.x[:-8].reshape(frames, 13))[:, :14], atol=5e-4)


def test_sequences_are_the_best_of_all() -> None:
    generator = torch.Generator().manual_seed(3)
    places = torch.randn(5, 6, 3, 2, generator=generator, dtype=torch.float64)
    cost = torch.rand(5, 6, 3, generator=generator, dtype=torch.float64)
    every = torch.cartesian_prod(*[torch.arange(3)] * 6)  # (729, 6)
    frame = torch.arange(6)
    bend = places[:, frame, every].diff(n=2, dim=2)
    total = cost[:, frame, every].sum(-1) + 4 * (1 + 2.5 * bend.square() / 4).log().sum((-1, -2))
    assert torch.equal(smoothest_sequence(places, cost, 2.5), every[total.argmin(dim=-1)])


def test_branches_of_known_lengths_are_found_from_the_middle_of_the_hips() -> None:
    joints, _ = moving(60)
    sight = joints[None][:, :, FREE] - joints.new_tensor(CAMERA)
    distance = sight.norm(dim=-1)
    lines = sight / distance[..., None]
    hips = (joints[:, 8] + joints[:, 11]) / 2
    whole = torch.cat([joints, hips[:, None]], dim=1)
    first = [LENGTH_OF_BONE.index(i) for i in range(8)]
    lengths = torch.stack(
        [(whole[:, BONES[i][0]] - whole[:, BONES[i][1]]).norm(dim=-1).mean() for i in first]
    )
    flat = ((distance[..., 7] + distance[..., 10]) / 2)[..., None].expand_as(distance)
    floor = torch.stack([torch.full_like(distance, 1e6), torch.zeros_like(distance)], dim=-1)
    # From the plane of the hips and a lifter that is right, all signs; from one that is 8 cm off, those of the legs.
    found = choose_branches(flat, lines, lengths[None], distance, 0.3, 0.05, floor, FPS)
    assert float((found - distance).abs().mean()) < 0.01
    generator = torch.Generator().manual_seed(0)
    given = distance + 0.08 * torch.randn(1, 1, 13, generator=generator, dtype=torch.float64)
    found = choose_branches(flat, lines, lengths[None], given, 0.3, 0.05, floor, FPS)
    torch.testing.assert_close(found[..., 7:], distance[..., 7:], rtol=0.0, atol=1e-6)


def test_limbs_that_lean_the_wrong_way_are_turned_over() -> None:
    """An arm mirrored in depth looks the same and has the right length: only the search over branches mends it."""
    motion = ActivityGenerator().generate("kicking", seed=5, duration_s=2.0, rate_hz=FPS)
    joints, height = motion.joints[0], float(motion.people.height_m[0])
    sight = joints - joints.new_tensor(CAMERA)
    distance = sight.norm(dim=-1, keepdim=True)
    wrong = distance.clone()
    wrong[20:40, 3:5] = 2 * wrong[20:40, 2:3] - wrong[20:40, 3:5]
    wrong = (joints.new_tensor(CAMERA) + sight / distance * wrong)[None]
    seen = torch.ones(1, 60, 14, dtype=torch.bool)

    def error(rounds: int) -> float:
        fitted = BoneFit(CAMERA, (height,), calibrated=True, rounds=rounds)(wrong, seen, FPS)[0]
        return float((fitted - joints)[:, 3:5].norm(dim=-1).mean())

    assert error(0) > 0.1
    assert error(3) < 0.02


def test_floor_holds_who_lies_and_tells_how_far() -> None:
    motion = ActivityGenerator().generate("falling to walking", seed=11, duration_s=2.0, rate_hz=FPS)
    joints, height = motion.joints[0], float(motion.people.height_m[0])
    sight = joints - joints.new_tensor(CAMERA)
    given = (joints.new_tensor(CAMERA) + 1.1 * sight)[None]
    seen = torch.ones(1, 60, 14, dtype=torch.bool)
    off = [
        float((BoneFit(CAMERA, (height,), calibrated)(given, seen, FPS)[0] - joints).norm(dim=-1).mean())
        for calibrated in (False, True)
    ]
    assert off[1] < 0.1
    assert off[1] < 0.5 * off[0]


def test_joints_that_are_not_seen_do_not_bend_the_others() -> None:
    joints, height = moving(60)
    wrong = misplaced(joints)[None]
    wrong[0, 20:40, 4] += torch.tensor([0.5, 0.0, -0.4], dtype=torch.float64)  # a wrist, guessed
    seen = torch.ones(1, 60, 14, dtype=torch.bool)
    others = [j for j in range(14) if j != 4]

    def error(seen: Tensor) -> float:
        fitted = BoneFit(CAMERA, (height,), calibrated=True)(wrong, seen, FPS)[0]
        return float((fitted - joints)[:, others].norm(dim=-1).mean())

    believed = error(seen)
    seen[0, 20:40, 4] = False
    assert error(seen) < 0.6 * believed


def test_joints_that_move_in_the_picture_are_expected_to_move_along_it() -> None:
    time = torch.arange(90, dtype=torch.float64) / FPS
    across = torch.zeros(1, 90, 2, 3, dtype=torch.float64)
    across[0, :, 1, 0] = 0.2 * torch.sin(2 * torch.pi * time)
    found = expected_acceleration(across, torch.zeros(1, dtype=torch.float64), FPS, 4.0, 3.0)[0, 30:60]
    mean_square = (0.2 * (2 * torch.pi) ** 2) ** 2 / 2
    assert float(found[:, 0].square().mean()) == pytest.approx(16 + 9 * mean_square / 2, rel=0.05)
    assert float(found[:, 1].square().mean()) == pytest.approx(16 + 9 * mean_square * 1.5, rel=0.05)
    generator = torch.Generator().manual_seed(0)
    noisy = across + 0.002 * torch.randn(across.shape, generator=generator, dtype=torch.float64) * (
        torch.tensor([1.0, 0.0, 1.0])
    )
    found = expected_acceleration(noisy, torch.tensor([0.002], dtype=torch.float64), FPS, 4.0, 3.0)[0, 30:60]
    assert float(found[:, 0].square().mean()) == pytest.approx(16 + 9 * mean_square / 2, rel=0.35)


def test_depths_of_exact_keypoints_come_out_right() -> None:
    joints, height = moving(90)
    given = torch.cat([misplaced(frame[None], seed=t) for t, frame in enumerate(joints)])
    fitted = BoneFit(CAMERA, (height,), calibrated=True)(
        given[None], torch.ones(1, 90, 14, dtype=torch.bool), FPS
    )[0]

    def error(x: Tensor) -> float:
        return float((x - joints).norm(dim=-1).square().mean().sqrt())

    assert error(given) > 0.07
    assert error(fitted) < 0.5 * error(given)
    lengths = torch.stack([(fitted[:, a] - fitted[:, b]).norm(dim=-1) for a, b in BONES[:11]])
    assert float((lengths.amax(-1) - lengths.amin(-1)).max()) < 0.01


def test_joints_stay_on_their_lines_of_sight_but_for_the_neck() -> None:
    joints, height = moving(30)
    given = misplaced(joints)
    fitted = BoneFit(CAMERA, (height,))(given[None], torch.ones(1, 30, 14, dtype=torch.bool), FPS)[0]
    before, after = (x[:, FREE] - x.new_tensor(CAMERA) for x in (given, fitted))
    torch.testing.assert_close(
        after / after.norm(dim=-1, keepdim=True), before / before.norm(dim=-1, keepdim=True)
    )
    torch.testing.assert_close(fitted[:, 1], (fitted[:, 2] + fitted[:, 5]) / 2)


def test_invalid_frames_and_very_short_clips_stay() -> None:
    joints, height = moving(30)
    given = misplaced(joints)[None]
    seen = torch.ones(1, 30, 14, dtype=torch.bool)
    seen[0, 10:13] = False
    fitted = BoneFit(CAMERA, (height,))(given, seen, FPS)
    assert torch.equal(fitted[:, 10:13], given[:, 10:13])
    assert not torch.equal(fitted[:, 9], given[:, 9])
    assert torch.equal(BoneFit(CAMERA)(given[:, :3], seen[:, :3], FPS), given[:, :3])


def test_settings_are_checked() -> None:
    for options, message in (
        ({"bone_m": 0.0}, "BoneFit.bone_m: got 0.0"),
        ({"person_height_m": ()}, "BoneFit.person_height_m: got no values"),
        ({"person_height_m": (1.8, -1.0)}, r"BoneFit.person_height_m\[1\]: got -1.0"),
    ):
        with pytest.raises(TensorsimError, match=message):
            BoneFit(**options)


def test_deviations_from_what_is_given_cost_as_in_numpy() -> None:
    """As of Cauchy's distribution: distances relative to the hips, and that of the hips."""
    rng = np.random.default_rng(0)
    given, off = rng.uniform(3, 5, (2, 4, 13)), 0.1 * rng.standard_normal((2, 4, 13))
    hips = (off[..., FREE.index(8)] + off[..., FREE.index(11)]) / 2
    expected = np.log1p((hips / 0.3) ** 2).sum(1)
    expected += np.log1p(((off - hips[..., None]) / 0.05) ** 2).sum((1, 2))
    empty = torch.zeros(0)
    clip = BoneClip(empty, torch.from_numpy(given), empty, empty, empty, empty, empty)
    cost = BoneCost(0.025, 0.05, 0.3, 0.3, 0.005, False).double()
    np.testing.assert_allclose(cost.given(clip, torch.from_numpy(given + off))[2], 0.3 * expected, rtol=1e-9)


@pytest.mark.parametrize("frames", [3, 6, 7])
@pytest.mark.parametrize("floor", [False, True])
def test_a_step_is_that_of_the_dense_normal_equations(frames: int, floor: bool) -> None:
    """Gauss-Newton with damping: gradient and Jacobian by automatic differentiation, one matrix for everything."""
    generator = torch.Generator().manual_seed(frames)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    lines = torch.nn.functional.normalize(random(2, frames, 13, 3) - 0.5, dim=-1)
    stiffness = torch.nn.functional.pad(50 * random(2, frames - 2, 13), [0, 0, 2, 2])
    clip = BoneClip(
        lines, 4 + random(2, frames, 13), 0.1 + random(2, 8), random(2, frames, 13, 2) - 0.3, stiffness,
        30 * (random(2, frames, 13) > 0.2), 0.01 * (random(2, frames, 12) > 0.7),
    )  # fmt: skip
    cost = BoneCost(0.025, 0.05, 0.3, 0.3, 0.005, floor).double()
    r, stretch, bone_m = clip.given + 0.1 * random(2, frames, 13), 0.1 * random(2, 8), 0.02 + 0.01 * random(2)
    damping = torch.tensor([1.0, 0.03], dtype=torch.float64)
    parts = second_difference_hessian(clip.stiffness, frames)
    found = BoneDescent(cost)._step(clip, r, stretch, bone_m, damping, *parts)
    step, stretch_step = (x.numpy() for x in found)

    count = 13 * frames
    jacobian_of = torch.autograd.functional.jacobian
    gradients = jacobian_of(lambda a, b: cost(clip, a, b, bone_m).sum() / 2, (r, stretch))
    slopes = jacobian_of(lambda a, b: cost.bone_errors(clip, a, b, bone_m)[2], (r, stretch))
    for k in range(2):
        by_r = slopes[0][k, :, :, k].reshape(frames * 12, count)
        jacobian = torch.cat([by_r, slopes[1][k, :, :, k].reshape(frames * 12, 8)], dim=1).numpy()
        matrix = jacobian.T @ jacobian
        matrix[:count, :count] += torch.block_diag(*cost.given(clip, r)[1][k]).numpy() + 250 * float(
            damping[k]
        ) * np.eye(count)
        if floor:
            matrix[:count, :count] += np.diag(cost.floor(clip, r)[1][k].flatten())
        bend = np.kron(np.diff(np.eye(frames), 2, axis=0), np.eye(13))
        matrix[:count, :count] += bend.T @ np.diag(stiffness[k, 2:-2].flatten()) @ bend
        matrix[count:, count:] += (1 / 0.025**2 + 1000 * float(damping[k])) * np.eye(8)
        expected = np.linalg.solve(matrix, -torch.cat([g[k].flatten() for g in gradients]).numpy())
        np.testing.assert_allclose(step[k].ravel(), expected[:count], rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(stretch_step[k], expected[count:], rtol=1e-7, atol=1e-10)

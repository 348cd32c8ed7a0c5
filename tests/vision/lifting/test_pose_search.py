"""The search for nearest poses, against brute force in NumPy and weighted least squares."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.motion.pose_sampler import sample_poses
from tensorsim.vision.lifting import pose_search
from tensorsim.vision.lifting.pose_library import all_headings, standardise_poses
from tensorsim.vision.lifting.pose_search import (
    PoseSearch,
    at_least,
    best_per_frame,
    blocks_of_similar,
    seen_along_depth,
    weighted_cosine,
)
from tests.stage import StageTester


def projected(poses: Tensor, scale: float = 170.0) -> Tensor:
    """Poses (..., 14, 3) seen along y, in pixels with v down."""
    return scale * torch.stack([poses[..., 0], -poses[..., 2]], dim=-1) + 200.0


def pictures(count: int, seed: int, noise: float = 5.0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise_px = noise * torch.randn(count, 14, 2, generator=generator, dtype=torch.float64)
    return projected(sample_poses(max(count, 13), seed=seed)[:count]) + noise_px


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks so small that a pool of hundreds has many."""
    monkeypatch.setattr(pose_search, "BLOCK", 192)


class TestPoseSearch(StageTester):
    batched_arguments = (0, 1)
    gradient_arguments = ()  # indices
    batch_shapes = ((3,), (7,))

    def make(self) -> nn.Module:
        return PoseSearch(standardise_poses(sample_poses(60, seed=1)).float(), 6, 5, 2**16)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        keypoints = pictures(batch[0], 2).to(dtype)
        weights = torch.linspace(0.2, 1.0, 14, dtype=dtype).repeat(*batch, 1)
        weights[1:] = torch.where(torch.arange(batch[0])[1:, None] % 2 == 0, weights[1:], 1.0)
        return keypoints, weights

    test_refuses_bad_input = None  # an inner stage: the lifter checks what it passes on


def brute_force(keypoints: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """The paper in NumPy: project along depth, centre, unit scale, Euclidean distance. (frames, poses)."""

    def normalised(x: np.ndarray) -> np.ndarray:
        x = x - x.mean(axis=1, keepdims=True)
        return (x / np.linalg.norm(x, axis=(1, 2), keepdims=True)).reshape(len(x), -1)

    k, p = normalised(keypoints), normalised(np.stack([poses[..., 0], -poses[..., 2]], axis=-1))
    return np.linalg.norm(k[:, None] - p[None], axis=-1)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("chunk", [1, 1000, 2**22])
@pytest.mark.parametrize("kind", ["people", "noise"])
def test_equal_weights_give_the_nearest_neighbours_of_normalised_poses(chunk: int, kind: str) -> None:
    library = standardise_poses(sample_poses(300, seed=4))
    if kind == "noise":  # no structure to make use of
        library = torch.randn(300, 14, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    keypoints = pictures(40, 5)
    search = PoseSearch(library, 8, 3, chunk)
    assert len(search.starts) > 8
    index = search(keypoints, torch.ones(40, 14, dtype=torch.float64))
    distance = brute_force(keypoints.numpy(), all_headings(library, 8).numpy())
    assert np.array_equal(index.numpy(), np.argsort(distance, axis=1)[:, :3])


@pytest.mark.usefixtures("small_blocks")
def test_what_fits_badly_is_searched_exactly_too() -> None:
    """Cosines far from one are rounded by more than bounds of the products say: the threshold allows for it."""
    library = standardise_poses(sample_poses(600, seed=4))
    keypoints = torch.randn(60, 14, 2, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    index = PoseSearch(library, 8, 32, 2**22)(keypoints, torch.ones(60, 14, dtype=torch.float64)).numpy()
    distance = brute_force(keypoints.numpy(), all_headings(library, 8).numpy())
    found = np.take_along_axis(distance, index, axis=1)
    np.testing.assert_allclose(found, np.sort(distance, axis=1)[:, :32], atol=1e-9, rtol=0)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("neighbours", [1, 32])
def test_float32_finds_the_same(neighbours: int) -> None:
    library = standardise_poses(sample_poses(2000, seed=4)).float()
    keypoints = pictures(60, 5, noise=1.0).float()
    index = PoseSearch(library, 4, neighbours, 2**22)(keypoints, torch.ones(60, 14)).numpy()
    poses = all_headings(library, 4).double().numpy()
    distance = np.sort(brute_force(keypoints.double().numpy(), poses), axis=1)[:, :neighbours]
    found = np.stack(
        [brute_force(keypoints[[i]].double().numpy(), poses[index[i]])[0] for i in range(len(index))]
    )
    np.testing.assert_allclose(found, distance, atol=1e-6, rtol=0)


@pytest.mark.usefixtures("small_blocks")
def test_weights_count_exactly_as_in_weighted_least_squares() -> None:
    library = standardise_poses(sample_poses(200, seed=4))
    keypoints = pictures(13, 6)
    weights = torch.rand(13, 14, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    weights[:, 4:7] = 0.0  # hidden, and wherever they are must not matter
    search = PoseSearch(library, 4, 1, 5000)
    assert len(search.starts) > 3
    index = search(keypoints, weights)[:, 0]
    elsewhere = keypoints.clone()
    elsewhere[:, 4:7] = 1e4
    assert torch.equal(search(elsewhere, weights)[:, 0], index)

    poses = all_headings(library, 4).numpy()
    for frame in range(13):
        errors = []
        root = np.sqrt(np.repeat(weights[frame].numpy(), 2))
        for pose in poses:
            p = np.stack([pose[:, 0], -pose[:, 2]], axis=-1)
            a = np.stack([p.ravel(), np.tile([1.0, 0.0], 14), np.tile([0.0, 1.0], 14)], axis=1)
            b = keypoints[frame].numpy().ravel()
            solution = np.linalg.lstsq(root[:, None] * a, root * b, rcond=None)[0]
            errors.append(np.sum((root * (b - a @ solution)) ** 2) if solution[0] > 0 else np.inf)
        assert int(np.argmin(errors)) == int(index[frame])


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("seen", [2, 4, 9])
def test_few_joints_are_searched_exactly(seen: int) -> None:
    library = standardise_poses(sample_poses(2000, seed=4)).float()
    keypoints = pictures(20, 5).float()
    weights = torch.zeros(20, 14)
    weights[:, torch.randperm(14, generator=torch.Generator().manual_seed(seen))[:seen]] = 1.0
    index = PoseSearch(library, 2, 4, 2**20)(keypoints, weights)
    normal = weights / seen
    every = weighted_cosine(keypoints[:, None], normal[:, None], all_headings(library, 2)[None])
    found = every.gather(1, index)
    torch.testing.assert_close(found, every.topk(4, dim=-1)[0], atol=1e-12, rtol=0)


@pytest.mark.slow
@pytest.mark.usefixtures("small_blocks")
def test_two_joints_of_different_weights_get_as_many_poses_as_all() -> None:
    library = standardise_poses(sample_poses(2000, seed=4)).float()
    keypoints = pictures(200, 5).float()
    weights = torch.zeros(200, 14)
    weights[:, 0], weights[:, 5] = 0.6103, 0.5931
    index = PoseSearch(library, 24, 16, 2**20)(keypoints, weights)
    normal = pose_search.normalise_weights(weights)
    every = weighted_cosine(keypoints[:, None], normal[:, None], all_headings(library, 24)[None])
    found = every.gather(1, index)
    torch.testing.assert_close(found, every.topk(16, dim=-1)[0], atol=1e-12, rtol=0)


@pytest.mark.usefixtures("small_blocks")
def test_ties_go_to_the_lower_index() -> None:
    library = standardise_poses(sample_poses(200, seed=4))
    library = torch.cat([library, library, library])  # thrice the same
    keypoints = projected(library[[150, 3]])
    for weights in (torch.ones(2, 14), torch.linspace(0.5, 1, 14).repeat(2, 1)):
        index = PoseSearch(library, 1, 3, 10_000)(keypoints, weights.double())
        assert index.tolist() == [[150, 350, 550], [3, 203, 403]]


def test_frames_that_say_nothing_get_the_first_poses() -> None:
    search = PoseSearch(standardise_poses(sample_poses(50)), 4, 3, 10_000)
    keypoints = pictures(3, 1)
    weights = torch.ones(3, 14, dtype=torch.float64)
    weights[1] = 0.0
    keypoints[2] = 7.0  # all joints at one place
    index = search(keypoints, weights)
    assert index[1].tolist() == index[2].tolist() == [0, 1, 2]
    assert torch.equal(index[0], search(keypoints[:1], weights[:1])[0])


def test_blocks_are_small_and_hold_every_pose_once() -> None:
    points = torch.randn(5000, 28, generator=torch.Generator().manual_seed(0))
    order, starts = blocks_of_similar(points, 400)
    assert torch.equal(order.sort()[0], torch.arange(5000))
    sizes = np.diff(starts)
    assert sizes.max() <= 400
    assert sizes.min() >= 400 // 2 - 64
    spread = [float(points[order[a:b]].var(dim=0).sum()) for a, b in itertools.pairwise(starts)]
    assert np.mean(spread) < 0.9 * float(points.var(dim=0).sum())


def test_selection_of_scores_and_pairs() -> None:
    generator = torch.Generator().manual_seed(0)
    for columns in (37, 64, 640, 100):
        score = torch.randn(9, columns, generator=generator)
        threshold = torch.randn(9, generator=generator)
        row, column = at_least(score, threshold)
        expected = torch.nonzero(score >= threshold[:, None])
        found = torch.stack([row, column], dim=-1)
        assert sorted(found.tolist()) == expected.tolist()
    frame, pose, fit = best_per_frame(
        torch.tensor([1, 0, 1, 1, 0]),
        torch.tensor([5, 4, 3, 2, 1]),
        torch.tensor([0.5, 0.1, 0.7, 0.5, 0.2]),
        2,
    )
    assert (frame.tolist(), pose.tolist()) == ([0, 0, 1, 1], [1, 4, 3, 2])
    torch.testing.assert_close(fit, torch.tensor([0.2, 0.1, 0.7, 0.5]))


@pytest.mark.usefixtures("small_blocks")
def test_rounding_of_coarse_scores_is_within_its_bound() -> None:
    """Scores of a block are as close to cosines in float64 as the bound states, and the bound is that of rounding."""
    search = PoseSearch(standardise_poses(sample_poses(500, seed=4)).float(), 4, 3, 2**20)
    keypoints, weights = pictures(200, 5).float(), torch.full((200, 14), 1 / 14)
    k = (keypoints - keypoints.mean(dim=1, keepdim=True)).double()
    moment = (k / k.square().sum(dim=(1, 2), keepdim=True).sqrt() / math.sqrt(14.0)).mT.flatten(1).float()
    poses = all_headings(search.library, 4)
    for block, (start, stop) in enumerate(itertools.pairwise(search.starts)):
        score, slack = search._coarse_scores(block, moment)
        members = poses[search.order[start:stop]]
        exact = weighted_cosine(keypoints[:, None], weights[:, None], members[None]) - 1.0
        # What bfloat16 rounds of the score itself, the search allows for in its threshold.
        assert bool(((exact - score).abs() <= slack[:, None] + 2.0**-8 * score.abs()).all())
        # Cauchy-Schwarz: what is rounded of the frame times the largest pose, what is kept times the most rounded.
        frame = math.sqrt(14.0) * moment - search.centres[block]
        pose = seen_along_depth(members).float() - search.centres[block]
        kept = frame.bfloat16().float()
        lost = (pose - pose.bfloat16().float()).norm(dim=-1).max()
        bound = (frame - kept).norm(dim=-1) * pose.norm(dim=-1).max() + kept.norm(dim=-1) * lost + 6e-5
        torch.testing.assert_close(slack, bound, rtol=1e-3, atol=1e-7)


@pytest.mark.slow
def test_a_large_library_is_searched_in_bounded_memory() -> None:
    library = torch.randn(400_000, 14, 3) * 0.2
    keypoints, weights = torch.randn(120, 14, 2), torch.ones(120, 14)
    weights[60:] = torch.rand(60, 14)
    search = PoseSearch(library, 1, 8, 2**20)
    with torch.profiler.profile(profile_memory=True) as profile:
        search(keypoints, weights)
    held = peak = 0
    for event in profile.profiler.kineto_results.events():
        if event.name() == "[memory]":
            held += event.nbytes()
            peak = max(peak, held)
    assert peak < 24 * 2**20 + 48 * 2**20

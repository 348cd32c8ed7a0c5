"""Sides over time: walkers whose limbs are exchanged at random get them back, and others keep theirs."""

import itertools
import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import body_to_coco, mid_hips
from tensorsim.config import ACTIVITIES, CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.camera import camera_to_world, project
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.vision.smoothing.sides import SteadySides, viterbi_two_states
from tests.stage import StageTester

FPS = 25.0
OPPOSITE = [0, 1, 2, 3, 4, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15]


def seen(activity: str, heading_deg: float, seed: int = 0, fps: float = FPS) -> Tensor:
    """Keypoints (T, 17, 2) of a generated person 4.5 m from a level camera."""
    joints = ActivityGenerator().generate(activity, seed=seed, duration_s=4.0, rate_hz=fps).joints[0].double()
    joints = joints - mid_hips(joints)[:1] * joints.new_tensor([1.0, 1.0, 0.0])
    joints = joints @ rotation(2, torch.tensor(math.radians(heading_deg), dtype=torch.float64)).mT
    joints = joints + joints.new_tensor([0.0, 4.5 + max(0.0, -float(joints[..., 1].min()) - 2.0), 0.0])
    return project(body_to_coco(joints), 500.0, (320.0, 180.0), camera_to_world(CameraConfig()).double())[0]


def errors_of_a_network(keypoints: Tensor, size_px: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return keypoints + 0.015 * size_px * torch.randn(
        keypoints.shape, generator=generator, dtype=torch.float64
    )


class TestSteadySides(StageTester):
    batched_arguments = (0, 1, 2)
    gradient_arguments = (0,)

    def make(self) -> nn.Module:
        return SteadySides()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        keypoints = 100 * torch.rand(*batch, 9, 17, 2, generator=generator, dtype=dtype)
        scores = torch.rand(*batch, 9, 17, generator=generator, dtype=dtype)
        return keypoints, scores, torch.rand(*batch, 9, generator=generator) > 0.2, 30.0

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        keypoints, scores, valid, fps = self.inputs((), torch.float32)
        return [
            ((keypoints[..., :16, :], scores, valid, fps), "17"),
            ((keypoints, scores[..., :16], valid, fps), "scores"),
            ((keypoints, scores, valid.float(), fps), "valid"),
            ((keypoints / 0, scores, valid, fps), "keypoints"),
            ((keypoints, scores, valid, 0.0), "fps"),
        ]


def test_viterbi_equals_trying_all_paths() -> None:
    generator = torch.Generator().manual_seed(0)
    stay, change = torch.rand(2, 20, 6, generator=generator, dtype=torch.float64)
    found = viterbi_two_states(stay, change, 0.05)
    for n in range(20):

        def cost(path: tuple[int, ...], n: int = n) -> float:
            steps = sum(
                float(stay[n, t] if path[t] == path[t + 1] else change[n, t]) for t in range(len(path) - 1)
            )
            return steps + 0.05 * sum(path)

        best = min(itertools.product((0, 1), repeat=7), key=cost)
        assert tuple(found[n].int().tolist()) == best


@pytest.mark.parametrize("activity", [name for name in ACTIVITIES if not name.startswith("S1 ")])
def test_right_sides_stay(activity: str) -> None:
    """Also of ankles that pass each other, arms that swing, and people who turn round."""
    for heading in (0.0, 60.0, 90.0, 200.0):
        keypoints = errors_of_a_network(seen(activity, heading), 200.0, 1)
        scores = torch.full(keypoints.shape[:-1], 0.8, dtype=torch.float64)
        steady, _ = SteadySides()(keypoints, scores, scores[:, 0] > 0, FPS)
        changed = (steady != keypoints).any(dim=-1).any(dim=-1)
        assert changed.double().mean() <= 0.02


@pytest.mark.parametrize("activity", ["S8 Walking", "S3 Kicking"])
@pytest.mark.parametrize("heading", [0.0, 45.0, 180.0])
def test_exchanged_limbs_are_exchanged_back(activity: str, heading: float) -> None:
    keypoints = errors_of_a_network(seen(activity, heading), 200.0, 2)
    generator = torch.Generator().manual_seed(3)
    wrong = torch.zeros(len(keypoints), dtype=torch.bool)
    for start in torch.randint(2, len(keypoints) - 12, (3,), generator=generator).tolist():
        wrong[start : start + int(torch.randint(1, 10, (1,), generator=generator))] = True
    spoilt = torch.where(wrong[:, None, None], keypoints[:, OPPOSITE], keypoints)
    scores = torch.full(keypoints.shape[:-1], 0.8, dtype=torch.float64)
    steady, _ = SteadySides()(spoilt, scores, scores[:, 0] > 0, FPS)

    def share_wrong(points: Tensor) -> float:
        return float(((points - keypoints).norm(dim=-1) > 12.0)[:, 5:].double().mean())

    assert share_wrong(spoilt) > 0.04
    assert share_wrong(steady) < 0.5 * share_wrong(spoilt)


@pytest.mark.parametrize("fps", [15.0, 30.0, 60.0, 120.0])
def test_legs_are_exchanged_back_for_as_long_at_any_frame_rate(fps: float) -> None:
    for seed in (3, 5, 7):
        keypoints = seen("S8 Walking", 0.0, seed, fps)
        spoilt, scores = keypoints.clone(), torch.full(keypoints.shape[:-1], 0.85, dtype=torch.float64)
        wrong = slice(int(fps), int(1.4 * fps))
        spoilt[wrong, 11:] = keypoints[wrong][:, OPPOSITE][:, 11:]
        steady, _ = SteadySides()(spoilt, scores, scores[:, 0] > 0, fps)
        torch.testing.assert_close(steady, keypoints)


def test_scores_go_with_their_points() -> None:
    keypoints = seen("S8 Walking", 0.0)
    scores = torch.full(keypoints.shape[:-1], 0.8, dtype=torch.float64)
    scores[:, 15] = 0.5
    spoilt, spoilt_scores = keypoints.clone(), scores.clone()
    spoilt[40:45], spoilt_scores[40:45] = keypoints[40:45][:, OPPOSITE], scores[40:45][:, OPPOSITE]
    steady, steady_scores = SteadySides()(spoilt, spoilt_scores, scores[:, 0] > 0, FPS)
    torch.testing.assert_close(steady, keypoints)
    torch.testing.assert_close(steady_scores, scores)


def test_a_single_frame_stays() -> None:
    keypoints = seen("S8 Walking", 0.0)[:1]
    scores = torch.full(keypoints.shape[:-1], 0.8, dtype=torch.float64)
    steady, steady_scores = SteadySides()(keypoints, scores, scores[:, 0] > 0, FPS)
    torch.testing.assert_close(steady, keypoints, atol=0, rtol=0)
    torch.testing.assert_close(steady_scores, scores, atol=0, rtol=0)


def test_refuses_costs_that_are_not_positive() -> None:
    with pytest.raises(TensorsimError, match="change"):
        SteadySides(change=0.0)

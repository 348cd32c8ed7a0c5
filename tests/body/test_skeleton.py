"""COCO-17 to the 14 joints, by name."""

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tensorsim.body.skeleton import body_to_coco, coco_to_body, trunk_lean, trunk_uprightness
from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.errors import TensorsimError
from tests.stage import StageTester


class CocoToBody(nn.Module):
    def forward(self, keypoints: Tensor, scores: Tensor) -> tuple[Tensor, Tensor]:
        return coco_to_body(keypoints, scores)


class TestCocoToBody(StageTester):
    batched_arguments = (0, 1)
    gradient_arguments = (0, 1)

    def make(self) -> nn.Module:
        return CocoToBody()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        keypoints = 200 * torch.rand(*batch, 5, 17, 2, generator=generator, dtype=dtype)
        return keypoints, 0.05 + 0.9 * torch.rand(*batch, 5, 17, generator=generator, dtype=dtype)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(16, 2), torch.zeros(16)), r"expected \(\.\.\., 17, 2\)"),
            ((torch.zeros(17, 3), torch.zeros(17)), r"expected \(\.\.\., 17, 2\)"),
            ((torch.zeros(17), torch.zeros(17)), r"expected \(\.\.\., 17, 2\)"),
            ((torch.zeros(4, 17, 2), torch.zeros(17)), r"scores: got shape \[17\], expected \[4, 17\]"),
            ((torch.full((17, 2), float("nan")), torch.zeros(17)), "keypoints: got NaN"),
            ((torch.zeros(17, 2), torch.full((17,), float("inf"))), "scores: got NaN"),
            ((torch.zeros(17, 2, dtype=torch.int64), torch.zeros(17)), "dtype"),
        ]


def named(**scores: float) -> tuple[Tensor, Tensor]:
    """Keypoints at (index, 10 * index), all seen unless said otherwise."""
    index = torch.arange(17.0)
    score = torch.tensor([scores.get(name, 0.9) for name in COCO_KEYPOINTS])
    return torch.stack([index, 10 * index], dim=-1), score


def place(name: str) -> Tensor:
    index = float(COCO_KEYPOINTS.index(name))
    return torch.tensor([index, 10 * index])


def test_scores_keep_their_names_and_shoulders_and_wrists_their_places() -> None:
    joints, scores = coco_to_body(*named(left_knee=0.4))
    for i, name in enumerate(JOINTS):
        if "shoulder" in name or "wrist" in name:
            torch.testing.assert_close(joints[i], place(name))
    assert float(scores[JOINTS.index("left_knee")]) == float(torch.tensor(0.4))
    assert int((scores < 0.5).sum()) == 1


def standing() -> Tensor:
    """Joints (14, 3) of a person whose arms and legs hang straight down."""
    heights = {"head": 1.6, "neck": 1.4, "shoulder": 1.4, "elbow": 1.1, "wrist": 0.8, "hip": 0.9, "knee": 0.5}
    rows = []
    for name in JOINTS:
        side, _, part = name.partition("_")
        across = {"right": 0.2, "left": -0.2}.get(side, 0.0)
        rows.append([across, 0.0, heights.get(part or side, 0.1)])
    return torch.tensor(rows, dtype=torch.float64)


def test_marks_of_somebody_who_stands() -> None:
    """Elbows and ankles of COCO are higher than the joints, hips and knees lower, by shares of 0.3, 0.4 and 0.5 m."""
    points = body_to_coco(standing())
    for side in ("left", "right"):
        heights = {
            part: float(points[COCO_KEYPOINTS.index(f"{side}_{part}"), 2])
            for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        }
        assert heights == pytest.approx(
            {
                "shoulder": 1.4,
                "elbow": 1.1 + 0.06 * 0.3,
                "wrist": 0.8,
                "hip": 0.9 - 0.017 * 0.5,
                "knee": 0.5 - 0.038 * 0.4,
                "ankle": 0.1 + 0.048 * 0.4,
            }
        )


def test_joints_of_marks_are_the_joints() -> None:
    generator = torch.Generator().manual_seed(1)
    joints = torch.randn(6, 14, 3, generator=generator, dtype=torch.float64)
    joints[:, 1] = 0.5 * (joints[:, 2] + joints[:, 5])
    points = body_to_coco(joints)[..., :2]
    back, _ = coco_to_body(points, torch.full((6, 17), 0.5, dtype=torch.float64))
    torch.testing.assert_close(back, joints[..., :2])


def test_a_keypoint_that_is_not_seen_moves_no_joint() -> None:
    """Files of keypoints have zeros for what was not found."""
    points = body_to_coco(standing())[:, [0, 2]]
    scores = torch.ones(17, dtype=torch.float64)
    wanted = points.clone()
    for name in ("left_ankle", "right_shoulder", "left_shoulder"):
        points[COCO_KEYPOINTS.index(name)] = 1e4
        scores[COCO_KEYPOINTS.index(name)] = 0.0
    joints, _ = coco_to_body(points, scores)
    for name in ("left_knee", "left_elbow", "right_elbow", "left_hip", "right_hip"):
        torch.testing.assert_close(joints[JOINTS.index(name)], wanted[COCO_KEYPOINTS.index(name)])


def test_head_is_the_nose_where_it_is_seen() -> None:
    joints, scores = coco_to_body(*named(nose=0.31, left_ear=0.99))
    torch.testing.assert_close(joints[0], place("nose"))
    torch.testing.assert_close(scores[0], torch.tensor(0.31))


def test_neck_is_between_the_shoulders_with_the_lower_score() -> None:
    joints, scores = coco_to_body(*named(left_shoulder=0.2))
    torch.testing.assert_close(joints[1], 0.5 * (place("left_shoulder") + place("right_shoulder")))
    torch.testing.assert_close(scores[1], torch.tensor(0.2))


def test_head_from_behind_is_the_mean_of_the_ears_by_score() -> None:
    hidden = {"nose": 0.0, "left_eye": 0.0, "right_eye": 0.0}
    joints, scores = coco_to_body(*named(**hidden, left_ear=0.9, right_ear=0.3))
    torch.testing.assert_close(joints[0], 0.75 * place("left_ear") + 0.25 * place("right_ear"))
    torch.testing.assert_close(scores[0], torch.tensor((0.81 + 0.09) / 1.2))


def test_head_slides_without_a_step_as_the_nose_is_lost() -> None:
    heads = torch.stack([coco_to_body(*named(nose=s / 1000))[0][0] for s in range(400)])
    assert float((heads[1:] - heads[:-1]).norm(dim=-1).max()) < 0.2  # of 25 pixels in all
    assert float((heads[0] - heads[-1]).norm()) > 20


def test_nothing_of_the_head_seen_leaves_the_nose() -> None:
    hidden = dict.fromkeys(COCO_KEYPOINTS[:5], 0.0)
    joints, scores = coco_to_body(*named(**hidden))
    torch.testing.assert_close(joints[0], place("nose"))
    assert float(scores[0]) == 0.0


@pytest.mark.parametrize("threshold", [0.0, -0.3, float("nan")])
def test_a_threshold_that_is_not_positive_is_refused(threshold: float) -> None:
    with pytest.raises(TensorsimError, match="threshold: got"):
        coco_to_body(*named(), threshold=threshold)


def test_trunk_uprightness_is_the_cosine_of_the_lean() -> None:
    angle = torch.tensor([0.0, 0.5, math.pi / 2, math.pi], dtype=torch.float64)
    joints = torch.zeros(4, 14, 3, dtype=torch.float64)
    joints[:, 1] = 0.5 * torch.stack([angle.sin(), torch.zeros(4, dtype=torch.float64), angle.cos()], -1)
    joints[:, (8, 11)] = 1e-9 * torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(0)).double()
    torch.testing.assert_close(trunk_uprightness(joints), angle.cos(), rtol=0, atol=1e-7)
    torch.testing.assert_close(trunk_lean(joints), (1 - angle.cos()).clamp(max=1), rtol=0, atol=1e-7)

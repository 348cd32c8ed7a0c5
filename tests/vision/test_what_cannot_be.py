"""What the pose network does not see as a person is not one; impossible motion is not output."""

import torch
from torch import nn

from tensorsim.pipeline import VideoToPose
from tensorsim.types import Tracks
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.pose_library import load_pose_library
from tests.film import STANDING

FPS, FRAMES = 30.0, 24


def lifted(
    scores: torch.Tensor, sideways_px: torch.Tensor, left_px: torch.Tensor | None = None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Joints (T, 14, 3) and validity (T,) of a standing body, its wrists moved by (T,) pixels.

    Its box begins ``left_px`` (T,) from the left edge of the picture.
    """
    body = torch.tensor(STANDING) * 200.0 + torch.tensor([320.0, 150.0])
    frames = len(sideways_px)
    keypoints = body.expand(1, 1, frames, 17, 2).clone()
    keypoints[0, 0, :, 9:11, 0] += sideways_px[:, None]
    there = torch.ones(1, 1, frames, dtype=torch.bool)
    boxes = torch.tensor([260.0, 140.0, 380.0, 360.0]).repeat(1, 1, frames, 1)
    if left_px is not None:
        boxes[0, 0, :, 0] = left_px
    tracks = Tracks(boxes, there, there)
    stage = VideoToPose(nn.Identity(), nn.Identity(), lifter=NearestPoseLifter(load_pose_library()[::40]))
    pose = stage.lift(tracks, keypoints, scores.expand(1, 1, frames, 17), 480, 640, FPS)
    return pose.joints[0, 0], pose.valid[0, 0]


def test_furniture_is_nobody() -> None:
    still = torch.zeros(FRAMES)
    scores = torch.full(
        (17,), 0.4
    )  # as HRNet's are on stools and tripods: some above the threshold, none high
    scores[:8] = 0.1
    _, valid = lifted(scores, still)
    assert not bool(valid.any())
    scores[8:] = 0.7  # a person whose upper half is hidden
    joints, valid = lifted(scores, still)
    assert bool(valid.all())
    assert bool(joints.isfinite().all())


def test_no_joint_is_faster_than_a_body_can_move() -> None:
    jump = torch.zeros(FRAMES)
    jump[12:14] = 250.0
    joints, _ = lifted(torch.ones(17), jump)
    assert float(joints.diff(dim=0).norm(dim=-1).max()) * FPS < 12.0 * 1.001
    assert float((joints[12:14, (4, 7)] - joints[8, (4, 7)]).norm(dim=-1).max()) < 0.3, (
        "taken out, not followed"
    )


def test_who_is_hidden_for_long_is_gone_and_for_a_moment_is_not() -> None:
    scores = torch.ones(120, 17)
    scores[10:30] = 0.0  # 0.67 s
    scores[50:90] = 0.0  # 1.33 s
    scores[110:] = 0.0  # never seen again
    _, valid = lifted(scores, torch.zeros(120))
    assert (~valid).nonzero()[:, 0].tolist() == [*range(50, 90), *range(110, 120)]


def test_who_leaves_the_picture_and_comes_back_is_not_there_meanwhile() -> None:
    scores = torch.ones(60, 17)
    scores[20:36] = 0.0
    left = torch.full((60,), 100.0)
    _, valid = lifted(scores, torch.zeros(60), left)
    assert bool(valid.all()), "behind something"
    left[24:30] = -5.0
    _, valid = lifted(scores, torch.zeros(60), left)
    assert (~valid).nonzero()[:, 0].tolist() == list(range(20, 36))
    scores[23:] = 1.0  # for a moment
    _, valid = lifted(scores, torch.zeros(60), left)
    assert bool(valid.all())

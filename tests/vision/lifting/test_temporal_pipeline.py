"""The temporal lifter inside the pipeline: scripted, for another camera, by its configuration."""

import math
from typing import cast

import pytest
import torch
from torch import Tensor, nn

import tensorsim as ts
from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import body_to_coco, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.geometry.camera import camera_to_world, project
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.pipeline import VideoToPose
from tensorsim.types import Tracks
from tensorsim.vision.lifting.temporal_lifter import TemporalLifter
from tensorsim.vision.lifting.temporal_net import TemporalNet
from tests.networks import keypoints_to_lift


class Lifting(nn.Module):
    """The part of VideoToPose after the networks."""

    def __init__(self, stage: VideoToPose) -> None:
        super().__init__()
        self.stage = stage

    def forward(self, keypoints: Tensor, scores: Tensor, boxes: Tensor, valid: Tensor) -> Tensor:
        joints: Tensor = self.stage.lift(
            Tracks(boxes, valid, valid), keypoints, scores, 360, 640, 30.0
        ).joints
        return joints


def stage_with(lifter: nn.Module | None, focal_px: float = 500.0) -> VideoToPose:
    camera = CameraConfig(focal_px=focal_px)
    # What stands before the lifting is not used here, but is scripted along.
    return VideoToPose(
        ts.vision.RTMDet("nano-person"),
        ts.vision.HRNet(18),
        lifter=lifter,
        metric_pose=ts.vision.MetricPose(camera, (1.75,)),
    ).eval()


def lifter() -> TemporalLifter:
    torch.manual_seed(0)
    net = TemporalNet(16)
    nn.init.normal_(net.leave.weight, std=0.05)
    return TemporalLifter(net, CameraConfig(focal_px=500.0), (1.75,)).eval()


@pytest.mark.slow
def test_scripted_lifting_equals_eager() -> None:
    keypoints, scores, boxes, valid, *_ = keypoints_to_lift(20)
    arguments = (keypoints[None], scores[None], boxes[None], valid[None])
    module = Lifting(stage_with(lifter()))
    with torch.no_grad():
        expected = module(*arguments)
        torch.testing.assert_close(torch.jit.script(module)(*arguments), expected, atol=1e-5, rtol=1e-5)
    assert expected.shape == (1, 1, 20, 14, 3)


def test_its_joints_depend_on_the_camera() -> None:
    keypoints, scores, boxes, valid, *_ = keypoints_to_lift(20)
    stage = stage_with(lifter())
    arguments = (keypoints[None], scores[None], boxes[None], valid[None])
    tilted = stage.seen_by(CameraConfig(focal_px=500.0, pitch_rad=-0.3))
    assert isinstance(tilted.temporal, TemporalLifter)
    assert cast(TemporalLifter, stage.temporal).network is tilted.temporal.network
    with torch.no_grad():
        level, down = (Lifting(one)(*arguments) for one in (stage, tilted))
    assert float((level - down).abs().max()) > 0.05


def test_the_configuration_chooses() -> None:
    config = ts.SimulationConfig().replace(pose__lifter="temporal", pose__person_height_m=(1.6,))
    detector, pose = nn.Identity(), nn.Identity()
    stage = VideoToPose.from_config(config, detector, pose)
    assert isinstance(stage.temporal, TemporalLifter)
    assert stage.temporal.heights.tolist() == [1.6]
    paper = ts.SimulationConfig.paper(config)
    assert VideoToPose.from_config(paper, detector, pose).temporal is None


def test_the_shipped_lifter_raises_arms_where_they_are() -> None:
    """A person 4 m away who raises both arms: range within 6 %, wrists within 20 cm of the truth."""
    keypoints, scores, boxes, valid, *size = keypoints_to_lift(30)
    shipped = TemporalLifter.from_pretrained(None, CameraConfig(focal_px=500.0), (1.75,))
    with torch.no_grad():
        found = shipped(keypoints, scores, boxes, valid, *size)
    assert found.root[0, :, 1].mean() == pytest.approx(4.0, rel=0.06)
    raised = found.joints[0, -1, [4, 7], 2]  # 0.288 H of trunk, arms 0.332 H, 115 degrees from straight down
    assert float((raised - 1.75 * (0.288 + 0.332 * 0.416)).abs().max()) < 0.2
    forward = found.joints[0, 15, [4, 7], 1].abs()  # about straight ahead or behind
    assert float(forward.min()) > 0.2


def test_legs_below_the_picture_step() -> None:
    """A person walks across in front of the camera, which sees no knee: the ankles swing like the true ones."""
    walk = ActivityGenerator().generate("walking", seed=1, duration_s=1.6, rate_hz=30.0).joints[0]
    walk = walk @ rotation(2, torch.tensor(-math.pi / 2, dtype=torch.float64)).mT
    walk = walk - mid_hips(walk)[24] + walk.new_tensor([0.0, 2.0, 0.9])
    camera = CameraConfig(focal_px=420.0)
    keypoints, _ = project(body_to_coco(walk).float(), 420.0, (319.5, 179.5), camera_to_world(camera).float())
    inside = ((keypoints >= 0) & (keypoints < torch.tensor([640.0, 360.0]))).all(dim=-1)
    assert inside[:, :13].all()
    assert not inside[:, 13:].any()
    low, high = keypoints.amin(dim=1), keypoints.amax(dim=1)
    boxes = torch.cat([low - 10, (high + 10).minimum(torch.tensor([639.0, 359.0]))], dim=-1)
    arguments = keypoints[None, None], 0.9 * inside[None, None], boxes[None, None], torch.ones(1, 1, 48) > 0
    stage = stage_with(TemporalLifter.from_pretrained(None, camera, (1.75,)).double(), 420.0)
    with torch.no_grad():
        found = Lifting(stage)(*arguments)[0, 0]

    def top_speed(joints: Tensor) -> float:
        ankles = joints[15:-15, [10, 13]]
        return float((ankles[1:] - ankles[:-1]).norm(dim=-1).amax() * 30.0)

    assert top_speed(found) == pytest.approx(top_speed(walk), rel=0.2)


def test_a_clip_of_one_frame_is_lifted_beside_a_longer_one() -> None:
    keypoints, scores, boxes, valid, *_ = keypoints_to_lift(20)
    tracks = Tracks(*(part[None].repeat(2, *[1] * part.dim()) for part in (boxes, valid, valid)))
    tracks.valid[1, :, 1:] = False
    twice = torch.stack([keypoints] * 2), torch.stack([scores] * 2)
    with torch.no_grad():
        pose = stage_with(lifter()).lift_each_length(tracks, *twice, torch.tensor([20, 1]), 360, 640, 30.0)
    assert pose.valid[1].sum(dim=-1).tolist() == [1] * len(keypoints)
    assert pose.joints.isfinite().all()


def test_nobody_is_lifted() -> None:
    """A film in which the tracker finds no one: joints of no person, in every layout of clips."""
    lifter = TemporalLifter(TemporalNet(8)).eval()
    for lead in ((0,), (2, 0)):
        keypoints, scores = torch.zeros(*lead, 12, 17, 2), torch.zeros(*lead, 12, 17)
        boxes, valid = torch.zeros(*lead, 12, 4), torch.zeros(*lead, 12, dtype=torch.bool)
        found = lifter(keypoints, scores, boxes, valid, 360, 640, 30.0)
        assert found.joints.shape == (*lead, 12, 14, 3)
        placed = lifter.in_picture(found, keypoints[..., :14, :], scores[..., :14], 360, 640, 30.0)
        assert placed.depth.shape == (*lead, 12, 14)

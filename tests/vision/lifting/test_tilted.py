"""Lifting and placing through a tilted camera: a body seen from above is found upright, where it stands."""

import math
from dataclasses import replace

import pytest
import torch
from torch import nn

from tensorsim.body.skeleton import body_to_coco, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.camera import camera_to_world, focal_length, principal_point, project
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.pipeline import VideoToPose
from tensorsim.types import Tracks
from tensorsim.vision.lifting.lifter import NearestPoseLifter, rolled
from tensorsim.vision.lifting.pose_library import load_pose_library, seen_from

HEIGHT, WIDTH, FPS = 480, 640, 30.0


def test_poses_seen_from_a_camera_are_what_it_projects() -> None:
    pose = torch.randn(14, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    world_to_camera = camera_to_world(CameraConfig(pitch_rad=-0.4))[:, :3].mT
    right, down, forward = (world_to_camera @ pose.mT).unbind(0)
    torch.testing.assert_close(seen_from(pose, -0.4), torch.stack([right, forward, -down], dim=-1))


@pytest.mark.parametrize("tilt_deg", [0.0, 30.0])
def test_a_tilted_camera_gives_the_same_body(tilt_deg: float) -> None:
    motion = ActivityGenerator().generate("walking", seed=2, duration_s=0.5)
    joints = motion.joints[0]
    joints = (
        joints - mid_hips(joints[:1]) * joints.new_tensor([1.0, 1.0, 0.0]) + joints.new_tensor([0, 5.0, 0])
    )
    camera = CameraConfig(position_m=(0.0, 0.0, 3.0), pitch_rad=-math.radians(tilt_deg))
    if tilt_deg == 0.0:
        camera = replace(camera, position_m=(0.0, 0.0, 1.0))
    coco, depth = project(
        body_to_coco(joints),
        focal_length(camera, WIDTH),
        principal_point(camera, HEIGHT, WIDTH),
        camera_to_world(camera),
    )
    assert bool((depth > 0).all())
    keypoints = coco.float()[None, None]
    there = torch.ones(keypoints.shape[:3], dtype=torch.bool)
    tracks = Tracks(torch.zeros(*there.shape, 4), there, there)
    lifter = NearestPoseLifter(load_pose_library()[::6])
    height_m = (float(motion.people.height_m[0]),)
    level = VideoToPose(nn.Identity(), nn.Identity(), height_m, lifter=lifter)
    stage = level.seen_by(camera)
    assert stage.detector is level.detector
    pose = stage.lift(tracks, keypoints, torch.ones(keypoints.shape[:-1]), HEIGHT, WIDTH, FPS)
    found = pose.joints[0, 0].double()
    assert float((mid_hips(found)[:, 1] / mid_hips(joints)[:, 1] - 1).abs().max()) < 0.08
    error = ((found - mid_hips(found)[:, None]) - (joints - mid_hips(joints)[:, None])).norm(dim=-1)
    assert float(error.mean()) < 0.09
    assert float((found[:, 0, 2] - joints[:, 0, 2]).abs().max()) < 0.12
    if tilt_deg:  # believed level, the camera makes a body that lies back
        wrong = level.lift(tracks, keypoints, torch.ones(keypoints.shape[:-1]), HEIGHT, WIDTH, FPS)
        lean = wrong.joints[0, 0] - mid_hips(wrong.joints[0, 0])[:, None]
        assert float((lean - (joints - mid_hips(joints)[:, None])).norm(dim=-1).mean()) > 1.3 * float(
            error.mean()
        )


def test_other_parts_know_no_camera() -> None:
    stage = VideoToPose(nn.Identity(), nn.Identity(), lifter=nn.Identity())
    with pytest.raises(TensorsimError, match="got Identity and MetricPose"):
        stage.seen_by(CameraConfig())


def test_a_rolled_camera_lifts_as_a_level_one_does() -> None:
    """Keypoints turned about the middle of the picture, as by a camera that is turned the other way."""
    generator = torch.Generator().manual_seed(0)
    library = torch.randn(40, 14, 3, generator=generator)
    level = NearestPoseLifter(library, yaws=4, neighbours=4)
    image = 100.0 * torch.randn(6, 14, 2, generator=generator) + 300.0
    angle = 0.3
    turned = rolled(image, -angle)
    cos, sin = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[cos, -sin], [sin, cos]])  # u right, v down: counter-clockwise by angle
    torch.testing.assert_close(turned, image @ rotation)
    weights = torch.ones(6, 14)
    expected, found = level(image, weights), level.tilted(0.0, angle)(turned, weights)
    torch.testing.assert_close(found.depth, expected.depth, atol=1e-4, rtol=1e-3)
    torch.testing.assert_close(found.scale, expected.scale, atol=1e-2, rtol=1e-4)
    torch.testing.assert_close(rolled(found.keypoints, angle), expected.keypoints, atol=1e-2, rtol=1e-4)

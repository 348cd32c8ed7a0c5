"""People of a film beyond the range axis of a radar: it is put in front of the camera, no nearer than needed."""

import warnings

import pytest
import torch
from torch import Tensor

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.pipeline.reach import NEAREST_M, radar_ahead_m
from tensorsim.radar.processing.ambiguity import mean_range
from tensorsim.streaming import Found, within_reach
from tensorsim.types import Pose
from tensorsim.vision.calibration.calibrator import CameraCalibrator, CameraEstimate, camera_config

RADAR = RadarConfig.free_space()  # sees 7.49 m


def body(y_m: float, x_m: float = 0.0, walks_m: float = 0.0, frames: int = 20) -> Tensor:
    """Joints (T, 14, 3) of a body that goes from ``y_m`` on by ``walks_m``."""
    joints = torch.rand(14, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    joints = joints * torch.tensor([0.4, 0.4, 1.7]) + torch.tensor([x_m, y_m, 0.0])
    way = torch.linspace(0, walks_m, frames, dtype=torch.float64)
    return joints + way[:, None, None] * torch.tensor([0.0, 1.0, 0.0])


def ahead(*people: Tensor) -> float:
    joints = torch.stack(people)
    return radar_ahead_m(joints, torch.ones(joints.shape[:2], dtype=torch.bool), RADAR)


def estimate() -> CameraEstimate:
    nobody = torch.zeros(1, 2, 17)
    return CameraCalibrator()(torch.zeros(1, 2, 17, 2), nobody, nobody[..., 0] > 1, 360, 640, 25.0)


@pytest.mark.parametrize("x_m", [0.0, 2.5])
def test_who_is_beyond_the_axis_comes_to_its_end(x_m):
    joints = body(9.0, x_m, walks_m=1.5)
    assert float(mean_range(joints, RADAR).max()) > RADAR.reach_m
    metres = ahead(joints)
    nearer = joints - torch.tensor([0.0, metres, 0.0])
    # As few metres as do, and some room for the limbs beyond the joints.
    assert float(mean_range(nearer, RADAR).max()) == pytest.approx(RADAR.reach_m - 0.4, abs=1e-3)


def test_nobody_is_moved_who_is_seen_and_nobody_comes_too_near():
    assert ahead(body(5.0)) == 0.0
    # From 3 to 12 m: nearer by 5 m he would pass through the radar.
    assert ahead(body(3.0, walks_m=9.0)) == 0.0
    # A far away bystander does not count, who can be brought in does.
    assert ahead(body(3.0), body(12.0)) == 0.0
    both = ahead(body(8.0), body(30.0))
    assert 0.5 < both < 8.0 - NEAREST_M
    assert both == pytest.approx(ahead(body(8.0)))
    assert radar_ahead_m(body(9.0)[None], torch.zeros(1, 20, dtype=torch.bool), RADAR) == 0.0


def test_frames_without_the_person_do_not_count():
    joints = body(9.0)[None]
    valid = torch.ones(1, 20, dtype=torch.bool)
    joints[0, :5] = 0.0
    valid[0, :5] = False
    assert radar_ahead_m(joints, valid, RADAR) == pytest.approx(ahead(body(9.0)))


def test_joints_of_another_shape_are_refused():
    with pytest.raises(TensorsimError, match="joints"):
        radar_ahead_m(torch.zeros(20, 14, 3), torch.ones(20, dtype=torch.bool), RADAR)


def found(joints: Tensor, camera: CameraEstimate | None) -> Found:
    frames = joints.shape[0]
    valid = torch.ones(1, 1, frames, dtype=torch.bool)
    valid[..., 0] = False
    joints = joints * valid[0, 0, :, None, None]
    keypoints = torch.zeros(1, 1, frames, 17, 2)
    return Found(
        Pose(torch.zeros(1, 1, frames, 4), keypoints, keypoints[..., 0], joints[None, None], valid), camera
    )


def test_the_radar_is_moved_where_the_camera_was_estimated_and_it_is_said():
    before = found(body(9.0), estimate())
    with pytest.warns(TensorsimWarning, match=r"placed \d\.\d\d m in front of the camera"):
        after = within_reach(before, RADAR)
    moved = before.pose.joints - after.pose.joints
    # Frames without anybody as well: a jump there would bend the curve beside it.
    assert float(moved[..., 1].min()) == pytest.approx(after.radar_ahead_m)
    assert float(moved[..., 1].max()) == pytest.approx(after.radar_ahead_m)
    assert float(moved[..., [0, 2]].abs().max()) == 0
    camera = camera_config(after.camera, after.radar_ahead_m)
    assert camera.position_m == (0.0, -after.radar_ahead_m, float(after.camera.height_m))
    assert float(mean_range(after.pose.joints[0, 0, 1:], RADAR).max()) < RADAR.reach_m


def test_who_is_seen_or_whose_camera_is_known_stays():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for one in (found(body(5.0), estimate()), found(body(9.0), None)):
            after = within_reach(one, RADAR)
            assert after.radar_ahead_m == 0
            assert torch.equal(after.pose.joints, one.pose.joints)

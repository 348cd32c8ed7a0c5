"""Corrected speeds along the line of sight: what moves whom where, against numbers that are known."""

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import MIRRORED_JOINTS, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.framing import keypoint_boxes, seen_keypoints
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.pipeline import VideoToPose
from tensorsim.types import Tracks
from tensorsim.vision.lifting.bone_fit import BoneFit
from tensorsim.vision.lifting.lifter import NearestPoseLifter
from tensorsim.vision.lifting.metric_pose import MetricPose
from tensorsim.vision.lifting.range_rate import (
    FEATURES,
    RATE_HZ,
    RangeRate,
    RangeRateNet,
    at_times,
    mirrored,
    movement,
    sample_count,
)
from tests.stage import StageTester

FPS = 25.0
CAMERA = torch.tensor([0.4, -1.0, 1.5], dtype=torch.float64)
OTHER = torch.tensor(MIRRORED_JOINTS)


def person(frames: int = 60, away_m_s: float = 0.0) -> Tensor:
    """Joints (T, 14, 3) of a generated person who punches, and is carried away from the camera."""
    joints = ActivityGenerator().generate("punching", seed=3, duration_s=4.0, rate_hz=FPS).joints[0].double()
    joints = joints[:frames] + torch.tensor([1.0, 2.0, 0.0], dtype=torch.float64)
    ahead = F.normalize(mid_hips(joints)[:1, :2] - CAMERA[:2], dim=-1)
    way = away_m_s * torch.arange(frames, dtype=torch.float64)[:, None] / FPS * ahead
    return joints + F.pad(way, [0, 1])[:, None]


def everywhere(joints: Tensor) -> tuple[Tensor, Tensor]:
    """All joints seen, the person always there."""
    return (
        torch.ones(joints.shape[:-1], dtype=torch.bool),
        torch.ones(joints.shape[:-2], dtype=torch.bool),
    )


def lively(channels: int = 16) -> RangeRateNet:
    """A network with random weights whose output is not zero."""
    torch.manual_seed(0)
    net = RangeRateNet(channels)
    nn.init.normal_(net.leave.weight, std=0.1)
    return net


class Fixed(nn.Module):
    """In the place of the network: the same speed for everybody, at all times or in turns to and fro."""

    def __init__(self, speed_m_s: float, period_s: float | None = None) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.speed_m_s, self.period_s, self.reach = speed_m_s, period_s, 0

    def forward(self, features: Tensor) -> Tensor:
        time = (torch.arange(features.shape[1], dtype=features.dtype) + 0.5) / RATE_HZ
        wave = (
            torch.ones_like(time) if self.period_s is None else torch.sin(2 * math.pi * time / self.period_s)
        )
        return self.speed_m_s * wave.expand(features.shape[:2])


class TestRangeRate(StageTester):
    batched_arguments = (0, 1, 2)
    float32_atol = 1e-4

    def make(self) -> nn.Module:
        return RangeRate(lively(), samples_per_block=16).eval()

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(0)
        joints = person(30).to(dtype)
        noise = torch.randn(*batch, *joints.shape, generator=generator, dtype=torch.float64).to(dtype)
        seen = torch.rand(*batch, *joints.shape[:-1], generator=generator) > 0.1
        valid = torch.rand(*batch, len(joints), generator=generator) > 0.05
        return joints + 0.01 * noise, seen, valid, CAMERA.to(dtype), FPS

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        joints, seen, valid, camera, fps = self.inputs((2,), torch.float32)
        return [
            ((joints[..., :2], seen, valid, camera, fps), "joints"),
            ((joints * torch.nan, seen, valid, camera, fps), "joints"),
            ((joints, seen[..., :3], valid, camera, fps), "seen"),
            ((joints, seen, valid[..., :3], camera, fps), "valid"),
            ((joints, seen, valid, camera[:2], fps), "camera_m"),
            ((joints, seen, valid, camera, 0.0), "fps"),
        ]


def test_an_untrained_network_changes_nothing() -> None:
    joints = person()
    assert torch.equal(RangeRate()(joints, *everywhere(joints), CAMERA, FPS), joints)


@pytest.mark.parametrize("fps", [15.0, 25.0, 60.0])
def test_a_person_moves_by_the_integral_along_the_line_of_sight_without_turning(fps: float) -> None:
    """A speed to and fro, faster than the mean over seconds, moves the body along its bearing by its integral."""
    frames = int(4 * fps)
    joints = person(1).expand(frames, -1, -1)
    there = RangeRate(Fixed(0.5, period_s=1.0))(joints, *everywhere(joints), CAMERA, fps)  # type: ignore[arg-type]
    shift = there - joints
    assert float((shift - shift[:, :1]).abs().max()) < 1e-12  # the whole body
    assert float(shift[..., 2].abs().max()) == 0.0
    ahead = F.normalize(mid_hips(joints)[:, :2] - CAMERA[:2], dim=-1)
    along = (shift[:, 0, :2] * ahead).sum(-1)
    torch.testing.assert_close(shift[:, 0, :2], along[:, None] * ahead)
    time = torch.arange(frames, dtype=torch.float64) / fps
    true = 0.5 / (2 * math.pi) * (1 - torch.cos(2 * math.pi * time))
    inside = slice(int(fps), -int(fps))
    apart = (along - true)[inside]
    assert float((apart - apart.mean()).abs().max()) < 0.012


def test_slow_changes_of_the_range_remain() -> None:
    joints = person(1).expand(400, -1, -1)
    there = RangeRate(Fixed(0.3))(joints, *everywhere(joints), CAMERA, FPS)  # type: ignore[arg-type]
    moved = (mid_hips(there) - mid_hips(joints)).norm(dim=-1)
    assert float(moved[150:250].max()) < 0.02  # of 0.3 m/s x 16 s
    # At both ends the mean is one-sided.
    assert float(moved.max()) < 1.0


def test_speeds_beyond_all_reason_are_bounded_and_absent_people_do_not_move() -> None:
    joints = person(1).expand(100, -1, -1)
    seen, valid = everywhere(joints)
    fast, bound = (
        RangeRate(Fixed(speed, period_s=1.0), level_s=1e3)(joints, seen, valid, CAMERA, FPS)  # type: ignore[arg-type]
        for speed in (1e6, 2.0)
    )
    assert float((fast - joints).abs().max()) < 2 * float((bound - joints).abs().max())
    gone = RangeRate(Fixed(0.5))(joints, seen, torch.zeros_like(valid), CAMERA, FPS)  # type: ignore[arg-type]
    torch.testing.assert_close(gone, joints, rtol=0, atol=1e-12)


def test_features_face_the_person() -> None:
    """Against numbers: a person carried away from the camera at 1.2 m/s, whichever way the world is turned."""
    joints = person(50, away_m_s=1.2)
    features = movement(joints[None], *(mask[None] for mask in everywhere(joints)), CAMERA, FPS)
    assert features.shape == (1, sample_count(50, FPS) - 1, FEATURES)
    still = person(50)
    at_rest = movement(still[None], *(mask[None] for mask in everywhere(still)), CAMERA, FPS)
    hips = (features - at_rest)[..., 84:87]
    torch.testing.assert_close(hips[..., 1].mean(), torch.tensor(1.2, dtype=torch.float64), atol=0.01, rtol=0)
    assert float(hips[..., 2].abs().max()) < 1e-9
    assert bool((features[..., 87:] == 1).all())
    turn = rotation(2, torch.tensor(0.7, dtype=torch.float64))
    other = movement((joints @ turn.mT)[None], *(m[None] for m in everywhere(joints)), turn @ CAMERA, FPS)
    torch.testing.assert_close(other, features, atol=1e-9, rtol=0)


def test_a_mirrored_person_makes_mirrored_features() -> None:
    joints = person(50) - F.pad(CAMERA[:2], [0, 1])
    camera = torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64)
    image = joints[:, MIRRORED_JOINTS] * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    seen = torch.rand(50, 14, generator=generator) > 0.3
    valid = torch.ones(50, dtype=torch.bool)
    features = movement(joints[None], seen[None], valid[None], camera, FPS)
    turned = movement(image[None], seen[:, MIRRORED_JOINTS][None], valid[None], camera, FPS)
    torch.testing.assert_close(turned, mirrored(features, OTHER), atol=1e-9, rtol=0)
    torch.testing.assert_close(mirrored(turned, OTHER), features, atol=1e-9, rtol=0)
    stage = RangeRate(lively().double()).requires_grad_(False)
    one = stage(joints, seen, valid, camera, FPS)
    other = stage(image, seen[:, MIRRORED_JOINTS], valid, camera, FPS)
    back = other[:, MIRRORED_JOINTS] * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(back, one, atol=1e-9, rtol=0)
    assert float((one - joints).abs().max()) > 1e-4


def test_interpolation_is_linear_and_keeps_to_the_frames() -> None:
    x = torch.tensor([[0.0, 2.0, 3.0]], dtype=torch.float64)
    position = torch.tensor([0.0, 0.5, 1.0, 1.25, 2.0, 2.4], dtype=torch.float64)
    expected = torch.tensor([[0.0, 1.0, 2.0, 2.25, 3.0, 3.0]], dtype=torch.float64)
    torch.testing.assert_close(at_times(x, position), expected)
    assert [sample_count(frames, 30.0) for frames in (1, 2, 4, 31)] == [1, 1, 3, 21]


def test_blocks_do_not_change_the_result_and_short_tracks_stay() -> None:
    joints = person(100)
    whole, parts = (RangeRate(lively(), samples_per_block=size) for size in (1000, 7))
    one, other = (stage(joints, *everywhere(joints), CAMERA, FPS) for stage in (whole, parts))
    torch.testing.assert_close(one, other, atol=1e-6, rtol=0)
    for frames in (0, 1, 2):
        assert torch.equal(
            whole(joints[:frames], *everywhere(joints[:frames]), CAMERA, 60.0), joints[:frames]
        )


def test_numbers_that_make_no_sense_and_other_weights_are_refused() -> None:
    with pytest.raises(TensorsimError, match="level_s"):
        RangeRate(level_s=0.0)
    with pytest.raises(TensorsimError, match="samples_per_block"):
        RangeRate(samples_per_block=0)
    with pytest.raises(TensorsimError, match="expected those of a RangeRate"):
        RangeRate.from_pretrained("models/temporal_lifter_small.safetensors")


def test_the_pipeline_uses_it_with_the_temporal_lifter_and_keypoints_that_are_not_exact() -> None:
    nothing, fit = nn.Identity(), BoneFit(CameraConfig().position_m, (1.8,))
    assert VideoToPose(nothing, nothing).range_rate is None
    assert VideoToPose(nothing, nothing, range_rate=True).range_rate is not None
    for others in (
        {"lifter": NearestPoseLifter()},
        {"metric_pose": MetricPose(mode="paper")},
        {"metric_pose": nn.Identity()},
        {"bone_fit": fit},
    ):
        assert VideoToPose(nothing, nothing, range_rate=True, **others).range_rate is None


def test_the_pipeline_moves_people_along_their_bearing_from_the_camera() -> None:
    """Of a generated person in front of a camera, known keypoints."""
    joints = ActivityGenerator().generate("walking", seed=2, duration_s=2.0, rate_hz=FPS).joints[0]
    joints = joints + torch.tensor([0.5, 3.0, 0.0])
    camera = CameraConfig(position_m=(0.3, -0.5, 1.2))
    valid = torch.ones(1, len(joints), dtype=torch.bool)
    keypoints, scores = seen_keypoints(joints[None], valid, camera, 480, 640)
    tracks = Tracks(keypoint_boxes(keypoints, scores)[None], valid[None], valid[None])
    nothing = nn.Identity()
    found = []
    for corrected in (False, True):
        stage = VideoToPose(nothing, nothing, camera=camera, walking_legs=False, range_rate=corrected).eval()
        with torch.no_grad():
            found.append(stage.lift(tracks, keypoints[None], scores[None], 480, 640, FPS).joints[0, 0])
    apart = mid_hips(found[1]) - mid_hips(found[0])
    ahead = F.normalize(mid_hips(found[0])[:, :2] - torch.tensor(camera.position_m[:2]), dim=-1)
    along = (apart[:, :2] * ahead).sum(-1, keepdim=True)
    assert float(along.abs().max()) > 5e-3
    torch.testing.assert_close(apart, F.pad(along * ahead, [0, 1]), atol=1e-5, rtol=0)

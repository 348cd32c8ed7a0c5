"""Arguments that a ready part beside them would leave without effect are refused, and parts made for another radar."""

from collections.abc import Callable

import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim import CameraConfig, PoseToDoppler, SceneConfig, TensorsimError, VideoToDoppler, VideoToPose
from tensorsim.config import ProcessingConfig
from tensorsim.motion import PoseResampler, PosturalSway, VitalSigns
from tensorsim.radar import (
    DopplerTimeMap,
    EchoSynthesizer,
    MovingTargetIndicator,
    RadarSimulator,
    RidgeExtractor,
)
from tensorsim.vision import MetricPose
from tests.film import RectangleDetector, StandingPose

RADAR = ts.RadarConfig.through_wall()
OTHER = ts.RadarConfig.through_wall(prf_hz=256.0)
WALL = ts.WallConfig()


def people() -> VideoToPose:
    return VideoToPose(RectangleDetector(), StandingPose())


def maps() -> PoseToDoppler:
    return PoseToDoppler(RadarSimulator(RADAR))


def video(**options: object) -> Callable[[], nn.Module]:
    return lambda: VideoToDoppler(video_to_pose=people(), pose_to_doppler=maps(), **options)


def pose(**options: object) -> Callable[[], nn.Module]:
    return lambda: VideoToPose(RectangleDetector(), StandingPose(), metric_pose=MetricPose(), **options)


def simulator(scene: object = RADAR, **options: object) -> Callable[[], nn.Module]:
    return lambda: RadarSimulator(scene, **options)


CASES: list[tuple[str, Callable[[], nn.Module]]] = [
    ("video_to_pose: .* person_height_m,", video(person_height_m=(1.9,))),
    ("video_to_pose: .* person_height_m,", video(person_height_m=(1.8, 1.7))),
    ("video_to_pose: .* detector, pose,", video(detector=RectangleDetector(), pose=StandingPose())),
    ("video_to_pose: .* camera,", video(camera=CameraConfig())),
    ("video_to_pose: .* detection_interval,", video(detection_interval=2)),
    ("video_to_pose: .* initial_distance_m,", video(initial_distance_m=(3.0,))),
    ("pose_to_doppler: .* radar, wall,", video(radar=RADAR, wall=WALL)),
    ("pose_to_doppler: .* multipath, leakage, wall_echo,", video(multipath=True, leakage=True, wall_echo=True)),
    ("pose_to_doppler: .* snr_db,", video(snr_db=None)),
    ("pose_to_doppler: .* denoiser,", video(denoiser=nn.Identity())),
    ("metric_pose: .* person_height_m,", pose(person_height_m=(1.9,))),
    ("metric_pose: .* initial_distance_m, camera,", pose(initial_distance_m=(3.0,), camera=CameraConfig())),
    ("echo: .* wall,", simulator(SceneConfig(RADAR, WALL, multipath=False), echo=EchoSynthesizer(RADAR))),
    ("echo: .* leakage,", simulator(SceneConfig(RADAR, leakage=True), echo=EchoSynthesizer(RADAR))),
    ("echo: .* multipath,", simulator(echo=EchoSynthesizer(RADAR), multipath=False)),
    ("echo: .* learnable,", simulator(echo=EchoSynthesizer(RADAR), learnable=("tx_m",))),
    ("echo: .* antenna,", simulator(echo=EchoSynthesizer(RADAR), antenna=nn.Identity())),
    ("doppler: .* window_s, overlap,",
     simulator(processing=ProcessingConfig(window_s=0.2, overlap=0.5), doppler=DopplerTimeMap(RADAR))),
    ("ridges: .* ridge_count,", simulator(processing=ProcessingConfig(ridge_count=1), ridges=RidgeExtractor(1))),
    ("mti: .* mti,", simulator(processing=ProcessingConfig(mti="mean"), mti=MovingTargetIndicator())),
    ("echo: .* prf_hz of 256.0, expected 128.0", simulator(echo=EchoSynthesizer(OTHER))),
    ("doppler: .* prf_hz of 256.0, expected 128.0", simulator(doppler=DopplerTimeMap(OTHER))),
    ("resampler: .* 256 Hz, expected .* 128 Hz",
     lambda: PoseToDoppler(RadarSimulator(RADAR), PoseResampler(256.0))),
    ("small_motions: .* 30 Hz, expected .* 128 Hz",
     lambda: PoseToDoppler(RadarSimulator(RADAR), small_motions=[PosturalSway(128.0), VitalSigns(30.0)])),
    ("recognizer: .*prf_hz=256.0.*prf_hz=128.0",
     lambda: ts.VideoToActivity(
         VideoToDoppler(video_to_pose=people(), pose_to_doppler=maps()),
         ts.recognition.ActivityRecognizer(OTHER, ts.recognition.SPGNet(12), size=32),
     )),
    ("cutoff_m_s, order: .* 'mean'", lambda: MovingTargetIndicator("mean", cutoff_m_s=0.5, order=2)),
    ("pulses: .* 'high-pass'", lambda: MovingTargetIndicator("high-pass", RADAR, pulses=5)),
]  # fmt: skip


@pytest.mark.parametrize(("message", "build"), CASES, ids=[message for message, _ in CASES])
def test_conflicts_raise(message: str, build: Callable[[], nn.Module]) -> None:
    with pytest.raises(TensorsimError, match=message):
        build()


def test_ready_parts_alone_are_taken() -> None:
    halves = people(), maps()
    whole = VideoToDoppler(video_to_pose=halves[0], pose_to_doppler=halves[1])
    assert (whole.video_to_pose, whole.pose_to_doppler) == halves
    echo, doppler = EchoSynthesizer(RADAR, WALL), DopplerTimeMap(RADAR, 0.2)
    made = RadarSimulator(RADAR, echo=echo, doppler=doppler, snr_db=None, processing=None)
    assert (made.echo, made.doppler) == (echo, doppler)


def test_camera_of_the_composition_reaches_the_lifter() -> None:
    """A tilted camera applies to the lifter as well as to positions in the world, as from a configuration."""
    camera = CameraConfig(pitch_rad=-0.3)
    composed = VideoToPose(RectangleDetector(), StandingPose(), camera=camera)
    config = ts.SimulationConfig().replace(pose__camera=camera)
    configured = VideoToPose.from_config(config, RectangleDetector(), StandingPose())
    assert composed.temporal is not None
    for name, buffer in configured.temporal.named_buffers():
        assert torch.equal(buffer, composed.temporal.get_buffer(name)), name

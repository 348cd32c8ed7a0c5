"""Stages with their usual input, and what is built from numbers."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

import tensorsim as ts
from tensorsim.body.skeleton import body_to_coco
from tensorsim.data.skeletons import Motion

RADAR = ts.RadarConfig.through_wall()
FADE = torch.ones(2, 8)


def _random(*shape: int, complex_: bool = False) -> Callable[[], Tensor]:
    dtype = torch.complex64 if complex_ else torch.float32
    return lambda: torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(0))


def _place(joints: Tensor) -> Any:
    valid = (
        torch.ones(joints.shape[:2], dtype=torch.bool) if isinstance(joints, Tensor) else torch.ones(1, 1) > 0
    )
    return ts.data.place(Motion(joints, valid, 30.0), 3.0, 0.5)


_PROFILES = _random(64, 20, complex_=True)
_BODIES = _random(2, 8, 14, 3)
_IF = _random(40, RADAR.samples_per_chirp, complex_=True)

STAGES: dict[str, tuple[Callable[[Any], Any], Callable[[], Tensor]]] = {
    "RangeProfile": (ts.radar.RangeProfile(RADAR), _IF),
    "two-pulse": (ts.radar.MovingTargetIndicator("two-pulse"), _PROFILES),
    "mean": (ts.radar.MovingTargetIndicator("mean"), _PROFILES),
    "DopplerTimeMap": (ts.radar.DopplerTimeMap(RADAR), _PROFILES),
    "ReceiverNoise": (ts.radar.ReceiverNoise(10.0), _IF),
    "RidgeExtractor": (ts.radar.RidgeExtractor(), lambda: _random(32, 5)().abs()),
    "PathRidgeExtractor": (ts.radar.PathRidgeExtractor(max_jump=4), lambda: _random(32, 5)().abs()),
    "EchoSynthesizer": (
        lambda x: ts.radar.EchoSynthesizer(RADAR)(x, torch.ones(2)),
        lambda: torch.ones(4, 2, 3),
    ),
    "rcs": (lambda x: ts.radar.EchoSynthesizer(RADAR)(torch.ones(4, 2, 3), x), lambda: torch.ones(2)),
    "JointScatterers": (lambda x: ts.motion.JointScatterers()(x, FADE), _BODIES),
    "Body13Scatterers": (lambda x: ts.motion.Body13Scatterers()(x, FADE), _BODIES),
    "LimbScatterers": (lambda x: ts.motion.LimbScatterers(RADAR.tx_m, RADAR.rx_m)(x, FADE), _BODIES),
    "fade": (lambda x: ts.motion.JointScatterers()(_BODIES(), x), lambda: FADE),
    "PoseResampler": (lambda x: ts.motion.PoseResampler(100.0)(x, 30.0), _random(6, 14, 3)),
    "SavitzkyGolay": (ts.motion.SavitzkyGolay(5, 2), _random(9, 14, 3)),
    "DnCNN": (ts.enhance.DnCNN(depth=2, channels=1).eval(), lambda: torch.rand(1, 8, 8)),
    "body_to_coco": (body_to_coco, _random(14, 3)),
    "place": (_place, _random(1, 4, 14, 3)),
}

#: What is built, and the arguments that are numbers.
SETTINGS: list[tuple[Callable[..., Any], list[str]]] = [
    (
        ts.RadarConfig,
        ["carrier_hz", "bandwidth_hz", "chirp_s", "prf_hz", "sample_rate_hz", "antenna_gain_dbi"],
    ),
    (ts.WallConfig, ["relative_permittivity", "loss_tangent"]),
    (ts.FloorConfig, ["relative_permittivity", "loss_tangent", "reflection"]),
    (ts.CameraConfig, ["focal_px", "horizontal_fov_rad", "pitch_rad", "yaw_rad"]),
    (ts.enhance.DnCNN, ["depth", "channels"]),
    (ts.radar.RidgeExtractor, ["count"]),
    (ts.radar.PathRidgeExtractor, ["count", "penalty_db", "max_jump", "band", "floor_db"]),
    (ts.radar.ReceiverNoise, ["snr_db"]),
    (ts.motion.PoseResampler, ["prf_hz"]),
]

"""Inputs that the radar tests share: generated motion, a recorded walk, noise, and stages that take a scene."""

import math

import numpy as np
import torch

from tensorsim.config import JOINT_RCS_M2, RadarConfig
from tests.stage import StageTester

#: A radar small enough for finite differences: 24 samples a pulse, Doppler windows of 26 pulses.
SMALL = RadarConfig(carrier_hz=2e9, bandwidth_hz=0.4e9, chirp_s=40e-6, sample_rate_hz=0.6e6, prf_hz=256.0)


def swinging(pulses, scatterers, prf_hz, distance_m=3.0, speed_m_s=-1.0, seed=0):
    """Positions (M, S, 3) float64, exact in float32: a cloud that walks and swings."""
    rng = np.random.default_rng(seed)
    t = np.arange(pulses)[:, None] / prf_hz
    rest = rng.uniform([-0.4, -0.2, 0.1], [0.4, 0.2, 1.8], (scatterers, 3))
    swing = 0.2 * np.sin(2 * np.pi * (0.9 * t + rng.uniform(0, 1, scatterers)))
    p = np.empty((pulses, scatterers, 3))
    p[..., 0] = rest[:, 0]
    p[..., 1] = rest[:, 1] + distance_m + speed_m_s * t + swing
    p[..., 2] = rest[:, 2] + 0.05 * swing
    return p.astype(np.float32).astype(np.float64)


def recorded_walk(shared_data, prf_hz, seconds, distance_m=3.0):
    """Positions (M, 14, 3) of a motion-captured walk, placed in front of the radar."""
    from scipy.interpolate import CubicSpline

    with np.load(shared_data / "mocap" / "cmu_14joints_120hz.npz") as clips:
        joints = clips["walking_1"].astype(np.float64)[1:]  # the first frame is a calibration pose
    joints = joints[: int(120 * seconds) + 2]
    joints[..., :2] -= joints[0, :, :2].mean(0)
    joints[..., 1] += distance_m
    t = np.arange(round(prf_hz * seconds)) / prf_hz
    return CubicSpline(np.arange(len(joints)) / 120, joints)(t)


def joint_rcs():
    return np.asarray(JOINT_RCS_M2)


def tensors(positions, rcs, dtype=torch.float64):
    return torch.as_tensor(positions, dtype=dtype), torch.as_tensor(rcs, dtype=dtype)


def complex_noise(*shape, dtype=torch.float32, seed=1):
    """White circular noise, complex64 or complex128 by the real ``dtype``; the numbers are the same."""
    x = torch.randn(*shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(seed))
    return x.to(torch.complex128 if dtype == torch.float64 else torch.complex64)


class ProfilesCase(StageTester):
    """A Doppler transform of :data:`SMALL`, windows of 26 pulses, of profiles (..., M, R); needs ``make``."""

    def inputs(self, batch, dtype):
        return (complex_noise(*batch, 40, 3, dtype=dtype),)

    def bad_inputs(self):
        x = self.inputs((), torch.float32)[0]
        return [
            ((x.real,), "profiles: got dtype"),
            ((x[0],), "profiles: got shape"),
            ((x[:25],), "got 25 pulses .* at least the 26"),
            ((x[:, :0],), "profiles: got shape"),
            ((x[None][:0],), "profiles: got shape .* without empty dimensions"),
        ]


class SceneCase(StageTester):
    """A stage of :data:`SMALL` that takes positions (..., M, S, 3) and RCS (..., S); needs ``make``."""

    batched_arguments = (0, 1)
    gradient_arguments = (0, 1)
    pulses = 7
    scatterers = 3

    def inputs(self, batch, dtype):
        clips = [
            swinging(self.pulses, self.scatterers, SMALL.prf_hz, seed=i) for i in range(math.prod(batch))
        ]
        rcs = np.random.default_rng(1).uniform(0.1, 1.0, (*batch, self.scatterers))
        return tensors(
            np.stack(clips).reshape(*batch, self.pulses, self.scatterers, 3), rcs.astype(np.float32), dtype
        )

    def bad_inputs(self):
        p, rcs = self.inputs((), torch.float32)
        hole = p.clone()
        hole[2, 1, 0] = float("nan")
        return [
            ((p.long(), rcs), "positions: got dtype"),
            ((p[0], rcs), "positions: got shape"),
            ((p[None][:0], rcs[None][:0]), "at least one pulse of one clip"),
            ((p[..., :2], rcs), "positions: got shape"),
            ((p[:0], rcs), "at least one pulse"),
            ((p, rcs[:2]), "rcs: got shape"),
            ((p, -rcs), "no negative"),
            ((hole, rcs), "positions: got NaN"),
        ]

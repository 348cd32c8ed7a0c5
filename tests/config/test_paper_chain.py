"""The paper's literal chain, from joints to Doppler-time map, against its formulas in NumPy and SciPy."""

import numpy as np
import pytest
import torch
from scipy.signal import savgol_filter

import tensorsim as ts
from tests.radar.reference import echo

FPS, FRAMES = 25.0, 40
WALL = ts.WallConfig()
RADAR = ts.RadarConfig.through_wall(sample_rate_hz=2e6)


def walker() -> np.ndarray:
    """Joints (T, 14, 3) that move away behind the wall, each with its own swing."""
    generator = np.random.default_rng(0)
    time_s = np.arange(FRAMES)[:, None, None] / FPS
    body = np.array([0.2, 3.0, 1.0]) + generator.normal(0, 0.25, (1, 14, 3))
    swing = 0.1 * np.sin(2 * np.pi * (1.1 * time_s + generator.random((1, 14, 3))))
    return body + swing + time_s * [0.0, 0.9, 0.0]


def doppler_time(joints: np.ndarray, wall: ts.WallConfig | None) -> np.ndarray:
    """The paper's chain in float64."""
    pulses = int((FRAMES - 1) / FPS * RADAR.prf_hz) + 1
    times = np.arange(pulses) / RADAR.prf_hz * FPS
    before = np.minimum(np.floor(times).astype(int), FRAMES - 2)
    share = (times - before)[:, None, None]
    straight = (1 - share) * joints[before] + share * joints[before + 1]
    window = round(0.25 * RADAR.prf_hz) // 2 * 2 + 1
    smooth = savgol_filter(straight, window, 3, axis=0, mode="interp")
    rcs = np.broadcast_to(np.array(ts.JOINT_RCS_M2), smooth.shape[:2])
    signal = echo(RADAR, smooth, rcs, wall, multipath=wall is not None, paper=True)
    profiles = np.fft.fft(signal, axis=1)[:, : signal.shape[1] // 2]  # rectangular window
    moving = profiles[1:] - profiles[:-1]  # two-pulse canceller
    total = np.abs(moving).sum(axis=1)
    length = round(0.1 * RADAR.prf_hz)
    hop = length - int(0.9 * length)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    frames = [total[k : k + length] * hann for k in range(0, len(total) - length + 1, hop)]
    return np.abs(np.fft.fftshift(np.fft.fft(frames, 256, axis=1), axes=1)).T


@pytest.mark.parametrize("wall", [None, WALL], ids=["free space", "wall"])
def test_the_paper_switch_is_the_papers_chain(wall: ts.WallConfig | None) -> None:
    config = ts.SimulationConfig.paper().replace(scene__radar=RADAR, scene__wall=wall, scene__snr_db=None)
    stage = ts.PoseToDoppler.from_config(config).double()
    joints = walker()
    expected = doppler_time(joints, wall)
    valid = torch.ones(1, 1, FRAMES, dtype=torch.bool)
    maps = stage(torch.from_numpy(joints)[None, None], valid, FPS)
    # Frames within the filter's window at the last frame of the film are left out: the stage continues after it.
    columns = expected.shape[1] - round(0.25 * RADAR.prf_hz)
    found = maps.doppler_time[0, :, :columns].numpy()
    np.testing.assert_allclose(found, expected[:, :columns], atol=1e-6 * expected.max())
    default = ts.PoseToDoppler.from_config(
        ts.SimulationConfig().replace(scene__radar=RADAR, scene__wall=wall, scene__snr_db=None)
    ).double()(torch.from_numpy(joints)[None, None], valid, FPS)
    assert not np.allclose(default.doppler_time[0, :, :columns].numpy(), found, atol=1e-2 * expected.max())

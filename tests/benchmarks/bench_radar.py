"""Speed and memory of the radar chain: `python -m tests.benchmarks.bench_radar [--ten-minutes]`.

Positions to range-time maps, Doppler-time map and ridges, noise included, against the echo alone evaluated
directly in float64 NumPy, in one run. Medians of the chain; the peer runs once.
"""

import argparse
import math
import resource
import statistics
import time

import numpy as np
import torch

from tensorsim.config import JOINT_RCS_M2, RadarConfig, WallConfig
from tensorsim.radar.simulator import RadarSimulator
from tests.radar import reference


def walker(start, stop, prf_hz, scatterers=14):
    """Positions (stop - start, S, 3) float32 of a swinging cloud that walks to and fro between 2 and 6 m."""
    t = torch.arange(start, stop, dtype=torch.float64)[:, None] / prf_hz
    limb = torch.linspace(0, 1, scatterers, dtype=torch.float64)
    y = 4 - 2 * torch.sin(0.6 * t) + 0.25 * torch.sin(2 * math.pi * (t + limb))
    return torch.stack((0.3 * torch.cos(7 * limb) + 0 * t, y, 0.1 + 1.6 * limb + 0 * t), -1).float()


def seconds(function, repeats):
    """Median wall time."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def compare(name, radar, clip_s, wall=None, multipath=False):
    """Print the chain's median, the peer's time and their ratio."""
    pulses = round(clip_s * radar.prf_hz)
    positions, rcs = walker(0, pulses, radar.prf_hz), torch.tensor(JOINT_RCS_M2)
    simulator = RadarSimulator(radar, wall, multipath)
    simulator(positions, rcs)
    chain = seconds(lambda: simulator(positions, rcs), 7)
    p, sigma = positions.double().numpy(), np.asarray(JOINT_RCS_M2)
    peer = seconds(lambda: reference.echo(radar, p, sigma, wall, multipath), 1)
    print(
        f"{name}: {pulses} pulses x 14 scatterers x {radar.samples_per_chirp} samples: "
        f"chain {chain:.3f} s (median of 7), NumPy echo alone {peer:.2f} s, ratio {peer / chain:.1f}"
    )


def ten_minutes(radar):
    """Stream a ten-minute free-space clip and print its time and the peak memory of this process."""
    pulses = round(600 * radar.prf_hz)
    rcs = torch.tensor(JOINT_RCS_M2)
    simulator = RadarSimulator(radar, display_rate_hz=100.0)
    begin = time.perf_counter()
    maps = simulator.stream(lambda start, stop: (walker(start, stop, radar.prf_hz), rcs), pulses)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"ten minutes of free space, {pulses} pulses: {time.perf_counter() - begin:.0f} s, peak {peak:.2f} GiB, "
        f"range-time {tuple(maps.range_time.shape)}, Doppler-time {tuple(maps.doppler_time.shape)}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--ten-minutes", action="store_true", help="only stream a ten-minute clip, for its memory"
    )
    arguments = parser.parse_args()
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads")
    with torch.no_grad():
        if arguments.ten_minutes:
            ten_minutes(RadarConfig.free_space())
        else:
            compare("free space, 4 s", RadarConfig.free_space(), 4.0)
            compare("through wall, 4 s", RadarConfig.through_wall(), 4.0, WallConfig(), multipath=True)
            compare("through wall, 60 s", RadarConfig.through_wall(), 60.0, WallConfig(), multipath=True)

"""Speed and memory of the radar chain: `python -m tests.benchmarks.bench_radar [--cpu] [--ten-minutes | --plot PNG]`.

Peers, in the same run: the echo and the chain evaluated directly in NumPy complex128 (tests/radar/reference.py), and
the echo's sum written plainly in torch. Medians of ours; the peers, which take long, run once. The chain is positions
to Doppler-time map; ours draws noise, the peer's has none.
`--cpu` takes processor time instead of wall time, for a machine that is busy with other work.
On a GPU, if there is one: clips per second for batches of 1 to 64.
"""

import argparse
import math
import re
import time
from pathlib import Path

import numpy as np
import torch

from tensorsim.config import JOINT_RCS_M2, RadarConfig, WallConfig
from tensorsim.radar.simulator import RadarSimulator
from tests.benchmarks.timing import host, medians, seconds
from tests.radar import reference


def walker(start, stop, prf_hz, scatterers=14):
    """Positions (stop - start, S, 3) float32 of a swinging cloud that walks to and fro between 2 and 6 m."""
    t = torch.arange(start, stop, dtype=torch.float64)[:, None] / prf_hz
    limb = torch.linspace(0, 1, scatterers, dtype=torch.float64)
    y = 4 - 2 * torch.sin(0.6 * t) + 0.25 * torch.sin(2 * math.pi * (t + limb))
    return torch.stack((0.3 * torch.cos(7 * limb) + 0 * t, y, 0.1 + 1.6 * limb + 0 * t), -1).float()


def plain_torch_echo(radar, positions, rcs):
    """The sum over scatterers as one would write it down: every exponential of every sample, in complex128."""
    p, light = positions.double(), 299_792_458.0
    out = (p - torch.tensor(radar.tx_m)).norm(dim=-1)
    back = (p - torch.tensor(radar.rx_m)).norm(dim=-1)
    tau = ((out + back) / light).unsqueeze(-1)
    gain = 10 ** (radar.antenna_gain_dbi / 10) * radar.wavelength_m / (4 * math.pi) ** 1.5
    amplitude = gain * rcs.double().sqrt() / (out * back)
    t = torch.arange(radar.samples_per_chirp, dtype=torch.float64) / radar.sample_rate_hz
    total = torch.zeros(p.shape[0], len(t), dtype=torch.complex128)
    for s in range(p.shape[1]):
        delay = tau[:, s]
        cycles = radar.carrier_hz * delay + radar.slope_hz_per_s * (delay * t - delay**2 / 2)
        total += amplitude[:, s, None] * torch.exp(2j * math.pi * cycles)
    return total


#: The chain in three settings: the defaults, closed-form bins, and those within a gate, as data sets are made.
SETTINGS = {
    "time engine, all bins": {},
    "range-bins engine, 8 near": {"engine": "range-bins", "near_bins": 8},
    "range-bins engine, 8 near, gate 1.5 to 5.5 m": {
        "engine": "range-bins",
        "near_bins": 8,
        "range_gate_m": (1.5, 5.5),
    },
}


def compare(name, radar, clip_s, clock, wall=None, multipath=False, rounds=5):
    """Print medians and ratios of echo and chain against both peers."""
    pulses = round(clip_s * radar.prf_hz)
    positions, rcs = walker(0, pulses, radar.prf_hz), torch.tensor(JOINT_RCS_M2)
    p, sigma = positions.double().numpy(), np.asarray(JOINT_RCS_M2)
    answers = []
    peer = seconds(lambda: answers.append(reference.echo(radar, p, sigma, wall, multipath)), clock)
    beat = answers.pop()

    def rest():
        moving = reference.two_pulse(reference.profiles(beat))
        reference.doppler_time(moving, radar.prf_hz)

    chain = peer + seconds(rest, clock)
    print(
        f"{name}: {pulses} pulses x 14 scatterers x {radar.samples_per_chirp} samples; "
        f"NumPy echo {peer:.2f} s, positions to Doppler-time map {chain:.2f} s"
    )
    versus = ""
    simulators = {
        label: RadarSimulator(radar, wall, multipath=multipath, **options)
        for label, options in SETTINGS.items()
    }
    echo = simulators["time engine, all bins"].echo
    error = reference.relative(echo(positions, rcs), beat)
    median = medians([lambda: echo(positions, rcs)], rounds, clock)[0]
    if wall is None:
        plain = seconds(lambda: plain_torch_echo(radar, positions, rcs), clock)
        versus = f", plain torch {plain / median:.1f} times"
    print(f"  echo {median:.3f} s, error {error:.1e}: NumPy {peer / median:.1f} times{versus}")
    for label, simulator in simulators.items():
        maps, alone = medians(
            [
                lambda s=simulator: s(positions, rcs),
                lambda s=simulator: s.doppler_time(positions, rcs),
            ],
            rounds,
            clock,
        )
        print(
            f"  {label}: all maps {maps:.3f} s; Doppler-time map alone {alone:.3f} s, NumPy {chain / alone:.1f} times, "
            f"its echo alone {peer / alone:.1f} times"
        )


def compiled(radar, clock):
    """Print what torch.compile makes of the sum over scatterers, where it finds a compiler."""
    echo = RadarSimulator(radar).echo
    pulses, rcs = walker(0, 1024, radar.prf_hz), torch.tensor(JOINT_RCS_M2).expand(1024, 14)
    function = torch.compile(echo.target_echo)
    try:
        function(pulses, rcs)
    except Exception as error:
        print(f"torch.compile: none here ({type(error).__name__})")
        return
    eager, fast = medians([lambda: echo.target_echo(pulses, rcs), lambda: function(pulses, rcs)], 20, clock)
    print(f"torch.compile of the echo, 1024 pulses: {fast * 1e3:.2f} ms, eager {eager * 1e3:.2f} ms")


def plot(path, clock):
    """Time of the echo against the length of the clip and the number of scatterers, as a PNG."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    radar = RadarConfig.free_space()
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    sweeps = {
        "clip, s": [(x, 14) for x in (1, 4, 15, 60, 600)],
        "scatterers": [(1, x) for x in (1, 5, 20, 100, 500)],
    }
    for axis, (label, cases) in zip(axes, sweeps.items(), strict=True):
        times = []
        for clip_s, scatterers in cases:
            echo = RadarSimulator(radar).echo
            rcs = torch.full((scatterers,), 0.1)

            pulses = round(clip_s * radar.prf_hz)

            def run(echo=echo, rcs=rcs, pulses=pulses, scatterers=scatterers):
                for start in range(0, pulses, 1024):
                    part = walker(start, min(start + 1024, pulses), radar.prf_hz, scatterers)
                    echo.target_echo(part, rcs.expand(part.shape[:2]))

            times.append(seconds(run, clock) if clip_s > 60 else medians([run], 3, clock)[0])
        values = [case[label == "scatterers"] for case in cases]
        slope = np.polyfit(np.log(values[1:]), np.log(times[1:]), 1)[0]
        points = ", ".join(f"{v}: {t:.3f} s" for v, t in zip(values, times, strict=True))
        print(f"{label}, exponent {slope:.2f} without the first: {points}")
        axis.loglog(values, times, "o-")
        axis.set(xlabel=label, ylabel="echo, s", title=f"exponent {slope:.2f}")
    figure.savefig(path)


def on_gpu():
    """Clips of 4 s per second, for batches of 1 to 64, and how much of the memory's bandwidth the IF alone takes."""
    if not torch.cuda.is_available():
        print("no GPU here")
        return
    radar, rcs = RadarConfig.free_space(), torch.tensor(JOINT_RCS_M2).cuda()
    clip = walker(0, round(4 * radar.prf_hz), radar.prf_hz).cuda()
    block = torch.empty(2**28, device="cuda")

    def timed(function):
        return medians([lambda: (function(), torch.cuda.synchronize())], 5)[0]

    bandwidth = 2 * block.nbytes / timed(lambda: block.clone())
    simulator = RadarSimulator(radar, pulse_chunk=32768, range_gate_m=(1.0, 7.0)).cuda()
    print(f"{torch.cuda.get_device_name()}, {bandwidth / 1e9:.0f} GB/s")
    for batch in (1, 4, 16, 64):
        positions = clip.expand(batch, *clip.shape)
        taken = timed(lambda positions=positions: simulator.doppler_time(positions, rcs))
        floor = (
            2 * 8 * batch * clip.shape[0] * radar.samples_per_chirp / bandwidth
        )  # the IF, written and read once
        print(
            f"  batch {batch}: {batch / taken:.1f} clips/s, {4 * batch / taken:.0f} x real time, "
            f"floor {floor / taken:.0%}"
        )


def ten_minutes(radar):
    """Stream a ten-minute free-space clip and print its time and the peak memory of this process."""
    pulses = round(600 * radar.prf_hz)
    rcs = torch.tensor(JOINT_RCS_M2)
    simulator = RadarSimulator(radar, display_rate_hz=100.0)
    begin = time.perf_counter()
    maps = simulator.stream(lambda start, stop: (walker(start, stop, radar.prf_hz), rcs), pulses)
    # Not getrusage: its peak begins with that of the process that started this one.
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak = int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) / 2**20
    outputs = sum(x.nbytes for x in maps) / 2**30
    print(
        f"ten minutes of free space, {pulses} pulses: {time.perf_counter() - begin:.0f} s, peak {peak:.2f} GiB, "
        f"of which outputs {outputs:.2f} GiB, "
        f"range-time {tuple(maps.range_time.shape)}, Doppler-time {tuple(maps.doppler_time.shape)}"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--ten-minutes", action="store_true", help="only stream a ten-minute clip, for its memory"
    )
    parser.add_argument("--cpu", action="store_true", help="processor time instead of wall time")
    parser.add_argument("--plot", metavar="PNG", help="only plot the time against pulses and scatterers")
    arguments = parser.parse_args()
    clock = time.process_time if arguments.cpu else time.perf_counter
    print(f"{host()}, {clock.__name__}")
    with torch.no_grad():
        if arguments.ten_minutes:
            ten_minutes(RadarConfig.free_space())
        elif arguments.plot:
            plot(arguments.plot, clock)
        else:
            on_gpu()
            compare("free space, 4 s", RadarConfig.free_space(), 4.0, clock)
            through, wall = RadarConfig.through_wall(), WallConfig()
            compare("through wall, 4 s", through, 4.0, clock, wall, multipath=True)
            compare("through wall, 60 s", through, 60.0, clock, wall, multipath=True)
            compiled(RadarConfig.free_space(), clock)

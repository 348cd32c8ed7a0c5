"""Speed and memory of the radar chain.

`python -m tests.benchmarks.bench_radar [--cpu] [--quick | --ten-minutes | --plot PNG]`

Peers, in the same run: the echo and the chain evaluated directly in NumPy complex128 (tests/radar/reference.py), which
compute every exponential; the echo's sum written plainly in torch; and NumPy and SciPy with the algorithm of ours, that
is, in complex64 with exponentials factored into coarse and fine samples, noise, and transforms on as many workers as
torch has threads. Medians of ours and of the last; the others, which take long, run once. The chain is positions to
Doppler-time map; the direct one has no noise.
`--cpu` takes processor time instead of wall time, for a machine that is busy with other work.
On a GPU, if there is one: clips per second for batches of 1 to 64.
"""

import argparse
import math
import re
import time
from pathlib import Path

import numpy as np
import scipy.fft
import torch

from tensorsim.config import JOINT_RCS_M2, RadarConfig, WallConfig
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.simulator import RadarSimulator
from tests.benchmarks.bench_stft import batched_map
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


def factored_echo(radar, positions, rcs):
    """The echo in NumPy by the factorisation of ours: (M, S, 3) and (S,) to (M, N) complex64."""
    p = positions.astype(np.float64)
    out, back = (np.linalg.norm(p - np.array(antenna), axis=-1) for antenna in (radar.tx_m, radar.rx_m))
    tau = (out + back) / 299_792_458.0
    gain = 10 ** (radar.antenna_gain_dbi / 10) * radar.wavelength_m / (4 * math.pi) ** 1.5
    amplitude = gain * np.sqrt(rcs) / (out * back)
    start = np.modf(radar.carrier_hz * tau - radar.slope_hz_per_s * tau**2 / 2)[0]  # cycles
    beat = radar.slope_hz_per_s * tau / radar.sample_rate_hz  # cycles per sample
    fine = math.isqrt(radar.samples_per_chirp - 1) + 1
    block = np.arange(-(-radar.samples_per_chirp // fine)) * fine
    coarse = np.exp(2j * math.pi * np.modf(start[..., None] + beat[..., None] * block)[0].astype(np.float32))
    tones = np.exp((2j * math.pi * np.arange(fine)).astype(np.complex64) * beat[..., None].astype(np.float32))
    coarse = coarse.astype(np.complex64) * amplitude[..., None].astype(np.float32)
    pulses = coarse.swapaxes(1, 2) @ tones.astype(np.complex64)
    return pulses.reshape(len(p), -1)[:, : radar.samples_per_chirp]


def factored_chain(radar, positions, rcs, snr_db=50.0, chunk=1024, bins=16):
    """Positions to the Doppler-time map (F, K) with noise, in NumPy and SciPy on as many threads as torch."""
    rng, workers, stage = np.random.default_rng(0), torch.get_num_threads(), DopplerTimeMap(radar)
    window = np.hamming(radar.samples_per_chirp).astype(np.float32)
    echo = np.concatenate(
        [factored_echo(radar, positions[at : at + chunk], rcs) for at in range(0, len(positions), chunk)]
    )
    deviation = np.sqrt(np.mean(echo.real**2 + echo.imag**2) * 10 ** (-snr_db / 10) / 2).astype(np.float32)
    noise = rng.standard_normal((*echo.shape, 2), np.float32) * deviation
    echo += noise.view(np.complex64)[..., 0]
    profiles = scipy.fft.fft(echo * window, workers=workers)[:, : radar.samples_per_chirp // 2]
    series = np.ascontiguousarray(np.diff(profiles, axis=0).conj().T)
    hann = stage.window.numpy().astype(np.float32)
    power = 0.0
    for at in range(0, len(series), bins):
        power = power + batched_map(series[None, at : at + bins], hann, stage.hop, stage.bins)[0] ** 2
    return np.sqrt(power)


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
    if wall is None:
        ours_too = [lambda: factored_echo(radar, p, sigma), lambda: factored_chain(radar, p, sigma)]
        error = reference.relative(torch.from_numpy(ours_too[0]()), beat)
        fast, fast_chain = medians(ours_too, 3, clock)
        print(
            f"  NumPy with the same factorisation: echo {fast:.3f} s, error {error:.1e}; chain {fast_chain:.3f} s"
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
    if wall is None:
        versus += f", NumPy with the same factorisation {fast / median:.2f} times"
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
            + (f", with the same factorisation {fast_chain / alone:.2f} times" if wall is None else "")
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
    parser.add_argument("--quick", action="store_true", help="only half a second of free space")
    parser.add_argument("--cpu", action="store_true", help="processor time instead of wall time")
    parser.add_argument("--plot", metavar="PNG", help="only plot the time against pulses and scatterers")
    arguments = parser.parse_args()
    clock = time.process_time if arguments.cpu else time.perf_counter
    print(f"{host()}, {clock.__name__}")
    with torch.no_grad():
        if arguments.ten_minutes:
            ten_minutes(RadarConfig.free_space())
        elif arguments.quick:
            compare("free space, 0.5 s", RadarConfig.free_space(), 0.5, clock)
        elif arguments.plot:
            plot(arguments.plot, clock)
        else:
            on_gpu()
            compare("free space, 4 s", RadarConfig.free_space(), 4.0, clock)
            through, wall = RadarConfig.through_wall(), WallConfig()
            compare("through wall, 4 s", through, 4.0, clock, wall, multipath=True)
            compare("through wall, 60 s", through, 60.0, clock, wall, multipath=True)
            compiled(RadarConfig.free_space(), clock)

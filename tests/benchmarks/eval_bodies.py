"""How a walker's echo is distributed over speed: ``python -m tests.benchmarks.eval_bodies [--walks N]``.

Measured walks (``../shared/data``: 24 GHz continuous wave, a recording and short bursts; 77 GHz in three directions)
beside generated ones, seen by the same radar and processed alike, for each model of the body:

- above 1.5, above 2: share of the power faster than 1.5 and 2 times the torso, in %;
- 95 %: the speed below which 95 % of the power lies, over the torso's;
- sigma: mean radar cross section of the walking body in m^2.

Speeds count in units of the torso's, which is the median over a second of the speed that halves the power of a frame.
Simulated walks have no noise; of measured ones the noise at the highest speeds is taken off.
"""

import argparse
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from tensorsim.config import RadarConfig
from tensorsim.motion import (
    ActivityGenerator,
    BodyScatterers,
    JointScatterers,
    LimbScatterers,
    PeopleConfig,
    PoseResampler,
)
from tensorsim.radar import DopplerTimeMap, EchoSynthesizer, RadarSimulator, RangeProfile

DATA = Path(__file__).parents[3] / "shared" / "data"
#: Slower cells are clutter and standing feet.
SLOWEST_M_S = 0.25
ANTENNA = (0.0, 0.0, 1.0)
#: A sweep of 1 MHz has range bins of 150 m: a continuous wave.
CW = RadarConfig(
    carrier_hz=24e9 - 0.5e6,
    bandwidth_hz=1e6,
    chirp_s=100e-6,
    sample_rate_hz=160e3,
    prf_hz=3000.0,
    tx_m=ANTENNA,
    rx_m=ANTENNA,
)
#: Rows of the measured map are 0.04 m/s, its columns 10 ms, if people walk at about 1.1 m/s.
FMCW = RadarConfig(
    carrier_hz=77e9, bandwidth_hz=2e9, sample_rate_hz=5e6, prf_hz=6000.0, tx_m=ANTENNA, rx_m=ANTENNA
)
BURST, BURST_S = 128, 0.2
DIRECTIONS = (0, 45, 315)


class SpeedShares(NamedTuple):
    """How the power of a walk is spread over speed in units of the torso's speed."""

    above_1_5: float
    above_2: float
    speed_95: float


def speed_shares(power: Tensor, speed_m_s: Tensor, frame_rate_hz: float, noisy: bool) -> SpeedShares:
    """Shares of a Doppler-time power map (F, K) with radial speeds (F,); their sign is ignored."""
    speed, order = speed_m_s.double().abs().sort()
    power = power.double()[order]
    if noisy:
        power = power - power[-len(speed) // 8 :].mean()
    power, speed = power[speed > SLOWEST_M_S], speed[speed > SLOWEST_M_S]
    below = power.cumsum(0) / power.sum(0).clamp_min(1e-300)
    torso = speed[(below < 0.5).sum(0).clamp_max(len(speed) - 1)]
    half = max(1, round(0.5 * frame_rate_hz))
    torso = torch.stack([torso[max(0, k - half) : k + half + 1].median() for k in range(len(torso))])
    steady = torso > 0.6 * torso.quantile(0.9)
    relative, order = (speed[:, None] / torso[steady]).flatten().sort()
    below = power[:, steady].flatten()[order].cumsum(0)
    below = below / below[-1]

    def above(multiple: float) -> float:
        return float(1 - below[(relative <= multiple).sum() - 1])

    return SpeedShares(above(1.5), above(2.0), float(relative[(below < 0.95).sum()]))


def mean(shares: list[SpeedShares]) -> SpeedShares:
    """Mean over walks, number by number."""
    return SpeedShares(*(float(np.mean(column)) for column in zip(*shares, strict=True)))


def wave_map(signal: Tensor, rate_hz: float) -> tuple[Tensor, Tensor, float]:
    """Power (F, K), speeds (F,) and frame rate of a continuous-wave signal (M,) complex, frames of 0.15 s."""
    radar = RadarConfig(carrier_hz=CW.carrier_hz, bandwidth_hz=1e6, prf_hz=rate_hz)
    doppler = DopplerTimeMap(radar, window_s=0.15)
    speed = doppler.doppler_hz * CW.doppler_wavelength_m / 2
    return doppler(signal[:, None]).square(), speed, doppler.frame_rate_hz


def burst_map(bursts: Tensor) -> tuple[Tensor, Tensor, float]:
    """Power, approaching speeds and frame rate of bursts (K, 128) at 3 kHz, their means removed."""
    window = torch.hamming_window(BURST, periodic=False, dtype=torch.float64)
    spectrum = torch.fft.fft((bursts - bursts.mean(-1, keepdim=True)) * window)
    speed = -torch.fft.fftfreq(BURST, 1 / CW.prf_hz, dtype=torch.float64) * CW.doppler_wavelength_m / 2
    return spectrum.abs().square().T, speed.clamp_min(0), 1 / BURST_S


def measured_wave() -> SpeedShares:
    """The 24 GHz recording of somebody walking to and fro."""
    from scipy.io import wavfile
    from scipy.signal import decimate

    rate, signal = wavfile.read(DATA / "radar" / "cw24ghz_walking.wav")
    signal = decimate(decimate(signal - signal.mean(), 3, ftype="fir"), 5, ftype="fir")
    return speed_shares(*wave_map(torch.from_numpy(signal + 0j), rate / 15), noisy=True)


def measured_bursts(style: str = "walk") -> SpeedShares:
    """The 24 GHz bursts of people who come towards the radar; the mean over clips."""
    with np.load(DATA / "measured" / "kmkim_cw24_iq" / "clips.npz") as clips:
        chosen = clips["label"] == list(clips["classes"]).index(style)
        iq = clips["iq"][chosen].astype(np.float64)
    found = []
    for bursts in torch.from_numpy(iq[:, 0] + 1j * iq[:, 1]).unflatten(-1, (-1, BURST)):
        power, speed, rate = burst_map(bursts)
        noise = power[(speed == 0) | (speed > 8)].median(0)[0]
        seen = power[speed > 0.3].amax(0) > 300 * noise
        if int(seen.sum()) > 5:
            found.append(speed_shares(power[:, seen], speed, rate, noisy=True))
    return mean(found)


def measured_fmcw(direction: int) -> SpeedShares:
    """A 77 GHz map of a walk; 0 degrees is towards the radar."""
    from scipy.io import loadmat

    decibels = loadmat(DATA / "radar" / f"mmrgait_walk_dir{direction:03d}.mat")["tfmap"]
    power = torch.from_numpy(10 ** (decibels / 10))
    power[126:131] = 0  # 0 Hz
    return speed_shares(power, (128 - torch.arange(192)) * 0.04, 100.0, noisy=True)


def generated_walks(count: int, direction_deg: float, distance_m: float, seed: int = 0) -> Tensor:
    """Joints (count, T, 14, 3) at 120 Hz of walks of 2.5 s about a place; 0 degrees is towards the radar."""
    config = PeopleConfig(
        heading_rad=0.0, facing_radar_share=1.0, keep_range_m=(0.0, 20.0), speed_m_s=(0.9, 1.3)
    )
    joints = ActivityGenerator(config).generate("walking", count, seed, 2.5, 120.0).joints
    middle = (
        0.5 * (joints[..., 8, :] + joints[..., 11, :]).mean(-2)[:, None, None] * torch.tensor([1.0, 1.0, 0])
    )
    c, s = math.cos(math.radians(direction_deg)), math.sin(math.radians(direction_deg))
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return (joints - middle) @ turn.T + torch.tensor([0.0, distance_m, 0.0])


def scatterers(body: nn.Module, radar: RadarConfig, joints: Tensor) -> tuple[Tensor, Tensor]:
    """The scene of one walk (T, 14, 3) at the radar's PRF."""
    positions = PoseResampler(radar.prf_hz)(joints, 120.0)[None]
    return body(positions, torch.ones(positions.shape[:2], dtype=torch.float64))


def simulated_wave(body: nn.Module, joints: Tensor) -> Tensor:
    """IF (M,) of a walk before the continuous-wave radar."""
    return RangeProfile(CW)(EchoSynthesizer(CW)(*scatterers(body, CW, joints)))[:, 0]


def simulated_fmcw(body: nn.Module, joints: Tensor) -> SpeedShares:
    """A walk before the 77 GHz radar."""
    simulator = RadarSimulator(
        FMCW, snr_db=None, mti="mean", window_s=0.05, overlap=0.8, engine="range-bins", near_bins=3
    )
    power = simulator.doppler_time(*scatterers(body, FMCW, joints)).square()
    speed = simulator.doppler.doppler_hz * FMCW.doppler_wavelength_m / 2
    return speed_shares(power, speed, simulator.doppler.frame_rate_hz, noisy=False)


def simulated(name: str, walks: int) -> dict[str, SpeedShares]:
    """All rows of the table for one body."""
    body = make_body(name, CW)
    rows: dict[str, SpeedShares] = {}
    waves = [
        simulated_wave(body, joints)
        for joints in tqdm(generated_walks(walks, 0, 3.5), name, unit="walk", leave=False)
    ]
    rows["24 GHz, recording"] = mean(
        [speed_shares(*wave_map(wave, CW.prf_hz), noisy=False) for wave in waves]
    )
    every = round(BURST_S * CW.prf_hz)
    bursts = [wave.unfold(0, BURST, every) for wave in waves]
    rows["24 GHz, bursts"] = mean([speed_shares(*burst_map(b), noisy=False) for b in bursts])
    body = make_body(name, FMCW)
    for direction in DIRECTIONS:
        joints = generated_walks(max(1, walks // 2), direction, 3.5)
        rows[f"77 GHz, {direction} degrees"] = mean([simulated_fmcw(body, j) for j in joints])
    return rows


def make_body(name: str, radar: RadarConfig) -> nn.Module:
    """A model of the body by name."""
    if name == "joints":
        return JointScatterers()
    if name == "limbs":
        return LimbScatterers(ANTENNA, ANTENNA)
    return BodyScatterers(ANTENNA, ANTENNA, radar.carrier_hz)


def cross_section(body: nn.Module) -> float:
    """Mean over a walk towards the radar and one across."""
    walks = torch.cat((generated_walks(1, 0, 3.5), generated_walks(1, 90, 3.5)))
    rcs = body(walks.unsqueeze(1), torch.ones(2, 1, walks.shape[1], dtype=torch.float64))[1]
    return float(rcs.sum(-1).mean())


def line(name: str, shares: SpeedShares) -> str:
    """A row of the table."""
    return f"  {name:22s}{100 * shares.above_1_5:12.2f}{100 * shares.above_2:10.2f}{shares.speed_95:9.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--walks", type=int, default=8, help="generated walks at 24 GHz; half of them at 77 GHz"
    )
    walks = parser.parse_args().walks
    torch.set_grad_enabled(False)
    print(f"  {'':22s}{'above 1.5':>12s}{'above 2':>10s}{'95 %':>9s}")
    print("measured")
    print(line("24 GHz, recording", measured_wave()))
    print(line("24 GHz, bursts", measured_bursts()))
    for direction in DIRECTIONS:
        print(line(f"77 GHz, {direction} degrees", measured_fmcw(direction)))
    for name in ("joints", "limbs", "surface"):
        sigma = [
            cross_section(make_body(name, RadarConfig(carrier_hz=f * 1e9, prf_hz=100))) for f in (5.8, 24, 77)
        ]
        print(f"{name}: sigma {' / '.join(f'{s:.2f}' for s in sigma)} m^2 at 5.8 / 24 / 77 GHz")
        for row, shares in simulated(name, walks).items():
            print(line(row, shares), flush=True)


if __name__ == "__main__":
    main()

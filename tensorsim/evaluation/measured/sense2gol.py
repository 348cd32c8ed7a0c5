"""Infineon Sense2GoL, 24 GHz continuous wave: I/Q bursts of people approaching the radar in four styles."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from tensorsim.evaluation.measured.motions import (
    KNOT_HZ,
    Draw,
    Unrest,
    add_unrest,
    at_half_the_pulse_rate,
    at_instants,
    dim_limbs,
    in_beam,
    knots,
    linear,
    place,
    stage_people,
)
from tensorsim.evaluation.measured.training import shift
from tensorsim.motion.activities import perform
from tensorsim.motion.exercises import creep, run, stride
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.people import PeopleConfig
from tensorsim.motion.scripts import walk
from tensorsim.radar.measured_sensors import (
    SENSE2GOL_BURST_S,
    SENSE2GOL_BURST_SAMPLES,
    SENSE2GOL_CARRIER_HZ,
    SENSE2GOL_SAMPLE_RATE_HZ,
)
from tensorsim.radar.synthesis.continuous_wave import ContinuousWaveEcho

CLASSES = ("walk", "run", "stride", "creep")
FRAMES = 15
ANTENNA_M = (0.0, 0.0, 1.0)
#: Rows of the Doppler maps within +-750 Hz (4.7 m/s).
ROWS = slice(32, 96)
#: Script and speeds in m/s of each style.
STYLES = (
    (walk, (0.95, 1.5)),
    (run, (2.0, 3.1)),
    (stride, (1.35, 1.95)),
    (creep, (0.35, 1.1)),
)


@dataclass(frozen=True)
class Effects:
    """Effects of the simulation beyond moving bodies; an ablation leaves out one at a time.

    Attributes:
        speeding_up: people start from rest and stop in front of the radar; else their speed is constant.
        unrest: sway of the body and small movements of the limbs.
        dim_limbs: limb-to-trunk ratios other than those of ellipsoids, drawn for each clip.
        image: the mirror image due to I/Q imbalance.
        saturation: quantization and clipping of the 12-bit converter.
        beam: a beam that is narrow in elevation.
        prf: a sampling rate high enough for all motion; else half of it, so that limbs above 4.7 m/s wrap.
    """

    speeding_up: bool = True
    unrest: bool = True
    dim_limbs: bool = True
    image: bool = True
    saturation: bool = True
    beam: bool = True
    prf: bool = True


def doppler_maps(iq: Tensor) -> Tensor:
    """Doppler maps in dB (N, 128, frames) of I/Q bursts (N, 2, 128 frames), ascending; approaching is negative."""
    signal = torch.complex(iq[:, 0], iq[:, 1]).unflatten(-1, (-1, SENSE2GOL_BURST_SAMPLES))
    signal = signal - signal.mean(-1, keepdim=True)
    window = torch.hamming_window(SENSE2GOL_BURST_SAMPLES, periodic=False)
    spectrum = torch.fft.fftshift(torch.fft.fft(signal * window), dim=-1)
    return 10 * (spectrum.abs().square() + 1).log10().transpose(1, 2)


class Sense2Gol:
    """Simulated bursts of I/Q in counts of the 12-bit converter."""

    def __init__(self, effects: Effects) -> None:
        self.effects = effects
        self.echo = ContinuousWaveEcho(SENSE2GOL_CARRIER_HZ, ANTENNA_M, ANTENNA_M)
        self.scatterers = LimbScatterers(ANTENNA_M, ANTENNA_M, per_segment=3)
        frames = torch.arange(FRAMES, dtype=torch.float64) * SENSE2GOL_BURST_S
        self.at = (
            frames[:, None]
            + torch.arange(SENSE2GOL_BURST_SAMPLES, dtype=torch.float64) / SENSE2GOL_SAMPLE_RATE_HZ
        ).flatten()

    def motion(self, label: int, count: int, generator: torch.Generator) -> Tensor:
        """Joints (count, K, 14, 3) at ``KNOT_HZ``: people stand, approach and stop in front of the radar."""
        draw = Draw(count, generator)
        script, speed = STYLES[label]
        config = PeopleConfig(heading_rad=0.15, facing_radar_share=1.0)
        people = stage_people(count, draw, config, speed)
        time = knots(FRAMES * SENSE2GOL_BURST_S).expand(count, -1)
        start_m = draw(4.2, 6.8)
        pace = torch.ones_like(time)
        if self.effects.speeding_up:
            pace = self._pace(time, draw, start_m, people.speed_m_s[:, None])
        clock = torch.cumsum(pace, dim=1) / KNOT_HZ
        joints = perform(script, clock, people)
        joints = torch.stack([-joints[..., 0], -joints[..., 1], joints[..., 2]], dim=-1)  # towards the radar
        joints = place(joints, draw(-0.3, 0.3), start_m)
        if self.effects.unrest:
            joints = add_unrest(joints, draw, Unrest((0.001, 0.006), (0.0, 0.03)))
        return joints

    def _pace(self, time: Tensor, draw: Draw, start_m: Tensor, speed: Tensor) -> Tensor:
        """Fraction (N, K) of full speed: from rest at the start to rest about half a metre in front of the radar."""
        begin, rise, brake, stop_m = draw(-0.3, 0.5), draw(0.3, 1.0), draw(1.2, 4.0), draw(0.3, 0.8)
        gained = ((time - begin) / rise).clamp(0.0, 1.0)
        gained = gained**2 * (3 - 2 * gained)
        pace, way = [], start_m - stop_m
        for k in range(time.shape[1]):
            limit = (2 * brake[:, 0] * way[:, 0].clamp(min=0.0)).sqrt() / speed[:, 0]
            pace.append(torch.minimum(gained[:, k], limit))
            way = way - (speed[:, 0] * pace[-1] / KNOT_HZ)[:, None]
        return torch.stack(pace, dim=1)

    def iq(self, joints: Tensor, generator: torch.Generator) -> Tensor:
        """Counts (N, 2, 1920) of people (N, K, 14, 3)."""
        draw = Draw(joints.shape[0], generator)
        positions, rcs = self.scatterers(joints.unsqueeze(1), torch.ones(joints.shape[:2]).unsqueeze(1))
        if self.effects.beam:
            rcs = in_beam(positions, rcs, ANTENNA_M[2], draw(25.0, 55.0))
        if self.effects.dim_limbs:
            rcs = dim_limbs(rcs, draw, -10.0, 2.0, self.scatterers.per_segment)
        echo = self.echo(at_instants(positions, self.at), linear(rcs, self.at))
        if not self.effects.prf:
            bursts = echo.unflatten(-1, (FRAMES, SENSE2GOL_BURST_SAMPLES))
            echo = at_half_the_pulse_rate(bursts).flatten(-2)
        far = echo[:, : 6 * SENSE2GOL_BURST_SAMPLES].abs().square().mean(-1, keepdim=True).sqrt()
        echo = echo / far * 10 ** (draw(36.0, 52.0) / 20).float()
        if self.effects.image:
            echo = echo + 10 ** (draw(-13.0, -9.0) / 20).float() * echo.conj()
        noise = 10 ** (draw(19.0, 24.0) / 20).float()
        signal = torch.stack([echo.real, echo.imag], dim=1)
        signal = signal + noise[..., None] / 2**0.5 * draw.normal(2, signal.shape[-1]).float()
        if self.effects.saturation:
            signal = (signal + 2090).round().clamp(0, 4095)
        return signal

    def simulate(self, label: int, count: int, generator: torch.Generator) -> Tensor:
        """Doppler maps (count, 64, 15) in dB of one class."""
        return doppler_maps(self.iq(self.motion(label, count, generator), generator))[:, ROWS]


def read(iq: npt.NDArray[np.int16]) -> Tensor:
    """Measured bursts of I/Q (N, 2, 1920) to Doppler maps (N, 64, 15) in dB."""
    return doppler_maps(torch.from_numpy(iq.astype(np.float32)))[:, ROWS]


def pictures(maps: Tensor) -> Tensor:
    """Doppler maps (N, 64, 15) in dB to pictures (N, 1, 64, 15): 40 to 90 dB become 0 to 1."""
    return ((maps - 40) / 50).clamp(0.0, 1.2).unsqueeze(1)


def augment(shown: Tensor, generator: torch.Generator) -> Tensor:
    """Pictures shifted by up to one frame, with changed levels and added noise."""
    count = shown.shape[0]
    shown = shift(shown, 1, -1, generator)
    factor, offset = torch.rand(2, count, 1, 1, 1, generator=generator)
    shown = shown * (0.9 + 0.2 * factor) + 0.1 * (offset - 0.5)
    return shown + 0.03 * torch.randn(shown.shape, generator=generator)

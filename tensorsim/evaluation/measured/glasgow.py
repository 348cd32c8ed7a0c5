"""Glasgow, 5.8 GHz FMCW: CFAR masks of Doppler-time maps of six activities.

The measured masks come from the data set's authors (2-D cell-averaging CFAR on the spectrogram in decibels,
256 x 256, a whole clip). The simulation repeats their chain: sweeps, high-pass over pulses, short-time Fourier
transform of every range bin, sum of bins, decibels, CFAR.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.config import JOINTS
from tensorsim.evaluation.measured.motions import (
    Draw,
    Unrest,
    act_out,
    add_unrest,
    at_half_the_pulse_rate,
    at_instants,
    dim_limbs,
    knots,
    linear,
    place,
    smooth_as_paper,
    stage_people,
    walk_to_and_fro,
)
from tensorsim.evaluation.measured.training import drop_cells, shift, warp
from tensorsim.motion.exercises import drink, fall_down, pick_up
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.people import PeopleConfig
from tensorsim.motion.scatterers import JointScatterers
from tensorsim.motion.scripts import sit_down, stand_up, walk_to_fall
from tensorsim.motion.timing import segment
from tensorsim.radar.measured_sensors import MEASURED_SENSORS
from tensorsim.radar.processing.cfar import CfarDetector
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.echo import EchoSynthesizer

CLASSES = ("walking", "sitting_down", "standing_up", "pick_up", "drinking", "falling")

#: Every other sweep of the measured 1000 per second: nobody is beyond +-250 Hz (6.3 m/s), and half the work remains.
RADAR = replace(MEASURED_SENSORS["glasgow-ancortek"].radar, prf_hz=500.0)
#: Rows of the measured masks (3.9 Hz each) within +-250 Hz.
ROWS = slice(64, 192)
#: Threshold above the median of a map, for the ablation without CFAR.
FIXED_THRESHOLD_DB = 10.0


@dataclass(frozen=True)
class Effects:
    """Effects of the simulation beyond moving bodies; an ablation leaves out one at a time.

    Attributes:
        to_and_fro: walkers turn round; else they walk straight on.
        falls_from_standing: people fall from standing; else while walking.
        random_start: the motion starts at a time drawn for each clip; else always at the same time.
        quick_limbs: joints keep their full motion; else they pass a Kalman smoother with the paper's noise values.
        ellipsoids: segments whose cross section depends on the aspect; else joints as identical points.
        unrest: sway of the body and small movements of the limbs.
        residue: noise next to zero Doppler, in every frame.
        lines: tones of the hardware at fixed Doppler.
        dim_limbs: limb-to-trunk ratios other than those of ellipsoids, drawn for each clip.
        levels: signal and noise floor drawn for each clip; else always the same.
        image: a weak mirror image in Doppler.
        shuffling: people end up farther back after sitting down, farther forward after rising.
        cfar: a threshold from the surroundings of each cell; else one for the whole map, 10 dB above its median.
        prf: a sweep rate high enough for all motion; else half of it, so that limbs above 3.2 m/s wrap.
    """

    to_and_fro: bool = True
    falls_from_standing: bool = True
    random_start: bool = True
    quick_limbs: bool = True
    ellipsoids: bool = True
    unrest: bool = True
    residue: bool = True
    lines: bool = True
    dim_limbs: bool = True
    levels: bool = True
    image: bool = True
    shuffling: bool = True
    cfar: bool = True
    prf: bool = True


class Glasgow:
    """Simulated masks; rows ascend from approaching to receding, as in the files."""

    def __init__(self, effects: Effects) -> None:
        self.effects = effects
        profile = RangeProfile(RADAR, window=None, gate_m=(3.4, 7.6))
        self.bins = profile.last_bin - profile.first_bin + 1
        self.echo = RangeBinSynthesizer(EchoSynthesizer(RADAR), profile, near_bins=2)
        self.scatterers = LimbScatterers(RADAR.tx_positions_m[0], RADAR.rx_positions_m[0], per_segment=3)
        self.points = JointScatterers([1.0] * len(JOINTS))
        self.mti = MovingTargetIndicator("high-pass", RADAR, cutoff_m_s=3.75 * RADAR.doppler_wavelength_m / 2)
        self.maps = DopplerTimeMap(RADAR, window_s=0.2, overlap=0.9)
        self.cfar = CfarDetector(
            guard=(10, 2), training=(50, 10), false_alarm=0.31, edges=("reflect", "circular")
        )

    def motion(self, label: int, count: int, generator: torch.Generator) -> tuple[Tensor, float]:
        """Joints (count, K, 14, 3) at ``KNOT_HZ`` and the length of the clips in s."""
        draw = Draw(count, generator)
        config = PeopleConfig(heading_rad=0.4, facing_radar_share=1.0, speed_m_s=(0.6, 1.25))
        people = stage_people(count, draw, config, None)
        range_m = draw(4.2, 5.6)
        if label == 0:
            duration = 10.0
            time = knots(duration).expand(count, -1)
            joints, offset_m = walk_to_and_fro(
                time, people, draw, (1.6, 3.2), (0.9, 2.2), self.effects.to_and_fro
            )
            joints = place(joints, draw(-0.3, 0.3), range_m + 0.4 + offset_m)
        else:
            duration = 5.0
            time = knots(duration).expand(count, -1)
            script, first_s, start, rate = {
                1: (sit_down, 0.8, (0.3, 2.6), (0.9, 2.0)),
                2: (stand_up, 0.7, (0.2, 2.2), (0.95, 2.0)),
                3: (pick_up, 0.0, (-0.1, 2.2), (0.9, 1.7)),
                4: (drink, 0.0, (-0.2, 1.8), (0.8, 1.9)),
                5: (fall_down, 0.0, (-0.1, 2.6), (0.6, 1.3)),
            }[label]
            if label == 5 and not self.effects.falls_from_standing:
                script, first_s = walk_to_fall, 1.0  # the fall begins at 1.55 s
                range_m = range_m + 1.5  # they come closer first
            began, tempo = draw(*start), draw(*rate)
            if not self.effects.random_start:
                began = torch.full_like(began, sum(start) / 2)
            joints = act_out(script, (time - began) * tempo + first_s, people)
            if label in (1, 2) and self.effects.shuffling:
                # People who sit down end up farther back than their feet, those who rise farther forward.
                way = draw(0.0, 0.25) * segment(time, began, began + 2 / tempo)
                joints[..., 1] += (way if label == 1 else -way)[..., None]
            joints = place(joints, draw(-0.3, 0.3), range_m)
        if self.effects.unrest:
            joints = add_unrest(joints, draw, Unrest((0.003, 0.02), (0.0, 0.05)))
        return joints if self.effects.quick_limbs else smooth_as_paper(joints), duration

    def masks(self, joints: Tensor, duration: float, generator: torch.Generator) -> Tensor:
        """Masks (N, 128, 256) bool of people (N, K, 14, 3)."""
        draw = Draw(joints.shape[0], generator)
        pulses = round(duration * RADAR.prf_hz)
        at = torch.arange(pulses, dtype=torch.float64) / RADAR.prf_hz
        body = self.scatterers if self.effects.ellipsoids else self.points
        positions, rcs = body(joints.unsqueeze(1), torch.ones(joints.shape[:2]).unsqueeze(1))
        if self.effects.dim_limbs and self.effects.ellipsoids:
            rcs = dim_limbs(rcs, draw, -9.0, 3.0, self.scatterers.per_segment)
        positions, rcs = at_instants(positions, at), linear(rcs, at)
        echo = self.echo(positions, rcs)
        if not self.effects.prf:
            echo = at_half_the_pulse_rate(echo.transpose(1, 2)).transpose(1, 2)
        echo = echo / echo.abs().square().sum(-1).mean(-1)[:, None, None].sqrt()
        signal_db = draw(28.0, 48.0) if self.effects.levels else draw(38.0, 38.0)
        if self.effects.image:
            # Both signs of Doppler in each frame: the image due to imperfect quadrature and scattered paths.
            image_db = draw(-45.0, -18.0)
            echo = echo + 10 ** (image_db / 20).float().unsqueeze(-1) * echo.conj()
        x = echo * 10 ** (signal_db / 20).float().unsqueeze(-1)
        x = x + self._receiver(draw, pulses)
        moving = self.mti(x.to(torch.complex64))
        level_db = draw(45.0, 75.0) if self.effects.levels else draw(60.0, 60.0)
        return self._detected(self.maps(moving), level_db)

    def _receiver(self, draw: Draw, pulses: int) -> Tensor:
        """White noise of power 1, residue of static echoes, and lines at fixed Doppler (N, M, R)."""
        shape = (pulses, self.bins)
        noise = torch.complex(draw.normal(*shape).float(), draw.normal(*shape).float()) / 2**0.5
        rate = RADAR.prf_hz
        frequency = torch.fft.fftfreq(pulses, 1 / rate)
        if self.effects.residue:
            # Phase noise of antenna leakage, walls and furniture, highest next to the carrier.
            corner, strength_db = draw(3.0, 9.0).float(), draw(14.0, 38.0).float()
            spectrum = 10 ** (strength_db / 20) / (1 + (frequency / corner).abs() ** 3)
            white = torch.complex(draw.normal(*shape).float(), draw.normal(*shape).float())
            noise = noise + torch.fft.ifft(torch.fft.fft(white, dim=1) * spectrum[..., None], dim=1) / 2**0.5
        if self.effects.lines:
            time = torch.arange(pulses) / rate
            for base, chance in ((100.0, 0.5), (124.0, 0.25)):
                on = (draw(0, 1) < chance).float()
                hz = (base + draw(-6.0, 6.0)).float()
                for order in (-2, -1, 1, 2):
                    db = draw(-22.0, -4.0).float() - 5 * (abs(order) - 1)
                    tone = torch.exp(2j * torch.pi * (order * hz * time + draw(0, 1).float()))
                    noise = noise + (on * 10 ** (db / 20) * tone)[..., None]
        return noise

    def _detected(self, maps: Tensor, level_db: Tensor) -> Tensor:
        """CFAR on the decibels of maps (N, F, K), resized to 128 x 256."""
        db = 20 * maps.clamp(min=1e-6).log10()
        db = db - db.median(dim=-1)[0].median(dim=-1)[0][:, None, None] + level_db.float().unsqueeze(-1)
        # Doppler 0 in the middle of the measured masks, a third of a row before row 128 of 256.
        db = F.interpolate(db.flip(-2).roll(1, -2)[:, None], (128, 256), mode="bilinear", antialias=True)[
            :, 0
        ]
        if not self.effects.cfar:
            return db > level_db.float().unsqueeze(-1) + FIXED_THRESHOLD_DB
        return self.cfar(db.clamp(min=0.0))

    def simulate(self, label: int, count: int, generator: torch.Generator) -> Tensor:
        """Masks (count, 128, 256) bool of one class."""
        joints, duration = self.motion(label, count, generator)
        return self.masks(joints, duration, generator)


def read(packed: npt.NDArray[np.uint8]) -> Tensor:
    """Measured masks (N, 256, 32), one bit per cell, to masks (N, 128, 256) bool."""
    return torch.from_numpy(np.unpackbits(packed, axis=-1).astype(bool))[:, ROWS]


def pictures(masks: Tensor) -> Tensor:
    """Masks (N, 128, 256) to pictures (N, 1, 80, 64) of +-156 Hz; the first columns (filter start-up) are zeroed."""
    shown = masks[:, 24:104].float()
    shown[..., :4] = 0.0
    return F.avg_pool2d(shown.unsqueeze(1), (1, 4))


def augment(shown: Tensor, generator: torch.Generator) -> Tensor:
    """Pictures shifted in time and Doppler, thickened or thinned, and with cells missing."""
    shown = shift(shown, 14, -1, generator)
    shown = shift(shown, 2, -2, generator)
    return drop_cells(thicken(shown, generator), 0.03, generator)


def augment_measured(shown: Tensor, generator: torch.Generator) -> Tensor:
    """Measured pictures, also at other tempos and speeds, because they are few and vary less than simulated ones."""
    shown = warp(shown, generator, time=0.2, doppler=0.12, later=0.4)
    return drop_cells(thicken(shown, generator), 0.1, generator)


def thicken(shown: Tensor, generator: torch.Generator) -> Tensor:
    """Pictures, some thickened along Doppler and some thinned."""
    chance = torch.rand(shown.shape[0], 1, 1, 1, generator=generator)
    thick = F.max_pool2d(shown, (3, 1), 1, (1, 0))
    thin = -F.max_pool2d(-shown, (3, 1), 1, (1, 0))
    return torch.where(chance < 0.25, thick, torch.where(chance > 0.85, thin, shown))

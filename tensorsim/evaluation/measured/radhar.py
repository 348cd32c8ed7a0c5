"""RadHAR, TI IWR1443 at 30 frames per second: what remains of five exercises in sparse point clouds."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
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
    in_beam,
    knots,
    linear,
    place,
    stage_people,
    walk_to_and_fro,
)
from tensorsim.evaluation.measured.training import drop_cells, shift
from tensorsim.motion.exercises import box, jump, jumping_jack, squat
from tensorsim.motion.limb_scatterers import LimbScatterers
from tensorsim.motion.people import PeopleConfig
from tensorsim.radar.measured_sensors import MEASURED_SENSORS, RADHAR_CHIRPS
from tensorsim.radar.processing.cfar import CfarDetector
from tensorsim.radar.processing.point_cloud import local_maxima
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.echo import EchoSynthesizer

CLASSES = ("boxing", "jack", "jump", "squats", "walk")
FRAMES, FRAME_HZ = 60, 30.0
RADAR = MEASURED_SENSORS["radhar-iwr1443"].radar
_WRISTS = [JOINTS.index("right_wrist"), JOINTS.index("left_wrist")]


@dataclass(frozen=True)
class Effects:
    """Effects of the simulation beyond moving bodies; an ablation leaves out one at a time.

    Attributes:
        to_and_fro: walkers turn round; else they walk straight on.
        unrest: sway of the body and small movements of the limbs.
        dim_limbs: limb-to-trunk ratios other than those of ellipsoids, drawn for each clip.
        peaks_only: detections with a stronger neighbour in range or Doppler are dropped.
        levels: signal drawn for each clip; else always the same.
        beam: a beam that is narrow in elevation.
        hands: a scatterer at each wrist.
        prf: the radar's chirp rate; else half of it, so that speeds above 2.5 m/s wrap.
    """

    to_and_fro: bool = True
    unrest: bool = True
    dim_limbs: bool = True
    peaks_only: bool = True
    levels: bool = True
    beam: bool = True
    hands: bool = True
    prf: bool = True


class RadHar:
    """Simulated presence maps over Doppler bins and time."""

    def __init__(self, effects: Effects) -> None:
        self.effects = effects
        profile = RangeProfile(RADAR, window="hamming", gate_m=(0.8, 4.6))
        self.echo = RangeBinSynthesizer(EchoSynthesizer(RADAR), profile, near_bins=2)
        self.scatterers = LimbScatterers(RADAR.tx_positions_m[0], RADAR.rx_positions_m[0], per_segment=2)
        # Next to a body that fills many range bins, the smaller reference cells are the ones with noise only.
        self.cfar = CfarDetector(
            (5, 0), (5, 0), 1e-6, "ordered-statistic", rank=0.4, edges=("reflect", "reflect")
        )
        frames = torch.arange(FRAMES, dtype=torch.float64) / FRAME_HZ
        self.at = (
            frames[:, None] + torch.arange(RADHAR_CHIRPS, dtype=torch.float64) / RADAR.prf_hz
        ).flatten()

    def motion(self, label: int, count: int, generator: torch.Generator) -> Tensor:
        """Joints (count, K, 14, 3) at ``KNOT_HZ``."""
        draw = Draw(count, generator)
        people = stage_people(
            count, draw, PeopleConfig(heading_rad=0.35, facing_radar_share=1.0, speed_m_s=(0.3, 0.75)), None
        )
        time = knots(FRAMES / FRAME_HZ).expand(count, -1)
        if label == 4:
            joints, offset_m = walk_to_and_fro(
                time, people, draw, (1.2, 2.5), (0.8, 2.0), self.effects.to_and_fro
            )
            joints = place(joints, draw(-0.4, 0.4), draw(1.6, 3.3) + offset_m)
        else:
            script = (box, jumping_jack, jump, squat)[label]
            joints = act_out(script, time * draw(0.65, 1.2) + draw(0.0, 5.0), people)
            joints = place(joints, draw(-0.3, 0.3), draw(1.3, 3.5))
        if self.effects.unrest:
            joints = add_unrest(joints, draw, Unrest((0.001, 0.008), (0.0, 0.02)))
        return joints

    def maps(self, joints: Tensor, generator: torch.Generator) -> Tensor:
        """Presence (N, 16, 60) bool, Doppler from approaching to receding, of people (N, K, 14, 3)."""
        count = joints.shape[0]
        draw = Draw(count, generator)
        positions, rcs = self.scatterers(joints.unsqueeze(1), torch.ones(joints.shape[:2]).unsqueeze(1))
        if self.effects.beam:
            rcs = in_beam(positions, rcs, RADAR.tx_positions_m[0][2], draw(14.0, 32.0))
        if self.effects.dim_limbs:
            rcs = dim_limbs(rcs, draw, -8.0, 3.0, self.scatterers.per_segment)
        if self.effects.hands:
            # A forearm seen end-on, as in a punch, has almost no cross section without its hand.
            hands = (10 ** draw(-2.6, -1.2)).expand(-1, 2)[:, None].expand(-1, joints.shape[1], -1)
            positions = torch.cat([positions, joints[:, :, _WRISTS]], dim=2)
            rcs = torch.cat([rcs, hands.to(rcs.dtype)], dim=2)
        echo = self.echo(at_instants(positions, self.at), linear(rcs, self.at))
        if not self.effects.prf:
            frames = echo.unflatten(1, (FRAMES, RADHAR_CHIRPS)).transpose(2, 3)
            echo = at_half_the_pulse_rate(frames).transpose(2, 3).flatten(1, 2)
        echo = echo / echo.abs().square().sum(-1).mean(-1)[:, None, None].sqrt()
        shape = (*echo.shape[1:],)
        noise = torch.complex(draw.normal(*shape).float(), draw.normal(*shape).float()) / 2**0.5
        level_db = draw(13.0, 34.0) if self.effects.levels else draw(20.0, 20.0)
        echo = echo * 10 ** (level_db / 20).float().unsqueeze(-1) + noise
        frames = echo.unflatten(1, (FRAMES, RADHAR_CHIRPS)).transpose(2, 3)
        window = torch.hann_window(RADHAR_CHIRPS, periodic=False)
        # Negative raw Doppler is approaching and comes first.
        cube = torch.fft.fftshift(torch.fft.fft(frames * window), dim=-1)
        power = cube.abs().square()
        scale = 10 ** (draw(0.0, 6.0) / 10).float()[..., None, None]
        found = power > scale * self.cfar.threshold(power)
        if self.effects.peaks_only:
            found = found & local_maxima(power)
        return found.any(2).transpose(1, 2)

    def simulate(self, label: int, count: int, generator: torch.Generator) -> Tensor:
        """Presence maps (count, 16, 60) bool of one class."""
        return self.maps(self.motion(label, count, generator), generator)


def read(intensity: npt.NDArray[np.uint8]) -> Tensor:
    """Measured windows (N, 16, 60) to presence maps of that shape, bool."""
    return torch.from_numpy(intensity > 0)


def pictures(maps: Tensor) -> Tensor:
    """Presence maps (N, 16, 60) to pictures (N, 1, 16, 60) with the row of zero Doppler cleared."""
    shown = maps.float()
    shown[:, RADHAR_CHIRPS // 2] = 0.0
    return shown.unsqueeze(1)


def augment(shown: Tensor, generator: torch.Generator) -> Tensor:
    """Pictures shifted in time, with cells missing."""
    return drop_cells(shift(shown, 20, -1, generator), 0.3, generator)

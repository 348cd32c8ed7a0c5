"""Checks that the speeds and ranges of a scene are unambiguous for a radar."""

import warnings

import torch
from torch import Tensor

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.radar.synthesis.legs import leg_length


def mean_range(positions: Tensor, radar: RadarConfig) -> Tensor:
    """Range ``(|P - Ptx| + |P - Prx|) / 2`` as on the range axis: (..., 3) metres -> (...) float64 metres.

    For several antennas, that of the first transmitter and receiver.
    """
    positions = positions.double()
    tx, rx = positions.new_tensor([radar.tx_positions_m[0], radar.rx_positions_m[0]])
    return (leg_length(positions, tx, 0.0) + leg_length(positions, rx, 0.0)) / 2


def radial_speed(positions: Tensor, radar: RadarConfig) -> Tensor:
    """Rate of change of :func:`mean_range` in m/s, positive = receding: (..., M, S, 3) metres -> (..., M - 1, S)."""
    return mean_range(positions, radar).diff(dim=-2) * radar.prf_hz


class SpeedCheck:
    """Collects the radial speeds and ranges of a scene, piece by piece, and compares them with the radar's limits.

    Doppler is ambiguous modulo the PRF, so a speed above ``lambda PRF / 4`` appears at a wrong frequency. If the
    RCS-weighted mean of the absolute radial speed (over scatterers and pulses of a clip) is above this limit, the
    whole map is wrong: an error. If only some scatterers are, a foot for instance: a warning. A scatterer at a range
    larger than that of the last bin has a beat frequency above half the sample rate and is not in the map: a warning.
    Scatterers with RCS 0, such as people before they appear, are ignored.
    """

    def __init__(self, radar: RadarConfig) -> None:
        self.radar = radar
        self.weighted, self.weight = torch.zeros(()), torch.zeros(())
        self.fastest, self.farthest = 0.0, 0.0

    def add(self, positions: Tensor, rcs: Tensor) -> None:
        """Add positions (..., M, S, 3) m and the RCS per pulse (..., M, S) m^2."""
        if positions.shape[-3] < 2 or positions.numel() == 0:
            return
        rcs = rcs.detach().double()
        distance = mean_range(positions.detach(), self.radar)
        self.farthest = max(self.farthest, float(torch.where(rcs > 0, distance, 0.0).max()))
        weight = torch.minimum(rcs[..., 1:, :], rcs[..., :-1, :])
        speed = torch.where(weight > 0, distance.diff(dim=-2).abs() * self.radar.prf_hz, 0.0)
        self.weighted = self.weighted + (weight * speed).sum((-2, -1)).cpu()
        self.weight = self.weight + weight.sum((-2, -1)).cpu()
        self.fastest = max(self.fastest, float(speed.max()))

    def judge(self) -> None:
        """Raise TensorsimError or warn; see the class."""
        reach_m = self.radar.range_resolution_m * (self.radar.samples_per_chirp // 2)
        if self.farthest > reach_m:
            warnings.warn(
                f"positions: some scatterer is {self.farthest:.2f} m away, more than the {reach_m:.2f} m of this "
                "radar's range axis",
                TensorsimWarning,
                stacklevel=3,
            )
        limit = self.radar.unambiguous_speed_m_s
        if self.fastest <= limit:
            return
        mean = float((self.weighted / self.weight.clamp_min(1e-300)).max())
        speed = mean if mean > limit else self.fastest
        enough = 4 * speed / self.radar.doppler_wavelength_m
        message = (
            f"radial speed of {speed:.2f} m/s, above the unambiguous {limit:.2f} m/s of a PRF of "
            f"{self.radar.prf_hz:g} Hz; expected a PRF of at least {enough:.0f} Hz"
        )
        if mean > limit:
            raise TensorsimError(f"positions: got a scene moving at a mean {message}")
        warnings.warn(f"positions: some scatterer has a {message}", TensorsimWarning, stacklevel=3)


def check_unambiguous(positions: Tensor, rcs: Tensor, radar: RadarConfig) -> None:
    """:class:`SpeedCheck` of a whole scene: positions (..., M, S, 3) m and RCS per pulse (..., M, S) m^2."""
    check = SpeedCheck(radar)
    check.add(positions, rcs)
    check.judge()

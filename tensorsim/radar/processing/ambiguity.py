"""Checks that the speeds and ranges of a scene are unambiguous for a radar."""

import math
import warnings

import torch
from torch import Tensor

from tensorsim.config import RadarConfig
from tensorsim.config.checks import is_finite
from tensorsim.errors import (
    TensorsimError,
    TensorsimWarning,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    check_size,
)
from tensorsim.radar.synthesis.legs import leg_length

#: A scatterer whose RCS is a smaller fraction of the largest counts as filtered out by the receiver.
_FILTERED = 1e-6


def mean_range(positions: Tensor, radar: RadarConfig) -> Tensor:
    """Range ``(|P - Ptx| + |P - Prx|) / 2`` as on the range axis: (..., 3) metres -> (...) float64 metres.

    For several antennas, that of the first transmitter and receiver.
    """
    positions = positions.double()
    tx, rx = positions.new_tensor([radar.tx_positions_m[0], radar.rx_positions_m[0]])
    return (leg_length(positions, tx, 0.0) + leg_length(positions, rx, 0.0)) / 2


def gate_around(positions: Tensor, radar: RadarConfig, margin_m: float = 0.5) -> tuple[float, float]:
    """The range gate (nearest, farthest) in metres that contains all scatterers, for a simulator's ``range_gate_m``.

    Args:
        positions: (..., 3) m of all people in the data set.
        radar: the radar.
        margin_m: added on both sides, for the width of a target in range and the delay of a wall.

    Raises:
        TensorsimError: no positions, positions of another shape or that are not finite, a margin below 0.

    >>> gate_around(torch.tensor([[0.0, 2.0, 1.0], [0.0, 5.0, 1.0]]), RadarConfig(tx_m=(0, 0, 1), rx_m=(0, 0, 1)))
    (1.5, 5.5)
    """
    check_floating(positions, "positions")
    check_min_rank(positions, 1, "positions", "(..., 3) metres")
    check_size(positions, -1, 3, "positions", "(..., 3) metres")
    check_not_empty(positions, "positions")
    check_finite(positions, "positions")
    if not (is_finite(margin_m) and margin_m >= 0):
        raise TensorsimError(f"margin_m: got {margin_m!r}, expected metres from 0 on")
    distance = mean_range(positions, radar)
    return max(0.0, float(distance.min()) - margin_m), float(distance.max()) + margin_m


class SpeedCheck:
    """Collects the radial speeds and ranges of a scene, piece by piece, and compares them with the radar's limits.

    Doppler is ambiguous modulo the PRF, so a speed above ``lambda PRF / 4`` appears at a wrong frequency. If the
    RCS-weighted mean of the absolute radial speed (over scatterers and pulses of a clip) is above this limit, the
    whole map is wrong: an error. If only some scatterers are, a foot for instance: a warning. A scatterer at a range
    larger than that of the last bin has a beat frequency above half the sample rate and is not in the map; from twice
    to three times that range the frequency is above the sample rate and the scatterer appears too near: warnings. A
    single-channel receiver cannot distinguish frequencies above half the sample rate from those below, so everything
    beyond the last bin appears too near. A scatterer outside a fixed range gate is cut off: a warning. Scatterers
    with RCS 0, such as people before they appear, are ignored.

    Args:
        radar: the radar.
        gate_m: (nearest, farthest) m of a fixed range gate; None is the whole range axis.
        real: whether the receiver has a single channel.
    """

    def __init__(
        self, radar: RadarConfig, gate_m: tuple[float, float] | None = None, real: bool = False
    ) -> None:
        self.radar, self.gate_m, self.real = radar, gate_m, real
        self.weighted, self.weight = torch.zeros(()), torch.zeros(())
        self.fastest, self.farthest, self.nearest = 0.0, 0.0, math.inf
        self.strongest, self.folded = 0.0, 0.0

    def add(self, positions: Tensor, rcs: Tensor) -> None:
        """Add positions (..., M, S, 3) m and the RCS per pulse (..., M, S) m^2."""
        if positions.shape[-3] < 2 or positions.numel() == 0:
            return
        rcs = rcs.detach().double()
        distance = mean_range(positions.detach(), self.radar)
        self.farthest = max(self.farthest, float(torch.where(rcs > 0, distance, 0.0).max()))
        self.nearest = min(self.nearest, float(torch.where(rcs > 0, distance, math.inf).min()))
        self.strongest = max(self.strongest, float(rcs.max()))
        reach_m = self.radar.reach_m
        if self.farthest > reach_m:
            # Beat frequencies are known up to multiples of the sample rate, so the range axis repeats. With a single
            # channel their sign is unknown too, so in between it repeats mirrored.
            seen_again = torch.remainder(distance, 2 * reach_m) < reach_m
            folded = (distance > reach_m) & (seen_again | self.real)
            self.folded = max(self.folded, float(torch.where(folded, rcs, 0.0).max()))
        weight = torch.minimum(rcs[..., 1:, :], rcs[..., :-1, :])
        speed = torch.where(weight > 0, distance.diff(dim=-2).abs() * self.radar.prf_hz, 0.0)
        self.weighted = self.weighted + (weight * speed).sum((-2, -1)).cpu()
        self.weight = self.weight + weight.sum((-2, -1)).cpu()
        self.fastest = max(self.fastest, float(speed.max()))

    def judge(self) -> None:
        """Raise TensorsimError or warn; see the class."""
        reach_m = self.radar.reach_m
        if self.folded > _FILTERED * self.strongest:
            limit_m, axis, rate = 2 * reach_m, "twice the range axis of this radar", "the sample rate"
            if self.real:
                limit_m, axis, rate = (
                    reach_m,
                    "the range axis of this radar",
                    "half the sample rate of one channel",
                )
            warnings.warn(
                f"positions: some scatterer is beyond {limit_m:.2f} m, {axis}: its beat frequency is above {rate}, "
                "and it appears too near; leave out people that far away",
                TensorsimWarning,
                stacklevel=3,
            )
        elif self.farthest > reach_m:
            warnings.warn(
                f"positions: some scatterer is beyond the {reach_m:.2f} m of this radar's range axis and does not "
                "appear in the maps",
                TensorsimWarning,
                stacklevel=3,
            )
        elif self.gate_m is not None and (self.nearest < self.gate_m[0] or self.farthest > self.gate_m[1]):
            near, far = self.gate_m
            warnings.warn(
                f"positions: some scatterer leaves the range gate of {near:g} to {far:g} m and is missing from the "
                "maps; tensorsim.radar.gate_around gives a gate that holds all",
                TensorsimWarning,
                stacklevel=3,
            )
        limit = self.radar.unambiguous_speed_m_s
        if self.fastest <= limit:
            return
        mean = float((self.weighted / self.weight.clamp_min(1e-300)).max())
        unambiguous = f"above the unambiguous {limit:.2f} m/s of a PRF of {self.radar.prf_hz:g} Hz"
        if mean > limit:
            enough = 4 * mean / self.radar.doppler_wavelength_m
            raise TensorsimError(
                f"positions: got a scene moving at a mean radial speed of {mean:.2f} m/s, {unambiguous}; expected a "
                f"PRF of at least {enough:.0f} Hz"
            )
        # Without the measured speed the text is always the same, so Python shows it once, not for every clip.
        warnings.warn(
            f"positions: some scatterer has a radial speed {unambiguous}: it appears at a wrong Doppler frequency",
            TensorsimWarning,
            stacklevel=3,
        )


def check_unambiguous(
    positions: Tensor,
    rcs: Tensor,
    radar: RadarConfig,
    gate_m: tuple[float, float] | None = None,
    real: bool = False,
) -> None:
    """:class:`SpeedCheck` of a whole scene: positions (..., M, S, 3) m and RCS per pulse (..., M, S) m^2."""
    check = SpeedCheck(radar, gate_m, real)
    check.add(positions, rcs)
    check.judge()

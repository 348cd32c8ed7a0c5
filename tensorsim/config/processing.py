"""From the intermediate-frequency signal to maps."""

from dataclasses import dataclass
from typing import Literal

from tensorsim.config.checks import (
    is_finite,
    make_plain,
    require_choices,
    require_counts,
    require_positive,
    require_ranges,
)
from tensorsim.exceptions import TensorsimError

RangeWindow = Literal["hamming", "hann", "blackman"]
Mti = Literal["two-pulse", "n-pulse", "mean", "high-pass"]
Integration = Literal["noncoherent", "coherent", "paper"]
Engine = Literal["time", "range-bins"]


@dataclass(frozen=True)
class ProcessingConfig:
    """How the radar's signal becomes maps.

    Attributes:
        range_window: window over fast time; None is rectangular.
        mti: moving target indicator, see :class:`tensorsim.radar.MovingTargetIndicator`.
        window_s: length of the STFT window in seconds (panel: STFT window, 0.1 s).
        overlap: overlap of neighbouring STFT windows, as a fraction (panel: overlap, 0.9).
        integration: how range bins are summed, see :class:`tensorsim.radar.DopplerTimeMap`.
        ridge_count: number of ridges of the Doppler-time map, 1 to 6 (panel: 3).
        denoiser: what cleans the maps (panel: denoiser on/off): ``"none"``, ``"perona-malik"``, ``"ksvd"``,
            ``"dncnn"``, or DnCNN weights by name or file, see :func:`tensorsim.enhance.choice.map_denoiser`; None
            is off.
        display_rate_hz: columns per second of the range-time maps; None keeps every pulse.
        engine: ``"time"`` synthesises the signal and transforms it; ``"range-bins"`` computes the range bins in
            closed form.
        near_bins: with ``engine="range-bins"``, number of bins computed on each side of a path; None computes all.
        energy_stride: with ``engine="range-bins"``, the echo power that the noise refers to is the mean over every
            n-th pulse; computing it takes a third of the time.
        range_gate_m: (nearest, farthest) range in metres of the bins used, or the width in metres of a gate that
            follows the people; None uses all bins.
        pulse_chunk: pulses processed at a time; bounds memory.

    Raises:
        TensorsimError: an unknown choice, or numbers out of range.
    """

    range_window: RangeWindow | None = "hamming"
    mti: Mti = "two-pulse"
    window_s: float = 0.1
    overlap: float = 0.9
    integration: Integration = "noncoherent"
    ridge_count: int = 3
    denoiser: str | None = None
    display_rate_hz: float | None = None
    engine: Engine = "time"
    near_bins: int | None = None
    energy_stride: int = 1
    range_gate_m: tuple[float, float] | float | None = None
    pulse_chunk: int = 1024

    def __post_init__(self) -> None:
        make_plain(self)
        require_choices(self, mti=Mti, integration=Integration, engine=Engine)
        if self.range_window is not None:
            require_choices(self, range_window=RangeWindow)
        require_counts(self, "ridge_count", most=6)
        require_counts(self, "pulse_chunk", "energy_stride", most=1_000_000)
        require_ranges(self, window_s="length of a window")
        if not (is_finite(self.overlap) and 0 <= self.overlap < 1):
            raise TensorsimError(f"overlap: got {self.overlap!r}, expected a number in [0, 1)")
        self._check_gate()
        if self.display_rate_hz is not None:
            require_positive("ProcessingConfig", display_rate_hz=self.display_rate_hz)
        if self.energy_stride > 1 and self.engine == "time":
            raise TensorsimError(
                f"energy_stride: got {self.energy_stride} with the engine 'time', expected 'range-bins'"
            )
        if self.near_bins is not None:
            require_counts(self, "near_bins")
            if self.engine == "time":
                raise TensorsimError(
                    f"near_bins: got {self.near_bins} with the engine 'time', expected 'range-bins'"
                )

    def _check_gate(self) -> None:
        gate_m = self.range_gate_m
        if isinstance(gate_m, tuple):
            if not (len(gate_m) == 2 and all(map(is_finite, gate_m)) and 0 <= gate_m[0] <= gate_m[1]):
                raise TensorsimError(
                    f"ProcessingConfig.range_gate_m: got {gate_m}, expected (nearest, farthest) metres from 0 on"
                )
        elif gate_m is not None:
            require_positive("ProcessingConfig", range_gate_m=gate_m)

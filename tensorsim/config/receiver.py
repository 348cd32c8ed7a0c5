"""Receiver imperfections, room clutter, and an interfering radar."""

import math
from dataclasses import dataclass

from tensorsim.config.checks import (
    Vector,
    is_finite,
    make_plain,
    require_counts,
    require_finite,
    require_position,
    require_positive,
    require_ranges,
)
from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class ReceiverConfig:
    """What the receiver does to the signal. Every effect is off by default.

    Attributes:
        phase_noise_dbc_hz: single-sideband phase noise of the oscillator in dBc/Hz, 1 MHz from the carrier; for its
            shape over frequency see :class:`tensorsim.radar.PhaseNoise`. None is an ideal oscillator.
        iq_imbalance_db: gain of Q relative to I in dB, see :class:`tensorsim.radar.QuadratureImbalance`.
        iq_phase_rad: deviation of the I/Q phase difference from a quarter turn, in radians.
        dc_offset_db: power of a constant offset in dB relative to the mean echo power that the noise refers to; None
            is no offset.
        real: the receiver has only the I channel, see :class:`tensorsim.radar.RealReceiver`. For the same
            ``snr_db``, which is per sample, the SNR of range bins is 3 dB lower.
        adc_bits: bits of the I and Q converters, see :class:`tensorsim.radar.Converter`; None does not quantise.
        adc_headroom_db: full scale of the converters relative to the rms magnitude of their input over the clip, in
            dB; 0 dB is a full-scale wave, smaller values saturate more.

    Raises:
        TensorsimError: numbers that are not finite, bits out of range.
    """

    phase_noise_dbc_hz: float | None = None
    iq_imbalance_db: float = 0.0
    iq_phase_rad: float = 0.0
    dc_offset_db: float | None = None
    real: bool = False
    adc_bits: int | None = None
    adc_headroom_db: float = 12.0

    def __post_init__(self) -> None:
        make_plain(self)
        require_finite(self, "iq_phase_rad")
        require_ranges(self, iq_imbalance_db="gain", adc_headroom_db="gain")
        for name in ("phase_noise_dbc_hz", "dc_offset_db"):
            if getattr(self, name) is not None:
                require_ranges(self, **{name: "ratio of powers"})
        if self.adc_bits is not None:
            require_counts(self, "adc_bits")
            require_ranges(self, adc_bits="bits of a converter")

    @classmethod
    def typical(cls) -> "ReceiverConfig":
        """An integrated 77 GHz radar: its oscillator, 12-bit converters, and typical residuals after calibration."""
        return cls(
            phase_noise_dbc_hz=-93.0,
            iq_imbalance_db=0.3,
            iq_phase_rad=math.radians(1.0),
            dc_offset_db=0.0,
            adc_bits=12,
        )

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the fields that change the signal."""
        switched = {
            "phase_noise_dbc_hz": self.phase_noise_dbc_hz is not None,
            "iq_imbalance_db": self.iq_imbalance_db != 0,
            "iq_phase_rad": self.iq_phase_rad != 0,
            "dc_offset_db": self.dc_offset_db is not None,
            "real": self.real,
            "adc_bits": self.adc_bits is not None,
        }
        return tuple(name for name, on in switched.items() if on)


@dataclass(frozen=True)
class ClutterConfig:
    """Furniture and walls of a room, seen by a slightly vibrating sensor, see :class:`tensorsim.radar.RoomClutter`.

    Attributes:
        reflectors: number of reflectors.
        jitter_m: rms vibration of the sensor along each axis in metres.

    Raises:
        TensorsimError: no reflector, a jitter below 0.
    """

    reflectors: int = 12
    jitter_m: float = 10e-6

    def __post_init__(self) -> None:
        make_plain(self)
        require_counts(self, "reflectors", most=10_000)
        if not (is_finite(self.jitter_m) and self.jitter_m >= 0):
            raise TensorsimError(
                f"ClutterConfig.jitter_m: got {self.jitter_m!r}, expected a finite number >= 0"
            )


@dataclass(frozen=True)
class InterferenceConfig:
    """An interfering radar in the same band, see :class:`tensorsim.radar.Interference`.

    Attributes:
        position_m: its position (x, y, z) in metres.
        chirp_ratio: duration of its sweeps relative to that of this radar; the slopes differ, so the sweeps cross. Its
            sweeps follow each other almost without a pause.
        power_ratio_db: its transmit power relative to that of this radar, in dB.
        delay_s: time in seconds at which its first sweep arrives.

    Raises:
        TensorsimError: a position without three finite numbers, a ratio that is not positive.
    """

    position_m: Vector = (2.0, 6.0, 1.5)
    chirp_ratio: float = 1.3
    power_ratio_db: float = 0.0
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        make_plain(self)
        require_position("InterferenceConfig", position_m=self.position_m)
        require_positive("InterferenceConfig", chirp_ratio=self.chirp_ratio)
        require_finite(self, "delay_s")
        require_ranges(self, power_ratio_db="ratio of powers")

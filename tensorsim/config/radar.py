"""The radar: waveform, sampling, antennas."""

from dataclasses import dataclass, replace

from tensorsim.config.checks import Vector, listed, make_plain, require_position, require_ranges
from tensorsim.exceptions import TensorsimError
from tensorsim.limits import check_range

SPEED_OF_LIGHT_M_S = 299_792_458.0


@dataclass(frozen=True)
class RadarConfig:
    """An FMCW radar. World frame: x right, y range, z height, metres.

    The chirp sweeps upwards from ``carrier_hz``, the **start** of the sweep: ``f(t) = fc + (B / T) t``.
    Defaults are the free-space preset of the original application's panel.

    ``tx_m`` and ``rx_m`` are one position (x, y, z) each, or K and A of them: ``((x, y, z), ...)`` or anything
    of shape (A, 3). A list of positions gives the echo an antenna dimension of K * A channels, transmitter by
    transmitter. Transmitters fire in turn (time division): number k at ``k / (K PRF)`` after the start of a pulse
    interval.

    Attributes:
        carrier_hz: frequency at the start of the sweep in Hz.
        bandwidth_hz: width of the sweep in Hz.
        chirp_s: duration of the sweep in seconds.
        prf_hz: pulse repetition frequency in Hz; each of the K transmitters fires once per pulse interval.
        sample_rate_hz: complex samples of the intermediate frequency per second.
        tx_m: position of the transmitter in metres, or K positions.
        rx_m: position of the receiver in metres, or A positions.
        antenna_gain_dbi: gain of each antenna in dBi, transmitters and receivers alike.
        isolation_db: attenuation in dB of the direct signal from transmitter to receiver; used only with leakage
            (:attr:`SceneConfig.leakage`).

    Raises:
        TensorsimError: a frequency or duration that is not positive, a position without three finite numbers,
            implausible values (:mod:`tensorsim.limits`), or K chirps that do not fit into a pulse interval.
    """

    carrier_hz: float = 77e9
    bandwidth_hz: float = 4e9
    chirp_s: float = 40e-6
    prf_hz: float = 8192.0
    sample_rate_hz: float = 10e6
    tx_m: Vector | tuple[Vector, ...] = (-0.1, 0.0, 1.5)
    rx_m: Vector | tuple[Vector, ...] = (0.1, 0.0, 1.5)
    antenna_gain_dbi: float = 10.0
    isolation_db: float = 20.0

    def __post_init__(self) -> None:
        make_plain(self)
        require_ranges(
            self,
            carrier_hz="carrier frequency",
            bandwidth_hz="bandwidth",
            chirp_s="chirp duration",
            prf_hz="pulse repetition frequency",
            sample_rate_hz="sample rate",
            antenna_gain_dbi="gain",
            isolation_db="gain",
        )
        for tx in self.tx_positions_m:
            require_position("RadarConfig", tx_m=tx)
        for rx in self.rx_positions_m:
            require_position("RadarConfig", rx_m=rx)
        check_range(self.samples_per_chirp, "samples per chirp", "RadarConfig: sample_rate_hz times chirp_s")
        turns = len(self.tx_positions_m)
        check_range(turns * len(self.rx_positions_m), "antennas", "RadarConfig: tx_m times rx_m")
        if self.chirp_s * self.prf_hz * turns > 1.0:
            chirps = (
                f"a chirp of {self.chirp_s:.4g} s does"
                if turns == 1
                else f"{turns} chirps of {self.chirp_s:.4g} s do"
            )
            raise TensorsimError(
                f"RadarConfig: {chirps} not fit the pulse interval {1.0 / self.prf_hz:.4g} s of prf_hz "
                f"{self.prf_hz:.5g}"
            )

    @classmethod
    def free_space(cls, **overrides: float | Vector) -> "RadarConfig":
        """The panel's free-space radar: 77 GHz, 4 GHz of bandwidth, PRF 8192 Hz."""
        return replace(cls(), **overrides)  # type: ignore[arg-type]

    @classmethod
    def through_wall(cls, **overrides: float | Vector) -> "RadarConfig":
        """The panel's through-wall radar: 2 GHz, 1 GHz of bandwidth, PRF 128 Hz."""
        return replace(cls(carrier_hz=2e9, bandwidth_hz=1e9, prf_hz=128.0), **overrides)  # type: ignore[arg-type]

    @property
    def tx_positions_m(self) -> tuple[Vector, ...]:
        """Position (x, y, z) in metres of every transmitter, even if there is only one."""
        return listed(self.tx_m)

    @property
    def rx_positions_m(self) -> tuple[Vector, ...]:
        """Position (x, y, z) in metres of every receiver, even if there is only one."""
        return listed(self.rx_m)

    @property
    def middle_m(self) -> Vector:
        """Midpoint in metres of the first transmitter and receiver: the origin of the range axis of one pair."""
        tx, rx = self.tx_positions_m[0], self.rx_positions_m[0]
        return ((tx[0] + rx[0]) / 2, (tx[1] + rx[1]) / 2, (tx[2] + rx[2]) / 2)

    @property
    def has_array(self) -> bool:
        """Whether the echo has an antenna dimension: ``tx_m`` or ``rx_m`` is a list of positions."""
        return self.tx_positions_m != (self.tx_m,) or self.rx_positions_m != (self.rx_m,)

    @property
    def slope_hz_per_s(self) -> float:
        """Chirp slope mu = B / T in Hz/s."""
        return self.bandwidth_hz / self.chirp_s

    @property
    def samples_per_chirp(self) -> int:
        """Number of samples per chirp, N = round(fs T)."""
        return round(self.sample_rate_hz * self.chirp_s)

    @property
    def wavelength_m(self) -> float:
        """Wavelength in metres used for the amplitude (radar equation), c / fc."""
        return SPEED_OF_LIGHT_M_S / self.carrier_hz

    @property
    def doppler_wavelength_m(self) -> float:
        """Wavelength in metres for Doppler shifts, c / (fc + B/2): in a range bin they follow the sweep's centre."""
        return SPEED_OF_LIGHT_M_S / (self.carrier_hz + self.bandwidth_hz / 2)

    @property
    def range_resolution_m(self) -> float:
        """Spacing of range bins in metres, c / (2B); if fs T is not an integer, B is the span of the N samples."""
        span = self.samples_per_chirp / (self.sample_rate_hz * self.chirp_s)
        return SPEED_OF_LIGHT_M_S / (2 * self.bandwidth_hz * span)

    @property
    def reach_m(self) -> float:
        """Range in metres at half the sample rate, where the N / 2 range bins end."""
        return self.range_resolution_m * (self.samples_per_chirp // 2)

    @property
    def unambiguous_speed_m_s(self) -> float:
        """Largest radial speed in m/s without Doppler aliasing, lambda PRF / 4 (presets: 7.8 m/s and 3.8 m/s)."""
        return self.doppler_wavelength_m * self.prf_hz / 4

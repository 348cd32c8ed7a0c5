"""Interference from another FMCW radar."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import SPEED_OF_LIGHT_M_S, RadarConfig
from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_complex_map
from tensorsim.protocols import check_instance
from tensorsim.radar.synthesis.phase_noise import PhaseNoise


class Interference(nn.Module):
    """Adds the chirps of another FMCW radar to the IF, where they pass through the receiver's band.

    The two sweeps beat at the difference of their instantaneous frequencies. The part within half the sample rate
    of zero enters the IF, as a chirp that spreads over all range bins; the rest is filtered out. There is one path,
    direct and in air, whatever walls the scene has, with amplitude ``sqrt(Pt2 / Pt1 Gt Gr) lambda / (4 pi R)``
    (Friis). See Brooker, *Mutual interference of millimeter-wave radar systems*, IEEE Trans. Electromagn. Compat. 49,
    2007.

    Times count from pulse 0, so that a clip processed in pieces gives the same result. The two clocks are ideal.

    Args:
        radar: the receiving radar, with one transmitter and one receiver.
        other: the other radar, at its own position; its PRF and sweep need not be those of ``radar``.
        delay_s: time at which its sweep number 0 begins, plus the propagation time to the receiver.
        power_ratio_db: its transmit power over that of ``radar``.
        phase_noise: of the oscillator of ``radar``; that of the other radar is independent and equally noisy. None:
            neither has any.

    Shapes: IF (..., M, N) complex, number of its first pulse -> IF likewise. Differentiable.

    Raises:
        TensorsimError: an array, the other radar at the receiver's position, numbers that are not finite, an IF that
            is not complex or has another number of samples.
    """

    def __init__(
        self,
        radar: RadarConfig,
        other: RadarConfig,
        delay_s: float = 0.0,
        power_ratio_db: float = 0.0,
        phase_noise: PhaseNoise | None = None,
    ) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        check_instance(other, RadarConfig, "other")
        self.phase_noise: PhaseNoise | None = phase_noise
        if radar.has_array or other.has_array:
            raise TensorsimError(
                "radar, other: got several antennas, expected one transmitter and one receiver each"
            )
        if not (is_finite(delay_s) and is_finite(power_ratio_db)):
            raise TensorsimError(
                f"delay_s, power_ratio_db: got {delay_s} and {power_ratio_db}, expected finite numbers"
            )
        heard, source = radar.rx_positions_m[0], other.tx_positions_m[0]
        distance = math.dist(heard, source)
        if distance == 0:
            raise TensorsimError(f"other.tx_m: got {source}, where the receiver is, expected another place")
        gain_db = radar.antenna_gain_dbi + other.antenna_gain_dbi + power_ratio_db
        wavelength = SPEED_OF_LIGHT_M_S / other.carrier_hz
        self.amplitude = 10 ** (gain_db / 20) * wavelength / (4 * math.pi * distance)
        self.samples, self.rate_hz, self.prf_hz = radar.samples_per_chirp, radar.sample_rate_hz, radar.prf_hz
        self.slope, self.other_slope = radar.slope_hz_per_s, other.slope_hz_per_s
        self.other_prf_hz, self.other_chirp_s = other.prf_hz, other.chirp_s
        self.apart_hz = radar.carrier_hz - other.carrier_hz
        self.carrier_hz = other.carrier_hz
        self.delay_s = float(delay_s)

    def forward(self, intermediate: Tensor, start: int = 0) -> Tensor:
        """IF of pulses ``start`` onwards to IF with interference."""
        check_complex_map(intermediate, "IF", f"(..., pulses, {self.samples} samples)")
        device = intermediate.device
        pulse = (start + torch.arange(intermediate.shape[-2], dtype=torch.float64, device=device)).unsqueeze(
            -1
        )
        own = torch.arange(self.samples, dtype=torch.float64, device=device) / self.rate_hz
        begin = pulse / self.prf_hz - self.delay_s
        sweep = torch.floor((begin + own) * self.other_prf_hz)
        # Time within the received sweep. The long times are subtracted first, so that their rounding error is a phase
        # that all samples of a pulse share.
        theirs = (begin - sweep / self.other_prf_hz) + own

        beat = self.apart_hz + self.slope * own - self.other_slope * theirs
        heard = (beat.abs() < self.rate_hz / 2) & (theirs < self.other_chirp_s)
        # Tx conj(Rx): own phase minus that of the incoming wave, in cycles; carriers are taken at the sample's time
        # within each sweep, so each sweep of the other radar begins with the same phase.
        turns = (
            self.apart_hz * own
            + self.slope * own.square() / 2
            - self.carrier_hz * (theirs - own)
            - self.other_slope * theirs.square() / 2
        )
        angle = 2 * math.pi * (turns - turns.floor())
        if self.phase_noise is not None:
            angle = angle + self.phase_noise.of_two_oscillators(start, angle.shape[0])
        wave = torch.polar(self.amplitude * heard.to(angle.dtype), angle)
        return intermediate + wave.to(intermediate.dtype)

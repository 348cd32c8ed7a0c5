"""Oscillator phase noise after the mixer, where most of it cancels (range correlation)."""

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, check_complex_map
from tensorsim.protocols import check_instance
from tensorsim.radar.synthesis.counter_noise import normal

#: Single-sideband phase noise of integrated oscillators at 77 GHz (typical): offsets from the carrier, and L at them.
OFFSETS_HZ = (1e4, 1e5, 1e6, 1e7)
LEVELS_DBC_HZ = (-68.0, -80.0, -93.0, -113.0)


def interpolated_level(frequency_hz: Tensor, offsets_hz: Tensor, level_dbc_hz: Tensor) -> Tensor:
    """Single-sideband phase noise L(f) in dBc/Hz at (...), linear in dB over log f between the offsets (P,)."""
    x = frequency_hz.clamp(float(offsets_hz[0]), float(offsets_hz[-1])).log()
    knots = offsets_hz.log()
    after = torch.searchsorted(knots, x.contiguous()).clamp(1, offsets_hz.shape[0] - 1)
    share = (x - knots[after - 1]) / (knots[after] - knots[after - 1])
    return torch.lerp(level_dbc_hz[after - 1], level_dbc_hz[after], share)


class PhaseNoise(nn.Module):
    """Adds the phase noise of the transmitter's oscillator to the IF, after dechirp.

    Transmitted wave and echo have the same phase noise, one delay apart, so that the IF of a path of delay tau gets
    ``phi(t) - phi(t - tau)``, whose spectrum is ``4 sin^2(pi f tau)`` times that of phi (Budge and Burt, *Range
    correlation effects in radars*, IEEE National Radar Conference 1993). Leakage and near walls keep little of it;
    a strong, distant echo gets a pedestal of noise in range and Doppler.

    The delay of every part of the IF is known from its beat frequency, tau = f_beat / slope. For one beat the
    difference is the derivative of phi at the middle of the delay times tau, and a second term with the third
    derivative: ``2 sin x = 2 x - x^3 / 3``, x = pi f tau. The rest is below 1 % up to f tau = 0.25. Noise slower than
    one pulse, which range correlation cancels best, is left out: pulses are independent of each other.

    Args:
        radar: sample rate and slope of the chirp.
        offsets_hz: ascending offsets from the carrier at which the phase noise is given.
        level_dbc_hz: single-sideband phase noise L(f) there; between them it is linear in dB over log f, beyond them
            constant. The defaults are typical of integrated oscillators at 77 GHz (-93 dBc/Hz at 1 MHz).
        seed: of the noise.

    Shapes: IF (..., M, N) complex, number of its first pulse -> IF likewise. A pulse has the same noise in whichever
        piece of the clip it is processed. Differentiable.

    Raises:
        TensorsimError: offsets that are not positive and ascending, levels that are not finite or not one per offset,
            an IF that is not complex or has another number of samples.
    """

    deviation: Tensor
    amplitude: Tensor
    delay_s: Tensor

    def __init__(
        self,
        radar: RadarConfig,
        offsets_hz: Sequence[float] = OFFSETS_HZ,
        level_dbc_hz: Sequence[float] = LEVELS_DBC_HZ,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        ascending = all(a < b for a, b in itertools.pairwise(offsets_hz))
        if len(offsets_hz) < 2 or offsets_hz[0] <= 0 or not ascending:
            raise TensorsimError(
                f"offsets_hz: got {offsets_hz}, expected two or more ascending positive numbers"
            )
        if len(level_dbc_hz) != len(offsets_hz) or not all(math.isfinite(v) for v in level_dbc_hz):
            raise TensorsimError(
                f"level_dbc_hz: got {level_dbc_hz}, expected {len(offsets_hz)} finite numbers, one per offset"
            )
        self.samples, self.seed = radar.samples_per_chirp, seed
        self.other_seed = seed + 2**32  # seeds in configurations are smaller
        self.line_delay_s = radar.sample_rate_hz / radar.slope_hz_per_s / (2 * math.pi)
        spacing = radar.sample_rate_hz / self.samples
        offsets = torch.tensor(tuple(offsets_hz), dtype=torch.float64)
        levels = torch.tensor(tuple(level_dbc_hz), dtype=torch.float64)
        frequency = torch.arange(self.samples // 2 + 1, dtype=torch.float64) * spacing
        # The spectrum of phi on both sides of the carrier is L(f), rad^2/Hz; variance of each complex coefficient.
        variance = 10 ** (interpolated_level(frequency, offsets, levels) / 10) * spacing
        angular = 2 * math.pi * frequency
        # First and third derivative of phi, as spectra; those at 0 Hz vanish.
        amplitude = variance.sqrt()
        deviation = torch.stack((angular, -(angular**3) / 24)) * amplitude
        amplitude[0] = 0.0
        beat = torch.fft.fftfreq(self.samples, 1 / radar.sample_rate_hz, dtype=torch.float64)
        self.register_buffer("deviation", deviation, persistent=False)
        self.register_buffer("amplitude", amplitude, persistent=False)
        self.register_buffer("delay_s", beat / radar.slope_hz_per_s, persistent=False)

    def forward(self, intermediate: Tensor, start: int = 0) -> Tensor:
        """IF of pulses ``start`` onwards to IF with phase noise."""
        check_complex_map(intermediate, "IF", f"(..., pulses, {self.samples} samples)")
        spectrum = self._drawn(self.seed, start, intermediate.shape[-2]) * 1j
        spectra = spectrum * self.deviation.double().unsqueeze(1)  # (2, M, half)
        rates = torch.fft.irfft(spectra, self.samples, norm="forward").to(torch.real(intermediate).dtype)

        # A pulse does not end where it began; the transform would see a jump, so a straight line is taken out first.
        end = 2 * intermediate[..., -1:] - intermediate[..., -2:-1]
        slope = (end - intermediate[..., :1]) / self.samples
        line = slope * torch.arange(self.samples, device=intermediate.device)
        beats = torch.fft.fft(intermediate - line)
        delay = self.delay_s.to(rates.dtype)
        delayed = torch.fft.ifft(beats * delay) - 1j * slope * self.line_delay_s
        return intermediate + 1j * (rates[0] * delayed + rates[1] * torch.fft.ifft(beats * delay**3))

    @torch.jit.export
    def of_two_oscillators(self, start: int, pulses: int) -> Tensor:
        """Phase (M, N) float64, in radians, of the IF of a wave from another oscillator, independent and as noisy.

        Nothing cancels: its spectrum is twice that of one oscillator.
        """
        spectrum = self._drawn(self.other_seed, start, pulses) * (math.sqrt(2) * self.amplitude.double())
        return torch.fft.irfft(spectrum, self.samples, norm="forward")

    def _drawn(self, seed: int, start: int, pulses: int) -> Tensor:
        """Independent complex normal numbers (M, N // 2 + 1) of variance 1."""
        half = self.samples // 2 + 1
        pulse = start + torch.arange(pulses, device=self.delay_s.device)
        drawn = normal(seed, pulse, 2 * half).unflatten(-1, [2, half]) * math.sqrt(0.5)
        return torch.complex(drawn[:, 0], drawn[:, 1])

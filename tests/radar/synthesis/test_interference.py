"""Another radar in the band: its level, its frequencies, and when it is heard."""

import cmath
import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.synthesis.interference import Interference
from tensorsim.radar.synthesis.phase_noise import PhaseNoise
from tests.stage import StageTester

RADAR = RadarConfig(tx_m=(0.0, 0.0, 1.0), rx_m=(0.0, 0.0, 1.0))
AWAY = (0.0, 8.0, 1.0)
OTHER = replace(RADAR, tx_m=AWAY, rx_m=AWAY)


def silence(pulses: int) -> Tensor:
    return torch.zeros(pulses, RADAR.samples_per_chirp, dtype=torch.complex128)


class TestInterference(StageTester):
    def make(self) -> nn.Module:
        return Interference(
            RADAR, replace(OTHER, chirp_s=50e-6, prf_hz=7000.0), phase_noise=PhaseNoise(RADAR)
        )

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(3)
        x = torch.randn(*batch, 3, 400, dtype=torch.complex128, generator=generator)
        return (x if dtype == torch.float64 else x.to(torch.complex64),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        x = self.inputs((), torch.float32)[0]
        return [
            ((x.real,), "IF: got dtype"),
            ((x[..., :8],), r"IF: got shape \[3, 8\], expected .*400 samples"),
            ((x[:0],), "IF: got shape"),
        ]


def test_equal_sweeps_are_a_target_of_friis_level() -> None:
    """A sweep of the same slope, late by 30 ns, is one tone: a ghost at c tau / 2 whose level goes with 1 / R."""
    delay = 30e-9
    heard = Interference(RADAR, OTHER, delay_s=delay)(silence(4))[:, 1:]
    gain, wavelength = 10 ** (20 / 20), RADAR.wavelength_m
    np.testing.assert_allclose(heard.abs().numpy(), gain * wavelength / (4 * np.pi * 8.0), rtol=1e-9)
    step = heard[:, 1:] / heard[:, :-1]
    beat_hz = torch.angle(step) / (2 * np.pi) * RADAR.sample_rate_hz
    np.testing.assert_allclose(beat_hz.numpy(), RADAR.slope_hz_per_s * delay, rtol=1e-6)


def test_other_slopes_cross_the_band() -> None:
    """The frequency is the difference of both sweeps, and what is beyond half the sample rate is not heard."""
    other = replace(OTHER, bandwidth_hz=3.9e9)  # both begin together; 100 MHz apart at the end of the sweep
    module = Interference(RADAR, other)
    heard = module(silence(2))[0]
    time = torch.arange(400, dtype=torch.float64) / RADAR.sample_rate_hz
    beat = (RADAR.slope_hz_per_s - other.slope_hz_per_s) * time
    assert torch.equal(heard.abs() > 0, beat < RADAR.sample_rate_hz / 2)
    count = int((heard.abs() > 0).sum())
    assert count == math.ceil(5e6 / 100e6 * 400)
    middle = (beat[1:count] + beat[: count - 1]) / 2
    found = torch.angle(heard[1:count] / heard[: count - 1]) / (2 * np.pi) * RADAR.sample_rate_hz
    np.testing.assert_allclose(found.numpy(), middle.numpy(), atol=1.0)


def test_sweeps_that_drift_are_heard_now_and_then() -> None:
    """A sweep 1/2 Hz slower slides through: it is heard while both are less than a band apart."""
    other = replace(OTHER, prf_hz=8191.5)
    # Sweep by sweep it begins later by 1 / 8191.5 - 1 / 8192; 5 MHz are 50 ns of the slope.
    module = Interference(RADAR, other, delay_s=-50e-9)
    late_s = -50e-9 + torch.arange(256, dtype=torch.float64) * (1 / 8191.5 - 1 / 8192)
    expected = late_s.abs() < 50e-9
    found = (module(silence(256))[:, 100:300].abs() > 0).all(-1)
    assert torch.equal(found, expected)
    assert 5 < int(expected.sum()) < 20


def test_an_hour_later_the_samples_of_a_pulse_are_as_exact() -> None:
    """Against fractions; a pulse as a whole has an error of phase, from the time since the beginning in float64."""
    other = replace(OTHER, chirp_s=52e-6, prf_hz=0.99 / 52e-6)
    module = Interference(RADAR, other)
    slopes = [Fraction(r.bandwidth_hz) / Fraction(r.chirp_s) for r in (RADAR, other)]

    def exact(pulse: int, sample: int) -> complex:
        own = Fraction(sample) / Fraction(RADAR.sample_rate_hz)
        theirs = (Fraction(pulse) / Fraction(RADAR.prf_hz) + own) % (1 / Fraction(other.prf_hz))
        if abs(slopes[0] * own - slopes[1] * theirs) >= RADAR.sample_rate_hz / 2 or theirs >= other.chirp_s:
            return 0.0
        turns = (
            slopes[0] * own**2 / 2 - Fraction(other.carrier_hz) * (theirs - own) - slopes[1] * theirs**2 / 2
        )
        return cmath.rect(module.amplitude, 2 * math.pi * float(turns % 1))

    first = 3600 * 8192
    found = module(silence(12), first).numpy()
    expected = np.array([[exact(first + k, n) for n in range(400)] for k in range(12)])
    assert (abs(expected) > 0).any(1).sum() >= 3
    common = np.exp(1j * np.angle((expected * found.conj()).sum(1, keepdims=True)))
    assert abs(found * common - expected).max() < 2e-3 * module.amplitude
    assert abs(np.angle(common)).max() < 0.5


def test_phase_noise_is_that_of_two_oscillators() -> None:
    """Beside the tone of equal sweeps both add up, 2 L(f), however short the delay; pieces are those of the whole."""
    noise = PhaseNoise(RADAR, (1e4, 1e7), (-100.0, -100.0))
    clean = Interference(RADAR, OTHER, delay_s=10e-9)(silence(500))[1:]
    module = Interference(RADAR, OTHER, delay_s=10e-9, phase_noise=noise)
    heard = module(silence(500))[1:]
    window = torch.hann_window(400, dtype=torch.float64)
    power = torch.fft.fft((heard - clean) * window).abs().square().mean(0) / window.square().sum()
    density = power / RADAR.sample_rate_hz / clean.abs().square().mean()
    assert 10 * math.log10(float(density[50:350].mean())) == pytest.approx(-97.0, abs=0.1)
    torch.testing.assert_close(module(silence(40), 100), heard[99:139])


def test_power_and_pieces() -> None:
    other = replace(OTHER, chirp_s=50e-6, prf_hz=7000.0)
    quiet, loud = (Interference(RADAR, other, power_ratio_db=p)(silence(40)) for p in (0.0, 6.0))
    assert float(loud.abs().max() / quiet.abs().max()) == pytest.approx(10 ** (6 / 20))
    module = Interference(RADAR, other)
    pieces = [module(silence(b - a), a) for a, b in ((0, 1), (1, 25), (25, 40))]
    assert torch.equal(torch.cat(pieces), quiet)
    assert bool((quiet.abs() > 0).any())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Interference(RADAR, replace(RADAR)), "other.tx_m: got"),
        (lambda: Interference(replace(RADAR, rx_m=((0, 0, 1), (1, 0, 1))), OTHER), "several antennas"),
        (lambda: Interference(RADAR, OTHER, delay_s=math.nan), "delay_s, power_ratio_db: got nan"),
        (lambda: Interference(RADAR, OTHER, power_ratio_db="6"), "delay_s, power_ratio_db: got 0.0 and 6"),
    ],
)
def test_refuses(make: Any, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        make()

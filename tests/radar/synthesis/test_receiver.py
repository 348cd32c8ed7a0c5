"""Hardware behind the mixer, each effect against its closed form."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.synthesis.receiver import Converter, DcOffset, QuadratureImbalance, RealReceiver
from tests.stage import StageTester


def tone(cycles: float, amplitude: float = 1.0, samples: int = 4096) -> Tensor:
    """One pulse (1, N) complex128 of a complex wave."""
    phase = 2 * np.pi * cycles * torch.arange(samples, dtype=torch.float64) / samples
    return torch.polar(torch.full_like(phase, amplitude), phase)[None]


def lines(signal: Tensor) -> Tensor:
    """Power spectrum (N,) of one pulse; a wave of amplitude 1 has 1."""
    return (torch.fft.fft(signal[0]) / signal.shape[-1]).abs().square()


class ReceiverTester(StageTester):
    """IF in, IF out."""

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(3)
        x = torch.randn(*batch, 6, 8, dtype=torch.complex128, generator=generator)
        return (x if dtype == torch.float64 else x.to(torch.complex64),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        x = self.inputs((), torch.float32)[0]
        return [((x.real,), "IF: got dtype"), ((x[0],), "IF: got shape"), ((x[:0],), "IF: got shape")]


class TestQuadratureImbalance(ReceiverTester):
    def make(self) -> nn.Module:
        return QuadratureImbalance()


class TestDcOffset(ReceiverTester):
    def make(self) -> nn.Module:
        return DcOffset(0.1 - 0.2j)


class TestRealReceiver(ReceiverTester):
    def make(self) -> nn.Module:
        return RealReceiver()


class TestConverter(ReceiverTester):
    gradient_arguments = ()  # that of clipping, tested below: finite differences see the steps
    float32_atol = 1.1 / 2**5  # a value near the edge of two steps goes to either

    def make(self) -> nn.Module:
        return Converter(6, 2.0)


@pytest.mark.parametrize(("gain_db", "degrees"), [(0.5, 2.0), (0.0, 5.0), (-1.0, 0.0), (1.5, -8.0)])
def test_image_rejection_in_closed_form(gain_db: float, degrees: float) -> None:
    module = QuadratureImbalance(gain_db, math.radians(degrees))
    power = lines(module(tone(37)))
    g, phi = 10 ** (gain_db / 20), math.radians(degrees)
    expected = 10 * np.log10((1 + 2 * g * np.cos(phi) + g * g) / (1 - 2 * g * np.cos(phi) + g * g))
    assert float(10 * torch.log10(power[37] / power[-37])) == pytest.approx(expected, abs=1e-6)
    assert module.image_rejection_db == pytest.approx(expected, abs=1e-9)


def test_imbalance_is_that_of_two_channels() -> None:
    """I stays; Q is larger by the gain and late by the angle: y = cos(wt) + j g sin(wt - phi)."""
    g, phi = 10 ** (0.8 / 20), math.radians(6.0)
    seen = QuadratureImbalance(0.8, phi)(tone(5))[0]
    angle = 2 * np.pi * 5 * np.arange(4096) / 4096
    np.testing.assert_allclose(seen.real.numpy(), np.cos(angle), atol=1e-12)
    np.testing.assert_allclose(seen.imag.numpy(), g * np.sin(angle - phi), atol=1e-12)


def test_balanced_receivers_have_no_image() -> None:
    module = QuadratureImbalance(0.0, 0.0)
    assert module.image_rejection_db == math.inf
    assert torch.equal(module(tone(5)), tone(5))


def test_offset_is_a_line_at_zero() -> None:
    power = lines(DcOffset(0.3 + 0.4j)(tone(37)))
    assert float(power[0]) == pytest.approx(0.25)
    assert float(power[37]) == pytest.approx(1.0)
    assert float(power.sum()) == pytest.approx(1.25)


def test_real_receivers_see_both_signs() -> None:
    """The Doppler-time map of a continuous wave is mirror-symmetric, a quarter of the power on either side."""
    radar = RadarConfig(carrier_hz=24e9, bandwidth_hz=1e6, prf_hz=2000.0)
    doppler = DopplerTimeMap(radar, window_s=0.1)
    pulse = torch.arange(600, dtype=torch.float64) / 2000
    wave = torch.polar(torch.ones_like(pulse), -2 * np.pi * 250 * pulse)[:, None]
    one, both = doppler(wave).square(), doppler(RealReceiver()(wave)).square()
    half = doppler.bins // 2
    torch.testing.assert_close(both[half + 1 :], both[1:half].flip(0))
    peak = int(one[:, 0].argmax())
    assert float(both[peak, 0] / one[peak, 0]) == pytest.approx(0.25, rel=1e-6)


@pytest.mark.parametrize("bits", [4, 8, 12])
def test_quantisation_noise_in_closed_form(bits: int) -> None:
    """A wave of full scale: 6.02 bits + 1.76 dB."""
    wave = tone(np.sqrt(1234567.0), 0.999, 2**16)
    error = Converter(bits, 1.0)(wave) - wave
    snr_db = 10 * np.log10(float(wave.abs().square().mean() / error.abs().square().mean()))
    assert snr_db == pytest.approx(6.02 * bits + 1.76, abs=0.6 if bits == 4 else 0.1)


def test_converter_levels_and_saturation() -> None:
    x = torch.tensor([[-5.0, -0.6, -0.01, 0.01, 0.26, 0.9, 3.0]]).double()
    found = Converter(2, 1.0)(torch.complex(x, -x))
    np.testing.assert_allclose(found.real[0].numpy(), [-0.75, -0.75, -0.25, 0.25, 0.25, 0.75, 0.75])
    np.testing.assert_allclose(found.imag[0].numpy(), [0.75, 0.75, 0.25, -0.25, -0.25, -0.75, -0.75])


def test_converter_gradient_is_that_of_clipping() -> None:
    x = torch.tensor([[0.3 + 0.2j, 4.0 + 0.1j]], requires_grad=True)
    torch.view_as_real(Converter(4, 1.0)(x)).sum().backward()
    assert x.grad is not None
    torch.testing.assert_close(x.grad, torch.tensor([[1.0 + 1.0j, 0.0 + 1.0j]]))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: QuadratureImbalance(math.nan), "gain_db, phase_rad: got nan"),
        (lambda: DcOffset(complex(math.inf, 0)), "offset: got"),
        (lambda: QuadratureImbalance(0.5, None), "gain_db, phase_rad: got 0.5 and None"),
        (lambda: Converter(0, 1.0), "bits: got 0"),
        (lambda: Converter(8.5, 1.0), "bits: got 8.5, expected an integer"),
        (lambda: Converter(8, 0.0), "full_scale: got 0.0"),
    ],
)
def test_refuses(make: Any, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        make()

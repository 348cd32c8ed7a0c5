"""Receiver noise: its variance for every reference, its whiteness, its seed."""

import math

import numpy as np
import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.radar.synthesis.noise import ProfileNoise, ReceiverNoise
from tests.stage import StageTester, assert_same


def signal(*shape, dtype=torch.complex64):
    generator = torch.Generator().manual_seed(3)
    return torch.randn(*shape, dtype=dtype, generator=generator)


class TestReceiverNoise(StageTester):
    """Without noise, since base tests repeat calls; the noise itself is tested below."""

    batched_arguments = (0, 1)

    def make(self):
        return ReceiverNoise(None)

    def inputs(self, batch, dtype):
        x = signal(*batch, 6, 8, dtype=torch.complex64)
        x = x.to(torch.complex128 if dtype == torch.float64 else torch.complex64)
        return x, 0.5 * x

    def bad_inputs(self):
        x, echo = self.inputs((), torch.float32)
        return [
            ((x.real, None), "IF: got dtype"),
            ((x[0], None), "IF: got shape"),
            ((x[:0], None), r"IF: got shape \[0, 8\].* without empty dimensions"),
            ((x, echo[:3]), "target_echo: got"),
            ((x, echo.real), "target_echo: got"),
        ]


class TestReceiverNoiseScripts(StageTester):
    """With noise, drawn from one seed."""

    gradient_arguments = ()

    def make(self):
        return ReceiverNoise(10.0)

    def inputs(self, batch, dtype):
        return TestReceiverNoise().inputs(batch, dtype)

    def bad_inputs(self):
        return TestReceiverNoise().bad_inputs()

    def test_smoke_and_no_state(self):
        module, (x, echo) = self.make(), self.inputs((3,), torch.float32)
        assert not torch.equal(module(x, echo), module(x, echo))

    test_batch_equals_loop = None  # clips of a batch draw from one generator
    test_float32_near_float64 = None  # precisions draw different noise

    def test_scripted_equals_eager(self):
        module, (x, echo) = self.make(), self.inputs((3,), torch.float32)
        torch.manual_seed(1)
        expected = module(x, echo)
        torch.manual_seed(1)
        assert_same(torch.jit.script(module)(x, echo), expected)

    def test_exports(self):
        module, (x, echo) = self.make(), self.inputs((3,), torch.float32)
        exported = torch.export.export(module, (x, echo)).module()
        torch.manual_seed(1)
        expected = module(x, echo)
        torch.manual_seed(1)
        assert_same(exported(x, echo), expected)


@pytest.mark.parametrize(
    ("reference", "power"), [("echo", 0.25), ("total", 4.0)], ids=["target echo alone", "everything"]
)
def test_noise_variance_per_reference(reference, power):
    echo = 0.5 * torch.exp(1j * signal(2, 300, 400).real)
    total = 4.0**0.5 * torch.exp(1j * signal(2, 300, 400).imag)
    noise = ReceiverNoise(13.0, reference)(total, echo) - total
    expected = power * 10**-1.3
    for clip in noise:
        assert float(clip.abs().square().mean()) == pytest.approx(expected, rel=0.02)  # 9 standard errors
        assert float(clip.real.square().mean()) == pytest.approx(expected / 2, rel=0.03)
        assert float(clip.imag.square().mean()) == pytest.approx(expected / 2, rel=0.03)
        assert float((clip.real * clip.imag).mean()) / expected == pytest.approx(0, abs=0.01)
        spectrum = torch.fft.fft(clip).abs().square().mean(0) / (400 * expected)
        assert 0.6 < float(spectrum.min()) < float(spectrum.max()) < 1.4  # white over fast time


def test_reference_is_the_mean_over_each_clip():
    """A strong clip does not raise the noise of its neighbour, and pulses of one clip share one level."""
    x = torch.stack((signal(200, 100), 100 * signal(200, 100)))
    x[:, :100] *= 0.1
    noise = ReceiverNoise(0.0)(x) - x
    power = noise.abs().square().mean(-1)
    assert float(power[1].mean() / power[0].mean()) == pytest.approx(1e4, rel=0.05)
    assert float(power[0, :100].mean() / power[0, 100:].mean()) == pytest.approx(1, rel=0.1)


def test_absolute_reference_is_thermal():
    x = torch.zeros(400, 400, dtype=torch.complex64)
    module = ReceiverNoise(None, "absolute", bandwidth_hz=10e6, noise_figure_db=6.0, transmit_power_w=0.1)
    watts = float((1e8 * module(x)).abs().square().mean()) * 1e-16 * 0.1
    assert 10 * math.log10(watts / 1e-3) == pytest.approx(-174 + 70 + 6, abs=0.1)  # kT0 = -174 dBm/Hz


def test_realised_ratio_is_returned():
    clean, echo = signal(2, 100, 100), 0.1 * signal(2, 100, 100)
    for reference in ("echo", "total"):
        module = ReceiverNoise(20.0, reference)
        realised = module.realised_snr_db(clean, module(clean, echo), echo)
        assert realised.tolist() == pytest.approx([20.0, 20.0], abs=0.2)
        assert realised[0] != realised[1]  # what was drawn, not what was asked for
    assert torch.isposinf(ReceiverNoise(None).realised_snr_db(clean, clean)).all()


def test_empty_clip_has_the_floor_it_was_given():
    x = torch.zeros(100, 100, dtype=torch.complex64)
    assert torch.equal(ReceiverNoise(20.0)(x), x)
    assert float(ReceiverNoise(20.0, empty_power=4.0)(x).abs().square().mean()) == pytest.approx(
        0.04, rel=0.1
    )


def test_seed_repeats_the_noise():
    x = signal(10, 20)
    torch.manual_seed(5)
    first = ReceiverNoise(10.0)(x)
    torch.manual_seed(5)
    assert torch.equal(ReceiverNoise(10.0)(x), first)
    torch.manual_seed(6)
    assert not torch.equal(ReceiverNoise(10.0)(x), first)


def test_gradient_scales_the_noise_with_the_signal():
    x = signal(4, 5, dtype=torch.complex128).requires_grad_(True)

    def function(x):
        torch.manual_seed(0)
        return ReceiverNoise(3.0)(x)

    assert torch.autograd.gradcheck(function, (x,))


def test_a_clip_without_echo_leaves_the_gradients_of_the_others_finite():
    gain = torch.ones((), dtype=torch.float64, requires_grad=True)
    clips = torch.stack([signal(4, 5, dtype=torch.complex128), torch.zeros(4, 5, dtype=torch.complex128)])
    ReceiverNoise(10.0)(gain * clips).abs().square().sum().backward()
    assert math.isfinite(float(gain.grad))
    power = torch.tensor([2.0, 0.0], dtype=torch.float64, requires_grad=True)
    noise, _ = ProfileNoise(torch.ones(16, dtype=torch.float64))(
        torch.zeros(2, 4, 6, dtype=torch.complex128), power
    )
    noise.abs().square().sum().backward()
    assert float(power.grad[0]) > 0
    assert float(power.grad[1]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"snr_db": float("nan")}, "snr_db: got nan"),
        ({"reference": "peak"}, "reference: got 'peak'"),
        ({"empty_power": -1.0}, "empty_power: got -1.0"),
        ({"empty_power": None}, "empty_power: got None"),
        ({"bandwidth_hz": 0.0}, "bandwidth_hz: got 0.0"),
        ({"transmit_power_w": -1.0}, "transmit_power_w: got -1.0"),
        ({"noise_figure_db": float("inf")}, "noise_figure_db: got inf"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(TensorsimError, match=message):
        ReceiverNoise(**arguments)


class TestProfileNoise(StageTester):
    """Without power, since base tests repeat calls."""

    batched_arguments = (0, 1)
    gradient_arguments = ()  # tested below
    batch_shapes = ((3,),)

    def make(self):
        return ProfileNoise(torch.hamming_window(24, periodic=False, dtype=torch.float64))

    def inputs(self, batch, dtype):
        x = signal(*batch, 6, 8)
        return x.to(torch.complex128 if dtype == torch.float64 else torch.complex64), torch.zeros(*batch)

    test_refuses_bad_input = None  # an inner stage: the simulator has checked its arguments


@pytest.mark.parametrize(
    ("window", "taps"), [(np.hamming, 2), (np.hanning, 2), (np.blackman, 3), (np.ones, 1)]
)
def test_noise_of_the_bins_has_the_covariance_of_windowed_white_noise(window, taps):
    """Against the definition, ``F diag(w^2) F^H``, phases counted from sample N / 2."""
    module = ProfileNoise(torch.tensor(window(400)))
    assert len(module.taps) == taps
    bins, draws = 40, 40_000
    k = np.arange(30, 30 + bins)
    dft = np.exp(-2j * np.pi * np.outer(k, np.arange(400) - 399 / 2) / 400) * np.exp(-1j * np.pi * k[:, None])
    expected = 2.0 * (dft * window(400) ** 2) @ dft.conj().T
    noise, energy = module(torch.zeros(1, bins, draws, dtype=torch.complex128), torch.tensor([2.0]).double())
    noise = noise[0].numpy()
    scale = np.abs(expected).max()
    drawn = noise @ noise.conj().T / draws
    assert np.abs(drawn - expected).max() < 6 / math.sqrt(draws) * scale
    assert np.abs(noise @ noise.T / draws).max() < 6 / math.sqrt(draws) * scale
    assert float(energy) / (draws * 400) == pytest.approx(2.0, rel=0.01)
    # The taps themselves, without the scatter of draws.
    filters = np.zeros((bins, bins + 2 * taps - 2))
    for lag in range(1 - taps, taps):
        filters[np.arange(bins), np.arange(bins) + taps - 1 + lag] = module.taps[abs(lag)]
    assert np.abs(2.0 * filters @ filters.T - expected).max() < 3e-3 * scale


def test_noise_of_the_bins_is_set_per_clip_and_scales_with_its_power():
    module = ProfileNoise(torch.tensor(np.hamming(24)))
    power = torch.tensor([1.0, 100.0], dtype=torch.float64)
    noise, energy = module(torch.zeros(2, 5, 4000, dtype=torch.complex128), power)
    level = noise.abs().square().mean((1, 2)) / (power * float((np.hamming(24) ** 2).sum()))
    assert level.tolist() == pytest.approx([1.0, 1.0], rel=0.05)
    assert (energy / (4000 * 24 * power)).tolist() == pytest.approx([1.0, 1.0], rel=0.05)

    def function(power):
        torch.manual_seed(0)
        return module(torch.zeros(2, 5, 3, dtype=torch.complex128), power)

    assert torch.autograd.gradcheck(function, power.requires_grad_(True))

"""The moving target indicator: response of every method against SciPy, measured tones and the closed form."""

import math

import numpy as np
import pytest
import torch
from scipy import signal

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.iir import BLOCK, BlockFilter
from tensorsim.radar.processing.mti import MovingTargetIndicator, two_pulse_canceller
from tests.radar import reference
from tests.radar.scenes import SMALL, complex_noise
from tests.stage import StageTester

FREE = RadarConfig.free_space()
METHODS = {
    "two-pulse": {},
    "n-pulse": {"pulses": 4},
    "mean": {},
    "high-pass": {"radar": FREE, "cutoff_m_s": 0.5, "order": 3},
}


def tone(doppler_hz, pulses, prf_hz=8192.0):
    """The echo (M, 1) of a target that approaches for a positive Doppler frequency: its phase decreases."""
    angle = -2 * math.pi * doppler_hz * torch.arange(pulses).double() / prf_hz
    return torch.polar(torch.ones_like(angle), angle)[:, None]


class TestTwoPulseCanceller(StageTester):
    least = 2

    def make(self):
        return MovingTargetIndicator("two-pulse")

    def inputs(self, batch, dtype):
        return (complex_noise(*batch, 9, 6, dtype=dtype),)

    def bad_inputs(self):
        x = self.inputs((), torch.float32)[0]
        return [
            ((x.real,), "profiles: got dtype"),
            ((x[: self.least - 1],), f"at least {self.least} pulses"),
            ((x[0],), "profiles: got shape"),
            ((x[:, :0],), "profiles: got shape"),
        ]


class TestNPulseCanceller(TestTwoPulseCanceller):
    least = 4

    def make(self):
        return MovingTargetIndicator("n-pulse", pulses=4)


class TestMeanRemoval(TestTwoPulseCanceller):
    def make(self):
        return MovingTargetIndicator("mean")


class TestHighPass(TestTwoPulseCanceller):
    def make(self):
        return MovingTargetIndicator("high-pass", SMALL, cutoff_m_s=0.3)

    def inputs(self, batch, dtype):
        return (complex_noise(*batch, 2 * BLOCK + 9, 3, dtype=dtype),)  # three blocks, the last one short


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("doppler_hz", [20.0, 263.0, 1024.0, 3500.0, -300.0])
def test_response_equals_measured_tone(method, doppler_hz):
    """What a tone becomes, at the instants that `delay_pulses` gives the outputs."""
    mti = MovingTargetIndicator(method, **METHODS[method])
    pulses = 8192  # whole periods, so that the mean of a tone is 0
    output = mti(tone(doppler_hz, pulses))[-2048:, 0]
    first = pulses - mti.lost_pulses - 2048
    instants = torch.arange(first, first + 2048).double() + mti.delay_pulses
    input_then = torch.polar(torch.ones(2048).double(), -2 * math.pi * doppler_hz * instants / 8192)
    gain = (output / input_then).numpy()
    expected = complex(mti.response(torch.tensor(doppler_hz), 8192.0))
    np.testing.assert_allclose(gain, np.full(2048, expected), atol=2e-6)
    assert abs(expected) > 1e-7


@pytest.mark.parametrize("method", ["two-pulse", "n-pulse", "high-pass"])
def test_response_equals_scipy(method):
    mti = MovingTargetIndicator(method, **METHODS[method])
    doppler = np.array([-4000.0, -511.0, -3.0, 0.0, 12.0, 1000.0, 4096.0])
    raw = np.mod(-2 * np.pi * doppler / 8192, 2 * np.pi)  # positive Doppler turns backwards in the raw signal
    if method == "high-pass":
        b, a = signal.butter(3, 2 * 0.5 / FREE.doppler_wavelength_m, "highpass", fs=8192)
        expected = signal.freqz(b, a, raw)[1]
    else:
        taps = {"two-pulse": [1, -1], "n-pulse": [1, -3, 3, -1]}[method]
        expected = signal.freqz(taps, 1, raw)[1] * np.exp(1j * raw * mti.delay_pulses)
        sign = np.where(doppler > 0, (-1) ** (len(taps) - 1), 1)  # half a pulse of 2 pi - w instead of -w
        expected = expected * sign
    actual = mti.response(torch.as_tensor(doppler), 8192.0)
    np.testing.assert_allclose(actual, expected, atol=1e-9)


def test_two_pulse_response():
    doppler = torch.tensor([0.0, 10.0, 263.0, 1024.0, 4096.0, -300.0]).double()
    actual = MovingTargetIndicator().response(doppler, 8192.0).abs()
    np.testing.assert_allclose(actual, abs(2 * np.sin(np.pi * doppler.numpy() / 8192)), atol=1e-12)


def test_response_at_a_slow_torso():
    """0.5 m/s at the centre of the sweep: -13.9 dB with two pulses, twice that with three, 0 dB with the others."""
    doppler = torch.tensor(2 * 0.5 / FREE.doppler_wavelength_m)

    def decibels(mti):
        return 20 * math.log10(mti.response(doppler, 8192.0).abs())

    assert decibels(MovingTargetIndicator()) == pytest.approx(-13.9, abs=0.05)
    assert decibels(MovingTargetIndicator("n-pulse", pulses=3)) == pytest.approx(-27.8, abs=0.1)
    assert decibels(MovingTargetIndicator("mean")) == pytest.approx(0.0, abs=1e-9)
    assert decibels(MovingTargetIndicator("high-pass", FREE, cutoff_m_s=0.1)) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("order", [1, 2, 4, 8])
@pytest.mark.parametrize("cutoff", [0.1, 3.0])
def test_high_pass_is_butterworth(order, cutoff):
    """|H|^2 = 1 / (1 + (tan(wc / 2) / tan(w / 2))^(2 n)): the bilinear transform of the analogue prototype."""
    mti = MovingTargetIndicator("high-pass", FREE, cutoff_m_s=cutoff, order=order)
    speed = torch.tensor([0.02, 0.05, 0.1, 0.4, 3.0, 7.0]).double()
    actual = mti.response(2 * speed / FREE.doppler_wavelength_m, 8192.0).abs()
    ratio = np.tan(2 * np.pi * cutoff / FREE.doppler_wavelength_m / 8192) / np.tan(
        2 * np.pi * speed.numpy() / FREE.doppler_wavelength_m / 8192
    )
    np.testing.assert_allclose(actual, 1 / np.sqrt(1 + ratio ** (2 * order)), rtol=1e-6)
    at_cutoff = mti.response(torch.tensor(2 * cutoff / FREE.doppler_wavelength_m), 8192.0).abs()
    assert float(at_cutoff) == pytest.approx(math.sqrt(0.5), rel=1e-6)


@pytest.mark.parametrize("order", [1, 3, 4, 8])
@pytest.mark.parametrize("cutoff", [0.02, 0.2, 7.0])
def test_high_pass_equals_sosfilt(order, cutoff):
    mti = MovingTargetIndicator("high-pass", FREE, cutoff_m_s=cutoff, order=order)
    x = complex_noise(1500, 2).to(torch.complex128) + (1000 - 300j)  # clutter 60 dB above
    sos = signal.butter(order, 2 * cutoff / FREE.doppler_wavelength_m, "highpass", fs=8192, output="sos")
    expected = signal.sosfilt(sos, (x - x[:1]).numpy(), axis=0)
    np.testing.assert_allclose(mti(x), expected, atol=1e-9)
    single = mti(x.to(torch.complex64))
    assert single.dtype == torch.complex64
    np.testing.assert_allclose(single, expected, atol=3e-4)  # the input itself is rounded to 6e-5


def test_block_filter_equals_torchaudio():
    lfilter = pytest.importorskip("torchaudio").functional.lfilter
    sections = torch.as_tensor(signal.butter(2, 0.1, "highpass", output="sos"))
    x = complex_noise(300, 4).real[None].double()
    expected = lfilter(x.transpose(1, 2), sections[0, 3:], sections[0, :3], clamp=False).transpose(1, 2)
    np.testing.assert_allclose(BlockFilter(sections)(x), expected, atol=1e-10)


@pytest.mark.parametrize("method", METHODS)
def test_static_scene_vanishes_and_lengths(method):
    mti = MovingTargetIndicator(method, **METHODS[method])
    x = torch.full((1, 400, 2), 3 - 2j, dtype=torch.complex64)
    output = mti(x)
    assert output.shape == (1, 400 - mti.lost_pulses, 2)
    assert float(output.abs().max()) < (1e-5 if method == "mean" else 1e-30)
    assert mti.lost_pulses == {"two-pulse": 1, "n-pulse": 3, "mean": 0, "high-pass": 0}[method]
    assert mti.delay_pulses == {"two-pulse": 0.5, "n-pulse": 1.5, "mean": 0, "high-pass": 0}[method]
    assert mti.whole_clip == (method in ("mean", "high-pass"))


def test_two_pulse_canceller_is_the_difference():
    x = complex_noise(2, 9, 3)
    np.testing.assert_array_equal(two_pulse_canceller(x), np.diff(x.numpy(), axis=-2))
    assert torch.equal(torch.jit.script(two_pulse_canceller)(x), MovingTargetIndicator()(x))


def test_differences_are_binomial():
    x = complex_noise(30, 3)
    actual = MovingTargetIndicator("n-pulse", pulses=4)(x)
    weights = np.array([1, -3, 3, -1])  # of the latest pulse first
    expected = np.stack([np.convolve(column, weights, "valid") for column in x.numpy().T], -1)
    assert reference.relative(actual, expected) < 1e-6
    later = MovingTargetIndicator()(torch.tensor([[1.0 + 0j], [3.0 + 1j], [2.0 + 1j]]))
    assert later.flatten().tolist() == [2 + 1j, -1 + 0j]  # later minus earlier
    assert torch.equal(MovingTargetIndicator("n-pulse", pulses=2)(x), MovingTargetIndicator()(x))


def test_mean_removal_keeps_motion_and_drops_clutter():
    mover = tone(512.0, 64)
    np.testing.assert_allclose(MovingTargetIndicator("mean")(mover + (3 - 2j)), mover, atol=1e-12)
    assert MovingTargetIndicator("mean").response(torch.tensor([0.0, 8192.0, 1.0]), 8192.0).tolist() == [
        0,
        0,
        1,
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "three-pulse"}, "method: got 'three-pulse'"),
        ({"method": "n-pulse", "pulses": 1}, "pulses: got 1"),
        ({"method": "n-pulse", "pulses": 2.5}, "pulses: got 2.5, expected an integer"),
        ({"method": "high-pass", "radar": FREE, "order": 2.5}, "order: got 2.5, expected an integer"),
        ({"method": "high-pass", "radar": FREE, "cutoff_m_s": None}, "cutoff_m_s: got None"),
        ({"method": "high-pass"}, "radar: got None"),
        ({"method": "high-pass", "radar": FREE, "cutoff_m_s": 0.0}, "cutoff_m_s: got 0.0"),
        ({"method": "high-pass", "radar": FREE, "cutoff_m_s": 8.0}, "unambiguous 7.77"),
        ({"method": "high-pass", "radar": FREE, "cutoff_m_s": float("nan")}, "cutoff_m_s: got nan"),
        ({"method": "high-pass", "radar": FREE, "order": 9}, "order: got 9"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(TensorsimError, match=message):
        MovingTargetIndicator(**arguments)

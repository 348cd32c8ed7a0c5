"""Range profiles."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.range_profile import FollowingGate, RangeProfile, gate_bins
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar import reference
from tests.radar.scenes import SMALL, complex_noise
from tests.stage import StageTester

FREE = RadarConfig.free_space()


class TestRangeProfile(StageTester):
    def make(self):
        return RangeProfile(SMALL)

    def inputs(self, batch, dtype):
        return (complex_noise(*batch, 5, 24, dtype=dtype),)

    def bad_inputs(self):
        x = self.inputs((), torch.float32)[0]
        return [
            ((x.real,), "IF: got dtype"),
            ((x[0],), "IF: got shape"),
            ((x[:, :20],), "24 samples"),
            ((x[:, :0],), "IF: got shape"),
            ((x[:0],), "IF: got shape .* without empty dimensions"),
        ]


class TestFollowingGate(StageTester):
    batched_arguments = (0, 1, 2)

    def make(self):
        return FollowingGate(SMALL, RangeProfile(SMALL).range_m, 0.8)

    def inputs(self, batch, dtype):
        targets = complex_noise(*batch, 5, 3, 3, dtype=dtype, seed=2).real + torch.tensor([0.0, 1.5, 1.5])
        rcs = complex_noise(*batch, 5, 3, dtype=dtype, seed=3).abs()
        return complex_noise(*batch, 5, 12, dtype=dtype), targets.to(dtype), rcs

    def bad_inputs(self):
        x, p, rcs = self.inputs((), torch.float32)
        return [
            ((x.real, p, rcs), "profiles: got dtype"),
            ((x[:, :5], p, rcs), "profiles: got shape"),
            ((x, p[1:], rcs), "positions: got shape"),
            ((x, p[..., :2], rcs), "positions: got shape"),
            ((x, p, rcs[0]), "rcs: got shape"),
        ]


@pytest.mark.parametrize("window", ["hamming", None])
def test_profile_equals_numpy(window):
    x = complex_noise(7, 400)
    actual = RangeProfile(FREE, window)(x)
    assert actual.shape == (7, 200)
    assert actual.dtype == torch.complex64
    assert reference.relative(actual, reference.profiles(x.numpy(), window)) < 1e-6


@pytest.mark.parametrize("window", ["hamming", "hann", "blackman"])
def test_windows_are_symmetric(window):
    expected = {"hamming": np.hamming, "hann": np.hanning, "blackman": np.blackman}[window](400)
    np.testing.assert_allclose(RangeProfile(FREE, window).window, expected, atol=1e-12)


@pytest.mark.parametrize("distance", [0.75, 3.0, 6.1])
def test_range_peak_is_at_half_the_path(distance):
    radar = RadarConfig(tx_m=(0, 0, 0), rx_m=(0, 0, 0))
    profile = RangeProfile(radar)
    x = EchoSynthesizer(radar)(torch.tensor([[[0.0, distance, 0.0]]]), torch.ones(1))
    peak = profile.range_m[profile(x).abs().argmax()]
    assert float(peak) == pytest.approx(distance, abs=C / (4 * 4e9) * 1.001)  # half a bin


@pytest.mark.parametrize("chirp_s", [16.5e-6, 33.4e-6, 64.45e-6])
def test_range_axis_where_samples_do_not_fill_the_sweep(chirp_s):
    radar = RadarConfig(10e9, 1e9, chirp_s, 1000.0, 1e6, (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    place = 0.7 * radar.reach_m
    target = torch.tensor([[[0.0, place, 1.0]]]).double()
    pulse = EchoSynthesizer(radar).double()(target, torch.ones(1).double())[0].numpy()
    spectrum = np.abs(np.fft.fft(pulse * np.hanning(len(pulse)), 256 * len(pulse)))
    assert np.argmax(spectrum[: 128 * len(pulse)]) / 256 * radar.range_resolution_m == pytest.approx(
        place, rel=1e-3
    )


def test_range_axis():
    axis = RangeProfile(FREE).range_m
    assert axis.shape == (200,)
    assert float(axis[0]) == 0.0
    assert float(axis[1]) == pytest.approx(C / 8e9, rel=1e-12)
    assert float(axis[-1]) == pytest.approx(7.457, abs=1e-3)  # the panel shows 0 to 7.5 m


def test_leakage_shows_at_its_delay():
    """|Ptx - Prx| = 0.2 m of path is 0.1 m of range: bin 2.67 at 4 GHz."""
    x = EchoSynthesizer(FREE, leakage=True).double()(torch.zeros(1, 0, 3), torch.zeros(0))[0]
    step = float((x[1:] * x[:-1].conj()).angle().mean())
    assert step / (2 * math.pi) * 400 == pytest.approx(2.67, abs=2e-3)
    assert float(x.abs().mean()) == pytest.approx(0.1, rel=1e-12)
    assert int(RangeProfile(FREE)(x[None]).abs().argmax()) == 3


def test_bad_arguments():
    two = RadarConfig(sample_rate_hz=2e6, chirp_s=1e-6, bandwidth_hz=1e8)
    for window in ("hann", "blackman"):
        with pytest.raises(
            TensorsimError, match=f"window: got '{window}', which is 0 at both of the 2 samples"
        ):
            RangeProfile(two, window)
    with pytest.raises(TensorsimError, match="window: got 'kaiser'"):
        RangeProfile(FREE, "kaiser")


def test_a_gate_has_the_bins_within_it() -> None:
    """Bins on its edges belong to it, also where quotients are a little above or below whole numbers."""
    assert 2.1 / 0.3 > 7
    assert gate_bins((2.1, 3.0), 0.3, 100) == (7, 10)
    assert 0.7 / 0.1 < 7
    assert gate_bins((0.3, 0.7), 0.1, 100) == (3, 7)
    assert gate_bins((1.10005, 1.99995), 0.1, 100) == (12, 19)
    assert gate_bins((-5.0, 99.0), 0.1, 50) == (0, 49)
    for gate in ((1.11, 1.19), (2.0, 1.0), (6.0, 7.0), (-2.0, -1.0), (0.0, float("nan"))):
        with pytest.raises(TensorsimError, match="gate_m: got"):
            gate_bins(gate, 0.1, 50)

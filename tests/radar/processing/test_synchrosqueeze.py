"""The synchrosqueezed transform: where a chirp goes, what comes back, and that nothing is lost."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.analysis.metrics import entropy
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.synchrosqueeze import SynchrosqueezedMap
from tests.radar.scenes import SMALL, ProfilesCase, complex_noise

SLOW = RadarConfig.through_wall(prf_hz=512.0)  # windows of 51 pulses, 256 bins of 2 Hz


def chirp(pulses, start_hz, rate_hz_s, prf_hz=512.0):
    """Raw echo (M, 1) whose Doppler frequency, positive = approaching, goes as start + rate t."""
    t = np.arange(pulses) / prf_hz
    return torch.as_tensor(np.exp(-2j * np.pi * (start_hz * t + rate_hz_s * t**2 / 2)))[:, None]


class TestSynchrosqueezedMap(ProfilesCase):
    def make(self):
        # What lies low between sidelobes changes its place at a touch: no finite differences there.
        return SynchrosqueezedMap(SMALL, threshold_db=30.0)

    def inputs(self, batch, dtype):
        x = complex_noise(*batch, 40, 3, dtype=torch.float64, seed=3)
        # A tone above the noise: few values lie so near a border between bins that rounding decides.
        x = 0.03 * x + torch.polar(torch.ones(40).double(), 0.7 * torch.arange(40).double())[:, None]
        return (x.to(torch.complex128 if dtype == torch.float64 else torch.complex64),)


def numpy_transform(x, length, hop, bins, prf_hz):
    """Frame by frame: conj(x) windowed, phase from the centre, every bin moved to its local frequency."""
    m = np.arange(length)
    g = 0.5 - 0.5 * np.cos(2 * np.pi * m / length)
    slope = np.pi / length * np.sin(2 * np.pi * m / length)
    frames = range(0, len(x) - length + 1, hop)
    out = np.zeros((bins, len(frames)), dtype=complex)
    for k, start in enumerate(frames):
        piece = np.conj(x[start : start + length])
        for f in range(bins):
            w = 2 * np.pi * f / bins
            v = (piece * g * np.exp(-1j * w * (m - length // 2))).sum()
            d = (piece * slope * np.exp(-1j * w * (m - length // 2))).sum()
            local = w - (d / v).imag
            out[round(local / (2 * np.pi) * bins) % bins, k] += v
    return np.fft.fftshift(out, axes=0)


def test_transform_equals_loop():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((120, 2)) + 1j * rng.standard_normal((120, 2))
    module = SynchrosqueezedMap(SLOW, overlap=0.5, threshold_db=300.0)
    expected = np.stack([numpy_transform(x[:, r], 51, 26, 256, 512.0) for r in range(2)])
    actual = module.transform(torch.as_tensor(x))
    assert actual.shape == expected.shape == (2, 256, 3)
    wrong = np.abs(actual.numpy() - expected) > 1e-8
    assert wrong.mean() < 0.002  # a bin exactly between two may go either way
    np.testing.assert_allclose(module(torch.as_tensor(x)), actual.abs().square().sum(0).sqrt(), atol=1e-9)


@pytest.mark.parametrize("rate", [0.0, 60.0, -200.0])
def test_ridge_is_the_instantaneous_frequency(rate):
    """Most of the energy of a chirp lies within one bin of start + rate t, on the right side of zero."""
    pulses = 400
    start = 20.0 if rate >= 0 else 140.0
    module = SynchrosqueezedMap(SLOW)
    maps = module(chirp(pulses, start, rate))
    # A frame's centre is pulse L // 2 of it: half a pulse before the middle of an odd window.
    t = (np.arange(maps.shape[1]) * module.hop + module.length // 2) / 512.0
    frequency = start + rate * t
    peak = module.doppler_hz.numpy()[maps.argmax(0)]
    assert np.abs(peak - frequency).max() <= 2.0 + 1e-9  # one bin
    near = np.abs(module.doppler_hz.numpy()[:, None] - frequency) <= 3.0
    energy = maps.square().numpy()
    share = (energy * near).sum() / energy.sum()
    spectrogram = DopplerTimeMap(SLOW)(chirp(pulses, start, rate)).square().numpy()
    assert share > 0.97 > 0.6 > (spectrogram * near).sum() / spectrogram.sum()


def test_inverse_gives_the_signal_back():
    """Every pulse whose window lies inside the clip, of noise, which is the hardest."""
    x = torch.randn(2, 130, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    module = SynchrosqueezedMap(SLOW, hop=1)
    transform = module.transform(x)
    assert transform.shape == (2, 3, 256, 80)
    np.testing.assert_allclose(module.inverse(transform), x[:, 25 : 25 + 80], atol=1e-12)
    sparse = SynchrosqueezedMap(SLOW, hop=7)
    np.testing.assert_allclose(sparse.inverse(sparse.transform(x)), x[:, 25:105:7], atol=1e-12)


def test_a_band_of_the_transform_is_a_component():
    up, down = chirp(300, 40.0, 60.0), 0.7 * chirp(300, -90.0, -30.0)
    module = SynchrosqueezedMap(SLOW, hop=1)
    transform = module.transform(up + down) * (module.doppler_hz > 0)[:, None]
    back = module.inverse(transform)
    wanted = up[25 : 25 + back.shape[0]]
    assert float((back - wanted).norm() / wanted.norm()) < 0.03


def test_sharper_than_the_spectrogram():
    x = chirp(400, 20.0, 150.0) + chirp(400, -60.0, 0.0)
    assert float(entropy(SynchrosqueezedMap(SLOW)(x))) < float(entropy(DopplerTimeMap(SLOW)(x))) - 1.0


def test_interface_is_that_of_the_map():
    plain, sharp = DopplerTimeMap(SLOW), SynchrosqueezedMap(SLOW)
    x = chirp(200, 10.0, 0.0)
    assert sharp(x).shape == plain(x).shape
    assert torch.equal(sharp.doppler_hz, plain.doppler_hz)
    assert torch.equal(sharp.frame_times_s(200), plain.frame_times_s(200))
    assert SynchrosqueezedMap(SLOW, hop=4).frame_rate_hz == 128.0
    silence = torch.zeros(100, 1, dtype=torch.complex64)
    assert float(sharp(silence).max()) == 0.0


def test_scripted_inverse():
    module = torch.jit.script(SynchrosqueezedMap(SLOW, hop=1))
    x = chirp(80, 10.0, 0.0)
    np.testing.assert_allclose(module.inverse(module.transform(x)), x[25:55], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"hop": 0}, "hop: got 0"),
        ({"hop": 52}, "hop: got 52"),
        ({"threshold_db": -3.0}, "threshold_db: got -3.0"),
        ({"overlap": 1.0}, "overlap: got 1.0"),
        ({"window_s": math.inf}, "window_s: got inf"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(TensorsimError, match=message):
        SynchrosqueezedMap(SLOW, **arguments)

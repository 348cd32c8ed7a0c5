"""The Doppler-time map against loops over frames, against SciPy, and its sign."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.doppler import (
    DopplerTimeMap,
    RangeDopplerVideo,
    coherent_sum,
    doppler_time_map,
)
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar import reference
from tests.radar.scenes import SMALL, ProfilesCase, complex_noise
from tests.stage import assert_same

FREE = RadarConfig.free_space()
THROUGH = RadarConfig.through_wall()


class TestDopplerTimeMap(ProfilesCase):
    def make(self):
        return DopplerTimeMap(SMALL)


class TestPaperIntegration(TestDopplerTimeMap):
    def make(self):
        return DopplerTimeMap(SMALL, integration="paper")


class TestCoherentIntegration(TestDopplerTimeMap):
    def make(self):
        return DopplerTimeMap(SMALL, integration="coherent", gate_m=(0.2, 0.8))  # bins 1 and 2

    def bad_inputs(self):
        return [*super().bad_inputs(), ((self.inputs((), torch.float32)[0][:, :1],), "before the gate")]


@pytest.mark.parametrize("gate_m", [(1.0, 0.5), (0.5, 0.6), (math.nan, 1.0), (0.5, math.inf)])
def test_a_gate_without_bins_is_refused(gate_m):
    with pytest.raises(TensorsimError, match="gate_m: got"):
        DopplerTimeMap(SMALL, gate_m=gate_m)


def test_a_gate_keeps_the_bins_within():
    x = complex_noise(40, 12)  # bins 0.3747 m apart
    torch.testing.assert_close(
        DopplerTimeMap(SMALL, gate_m=(0.5, 1.2))(x), DopplerTimeMap(SMALL)(x[:, 2:4]), rtol=1e-5, atol=0
    )


class TestRangeDopplerVideo(TestDopplerTimeMap):
    def make(self):
        return RangeDopplerVideo(SMALL)


@pytest.mark.parametrize("paper", [False, True])
@pytest.mark.parametrize(
    ("radar", "pulses", "frames"), [(FREE, 819 + 82 * 70, 71), (THROUGH, 300, 144), (FREE, 819, 1)]
)
def test_map_equals_loop_over_frames(radar, pulses, frames, paper):
    x = complex_noise(pulses, 7)
    module = DopplerTimeMap(radar, integration="paper" if paper else "noncoherent")
    expected, axis = reference.doppler_time(x.numpy().astype(complex), radar.prf_hz, paper=paper)
    actual = module(x)
    assert actual.shape == expected.shape == (module.bins, frames)
    assert actual.dtype == torch.float32
    assert reference.relative(actual, expected) < 1e-6
    np.testing.assert_array_equal(module.doppler_hz, axis)


def test_map_equals_scipy():
    from scipy.signal import ShortTimeFFT
    from scipy.signal.windows import hann

    x = complex_noise(3000, 4).numpy().astype(complex)
    module = DopplerTimeMap(FREE)
    stft = ShortTimeFFT(hann(819, sym=False), 82, 8192, fft_mode="centered", mfft=1024)
    expected = stft.stft(x.conj().T, p0=stft.p_min, p1=stft.p_max(3000))  # (R, F, all frames)
    first = -stft.p_min - 1
    while stft.t(3000, p0=stft.p_min)[first] * 8192 < 819 // 2:  # its frames start outside the signal
        first += 1
    offset = round(stft.t(3000, p0=stft.p_min)[first] * 8192) - 819 // 2
    expected = np.sqrt((np.abs(expected) ** 2).sum(0))[:, first:]
    actual = module(torch.as_tensor(x[offset:]))
    count = min(actual.shape[1], expected.shape[1])
    assert count >= 25
    np.testing.assert_allclose(actual[:, :count], expected[:, :count], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("radar", [FREE, THROUGH, SMALL])
@pytest.mark.parametrize("batch", [(), (2, 2)])
def test_blocks_equal_the_formula(radar, batch):
    """The blocked path of the Module and ``torch.stft``, and that against a loop over frames in NumPy."""
    module = DopplerTimeMap(radar).double()
    x = complex_noise(*batch, module.length + 8 * module.hop - 1, 5, dtype=torch.float64)
    formula = doppler_time_map(x, module.window, module.hop, module.bins)
    assert formula.shape == (*batch, module.bins, 8)
    assert reference.relative(module(x), formula) < 1e-12
    assert reference.relative(module(x.to(torch.complex64)), formula) < 1e-6
    expected, _ = reference.doppler_time(x.flatten(0, -3)[0].numpy() if batch else x.numpy(), radar.prf_hz)
    assert reference.relative(formula.flatten(0, -3)[0] if batch else formula, expected) < 1e-12
    scripted = torch.jit.script(doppler_time_map)
    assert_same(scripted(x, module.window, module.hop, module.bins), formula)


def test_gradient_of_the_formula():
    x = complex_noise(40, 2, dtype=torch.float64).requires_grad_()
    window = torch.hann_window(16).double()
    assert torch.autograd.gradcheck(lambda x: doppler_time_map(x, window, 8, 32), (x,), fast_mode=True)
    silent = torch.zeros(40, 2, dtype=torch.complex128, requires_grad=True)
    doppler_time_map(silent, window, 8, 32).sum().backward()
    assert torch.isfinite(silent.grad.abs()).all()


def test_settings_of_the_presets():
    free, through = DopplerTimeMap(FREE), DopplerTimeMap(THROUGH)
    assert (free.length, free.hop, free.bins) == (819, 82, 1024)
    assert (through.length, through.hop, through.bins) == (13, 2, 256)


@pytest.mark.parametrize(
    ("pulses", "overlap", "hop"), [(90, 0.7, 27), (50, 0.58, 21), (90, 0.0, 90), (90, 1 - 1e-12, 1)]
)
def test_hop_is_exact(pulses, overlap, hop):
    frames = DopplerTimeMap(RadarConfig.through_wall(prf_hz=1000.0), pulses / 1000, overlap)
    assert (frames.length, frames.hop) == (pulses, hop)


@pytest.mark.parametrize("speed", [-2.0, -0.5, 1.0, 3.0])
def test_approaching_is_positive_at_the_centre_of_the_sweep(speed):
    """A point closing in at `speed` shows at +2 v (fc + B/2) / c."""
    radar = RadarConfig(tx_m=(0, 0, 0), rx_m=(0, 0, 0))
    t = torch.arange(1700).double() / radar.prf_hz
    p = torch.stack((0 * t, 4.0 - speed * t, 0 * t), -1)[:, None]
    module = DopplerTimeMap(radar)
    maps = module(MovingTargetIndicator()(RangeProfile(radar)(EchoSynthesizer(radar)(p, torch.ones(1)))))
    peak = module.doppler_hz[maps.argmax(0)]
    expected = 2 * speed * 79e9 / C
    assert torch.sign(peak).tolist() == [math.copysign(1, speed)] * peak.numel()
    # Over a window a fast point moves through range bins, whose weight spreads over the sweep.
    assert peak.tolist() == pytest.approx([expected] * peak.numel(), abs=8.0 + 0.01 * abs(expected))
    power = maps.square().sum(1)
    centroid = float((power * module.doppler_hz).sum() / power.sum())
    assert centroid == pytest.approx(expected, rel=2e-3)  # fc alone would be 2.5 % off


def test_printed_formula_loses_the_sign():
    t = torch.arange(2000).double() / 8192
    raw = torch.polar(torch.ones(2000).double(), 2 * math.pi * -790 * t)[:, None]
    noncoherent = DopplerTimeMap(FREE)
    assert float(noncoherent.doppler_hz[noncoherent(raw)[:, 0].argmax()]) == pytest.approx(790, abs=8)
    paper = DopplerTimeMap(FREE, integration="paper")(raw + 0.1 * raw.square())
    np.testing.assert_allclose(paper[1:], paper[1:].flip(0), atol=1e-9)  # as much left as right


def beat(bin, amplitude=1.0, window="hann"):
    """The bins (1, N // 2) of a target at a beat of `bin` cycles per chirp, and its sample at mid-chirp."""
    n = np.arange(400)
    x = amplitude * np.exp(2j * np.pi * bin * n / 400)
    centre = amplitude * np.exp(2j * np.pi * bin * 399 / 800)
    weights = np.hanning(400) if window == "hann" else np.ones(400)
    return np.fft.fft(x * weights)[None, :200], centre


@pytest.mark.parametrize("bin", [20.0, 37.3, 80.5])
def test_coherent_sum_is_the_beat_at_mid_chirp(bin):
    """The plain sum is the first sample times a window that is 0 there; referred to mid-chirp it is N times 1."""
    profile, centre = beat(bin, 0.7j)
    whole = complex(coherent_sum(torch.as_tensor(profile), 400))
    peak = np.hanning(400)[199]  # 400 samples have no middle one: the window is 1 between two
    assert whole / (400 * centre) == pytest.approx(peak, rel=1e-3)
    assert abs(profile.sum()) < 1e-3 * abs(whole)  # but for the bins of negative range it would be exactly 0
    near = round(bin)
    gate = complex(coherent_sum(torch.as_tensor(profile[:, near - 2 : near + 3]), 400))
    bins = np.abs(profile[:, near - 2 : near + 3]).sum()
    assert abs(gate) > 0.93 * bins  # the bins of the main lobe add up in phase


def test_coherent_map_equals_numpy_and_does_not_vanish():
    """A target 3.02 m away that approaches at 1 m/s, Hann over range: evaluated sample by sample in NumPy."""
    radar = RadarConfig(tx_m=(0, 0, 0), rx_m=(0, 0, 0))
    t = np.arange(1700) / radar.prf_hz
    p = np.stack((0 * t, 3.02 - t, 0 * t), -1)[:, None]
    samples = reference.echo(radar, p, np.ones(1))
    profiles = np.fft.fft(samples * np.hanning(400), axis=1)[:, :200]
    gate = (2.0, 3.2)
    module = DopplerTimeMap(radar, integration="coherent", gate_m=gate)
    spacing = C / 8e9
    used = [k for k in range(200) if gate[0] <= k * spacing <= gate[1]]
    series = sum(profiles[:, [k]] * np.exp(2j * np.pi * k * 199.5 / 400) for k in used)
    expected, _ = reference.doppler_time(series, radar.prf_hz)
    actual = module(torch.as_tensor(profiles))
    assert reference.relative(actual, expected) < 1e-9
    assert float(module.doppler_hz[actual[:, 0].argmax()]) == pytest.approx(2 * 79e9 / C, abs=8)
    plain, _ = reference.doppler_time(profiles.sum(1, keepdims=True), radar.prf_hz)
    assert float(actual.max()) > 100 * plain.max()
    noncoherent = DopplerTimeMap(radar)(torch.as_tensor(profiles)).max()
    assert float(actual.max()) > 1.3 * float(noncoherent)  # amplitudes add up, not powers


@pytest.mark.parametrize("integration", ["noncoherent", "coherent", "paper"])
def test_gate_takes_the_bins_inside(integration):
    x = complex_noise(900, 12)
    spacing = FREE.range_resolution_m
    gated = DopplerTimeMap(FREE, integration=integration, gate_m=(3 * spacing, 7.4 * spacing))(x)
    np.testing.assert_allclose(gated, DopplerTimeMap(FREE, integration=integration)(x[:, 3:8]), rtol=1e-4)


def test_video_is_the_map_before_its_sum_over_range():
    x = complex_noise(2, 1200, 5)
    video, maps = RangeDopplerVideo(FREE)(x), DopplerTimeMap(FREE)(x)
    assert video.shape == (2, 5, 5, 1024)
    np.testing.assert_allclose(video.sum(2).sqrt().transpose(1, 2), maps, rtol=1e-5)
    expected, _ = reference.doppler_time(x[1, :, 3:4].numpy().astype(complex), 8192)
    assert reference.relative(video[1, :, 3].sqrt().T, expected) < 1e-6


def test_frame_times_are_centres():
    module = DopplerTimeMap(FREE)
    x = torch.zeros(4000, 1, dtype=torch.complex64)
    x[2000] = 1  # a click is loudest in the frame around it
    times = module.frame_times_s(4000)
    maps = module(x)
    assert times.shape == (maps.shape[1],) == (module.frames(4000),)
    assert float(times[maps[0].argmax()]) == pytest.approx(2000 / 8192, abs=41.5 / 8192)
    assert float(times[0]) == pytest.approx(819 / 2 / 8192)
    assert module.frames(818) == 0
    assert module.frame_times_s(818).numel() == 0


def test_gradient_at_silence_is_finite():
    x = torch.zeros(40, 2, dtype=torch.complex128, requires_grad=True)
    DopplerTimeMap(SMALL)(x).sum().backward()
    assert torch.isfinite(x.grad.abs()).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"window_s": 0.0}, "window_s: got 0.0"),
        ({"window_s": float("nan")}, "window_s: got nan"),
        ({"overlap": 1.0}, "overlap: got 1.0"),
        ({"overlap": -0.1}, "overlap: got -0.1"),
        ({"overlap": None}, "overlap: got None"),
        ({"window_s": "0.1"}, "window_s: got 0.1"),
        ({"gate_m": 2.0}, r"gate_m: got 2.0, expected \(nearest, farthest\)"),
        ({"integration": "incoherent"}, "integration: got 'incoherent'"),
        ({"gate_m": (3.0, 2.0)}, "gate_m: got"),
        ({"gate_m": (3.001, 3.002)}, "with one of the range bins between"),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(TensorsimError, match=message):
        DopplerTimeMap(FREE, **arguments)

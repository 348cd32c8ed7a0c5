"""Range bins in closed form: against the definition, against the time-domain engine, and the noise in them."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import RadarConfig, WallConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar import reference
from tests.radar.scenes import SMALL, SceneCase, joint_rcs, recorded_walk, swinging, tensors
from tests.stage import assert_same

FREE = RadarConfig.free_space()
THROUGH = RadarConfig.through_wall()
WINDOWS = ["hamming", "hann", "blackman", None]
C = 299_792_458.0


def synthesizer(radar, window="hamming", near_bins=None, gate_m=None, **scene):
    return RangeBinSynthesizer(
        EchoSynthesizer(radar, **scene), RangeProfile(radar, window, gate_m), near_bins
    )


class TestRangeBinSynthesizer(SceneCase):
    pulses = 6

    def make(self):
        wall = WallConfig(center_m=(0.0, 3.0, 1.5))
        return synthesizer(SMALL, wall=wall, multipath=True, leakage=True, wall_echo=True)


class TestNearBins(TestRangeBinSynthesizer):
    def make(self):
        return synthesizer(SMALL, "hann", near_bins=3, gate_m=(0.5, 2.5))


def dirichlet(x, samples):
    """``sum over n of exp(-j 2 pi x n / N)`` in its printed form, for x that is not a multiple of N."""
    return np.exp(-1j * np.pi * x * (samples - 1) / samples) * np.sin(np.pi * x) / np.sin(np.pi * x / samples)


def cosine_window(coefficients, x, samples):
    """Transform of ``a0 - a1 cos(2 pi n / (N - 1)) + a2 cos(4 pi n / (N - 1))``: Dirichlet kernels side by side."""
    spread = samples / (samples - 1)
    total = coefficients[0] * dirichlet(x, samples)
    for order, a in enumerate(coefficients[1:], 1):
        both = dirichlet(x - order * spread, samples) + dirichlet(x + order * spread, samples)
        total = total + (-1) ** order * a / 2 * both
    return total


@pytest.mark.parametrize(
    ("window", "coefficients"),
    [(None, [1.0]), ("hamming", [0.54, 0.46]), ("hann", [0.5, 0.5]), ("blackman", [0.42, 0.5, 0.08])],
)
def test_bins_are_dirichlet_kernels(window, coefficients):
    p, rcs = tensors(swinging(5, 4, 8192.0), np.ones(4))
    tau, r1, r2, _ = reference.path_list(FREE, p.numpy())[0]
    lam, mu = C / 77e9, 1e14
    a = 10 * lam / (4 * np.pi) ** 1.5 / (r1 * r2)
    start = a * np.exp(2j * np.pi * (77e9 * tau - mu * tau**2 / 2))
    x = np.arange(200) - (mu * tau * 40e-6)[..., None]
    expected = (start[..., None] * cosine_window(coefficients, x, 400)).sum(1)
    assert reference.relative(synthesizer(FREE, window).double()(p, rcs), expected) < 1e-9


@pytest.mark.parametrize("window", WINDOWS)
def test_equals_the_time_domain(window):
    p, rcs = tensors(swinging(300, 5, 8192.0), np.linspace(0.1, 1, 5))
    expected = RangeProfile(FREE, window).double()(EchoSynthesizer(FREE, leakage=True).double()(p, rcs))
    bins = synthesizer(FREE, window, leakage=True)
    assert reference.relative(bins(p.float(), rcs.float()), expected) < 1e-6
    assert reference.relative(bins.double()(p, rcs), expected) < 1e-12


@pytest.mark.parametrize("wall_y", [0.12, 5.0])
def test_equals_the_time_domain_through_and_before_a_wall(wall_y):
    scene = {"wall": WallConfig((-0.1, wall_y, 1.5)), "multipath": True, "wall_echo": True, "leakage": True}
    p, rcs = tensors(swinging(50, 5, 128.0), np.ones(5))
    expected = RangeProfile(THROUGH).double()(EchoSynthesizer(THROUGH, **scene).double()(p, rcs))
    assert reference.relative(synthesizer(THROUGH, **scene).double()(p, rcs), expected) < 1e-12
    assert reference.relative(synthesizer(THROUGH, **scene)(p.float(), rcs.float()), expected) < 1e-5


def test_equals_the_definition_on_recorded_motion(shared_data):
    walk = recorded_walk(shared_data, FREE.prf_hz, 0.05)
    expected = reference.profiles(reference.echo(FREE, walk, joint_rcs()))
    assert reference.relative(synthesizer(FREE)(*tensors(walk, joint_rcs())), expected) < 1e-6


def test_phase_keeps_ninety_decibels():
    """What is left of a resting target after the exact phase is taken off, at 77 GHz in float32."""
    p, rcs = tensors(swinging(400, 1, 8192.0), np.ones(1))
    exact = synthesizer(FREE).double()(p, rcs)
    assert 20 * math.log10(reference.relative(synthesizer(FREE)(p, rcs), exact)) < -90


@pytest.mark.parametrize("beat", [0.0, 30.0, 30.5, 199.0, 260.25, 399.75, 400.5])
def test_whole_half_and_aliased_bins(beat):
    """The printed kernel is 0 / 0 at whole bins; beyond N / 2 a target aliases, beyond N it comes round."""
    radar = RadarConfig(tx_m=(0, 0, 0), rx_m=(0, 0, 0), carrier_hz=2e9)
    p = torch.tensor([[[0.0, beat * C / (2 * 4e9), 0.0]]], dtype=torch.float64, requires_grad=True)
    rcs = torch.ones(1, dtype=torch.float64)
    bins, echo, profile = (
        synthesizer(radar).double(),
        EchoSynthesizer(radar).double(),
        RangeProfile(radar).double(),
    )
    weight = torch.randn(200, dtype=torch.complex128)
    values, gradients = [], []
    for values_of in (bins, lambda p, rcs: profile(echo(p, rcs))):
        result = values_of(p, rcs)
        values.append(result.detach())
        gradients.append(torch.autograd.grad((result * weight).real.sum(), p)[0])
    assert reference.relative(values[0], values[1]) < 1e-11
    if beat > 0:  # at the antenna the range has no slope
        assert reference.relative(gradients[0], gradients[1]) < 1e-9


@pytest.mark.parametrize(("window", "near_bins", "error"), [("hamming", 8, 0.0135), ("hann", 8, 0.00057)])
def test_truncation_is_the_energy_beyond_the_near_bins(window, near_bins, error):
    """By NumPy: a tone at a fraction of a bin, its windowed spectrum, and what lies beyond the bins nearest to it."""
    n = np.arange(FREE.samples_per_chirp)
    taper = {"hamming": np.hamming, "hann": np.hanning}[window](len(n))
    beyond, whole = 0.0, 0.0
    for fraction in (np.arange(32) + 0.5) / 32 - 0.5:
        power = np.abs(np.fft.fft(taper * np.exp(2j * np.pi * (100 + fraction) * n / len(n)))) ** 2
        whole += power.sum()
        beyond += power.sum() - power[100 - near_bins : 100 + near_bins + 1].sum()
    assert np.sqrt(beyond / whole) == pytest.approx(error, rel=0.05)
    assert synthesizer(FREE, window, near_bins).truncation == pytest.approx(error, rel=0.05)


@pytest.mark.parametrize("near_bins", [1, 5])
def test_exactly_the_near_bins_are_computed(near_bins):
    """As many on either side of the bin nearest to the target, and no more."""
    target = torch.tensor([[[0.0, 40.3 * FREE.range_resolution_m, 1.5]]], dtype=torch.float64)
    target[..., 1] = (target[..., 1] ** 2 - 0.1**2).sqrt()  # half of the antennas' distance
    filled = torch.nonzero(synthesizer(FREE, "hamming", near_bins)(target, torch.ones(1))[0].abs() > 0)[:, 0]
    assert filled.tolist() == list(range(40 - near_bins, 41 + near_bins))


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("near_bins", [4, 12])
def test_truncation_is_the_stated_one(window, near_bins):
    rng = np.random.default_rng(0)
    p = np.zeros((2000, 1, 3))
    p[..., 1], p[..., 2] = rng.uniform(2, 5, (2000, 1)), 1.5
    near = synthesizer(FREE, window, near_bins)
    exact = synthesizer(FREE, window)
    measured = reference.relative(near(*tensors(p, [1.0])), exact(*tensors(p, [1.0])))
    assert measured == pytest.approx(near.truncation, rel=0.1)
    assert exact.truncation == 0.0
    assert synthesizer(FREE, window, 250).truncation == 0.0


def test_gate_is_a_cut_through_all_bins():
    p, rcs = tensors(swinging(20, 3, 8192.0), np.ones(3))
    whole, gated = synthesizer(FREE, leakage=True), synthesizer(FREE, gate_m=(2.0, 4.0), leakage=True)
    chosen = (whole.profile.range_m >= 2.0) & (whole.profile.range_m <= 4.0)
    assert torch.equal(gated.profile.range_m, whole.profile.range_m[chosen])
    assert_same(gated(p, rcs), whole(p, rcs)[:, chosen])


@pytest.mark.parametrize("paths", [2, 14, 90])
def test_energy_is_that_of_the_samples(paths):
    """By pairs, and for many paths by samples; two of them at one place, with and without what stands still."""
    p = swinging(20, paths, 8192.0)
    p[:, 1] = p[:, 0]
    p, rcs = tensors(p, np.linspace(0.1, 1, paths))
    bins = synthesizer(FREE, leakage=True)
    echo = bins.echo.double().target_echo(p, rcs.expand(20, paths))
    expected = {
        total: (echo + total * bins.echo.static_echo()).abs().square().sum(-1) for total in (False, True)
    }
    for module, error in ((bins.double(), 1e-9), (synthesizer(FREE, leakage=True), 1e-5)):
        for total in (False, True):
            energy = module.energy(*module.tones(p, rcs.expand(20, paths)), total)
            assert reference.relative(energy, expected[total]) < error


def test_energy_of_every_nth_pulse_stands_for_those_up_to_the_next():
    p, rcs = tensors(swinging(20, 3, 8192.0), np.linspace(0.1, 1, 3))
    exact, sparse = synthesizer(FREE), synthesizer(FREE)
    sparse.energy_stride = 6
    tones = exact.tones(p, rcs.expand(20, 3))
    every = exact.energy(*tones, False)[[0] * 6 + [6] * 6 + [12] * 6 + [18] * 2]
    assert torch.equal(sparse.energy(*tones, False), every)
    assert torch.equal(torch.jit.script(sparse).energy(*tones, False), every)
    with pytest.raises(TensorsimError, match="energy_stride: got 0"):
        RangeBinSynthesizer(exact.echo, exact.profile, energy_stride=0)


def test_refuses_bad_settings():
    for bins in (0, 8.5):
        with pytest.raises(TensorsimError, match=f"near_bins: got {bins}, expected an integer"):
            synthesizer(FREE, near_bins=bins)
        with pytest.raises(TensorsimError, match=f"near_bins: got {bins}, expected an integer"):
            RadarSimulator(FREE, engine="range-bins", near_bins=bins)
    with pytest.raises(TensorsimError, match="engine: got 'magic'"):
        RadarSimulator(FREE, engine="magic")
    with pytest.raises(TensorsimError, match="near_bins: got 4 with the engine 'time'"):
        RadarSimulator(FREE, near_bins=4)


class TestSimulatorWithRangeBins(SceneCase):
    pulses = 35
    gradient_arguments = ()  # tested with noise below: without a floor, magnitudes have kinks
    exports = False  # it does; RangeBinSynthesizer shows it in a tenth of the time

    def make(self):
        wall = WallConfig(center_m=(0.0, 3.0, 1.5))
        options = {"multipath": True, "leakage": True, "wall_echo": True, "snr_db": None, "pulse_chunk": 8}
        return RadarSimulator(SMALL, wall, ridge_count=2, engine="range-bins", **options)

    def bad_inputs(self):
        p, rcs = self.inputs((), torch.float32)
        return [*super().bad_inputs(), ((p[:26], rcs), "got 26 pulses")]


def test_gradients_of_the_doppler_map():
    module = RadarSimulator(SMALL, snr_db=10.0, engine="range-bins", range_gate_m=2.0).double()
    p, rcs = tensors(swinging(30, 3, 256.0), np.ones(3))

    def function(p, rcs):
        torch.manual_seed(0)
        return module.doppler_time(p, rcs)

    assert torch.autograd.gradcheck(
        function, (p.requires_grad_(True), rcs.requires_grad_(True)), fast_mode=True, rtol=1e-3
    )


@pytest.mark.parametrize("gate", [None, (2.0, 4.5), 1.0])
def test_engines_give_the_same_maps(gate):
    p, rcs = tensors(swinging(1100, 5, FREE.prf_hz), np.ones(5))
    options = {"snr_db": None, "range_gate_m": gate}
    expected = RadarSimulator(FREE, **options).double()(p, rcs)
    maps = RadarSimulator(FREE, engine="range-bins", **options)(p.float(), rcs.float())
    for name in ("range_time", "range_time_mti", "doppler_time"):
        assert reference.relative(getattr(maps, name), getattr(expected, name)) < 1e-5, name
    assert maps.snr_db == expected.snr_db == math.inf


@pytest.mark.parametrize("engine", ["time", "range-bins"])
def test_noise_of_both_engines_has_its_power(engine):
    p, rcs = tensors(swinging(1000, 4, 128.0, speed_m_s=0.0), np.ones(4))
    maps = RadarSimulator(THROUGH, snr_db=10.0, engine=engine)(p, rcs)
    echo = float(EchoSynthesizer(THROUGH)(p, rcs).abs().square().mean())
    far = maps.range_time_mti[150:].square().mean()  # beyond 20 m there is nothing but noise
    assert float(far) == pytest.approx(2 * echo / 10 * (np.hamming(400) ** 2).sum(), rel=0.03)
    assert float(maps.snr_db) == pytest.approx(10.0, abs=0.1)

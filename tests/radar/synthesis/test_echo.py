"""The echo against the definition, sample by sample in float64."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import RadarConfig, WallConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.synthesis.dechirp import beat_sum, intermediate_frequency
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar import reference
from tests.radar.scenes import SMALL, SceneCase, joint_rcs, recorded_walk, swinging, tensors
from tests.stage import assert_same

FREE = RadarConfig.free_space()
THROUGH = RadarConfig.through_wall()
WALL_IN_SCENE = WallConfig(center_m=(0.0, 3.1, 1.5))  # a person at 3 m is partly in front, partly behind

SCENES = {
    "free space": (FREE, {}, {}),
    "through wall": (THROUGH, {"wall": WallConfig()}, {}),
    "series": (THROUGH, {"wall": WallConfig(), "multipath": True}, {}),
    "paper": (THROUGH, {"wall": WallConfig(), "multipath": True, "wall_paths": "paper"}, {"paper": True}),
    "on both sides": (THROUGH, {"wall": WALL_IN_SCENE, "multipath": True}, {}),
}


class TestEchoSynthesizer(SceneCase):
    scatterers = 4

    def make(self):
        wall = WallConfig(center_m=(0.0, 3.0, 1.5))
        return EchoSynthesizer(SMALL, wall, multipath=True, leakage=True, wall_echo=True, pulse_chunk=5)

    def bad_inputs(self):
        p, rcs = self.inputs((), torch.float32)
        return [
            *super().bad_inputs(),
            ((p, rcs.long()), "rcs: got dtype"),
            ((p, rcs[:3]), r"rcs: got shape \[3\], expected \[4\] .* or \[7, 4\]"),
            ((p, rcs[None, None]), "rcs: got shape"),
            ((p, rcs * float("inf")), "rcs: got NaN or inf"),
        ]

    def test_scripted_refuses_bad_input(self):
        scripted = torch.jit.script(self.make())
        for args, message in self.bad_inputs():
            with pytest.raises(Exception, match=message):
                scripted(*args)


def test_intermediate_frequency():
    """The formula against NumPy, and the factorised sum of the echo against the formula."""
    rng = np.random.default_rng(0)
    delay, t = rng.uniform(1e-9, 4e-8, (3, 5)), np.arange(400) / 10e6
    amplitude = rng.normal(size=(3, 5)) + 1j * rng.normal(size=(3, 5))
    mu = 4e9 / 40e-6
    phase = 77e9 * delay[..., None] + mu * delay[..., None] * t - mu * delay[..., None] ** 2 / 2
    expected = (np.conj(amplitude)[..., None] * np.exp(2j * np.pi * phase)).sum(1)
    tau, a, time = map(torch.as_tensor, (delay, amplitude, t))
    actual = intermediate_frequency(tau, a, 77e9, mu, time)
    assert reference.relative(actual, expected) < 1e-11
    assert_same(torch.jit.script(intermediate_frequency)(tau, a, 77e9, mu, time), actual, atol=1e-12)
    index = torch.arange(20).double()
    fast = beat_sum(tau, a.conj().resolve_conj(), 77e9, mu, 10e6, index, index)
    assert reference.relative(fast, actual) < 1e-11


@pytest.mark.parametrize("scene", SCENES)
def test_echo_is_the_sum_over_its_paths(scene):
    radar, options, _ = SCENES[scene]
    p, rcs = tensors(swinging(8, 4, radar.prf_hz), np.linspace(0.1, 1, 4))
    module = EchoSynthesizer(radar, **options).double()
    paths = module.paths(p, rcs.expand(8, 4))
    time = torch.arange(module.samples).double() / radar.sample_rate_hz
    slow = intermediate_frequency(
        paths.delay_s.flatten(-2), paths.gain.flatten(-2).conj(), radar.carrier_hz, radar.slope_hz_per_s, time
    )
    assert reference.relative(module(p, rcs), slow) < 1e-11


@pytest.mark.parametrize("scene", SCENES)
def test_if_equals_the_definition(scene):
    radar, options, reference_options = SCENES[scene]
    p, rcs = swinging(40, 6, radar.prf_hz), np.linspace(0.1, 1, 6)
    expected = reference.echo(
        radar, p, rcs, options.get("wall"), options.get("multipath", False), **reference_options
    )
    module = EchoSynthesizer(radar, pulse_chunk=16, **options)
    actual = module(*tensors(p, rcs))
    assert actual.dtype == torch.complex64
    assert reference.relative(actual, expected) < 1e-5
    doubled = module.double()(*tensors(p, rcs))
    assert doubled.dtype == torch.complex128
    assert reference.relative(doubled, expected) < 1e-9


@pytest.mark.parametrize("scene", ["free space", "series", "on both sides"])
def test_if_equals_the_definition_on_recorded_motion(scene, shared_data):
    radar, options, _ = SCENES[scene]
    p = recorded_walk(shared_data, radar.prf_hz, 0.02 if scene == "free space" else 1.0)
    expected = reference.echo(radar, p, joint_rcs(), options.get("wall"), options.get("multipath", False))
    assert reference.relative(EchoSynthesizer(radar, **options)(*tensors(p, joint_rcs())), expected) < 1e-5


def test_float32_phase_floor_is_below_90_db():
    p, rcs = swinging(64, 1, FREE.prf_hz, distance_m=7.0), np.ones(1)
    expected = reference.echo(FREE, p, rcs)
    error = np.abs(EchoSynthesizer(FREE)(*tensors(p, rcs)).numpy() - expected).max() / np.abs(expected).max()
    assert 20 * math.log10(error) < -90


@pytest.mark.parametrize("samples", [2, 3, 7, 97, 100])
def test_any_number_of_samples(samples):
    radar = RadarConfig(sample_rate_hz=samples / 40e-6)
    p, rcs = swinging(3, 2, radar.prf_hz), np.ones(2)
    actual = EchoSynthesizer(radar)(*tensors(p, rcs))
    assert actual.shape == (3, samples)
    assert reference.relative(actual, reference.echo(radar, p, rcs)) < 1e-5


def test_beat_is_positive_and_approaching_phase_decreases():
    """Both signs follow from transmitted times conjugate of received."""
    radar = RadarConfig(tx_m=(0, 0, 0), rx_m=(0, 0, 0))
    p = torch.tensor([[[0.0, 3.0, 0.0]], [[0.0, 3.0 - 2e-4, 0.0]]], dtype=torch.float64)
    x = EchoSynthesizer(radar)(p, torch.ones(1))
    beat = (x[0, 1:] * x[0, :-1].conj()).angle().mean() / (2 * math.pi) * radar.sample_rate_hz
    assert float(beat) == pytest.approx(radar.slope_hz_per_s * 6.0 / C, rel=1e-4)
    turn = float((x[1, 0] * x[0, 0].conj()).angle())
    assert turn == pytest.approx(-2 * math.pi * 2 * 2e-4 * 77e9 / C, rel=1e-3)


def test_switches_stand_for_names_of_paths():
    p, rcs = tensors(swinging(4, 3, THROUGH.prf_hz), np.ones(3))
    wall = WallConfig()

    def echo(**options):
        return EchoSynthesizer(THROUGH, wall, **options).double()(p, rcs)

    alone = {name: echo(paths=(name,)) for name in ("direct", "wall_bounces", "leakage", "wall_echo")}
    assert all(float(part.abs().max()) > 0 for part in alone.values())
    assert_same(echo(), alone["direct"], atol=1e-12)
    assert_same(echo(multipath=True), alone["direct"] + alone["wall_bounces"], atol=1e-12)
    assert_same(echo(multipath=True, direct=False), alone["wall_bounces"], atol=1e-12)
    assert_same(echo(leakage=True), alone["direct"] + alone["leakage"], atol=1e-12)
    assert_same(echo(wall_echo=True), alone["direct"] + alone["wall_echo"], atol=1e-12)
    assert_same(echo(multipath=True, leakage=True, wall_echo=True), sum(alone.values()), atol=1e-12)


def test_leakage_and_wall_echo_equal_their_definitions():
    p, rcs = torch.zeros(2, 0, 3).double(), torch.zeros(0)
    leakage = EchoSynthesizer(FREE, leakage=True)(p, rcs)
    expected = reference.static_path(FREE, 0.2, 10 ** (-20 / 20))
    assert reference.relative(leakage, np.stack([expected] * 2)) < 1e-6
    wall = WallConfig(center_m=(0.0, 5.12, 1.5))
    g = reference.wall_terms(wall, 2e9)[1]
    amplitude = (C / 2e9) * 10 / (4 * np.pi * 10.0020) * g
    expected = reference.static_path(THROUGH, math.hypot(10, 0.2), amplitude)
    assert math.hypot(10, 0.2) == pytest.approx(10.0020, abs=5e-5)
    actual = EchoSynthesizer(THROUGH, wall, wall_echo=True)(p, rcs)
    assert reference.relative(actual, np.stack([expected] * 2)) < 1e-4  # four digits of the length above


def test_wall_factor_enters_conjugated():
    """A lossy wall delays what it lets through: the IF of T0^2 turns by the opposite angle."""
    p, rcs = tensors(np.array([[[0.0, 3.0, 1.5]]]), np.ones(1))
    lossy = WallConfig(loss_tangent=0.3)
    plain = WallConfig(loss_tangent=0.0)
    turned = EchoSynthesizer(THROUGH, lossy).double()(p, rcs) / EchoSynthesizer(THROUGH, plain).double()(
        p, rcs
    )
    t0 = reference.wall_terms(lossy, 2e9)[2]
    excess = 2 * 0.24 * (lossy.refractive_index.real - plain.refractive_index.real)
    expected = -2 * np.angle(t0) + 2 * np.pi * 2e9 * excess / C
    assert abs(np.exp(1j * float(turned[0, 0].angle())) - np.exp(1j * expected)) < 1e-3
    assert abs(np.angle(t0)) > 0.02  # large enough to tell the signs apart


def test_rcs_forms_agree():
    p, rcs = tensors(np.stack([swinging(5, 3, 8192.0, seed=i) for i in range(2)]), np.array([0.2, 1.0, 0.5]))
    module = EchoSynthesizer(FREE)
    expected = module(p, rcs.expand(2, 3))
    assert_same(module(p, rcs), expected)
    assert_same(module(p, rcs.expand(2, 5, 3)), expected)
    fading = rcs.expand(2, 5, 3) * torch.linspace(0, 1, 5).double()[:, None] ** 2
    assert_same(module(p, fading), expected * torch.linspace(0, 1, 5)[:, None], atol=1e-6)


def test_empty_scene_and_silent_scatterers():
    p, rcs = tensors(swinging(5, 3, 8192.0), np.zeros(3))
    module = EchoSynthesizer(FREE)
    assert torch.equal(module(p[:, :0], rcs[:0]), torch.zeros(5, 400, dtype=torch.complex64))
    assert torch.equal(module(p, rcs), torch.zeros(5, 400, dtype=torch.complex64))
    p.requires_grad_(True)
    rcs.requires_grad_(True)
    module(p, rcs).abs().sum().backward()
    assert torch.isfinite(p.grad).all()
    assert torch.isfinite(rcs.grad).all()


@pytest.mark.parametrize(
    "wall", [WallConfig(size_m=(5, 0, 2.5)), WallConfig((0, 4, 1), (5, 0.24, 2.5), 1.0, 0.0)]
)
def test_wall_of_nothing_equals_free_space(wall):
    p, rcs = tensors(swinging(6, 4, THROUGH.prf_hz), np.ones(4))
    with_wall = EchoSynthesizer(THROUGH, wall, multipath=True, wall_echo=True)(p, rcs)
    assert_same(with_wall, EchoSynthesizer(THROUGH)(p, rcs), atol=1e-6)


def test_chunks_do_not_show():
    p, rcs = tensors(swinging(33, 4, FREE.prf_hz), np.ones(4))
    whole = EchoSynthesizer(FREE, pulse_chunk=100)(p, rcs)
    for chunk in (1, 7, 33):
        assert_same(EchoSynthesizer(FREE, pulse_chunk=chunk)(p, rcs), whole, atol=1e-6)


def test_bad_arguments():
    with pytest.raises(TensorsimError, match="pulse_chunk: got 0"):
        EchoSynthesizer(FREE, pulse_chunk=0)
    with pytest.raises(TensorsimError, match="wall_paths"):
        EchoSynthesizer(FREE, wall_paths="all")


@pytest.mark.parametrize(
    ("scale", "rcs", "message"),
    [
        (1.0, -1.0, "rcs: got a minimum of -1.0"),
        (math.nan, 1.0, "positions: got NaN"),
        (1.0, math.inf, "rcs: got NaN or infinite"),
    ],
)
def test_echo_of_the_targets_refuses_what_has_no_echo(scale, rcs, message):
    positions = scale * torch.tensor([[0.0, 3.0, 1.0], [0.0, 4.0, 1.0]])
    with pytest.raises(TensorsimError, match=message):
        EchoSynthesizer(FREE).target_echo(positions, torch.tensor([1.0, rcs]))


def test_times_of_pulses_go_on_from_the_first() -> None:
    times = EchoSynthesizer(RadarConfig(prf_hz=500.0)).pulse_times(1000, 4)
    assert times.tolist() == pytest.approx([2.0, 2.002, 2.004, 2.006], abs=1e-12)

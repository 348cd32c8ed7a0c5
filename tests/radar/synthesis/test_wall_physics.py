"""The wall beyond normal incidence: refraction, Fresnel, the closed slab, and gradients by its constants."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import RadarConfig, WallConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.simulator import RadarSimulator
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.paths import LEARNABLE
from tensorsim.radar.synthesis.wall import airy, fresnel, refracted_leg, slab_coefficients, wall_tensors
from tests.radar import reference
from tests.radar.scenes import SMALL, SceneCase, swinging, tensors

THROUGH = RadarConfig.through_wall()
WALL = WallConfig()
LOSSLESS = WallConfig(loss_tangent=0.0)


def f64(*values):
    return torch.tensor(values, dtype=torch.float64)


class ObliqueCase(SceneCase):
    options: dict = {}  # noqa: RUF012

    def make(self):
        wall = WallConfig(center_m=(0.0, 2.2, 1.5))
        return EchoSynthesizer(SMALL, wall, multipath=True, wall_echo=True, pulse_chunk=16, **self.options)


class TestObliqueEcho(ObliqueCase):
    options = {"incidence": "oblique", "polarization": "tm", "bounces": 2}  # noqa: RUF012


class TestAiryEcho(ObliqueCase):
    options = {"incidence": "airy"}  # noqa: RUF012

    @pytest.mark.slow
    def test_exports(self):
        super().test_exports()


@pytest.mark.parametrize(("degrees", "excess"), [(0, 0.348), (45, 0.393)])
def test_excess_range_of_the_refracted_path(degrees, excess):
    eps, _, d = wall_tensors(WALL)
    far, angle = 1e4, math.radians(degrees)
    lateral, depth = f64(far * math.sin(angle)), f64(far * math.cos(angle))
    cosine, length = refracted_leg(lateral, depth - d, d, eps.sqrt())
    assert float(length) - far == pytest.approx(excess, abs=5e-4)
    assert float(cosine) == pytest.approx(math.cos(angle), abs=1e-4)


@pytest.mark.parametrize("air", [0.01, 0.5, 4.0])
@pytest.mark.parametrize("lateral", [0.0, 0.3, 5.0])
def test_refracted_path_is_the_path_of_least_time(air, lateral):
    for index in (1.0, 1.3, 2.45):
        expected = reference.fermat(lateral, air, 0.24, index)
        cosine, length = refracted_leg(f64(lateral), f64(air), f64(0.24), f64(index))
        assert float(length) == pytest.approx(expected[1], rel=1e-9)
        assert float(cosine) == pytest.approx(expected[0], rel=1e-5)


def test_refracted_path_obeys_snell_at_grazing_incidence():
    lateral = torch.linspace(0, 30, 200).double()
    cosine, _ = refracted_leg(lateral, torch.full_like(lateral, 1e-3), f64(0.24), f64(2.45))
    sine = (1 - cosine.square()).sqrt()
    inside = sine / 2.45
    crossed = 1e-3 * sine / cosine + 0.24 * inside / (1 - inside.square()).sqrt()
    torch.testing.assert_close(crossed, lateral, rtol=0, atol=1e-9)


def test_gradient_of_the_implicit_path():
    args = [f64(0.0, 0.4, 3.0), f64(0.5, 2.0, 1.0), f64(0.24), f64(2.4)]
    args = [a.requires_grad_() for a in args]
    args[0] = f64(0.2, 0.4, 3.0).requires_grad_()
    assert torch.autograd.gradcheck(refracted_leg, args)


def test_fresnel_brewster_normal_and_signs():
    eps, zero = f64(6.0).squeeze(), f64(0.0).squeeze()
    brewster = torch.cos(torch.atan(eps.sqrt()))
    assert abs(complex(fresnel(eps, zero, brewster, "tm"))) < 1e-12
    assert abs(complex(fresnel(eps, zero, brewster, "te"))) > 0.5
    n = math.sqrt(6)
    for polarization in ("te", "tm"):
        normal = complex(fresnel(eps, zero, torch.ones(()).double(), polarization))
        assert normal == pytest.approx((1 - n) / (1 + n), abs=1e-12)
        for cosine in (0.05, 0.4, 0.9):
            actual = complex(fresnel(eps, f64(0.2).squeeze(), f64(cosine).squeeze(), polarization))
            assert actual == pytest.approx(reference.interface(6.0, 0.2, cosine, polarization), abs=1e-12)


@pytest.mark.parametrize("polarization", ["te", "tm"])
def test_air_reflects_nothing_at_any_angle(polarization):
    """Nor where no wave arrives: there the value is not used, but its gradient would spoil that of the others."""
    eps, cosine = torch.ones(5).double().requires_grad_(), f64(1.0, 0.3, 1e-12, 0.0, -0.4).requires_grad_()
    reflection = fresnel(eps, torch.zeros(5).double(), cosine, polarization)
    assert float(reflection.detach().abs().max()) < 1e-12
    torch.view_as_real(reflection).sum().backward()
    assert bool(torch.isfinite(eps.grad).all() & torch.isfinite(cosine.grad).all())


@pytest.mark.parametrize("incidence", ["oblique", "airy"])
def test_echoes_of_a_wall_of_air_have_gradients(incidence):
    """Also where its faces reflect: at the antennas it is a reflection of 0, not of 0 / 0."""
    p, rcs = tensors(swinging(3, 3, THROUGH.prf_hz), np.ones(3))
    p.requires_grad_()
    wall = WallConfig(relative_permittivity=1.0, loss_tangent=0.0)
    options = {"incidence": incidence, "multipath": True, "wall_echo": True}
    module = EchoSynthesizer(THROUGH, wall, learnable=("relative_permittivity",), **options).double()
    echo = module(p, rcs)
    assert reference.relative(echo.detach(), EchoSynthesizer(THROUGH).double()(p, rcs).detach()) < 1e-8
    echo.abs().sum().backward()
    for tensor in (p, *module.parameters()):
        assert bool(torch.isfinite(tensor.grad).all())


@pytest.mark.parametrize("polarization", ["te", "tm"])
@pytest.mark.parametrize("cosine", [1.0, 0.8, 0.3])
def test_closed_slab_equals_its_matrix_and_keeps_energy(polarization, cosine):
    for frequency in (2.0e9, 2.37e9, 3e9):
        slab = slab_coefficients(*wall_tensors(LOSSLESS), frequency, f64(cosine).squeeze(), polarization)
        r, t = map(complex, airy(slab, frequency))
        expected_r, expected_t = reference.slab_matrix(LOSSLESS, frequency, cosine, polarization)
        inside = math.sqrt(6 - (1 - cosine**2))
        straight = 2 * math.pi * frequency / C * 0.24 * inside  # the phase that delays hold
        assert r == pytest.approx(expected_r, abs=1e-9)
        assert t == pytest.approx(expected_t * np.exp(1j * straight), abs=1e-9)
        assert abs(r) ** 2 + abs(t) ** 2 == pytest.approx(1, abs=1e-12)


def test_closed_slab_with_loss_equals_its_matrix_at_normal_incidence():
    wall = WallConfig(loss_tangent=0.2)
    slab = slab_coefficients(*wall_tensors(wall), 2e9, torch.ones(()).double())
    r, t = map(complex, airy(slab, 2e9))
    expected_r, expected_t = reference.slab_matrix(wall, 2e9, 1.0, "te")
    straight = 2 * math.pi * 2e9 / C * 0.24 * wall.refractive_index.real
    assert r == pytest.approx(expected_r, abs=1e-9)
    assert t == pytest.approx(expected_t * np.exp(1j * straight), abs=1e-9)


@pytest.mark.parametrize("polarization", ["te", "tm"])
def test_oblique_echo_equals_the_definition(polarization):
    point = (1.5, 3.0, 0.4)
    legs = [
        reference.oblique_legs(THROUGH, point, a, WALL, 2, polarization) for a in (THROUGH.tx_m, THROUGH.rx_m)
    ]
    expected = reference.beat(THROUGH, *reference.pair_legs(THROUGH, *legs))
    module = EchoSynthesizer(
        THROUGH, WALL, multipath=True, incidence="oblique", polarization=polarization, bounces=2
    ).double()
    actual = module(f64(*point)[None, None], torch.ones(1).double())[0]
    assert reference.relative(actual, expected) < 1e-7


@pytest.mark.parametrize("loss_tangent", [0.0, 0.05])
def test_airy_echo_is_the_slab_at_the_frequency_of_each_sample(loss_tangent):
    """On the axis of a monostatic radar, where the angle is normal and the reference exact."""
    radar = RadarConfig.through_wall(tx_m=(0, 0, 1.5), rx_m=(0, 0, 1.5))
    wall = WallConfig(loss_tangent=loss_tangent)
    excess = 0.24 * (wall.refractive_index.real - 1)
    tau = 2 * (3.0 + excess) / C
    t = np.arange(400) / radar.sample_rate_hz
    arriving = 2e9 + radar.slope_hz_per_s * (t - tau)
    passage = reference.slab_matrix(wall, arriving, 1.0, "te")[1]
    passage = passage * np.exp(2j * np.pi * arriving / C * 0.24 * wall.refractive_index.real)
    amplitude = reference.pair_legs(radar, [(3.0, tau / 2, 1.0)], [(3.0, tau / 2, 1.0)])
    expected = reference.beat(radar, *amplitude) * np.conj(passage**2)
    module = EchoSynthesizer(radar, wall, incidence="airy").double()
    actual = module(f64(0.0, 3.0, 1.5)[None, None], torch.ones(1).double())[0]
    assert reference.relative(actual, expected) < 1e-9


def test_series_converges_to_airy():
    p, rcs = tensors(swinging(3, 3, THROUGH.prf_hz), np.ones(3))
    closed = EchoSynthesizer(THROUGH, LOSSLESS, incidence="airy").double()(p, rcs)
    errors = []
    for bounces in (1, 2, 4, 8):
        module = EchoSynthesizer(THROUGH, LOSSLESS, multipath=True, incidence="oblique", bounces=bounces)
        errors.append(reference.relative(module.double()(p, rcs), closed))
    assert errors[0] > 3 * errors[1] > 9 * errors[2]  # G^2 = 0.18 per bounce
    assert errors[3] < 1e-3  # what is left is mu (k t)^2 / 2 of the closed form


@pytest.mark.parametrize("incidence", ["normal", "oblique", "airy"])
@pytest.mark.parametrize(
    "wall", [WallConfig((0, 0.5, 1.5), (5, 1e-12, 3)), WallConfig((0, 1, 1), (5, 0.24, 3), 1, 0)]
)
def test_a_wall_of_nothing_equals_free_space(incidence, wall):
    p, rcs = tensors(swinging(4, 3, THROUGH.prf_hz), np.ones(3))
    air = EchoSynthesizer(THROUGH).double()(p, rcs)
    module = EchoSynthesizer(THROUGH, wall, multipath=True, incidence=incidence, bounces=12).double()
    assert (
        reference.relative(module(p, rcs), air) < 1e-8
    )  # a thin wall does so in the sum of its bounces only


def test_oblique_is_normal_on_the_axis():
    radar = RadarConfig.through_wall(tx_m=(0, 0, 1.5), rx_m=(0, 0, 1.5))
    p, rcs = f64(0.0, 3.0, 1.5)[None, None], torch.ones(1).double()
    wall = WallConfig(center_m=(0, 1, 1.5))
    results = [
        EchoSynthesizer(radar, wall, multipath=True, incidence=i, wall_echo=True).double()(p, rcs)
        for i in ("normal", "oblique")
    ]
    assert reference.relative(*results) < 1e-9


@pytest.mark.parametrize("incidence", ["normal", "oblique", "airy"])
@pytest.mark.parametrize("name", LEARNABLE)
def test_gradient_by_each_constant(name, incidence):
    radar = RadarConfig(2e9, 0.6e9, 40e-6, 256.0, 0.4e6)
    module = EchoSynthesizer(
        radar, WallConfig((0, 1, 1)), True, True, True, incidence=incidence, learnable=(name,)
    ).double()
    assert [n for n, _ in module.named_parameters()] == [f"paths.{name}"]
    p, rcs = tensors(swinging(2, 2, 256.0), np.ones(2))

    def echo(value):
        return torch.view_as_real(torch.func.functional_call(module, {f"paths.{name}": value}, (p, rcs)))

    value = getattr(module.paths, name).detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(echo, (value,), eps=1e-7, atol=1e-6, rtol=1e-3)
    assert float(torch.autograd.grad(echo(value).square().sum(), value)[0].abs().max()) > 0


@pytest.mark.parametrize("name", LEARNABLE)
def test_gradient_of_the_maps_by_each_constant(name):
    """Profiles and Doppler-time map, with noise of one seed: without a floor, magnitudes have kinks."""
    echo = EchoSynthesizer(SMALL, WallConfig((0, 1, 1)), multipath=True, learnable=(name,))
    simulator = RadarSimulator(SMALL, echo=echo, snr_db=10.0).double()
    p, rcs = tensors(swinging(35, 2, SMALL.prf_hz), np.ones(2))

    def maps(value):
        torch.manual_seed(0)
        found = torch.func.functional_call(simulator, {f"echo.paths.{name}": value}, (p, rcs))
        return found.range_time, found.doppler_time

    value = getattr(echo.paths, name).detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(maps, (value,), eps=1e-7, atol=1e-6, rtol=1e-3, fast_mode=True)
    assert float(torch.autograd.grad(maps(value)[1].sum(), value)[0].abs().max()) > 0


def test_constants_are_buffers_unless_learnable():
    assert EchoSynthesizer(THROUGH, WALL).state_dict() == {}
    module = EchoSynthesizer(THROUGH, WALL, learnable=("thickness_m", "rx_m"))
    assert set(module.state_dict()) == {"paths.thickness_m", "paths.rx_m"}
    assert module.paths.thickness_m.dtype == torch.float64
    assert not isinstance(module.paths.relative_permittivity, torch.nn.Parameter)


def test_a_learnable_wall_scripts():
    module = EchoSynthesizer(
        THROUGH, WALL, True, learnable=("relative_permittivity", "tx_m"), incidence="airy"
    )
    p, rcs = tensors(swinging(3, 2, 128.0), np.ones(2))
    torch.testing.assert_close(torch.jit.script(module)(p, rcs), module(p, rcs), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"incidence": "slanted"}, "incidence: got 'slanted'"),
        ({"polarization": "v"}, "polarization: got 'v'"),
        ({"bounces": 0}, "bounces: got 0"),
        ({"learnable": ("size_m",)}, "learnable: got 'size_m'"),
        ({"paths": ("direct", "echo")}, "paths: got 'echo'"),
        ({"paths": ("floor",)}, "'floor' without a floor"),
    ],
)
def test_unknown_options_are_refused(options, message):
    with pytest.raises(TensorsimError, match=message):
        EchoSynthesizer(THROUGH, WALL, **options)
    with pytest.raises(TensorsimError, match="without a wall"):
        EchoSynthesizer(THROUGH, learnable=("thickness_m",))

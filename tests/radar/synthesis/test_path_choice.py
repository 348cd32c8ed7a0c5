"""Which paths a scene has: names, contributions, side channels, and the floor."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import FloorConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tests.radar import reference
from tests.radar.scenes import SMALL, SceneCase, swinging, tensors
from tests.stage import assert_same

THROUGH = RadarConfig.through_wall()
BETWEEN = WallConfig(center_m=(0.0, 3.1, 1.5))  # some scatterers in front, some behind
FLOOR = FloorConfig()


class TestEchoWithFloor(SceneCase):
    def make(self):
        return EchoSynthesizer(SMALL, WallConfig((0, 3, 1.5)), multipath=True, floor=FLOOR, pulse_chunk=12)


def scene(pulses=5, scatterers=4, radar=THROUGH):
    return tensors(swinging(pulses, scatterers, radar.prf_hz), np.linspace(0.2, 1, scatterers))


def test_in_air_leaves_the_wall_out():
    p, rcs = scene()
    air = EchoSynthesizer(THROUGH).double()(p, rcs)
    assert_same(EchoSynthesizer(THROUGH, BETWEEN, paths=("direct_in_air",)).double()(p, rcs), air, atol=1e-12)
    assert reference.relative(EchoSynthesizer(THROUGH, BETWEEN).double()(p, rcs), air) > 0.1


@pytest.mark.parametrize("wall_paths", ["series", "paper"])
def test_without_attenuation_the_delay_stays(wall_paths):
    """The strength of free space at the delay behind the wall; bounces keep their ratio to the straight path."""
    p, rcs = scene()
    rcs = rcs.expand(p.shape[:-1])

    def paths(wall, attenuation):
        echo = EchoSynthesizer(
            THROUGH, wall, wall_paths=wall_paths, wall_attenuation=attenuation, multipath=True
        )
        return echo.paths(p, rcs)

    wall = WallConfig(center_m=(0.0, 2.0, 1.5))
    lossy, lossless, air = paths(wall, True), paths(wall, False), paths(None, True)
    behind = p[..., 1] > 2.12
    assert bool(behind.any())
    assert_same(lossless.delay_s, lossy.delay_s)
    assert_same(lossless.gain[..., 0].abs(), air.gain[..., 0].abs(), atol=1e-12)
    assert float((lossy.gain[..., 0] / lossless.gain[..., 0])[behind].abs().min()) < 0.9
    ratio = lossless.gain[behind] / lossless.gain[behind][:, :1]
    assert_same(ratio, lossy.gain[behind] / lossy.gain[behind][:, :1], atol=1e-10)


@pytest.mark.parametrize("wall_paths", ["series", "paper"])
def test_without_attenuation_a_wall_may_let_nothing_through(wall_paths):
    """The ratio of bounces to the straight passage has no quotient of numbers that are both 0."""
    wall = WallConfig(loss_tangent=100.0)
    options = {"wall_paths": wall_paths, "multipath": True, "wall_attenuation": False}
    p, rcs = scene()
    radar = replace(THROUGH, carrier_hz=77e9)
    with pytest.warns(TensorsimWarning, match="practically invisible"):
        module = EchoSynthesizer(radar, wall, **options).double()
    rcs = rcs.expand(p.shape[:-1])
    gain, air = module.paths(p, rcs).gain, EchoSynthesizer(radar).paths(p, rcs).gain
    assert_same(gain[..., :1].abs(), air.abs(), atol=1e-12)
    assert float(gain[..., 1:].abs().max()) == 0
    module(p.requires_grad_(), rcs).abs().sum().backward()
    assert bool(torch.isfinite(p.grad).all())


def test_bounces_and_images_are_apart():
    p, rcs = scene()
    both = EchoSynthesizer(THROUGH, BETWEEN, multipath=True, direct=False).double()(p, rcs)
    bounces = EchoSynthesizer(THROUGH, BETWEEN, paths=("wall_bounces",)).double()(p, rcs)
    images = EchoSynthesizer(THROUGH, BETWEEN, paths=("wall_images",)).double()(p, rcs)
    assert_same(bounces + images, both, atol=1e-12)
    front = (p[..., 1] <= 2.98).double()
    assert_same(EchoSynthesizer(THROUGH, BETWEEN, paths=("wall_images",)).double()(p, rcs * front), images)
    assert_same(
        EchoSynthesizer(THROUGH, BETWEEN, paths=("wall_bounces",)).double()(p, rcs * (1 - front)), bounces
    )
    assert float(bounces.abs().max()) > 0
    assert float(images.abs().max()) > 0


@pytest.mark.parametrize("floor", [FLOOR, FloorConfig(reflection=-0.5)])
@pytest.mark.parametrize("polarization", ["te", "tm"])
def test_floor_equals_the_definition(floor, polarization):
    point = (0.4, 3.0, 1.1)
    other = (
        "tm" if polarization == "te" else "te"
    )  # the field normal to one plane of incidence is in the other's
    legs = []
    for antenna in (THROUGH.tx_m, THROUGH.rx_m):
        r = float(reference.distance(np.array(point), antenna))
        legs.append([(r, r / C, 1.0), reference.floor_leg(point, antenna, floor, other)])
    delays, gains = reference.pair_legs(THROUGH, *legs)
    module = EchoSynthesizer(THROUGH, floor=floor, polarization=polarization).double()
    assert module.paths.path_names == ["direct", "floor-direct", "direct-floor", "floor-floor"]
    position = torch.tensor(point).double()[None, None]
    paths = module.paths(torch.tensor([point], dtype=torch.float64), torch.ones(1).double())
    order = [0, 2, 1, 3]  # the reference runs through the way back first
    np.testing.assert_allclose(paths.delay_s[0], delays[order], rtol=1e-14)
    np.testing.assert_allclose(paths.gain[0], gains[order], rtol=1e-10)
    actual = module(position, torch.ones(1).double())[0]
    assert (
        reference.relative(actual, reference.beat(THROUGH, delays, gains)) < 1e-6
    )  # position above is float32


@pytest.mark.parametrize(
    ("floor", "grazing", "upright", "lying"),
    [
        (FloorConfig(1000.0, 100.0), False, 1.0, -1.0),  # metal: the image of an upright dipole is upright
        (FloorConfig(), True, -1.0, -1.0),  # two rays cancel, however the antennas are polarised
    ],
)
def test_sign_of_the_floor(floor, grazing, upright, lying):
    point = torch.tensor([[0.0, 900.0 if grazing else 2.0, 0.1 if grazing else 1.0]]).double()
    for polarization, expected in (("te", upright), ("tm", lying)):
        paths = EchoSynthesizer(THROUGH, floor=floor, polarization=polarization).double().paths
        gain = paths(point, torch.ones(1).double()).gain[0]
        ratio = complex(gain[1] / gain[0])
        assert ratio / abs(ratio) == pytest.approx(expected, abs=0.05)


def test_without_attenuation_the_closed_slab_has_the_ripple_of_its_bounces_alone():
    wall, point = WallConfig(), torch.tensor([[[-0.1, 4.0, 1.5]]]).double()
    radar = replace(THROUGH, rx_m=THROUGH.tx_m)
    one = torch.ones(1).double()
    options = {"incidence": "airy", "wall_attenuation": False}
    found = EchoSynthesizer(radar, wall, **options).double()(point, one)
    air = EchoSynthesizer(radar).double()(point, one)
    delay = float(EchoSynthesizer(radar, wall, **options).paths(point[0], one).delay_s)
    f = radar.carrier_hz + radar.slope_hz_per_s * (np.arange(400) / radar.sample_rate_hz - delay)
    n, g, _, _ = reference.wall_terms(wall, radar.carrier_hz)
    once = g**2 * np.exp(-4j * np.pi * f * 0.24 * n.real / C + 4 * np.pi * f * 0.24 * n.imag / C)
    np.testing.assert_allclose((found / air).abs()[0], abs(1 / (1 - once)) ** 2, rtol=1e-6)


def test_floor_below_a_wall_of_air_is_the_floor_alone():
    p, rcs = scene()
    nothing = WallConfig((0, 1, 1.25), (50, 0.24, 2.5), 1.0, 0.0)
    alone = EchoSynthesizer(THROUGH, floor=FLOOR).double()(p, rcs)
    assert_same(EchoSynthesizer(THROUGH, nothing, floor=FLOOR).double()(p, rcs), alone, atol=1e-9)


def test_floor_legs_pass_the_wall_above_the_floor():
    """The mirrored leg crosses below z = 0; folded back it hits the wall, and is attenuated once more."""
    wall = WallConfig((0, 1, 1.25), (5, 0.24, 2.5))
    module = EchoSynthesizer(THROUGH, wall, floor=FLOOR).double()
    point, ones = torch.tensor([[0.0, 1.6, 0.2]]).double(), torch.ones(1).double()
    gain = module.paths(point, ones).gain[0]
    air = EchoSynthesizer(THROUGH, floor=FLOOR).double().paths(point, ones).gain[0]
    t0 = reference.wall_terms(wall, 2e9)[2]
    np.testing.assert_allclose(gain / air, np.full(4, np.conj(t0**2)), rtol=1e-9)


def test_nothing_comes_from_below_the_floor():
    point = torch.tensor([[0.0, 3.0, -0.1]]).double()
    gain = EchoSynthesizer(THROUGH, floor=FLOOR).double().paths(point, torch.ones(1).double()).gain[0]
    assert gain[0] != 0
    assert torch.equal(gain[1:], torch.zeros(3, dtype=torch.complex128))


@pytest.mark.parametrize("incidence", ["normal", "airy"])
def test_contributions_add_up_and_are_those_of_people(incidence):
    p, rcs = scene()
    module = EchoSynthesizer(THROUGH, BETWEEN, True, True, floor=FLOOR, incidence=incidence).double()
    groups = torch.tensor([0, 1, 1, 0])
    parts = module.contributions(p, rcs, groups)
    assert parts.shape == (2, len(module.paths.path_names), 5, 400)
    assert_same(parts.sum((0, 1)) + module.static_echo(), module(p, rcs), atol=1e-9)
    first = module(p, rcs * (groups == 0)) - module.static_echo()
    assert_same(parts[0].sum(0), first, atol=1e-9)
    direct = EchoSynthesizer(THROUGH, BETWEEN, incidence=incidence).double()(p, rcs)
    assert_same(parts.sum(0)[module.paths.path_names.index("direct")], direct, atol=1e-9)
    batch = module.contributions(torch.stack((p, p + 0.1)), rcs, groups)
    assert batch.shape == (2, 2, len(module.paths.path_names), 5, 400)
    assert_same(batch[0], parts, atol=1e-9)
    with pytest.raises(TensorsimError, match="groups: got"):
        module.contributions(p, rcs, groups[:2])
    with pytest.raises(TensorsimError, match="groups: got -1, expected numbers from 0"):
        module.contributions(p, rcs, groups - 1)


def test_side_channels_of_a_target_that_comes_straight_on():
    radar = replace(THROUGH, tx_m=(0, 0, 0), rx_m=(0, 0, 0))
    time = torch.arange(6).double() / radar.prf_hz
    p = torch.zeros(6, 1, 3).double()
    p[:, 0, 1] = 4 - 1.5 * time
    truth = EchoSynthesizer(radar).side_channels(p, torch.full((1,), 0.5).double())
    torch.testing.assert_close(truth.range_m[:, 0, 0], p[:, 0, 1], rtol=1e-12, atol=0)
    torch.testing.assert_close(truth.radial_speed_m_s, torch.full((6, 1, 1), 1.5).double(), rtol=1e-9, atol=0)
    amplitude = 10 * radar.wavelength_m * math.sqrt(0.5) / ((4 * math.pi) ** 1.5 * p[:, 0, 1] ** 2)
    torch.testing.assert_close(truth.amplitude[:, 0, 0], amplitude, rtol=1e-12, atol=0)
    still = EchoSynthesizer(radar).side_channels(p[:1], torch.ones(1).double())
    assert float(still.radial_speed_m_s) == 0.0


def test_side_channels_script_and_batch():
    p, rcs = scene()
    module = EchoSynthesizer(THROUGH, BETWEEN, multipath=True)
    truth = module.side_channels(p, rcs)
    assert truth.range_m.shape == (5, 4, 4)
    assert_same(torch.jit.script(module).side_channels(p, rcs), truth, atol=1e-12)
    batch = module.side_channels(torch.stack((p, p + 1)), rcs)
    for part, whole in zip(truth, batch, strict=True):
        assert_same(part, whole[0], atol=1e-12)


@pytest.mark.parametrize(
    "options",
    [{"relative_permittivity": 0.5}, {"loss_tangent": -1.0}, {"reflection": 1.5}, {"reflection": math.nan}],
)
def test_floor_that_is_not_physical_is_refused(options):
    with pytest.raises(TensorsimError, match=f"FloorConfig.{next(iter(options))}: got"):
        FloorConfig(**options)


@pytest.mark.parametrize("incidence", ["normal", "oblique", "airy"])
def test_empty_scenes_are_silent_in_every_mode(incidence):
    module = EchoSynthesizer(THROUGH, BETWEEN, True, floor=FLOOR, incidence=incidence)
    nobody = torch.zeros(3, 0, 3)
    assert torch.equal(module(nobody, torch.zeros(0)), torch.zeros(3, 400, dtype=torch.complex64))
    with pytest.raises(TensorsimError, match="contributions: got a scene without"):
        module.contributions(nobody, torch.zeros(0), torch.zeros(0, dtype=torch.long))

"""Where the wall stands, its coefficients, and the paths that geometry gives."""

import cmath
import math
import warnings

import numpy as np
import pytest
import torch

from tensorsim.config import SPEED_OF_LIGHT_M_S as C
from tensorsim.config import RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, TensorsimWarning
from tensorsim.ops import safe_sqrt
from tensorsim.radar.synthesis.legs import leg_length, mirror_delays
from tensorsim.radar.synthesis.paths import PropagationPaths, radar_equation_amplitude
from tensorsim.radar.synthesis.wall import (
    one_way_loss_db,
    place_wall,
    slab_coefficients,
    transmission,
    two_way_wall_transmission,
    wall_tensors,
)
from tests.radar import reference
from tests.stage import assert_same

RADAR = RadarConfig.through_wall()
FAR_WALL = WallConfig(center_m=(0.0, 5.12, 1.5))  # near face at y = 5


def paths_module(wall, radar=RADAR, multipath=False, **options):
    names = ("direct", "wall_bounces", "wall_images") if multipath else ("direct",)
    return PropagationPaths(radar, wall, names, **options)


def normal_slab(wall, frequency=RADAR.carrier_hz):
    """The slab of the module under test as Python numbers: G, T0, T1, excess and bounce delay."""
    slab = slab_coefficients(*wall_tensors(wall), frequency, torch.ones(()).double())
    return (
        complex(slab.reflection),
        complex(transmission(slab, 0)),
        complex(transmission(slab, 1)),
        float(slab.excess_s),
        float(slab.bounce_s),
    )


def paths_of(point, wall, radar=RADAR, **options):
    module = paths_module(wall, radar, **options)
    position = torch.tensor([point], dtype=torch.float64)
    paths = module(position, torch.ones(1, dtype=torch.float64))
    return paths.delay_s[0].numpy(), paths.gain[0].numpy()


def test_worked_case_of_a_target_in_front_of_a_wall():
    delay, gain = paths_of((0.5, 3.0, 1.0), FAR_WALL, multipath=True)
    np.testing.assert_allclose(delay * C, [6.1676, 10.1110, 10.1292, 14.0727], atol=5e-5)
    g = normal_slab(FAR_WALL)[0].conjugate()
    p, tx, rx = map(np.array, ((0.5, 3.0, 1.0), (-0.1, 0.0, 1.5), (0.1, 0.0, 1.5)))
    tx_image, rx_image = tx + np.array((0, 10, 0)), rx + np.array((0, 10, 0))
    legs = [(tx, rx), (tx_image, rx), (tx, rx_image), (tx_image, rx_image)]
    spread = [np.linalg.norm(p - a) * np.linalg.norm(p - b) for a, b in legs]
    expected = np.array([1, g, g, g * g]) / spread  # every path spreads over its own legs
    np.testing.assert_allclose(gain / gain[0], expected / expected[0], rtol=1e-12)


def test_amplitude_is_the_radar_equation():
    _, gain = paths_of((0.5, 3.0, 1.0), None)
    legs = [math.dist((0.5, 3.0, 1.0), a) for a in (RADAR.tx_m, RADAR.rx_m)]
    expected = 10 * 10 * (C / 2e9) ** 2 / ((4 * math.pi) ** 3 * legs[0] ** 2 * legs[1] ** 2)
    np.testing.assert_allclose(abs(gain[0]) ** 2, expected, rtol=1e-12)


@pytest.mark.parametrize(("rcs", "factor"), [(1.0, 1 / 16), (4.0, 1 / 4)])
def test_power_falls_with_the_fourth_power_of_range_and_rises_with_rcs(rcs, factor):
    module = PropagationPaths(RadarConfig(tx_m=(0, 0, 0), rx_m=(0, 0, 0)))
    near = module(torch.tensor([[0.0, 2.0, 0.0]]).double(), torch.ones(1).double()).gain
    far = module(torch.tensor([[0.0, 4.0, 0.0]]).double(), torch.full((1,), rcs).double()).gain
    assert float((far.abs() / near.abs()) ** 2) == pytest.approx(factor, rel=1e-12)


def test_through_wall_terms():
    wall = WallConfig()
    _, _, t0, t1 = reference.wall_terms(wall, RADAR.carrier_hz)
    point = (0.5, 3.0, 1.0)
    air, plain = paths_of(point, None)
    d, n = wall.size_m[1], wall.refractive_index.real
    delay, gain = paths_of(point, wall, multipath=True)
    once = 2 * d * (2 * n - 1)  # one leg bounced: out, or back
    excess = np.array([2 * d * (n - 1), once, once, 2 * d * (3 * n - 1)]) / C
    np.testing.assert_allclose(delay - air, excess, atol=1e-18)
    np.testing.assert_allclose(gain / plain, np.conj([t0**2, t0 * t1, t0 * t1, t1**2]), rtol=1e-12)
    np.testing.assert_allclose(paths_of(point, wall)[1], gain[:1], rtol=1e-15)


def test_literal_paper_formula():
    """T0^2 and T1^2 with exp(-j beta d) per passage, in the amplitude and again in the delay; no 2 T0 T1."""
    wall, point, f = WallConfig(), (0.5, 3.0, 1.0), RADAR.carrier_hz
    air, plain = paths_of(point, None)
    n = np.sqrt(6 * (1 - 0.03j))
    d, k = 0.24, 2 * np.pi * f / C
    alpha, beta = -k * n.imag, k * n.real
    g = (1 - n) / (1 + n)
    t0 = (1 + g) * (1 - g) * np.exp(-alpha * d) * np.exp(-1j * beta * d)
    t1 = (1 + g) * g**2 * (1 - g) * np.exp(-3 * alpha * d) * np.exp(-3j * beta * d)
    delay, gain = paths_of(point, wall, multipath=True, wall_paths="paper")
    excess = np.array([2 * d * (n.real - 1), 2 * d * (3 * n.real - 1)]) / C
    np.testing.assert_allclose(delay[[0, 3]] - air, excess, atol=1e-18)
    np.testing.assert_allclose(gain / plain, np.conj([t0**2, 0, 0, t1**2]), rtol=1e-11)
    series = paths_of(point, wall, multipath=True)[1]
    np.testing.assert_allclose(abs(gain[[0, 3]]), abs(series[[0, 3]]), rtol=1e-12)
    assert abs(np.angle(gain[0] / series[0])) > 0.1  # the phase does differ


@pytest.mark.parametrize("wall_paths", ["series", "paper"])
def test_paper_option_changes_nothing_in_front_of_the_wall(wall_paths):
    delay, gain = paths_of((0.5, 3.0, 1.0), FAR_WALL, multipath=True, wall_paths=wall_paths)
    _, plain = paths_of((0.5, 3.0, 1.0), FAR_WALL, multipath=True)
    np.testing.assert_array_equal(gain, plain)
    assert delay.shape == (4,)


def test_two_way_wall_transmission():
    """Term by term against NumPy, and their sum against the path list of a target behind the wall."""
    wall, point = WallConfig(), (0.5, 3.0, 1.0)
    terms = two_way_wall_transmission(slab_coefficients(*wall_tensors(wall), 2e9, torch.ones(()).double()))
    _, _, t0, t1 = reference.wall_terms(wall, 2e9)
    np.testing.assert_allclose(terms.gain, [t0**2, 2 * t0 * t1, t1**2], rtol=1e-12)
    d, n = wall.size_m[1], wall.refractive_index.real
    expected = np.array([2 * d * (n - 1), 2 * d * (n - 1) + 2 * d * n, 2 * d * (n - 1) + 4 * d * n]) / C
    np.testing.assert_allclose(terms.delay_s, expected, rtol=1e-12)
    air, plain = paths_of(point, None)
    delay, gain = paths_of(point, wall, multipath=True)
    np.testing.assert_allclose(air + terms.delay_s.numpy(), delay[[0, 1, 3]], rtol=1e-14)
    found = np.conj(terms.gain.numpy()) * plain
    np.testing.assert_allclose(found, [gain[0], gain[1] + gain[2], gain[3]], rtol=1e-12)
    scripted = torch.jit.script(two_way_wall_transmission)
    slab = slab_coefficients(*wall_tensors(wall), 2e9, torch.ones(3).double())
    assert_same(scripted(slab), two_way_wall_transmission(slab))


def test_mirror_delays():
    """The worked case: antennas 0.2 m apart, a target at (0.5, 3, 1), the face at y = 5."""
    point, tx, rx = (
        torch.tensor([[0.5, 3.0, 1.0], [-0.3, 4.0, 0.2]], dtype=torch.float64),
        RADAR.tx_m,
        RADAR.rx_m,
    )
    tx_m, rx_m = torch.tensor([tx, rx], dtype=torch.float64)
    delays = mirror_delays(point, tx_m, rx_m, 5.0)
    assert delays.shape == (2, 3)
    np.testing.assert_allclose(delays[0] * C, [10.1110, 10.1292, 14.0727], atol=5e-5)
    for p, found in zip(point, delays, strict=True):
        listed, _ = paths_of(p.tolist(), FAR_WALL, multipath=True)
        np.testing.assert_allclose(found, listed[1:], rtol=1e-14)
    assert_same(torch.jit.script(mirror_delays)(point, tx_m, rx_m, 5.0), delays)


def test_radar_equation_amplitude():
    out, back, rcs = 3.0, 4.0, 0.5
    found = radar_equation_amplitude(*map(torch.tensor, (rcs, out, back)), 0.15, 20.0, 5.0)
    power = 20.0 * 5.0 * 0.15**2 * rcs / ((4 * math.pi) ** 3 * out**2 * back**2)
    assert float(found) == pytest.approx(math.sqrt(power), rel=1e-6)
    scripted = torch.jit.script(radar_equation_amplitude)
    assert_same(scripted(*map(torch.tensor, (rcs, out, back)), 0.15, 20.0, 5.0), found)


def test_wall_factors_in_decibels():
    _, t0, t1, _, _ = normal_slab(WallConfig())
    relative = abs(t1 / t0)
    assert 20 * math.log10(2 * relative) == pytest.approx(-15.5, abs=0.1)
    assert 20 * math.log10(relative**2) == pytest.approx(-43, abs=0.2)
    assert one_way_loss_db(WallConfig(), 77e9) == pytest.approx(125, abs=0.6)


@pytest.mark.parametrize("eps", [1.5, 6.0, 12.0])
@pytest.mark.parametrize("thickness", [0.01, 0.24])
def test_lossless_slab_keeps_energy(eps, thickness):
    wall = WallConfig(size_m=(5, thickness, 2.5), relative_permittivity=eps, loss_tangent=0.0)
    g, t0, t1, _, bounce = normal_slab(wall)
    assert abs(g) ** 2 + abs(t0) == pytest.approx(1, abs=1e-12)  # one interface: 1 - G^2 passes
    # T0 and T1 are the first terms of the Airy series; summed up with its phase, it keeps energy.
    turn = cmath.exp(-2j * math.pi * 2e9 * bounce)
    through = t0 / (1 - t1 / t0 * turn)
    back = g - g * t0 * turn / (1 - t1 / t0 * turn)
    assert abs(through) ** 2 + abs(back) ** 2 == pytest.approx(1, abs=1e-12)
    phase = 2 * math.pi * 2e9 * thickness * math.sqrt(eps) / C  # Born and Wolf, 7.6: Fabry-Perot transmission
    finesse = (2 * g.real / (1 - g.real**2)) ** 2
    assert abs(through) ** 2 == pytest.approx(1 / (1 + finesse * math.sin(phase) ** 2), abs=1e-12)


def test_a_target_beside_the_wall_is_in_free_space():
    wall = WallConfig(center_m=(0.0, 2.0, 1.5), size_m=(2.0, 0.24, 2.5))
    for point in [(3.0, 3.0, 1.5), (0.0, 2.3, -4.0), (-3.0, 2.5, 1.0)]:
        delay, gain = paths_of(point, wall, multipath=True)
        air, plain = paths_of(point, None)
        np.testing.assert_allclose(delay[0], air[0], rtol=1e-15)
        np.testing.assert_allclose(gain, [plain[0], 0, 0, 0], rtol=1e-15)


def test_one_leg_through_the_wall():
    wall = WallConfig(center_m=(-1.0, 2.0, 1.5), size_m=(2.0, 0.24, 2.5))  # ends at x = 0
    _, t0, t1, excess, _ = normal_slab(wall)
    delay, gain = paths_of((0.0, 4.0, 1.5), wall, multipath=True)
    # Tx at -0.1 sees it through, Rx at 0.1 past it
    air, plain = paths_of((0.0, 4.0, 1.5), None)
    assert delay[0] - air[0] == pytest.approx(excess, abs=1e-18)
    expected = np.conj([t0, t1, 0, 0])
    np.testing.assert_allclose(gain / plain[0], expected, rtol=1e-12)


def test_case_follows_geometry_per_scatterer_and_pulse():
    module = paths_module(FAR_WALL, multipath=True)
    p = torch.tensor([[[0.0, 4.99, 1.5]], [[0.0, 5.01, 1.5]], [[0.0, 5.1, 1.5]], [[0.0, 5.3, 1.5]]]).double()
    gain = module(p, torch.ones(4, 1).double()).gain[:, 0]
    g, t0, t1, _, _ = normal_slab(FAR_WALL)
    ratio = (gain[:, 1] / gain[:, 0]).abs()
    assert float(ratio[0]) == pytest.approx(abs(g), rel=0.02)  # mirrored
    expected = abs(t1 / t0)
    assert ratio[1:].tolist() == pytest.approx([expected] * 3, rel=1e-9)  # inside the slab counts as behind


@pytest.mark.parametrize(
    "wall",
    [
        WallConfig(size_m=(5, 0.0, 2.5)),
        WallConfig(relative_permittivity=1.0, loss_tangent=0.0),
        WallConfig(center_m=(0, 5, 1.5), relative_permittivity=1.0, loss_tangent=0.0),
    ],
)
def test_no_wall_equals_free_space(wall):
    for point in [(0.5, 3.0, 1.0), (0.0, 6.0, 1.2)]:
        delay, gain = paths_of(point, place_wall(wall, RADAR), multipath=True)
        air, plain = paths_of(point, None)
        np.testing.assert_allclose(delay[0], air[0], rtol=1e-15)
        np.testing.assert_allclose(gain, np.pad(plain, (0, gain.size - 1)), rtol=1e-15)


def test_wall_around_the_antennas_is_moved():
    with pytest.warns(TensorsimWarning, match="moved so that its near face touches"):
        wall = place_wall(WallConfig(center_m=(-0.1, 0.0, 1.5)), RADAR)
    assert wall.center_m == (-0.1, 0.12, 1.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert place_wall(WallConfig(), RADAR) == WallConfig()


def test_wall_behind_the_antennas_is_refused():
    with pytest.raises(TensorsimError, match="a wall behind them has no effect"):
        place_wall(WallConfig(center_m=(0, -1, 1.5)), RADAR)
    with pytest.raises(TensorsimError, match="a wall behind them has no effect"):
        place_wall(WallConfig(center_m=(0, -0.12, 1.5)), RADAR)
    apart = RadarConfig.through_wall(rx_m=(0.0, 5.0, 1.5))
    with pytest.raises(TensorsimError, match=r"far face is at y = 2.12 m, .* the foremost at y = 5 m"):
        place_wall(WallConfig(center_m=(0, 2, 1.5)), apart)


def test_opaque_wall_warns():
    with pytest.warns(TensorsimWarning, match="-125 dB one way at 77 GHz"):
        place_wall(WallConfig(), RadarConfig.free_space())


def test_unknown_wall_paths_are_refused():
    with pytest.raises(TensorsimError, match="wall_paths: got 'airy'"):
        PropagationPaths(RADAR, WallConfig(), wall_paths="airy")
    with pytest.raises(TensorsimError, match="wall_paths: got 'paper' with incidence 'airy'"):
        PropagationPaths(RADAR, WallConfig(), wall_paths="paper", incidence="airy")


def test_square_root_and_legs_have_finite_gradients_at_zero():
    x = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    (safe_sqrt(x).sum()).backward()
    assert torch.equal(x.grad, torch.zeros(2).double())
    p = torch.tensor([[-0.1, 0.0, 1.5]], dtype=torch.float64, requires_grad=True)
    length = leg_length(p, torch.tensor([-0.1, 0.0, 1.5]).double(), 0.01)
    length.sum().backward()
    assert length.item() == pytest.approx(0.01)
    assert torch.isfinite(p.grad).all()

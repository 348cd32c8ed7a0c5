"""Points against targets at known places."""

import math

import pytest
import torch

from tensorsim.errors import TensorsimError
from tensorsim.radar.processing.point_cloud import PointCloud, beam_sines, local_maxima
from tests.radar.scenes import complex_noise
from tests.stage import StageTester

R, F, A = 20, 16, 4


def targets(places, dtype=torch.complex128):
    """A cube (A, R, F) of single cells: (range bin, Doppler bin, sine, amplitude)."""
    cube = torch.zeros(A, R, F, dtype=dtype)
    for r, f, sine, amplitude in places:
        # Half a wavelength apart: pi sin(theta) from antenna to antenna.
        cube[:, r, f] = amplitude * torch.exp(1j * math.pi * sine * torch.arange(A, dtype=torch.float64))
    return cube


class TestPointCloud(StageTester):
    gradient_arguments = ()  # which cells are chosen has no gradient; their power has, below

    def make(self):
        return PointCloud(0.04, 0.6, points=12, beams=32)

    def inputs(self, batch, dtype):
        cube = complex_noise(*batch, A, R, F, dtype=dtype)
        return cube, cube.abs().square().mean(-3) > 1.5

    batched_arguments = (0, 1)

    def bad_inputs(self):
        cube, found = self.inputs((), torch.float32)
        return [
            ((cube.abs(), found), "cube: got dtype torch.float32, expected a complex tensor"),
            ((cube[:, :0], found[:0]), "cube: got an empty tensor"),
            ((cube, found.tolist()), "detected: got list, expected a tensor"),
            ((cube[0], found[0]), "cube: got shape"),
            ((cube, found[1:]), r"detected: got torch.bool of shape \[19, 16\]"),
            ((cube, found.float()), "detected: .*expected bool"),
        ]


def test_targets_come_back_strongest_first():
    places = [(3, 8, 0.0, 1.0), (10, 2, 0.5, 3.0), (15, 13, -0.3, 2.0)]
    cube = targets(places)
    points = PointCloud(0.04, 0.6, points=5)(cube, cube.abs().square().mean(0) > 0)
    assert points.valid.tolist() == [True, True, True, False, False]
    expected = [places[1], places[2], places[0]]
    for i, (r, f, sine, amplitude) in enumerate(expected):
        assert float(points.range_m[i]) == pytest.approx(0.04 * r)
        assert float(points.speed_m_s[i]) == pytest.approx(0.6 * (f - 8))
        assert float(points.sine[i]) == pytest.approx(sine, abs=0.02)
        assert float(points.power[i]) == pytest.approx(amplitude**2)
    assert all(float(x[3:].abs().sum()) == 0 for x in (points.range_m, points.speed_m_s, points.sine))


def test_only_peaks_are_kept_unless_asked():
    cube = targets([(5, 5, 0.0, 2.0), (5, 6, 0.0, 1.0), (6, 5, 0.0, 1.0)])
    found = cube.abs().square().mean(0) > 0
    assert int(PointCloud(0.04, 0.6)(cube, found).valid.sum()) == 1
    assert int(PointCloud(0.04, 0.6, peaks_only=False)(cube, found).valid.sum()) == 3


def test_what_was_not_detected_is_no_point():
    cube = targets([(5, 5, 0.0, 2.0), (12, 9, 0.0, 9.0)])
    found = torch.zeros(R, F, dtype=torch.bool)
    found[5, 5] = True
    points = PointCloud(1.0, 1.0, points=3)(cube, found)
    assert points.range_m[points.valid].tolist() == [5.0]


def test_a_map_with_fewer_cells_than_points():
    cube = targets([(1, 1, 0.0, 1.0)])[:, :3, :2]
    points = PointCloud(1.0, 1.0, points=10)(cube, torch.ones(3, 2, dtype=torch.bool))
    assert points.valid.shape == (10,)
    assert int(points.valid.sum()) < 6 < 10


@pytest.mark.parametrize("spacing", [0.5, 1.0])
def test_sines_of_plane_waves(spacing):
    sines = torch.linspace(-0.45, 0.45, 31, dtype=torch.float64)
    waves = torch.exp(2j * math.pi * spacing * sines[:, None] * torch.arange(8, dtype=torch.float64))
    torch.testing.assert_close(beam_sines(waves, spacing, 128), sines, atol=2e-3, rtol=0)


def test_local_maxima_equal_a_loop():
    power = torch.rand(2, 9, 7, generator=torch.Generator().manual_seed(0))
    expected = torch.zeros_like(power, dtype=torch.bool)
    for b in range(2):
        for i in range(9):
            for j in range(7):
                near = power[b, max(0, i - 1) : i + 2, [j - 1, j, (j + 1) % 7]]
                expected[b, i, j] = power[b, i, j] >= near.max()
    assert torch.equal(local_maxima(power), expected)


def test_power_is_differentiable():
    cube = targets([(3, 8, 0.1, 1.0), (10, 2, 0.5, 3.0)]).requires_grad_(True)
    found = cube.detach().abs().square().mean(0) > 0
    PointCloud(0.04, 0.6, points=2)(cube, found).power.sum().backward()
    torch.testing.assert_close(cube.grad, 2 * cube.detach() / A)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": 0}, "points: got 0"),
        ({"points": 1.5}, "points: got 1.5, expected an integer"),
        ({"beams": 1}, "beams: got 1"),
        ({"beams": math.inf}, "beams: got inf"),
        ({"spacing_wavelengths": 0.0}, "spacing"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(TensorsimError, match=message):
        PointCloud(0.04, 0.6, **settings)


@pytest.mark.parametrize(("rows", "columns"), [(2, 6), (6, 2)])
def test_maps_of_a_batch_with_fewer_cells_than_points(rows, columns):
    cube = complex_noise(3, A, rows, columns)
    found = torch.ones(3, rows, columns, dtype=torch.bool)
    points = PointCloud(1.0, 1.0, points=20, peaks_only=False)(cube, found)
    assert points.valid.sum(-1).tolist() == [12, 12, 12], "every cell is a point"
    assert not points.valid[:, 12:].any()

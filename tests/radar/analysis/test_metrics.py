"""Map metrics against their formulas in NumPy and against worked cases."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from tensorsim.errors import TensorsimError
from tensorsim.radar.analysis import metrics


def pair(shape=(2, 40, 30)):
    rng = np.random.default_rng(3)
    a = gaussian_filter(rng.random(shape), 1.5) ** 4
    return a, a * rng.uniform(0.5, 1.5, shape)


def scaled(x, scale):
    level = x / x.max((-2, -1), keepdims=True)
    if scale == "linear":
        return level
    return np.clip(20 * np.log10(level) + 40, 0, None) / 40


@pytest.mark.parametrize("scale", ["linear", "db"])
def test_figures_equal_their_formulas(scale):
    a, b = pair()
    x, y = torch.as_tensor(a), torch.as_tensor(b)
    u, v = scaled(a, scale), scaled(b, scale)
    np.testing.assert_allclose(metrics.normalise(x, scale), u, atol=1e-12)
    mse = ((u - v) ** 2).mean((1, 2))
    np.testing.assert_allclose(metrics.psnr(x, y, scale), 10 * np.log10(1 / mse), rtol=1e-10)
    np.testing.assert_allclose(
        metrics.nmse(x, y, scale), ((u - v) ** 2).sum((1, 2)) / (v**2).sum((1, 2)), rtol=1e-10
    )
    for k in range(2):

        def blur(image):
            return gaussian_filter(image, 1.5, truncate=3.5)[5:-5, 5:-5]  # 11 x 11, inside only

        mu, mv = blur(u[k]), blur(v[k])
        su, sv, suv = blur(u[k] ** 2) - mu**2, blur(v[k] ** 2) - mv**2, blur(u[k] * v[k]) - mu * mv
        expected = (2 * mu * mv + 1e-4) * (2 * suv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (su + sv + 9e-4))
        assert float(metrics.ssim(x, y, scale)[k]) == pytest.approx(expected.mean(), rel=1e-9)


def test_ssim_of_the_smallest_map_is_that_of_one_window():
    rng = np.random.default_rng(1)
    u, v = rng.random((2, 11, 11))
    u, v = u / u.max(), v / v.max()
    bell = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    weight = np.outer(bell, bell) / bell.sum() ** 2
    mu, mv = (weight * u).sum(), (weight * v).sum()
    su, sv, suv = ((weight * x).sum() for x in ((u - mu) ** 2, (v - mv) ** 2, (u - mu) * (v - mv)))
    expected = (2 * mu * mv + 1e-4) * (2 * suv + 9e-4) / ((mu**2 + mv**2 + 1e-4) * (su + sv + 9e-4))
    found = metrics.ssim(torch.as_tensor(u), torch.as_tensor(v), "linear")
    assert float(found) == pytest.approx(expected, rel=1e-9)


def test_equal_maps_and_gain():
    """Every map is set against its own peak, so gain does not count."""
    x = torch.as_tensor(pair()[0])
    for scale in ("linear", "db"):
        assert float(metrics.ssim(x, 3 * x, scale).min()) == pytest.approx(1.0)
        assert float(metrics.nmse(x, 3 * x, scale).max()) < 1e-25
        assert float(metrics.psnr(x, x, scale).min()) == math.inf
    np.testing.assert_allclose(metrics.entropy(5 * x), metrics.entropy(x), rtol=1e-12)


def test_decibel_scale_clips_at_its_range():
    x = torch.tensor([[1.0, 0.1, 0.01, 1e-3, 0.0]])
    np.testing.assert_allclose(metrics.normalise(x), [[1.0, 0.5, 0.0, 0.0, 0.0]], atol=1e-6)
    np.testing.assert_allclose(metrics.normalise(x, "db", 60.0), [[1, 2 / 3, 1 / 3, 0, 0]], atol=1e-6)
    assert torch.equal(metrics.normalise(torch.zeros(3, 3), "linear"), torch.zeros(3, 3))


def test_entropy_of_known_maps():
    point = torch.zeros(8, 4)
    point[3, 2] = 7.0
    four = torch.zeros(8, 4)
    four[:4, 0] = 2.0
    maps = torch.stack((point, four, torch.ones(8, 4), torch.zeros(8, 4)))
    assert metrics.entropy(maps).tolist() == pytest.approx([0.0, math.log(4), math.log(32), 0.0], abs=1e-6)
    two = torch.tensor([[1.0, 3.0]])  # powers 0.1 and 0.9
    assert float(metrics.entropy(two)) == pytest.approx(-0.1 * math.log(0.1) - 0.9 * math.log(0.9), rel=1e-6)


def test_gradient_of_entropy_in_closed_form():
    """dH / dm = -2 m (ln p + H) / sum m^2, which is 0 in a cell of 0."""
    m = np.array([[1.0, 3.0], [0.0, 2.0]])
    x = torch.tensor(m, requires_grad=True)
    metrics.entropy(x).backward()
    p = m**2 / 14
    slope = np.log(p, where=p > 0, out=np.zeros_like(p)) + metrics.entropy(x).item()
    np.testing.assert_allclose(x.grad, -2 * m * slope / 14, rtol=1e-12)


def test_level_envelope():
    axis = torch.linspace(-2, 2, 9)
    x = torch.zeros(9, 4)
    x[2:7, 0] = 1.0  # -1 to 1
    x[8, 1] = 0.2  # -14 dB: inside
    x[0, 1] = 0.05  # -26 dB: outside
    x[4, 2] = 0.05
    upper, lower = metrics.level_envelope(x, axis)
    np.testing.assert_array_equal(upper, [1.0, 2.0, np.nan, np.nan])
    np.testing.assert_array_equal(lower, [-1.0, 2.0, np.nan, np.nan])
    assert metrics.level_envelope(x, axis, 30.0).lower[:3].tolist() == [-1.0, -2.0, 0.0]


def test_percentile_envelope_equals_interpolated_energy():
    rng = np.random.default_rng(0)
    x = rng.random((50, 12))
    axis = np.linspace(-3, 4, 50)
    width = axis[1] - axis[0]
    envelope = metrics.percentile_envelope(torch.as_tensor(x), torch.as_tensor(axis), 90.0)
    x = np.where(x >= 0.01 * x.max(), x, 0)
    for k in range(12):
        energy = np.concatenate(([0], np.cumsum(x[:, k] ** 2))) / (x[:, k] ** 2).sum()
        edges = np.append(axis - width / 2, axis[-1] + width / 2)
        assert float(envelope.upper[k]) == pytest.approx(np.interp(0.9, energy, edges), abs=1e-9)
        assert float(envelope.lower[k]) == pytest.approx(np.interp(0.1, energy, edges), abs=1e-9)
    silent = metrics.percentile_envelope(torch.zeros(50, 2), torch.as_tensor(axis))
    assert bool(torch.isnan(silent.upper).all())
    assert bool(torch.isnan(silent.lower).all())


def test_percentile_envelope_ignores_what_is_below_the_floor():
    x = torch.full((201, 3), 0.009)
    x[100] = 1.0
    axis = torch.linspace(-10, 10, 201)
    upper, lower = metrics.percentile_envelope(x, axis)
    assert (
        float(upper.max())
        < 0.05
        < 1.0
        < float(metrics.percentile_envelope(x, axis, floor_db=60.0).upper[0]) + 2
    )
    np.testing.assert_allclose(lower, -upper, atol=1e-5)


def test_percentile_envelope_is_differentiable():
    x = torch.rand(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    axis = torch.linspace(-1, 1, 20).double()
    assert torch.autograd.gradcheck(lambda m: tuple(metrics.percentile_envelope(m, axis)), (x,))


@pytest.mark.parametrize("scale", ["linear", "db"])
def test_gradients_against_finite_differences(scale):
    generator = torch.Generator().manual_seed(8)
    a, b = (0.2 + torch.rand(12, 13, dtype=torch.float64, generator=generator) for _ in range(2))

    def figures(x, y):
        pairs = [figure(x, y, scale) for figure in (metrics.psnr, metrics.nmse, metrics.ssim)]
        return *pairs, metrics.entropy(x)

    assert torch.autograd.gradcheck(figures, (a.requires_grad_(), b.requires_grad_()), fast_mode=True)


def test_envelope_rmse_of_a_shift_is_the_shift():
    axis = torch.linspace(-4, 4, 81).double()
    k = torch.arange(30)
    centre = 1.5 * torch.sin(k / 5)

    def body(shift):
        x = torch.exp(-(((axis[:, None] - centre - shift) / 0.3) ** 2))
        x[:, 7] = 0  # a frame that neither has
        return x

    for outline in (metrics.level_envelope, metrics.percentile_envelope):
        error = metrics.envelope_rmse(outline(body(0.4), axis), outline(body(0.0), axis))
        assert float(error) == pytest.approx(0.4, abs=1e-3)
    nothing = metrics.level_envelope(torch.zeros(81, 3), axis)
    assert math.isnan(metrics.envelope_rmse(nothing, nothing))


def test_any_batch_dimensions():
    a, b = (torch.as_tensor(x).reshape(2, 1, 40, 30).expand(2, 3, 40, 30) for x in pair())
    axis = torch.arange(40.0)
    for figure in (metrics.psnr, metrics.nmse, metrics.ssim):
        whole = figure(a, b)
        assert whole.shape == (2, 3)
        assert float(whole[1, 2]) == pytest.approx(float(figure(a[1, 2], b[1, 2])))
    assert metrics.entropy(a).shape == (2, 3)
    envelope = metrics.level_envelope(a, axis)
    assert envelope.upper.shape == (2, 3, 30)
    assert metrics.envelope_rmse(envelope, envelope).shape == (2, 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x, axis: metrics.psnr(x, x[:-1]), "expected the reference's"),
        (lambda x, axis: metrics.nmse(x, x, "log"), "scale: got 'log'"),
        (lambda x, axis: metrics.normalise(x, "db", 0.0), "range_db: got 0.0"),
        (lambda x, axis: metrics.entropy(-x), "negative"),
        (lambda x, axis: metrics.entropy(x + float("nan")), "map: got NaN"),
        (lambda x, axis: metrics.entropy(x[0]), "map: got shape"),
        (lambda x, axis: metrics.entropy(x[:, :0]), "map: got shape"),
        (lambda x, axis: metrics.ssim(x[:5], x[:5]), "at least 11 x 11"),
        (lambda x, axis: metrics.level_envelope(x, axis[:3]), "axis: got shape"),
        (lambda x, axis: metrics.level_envelope(x, axis.flip(0)), "ascending"),
        (lambda x, axis: metrics.level_envelope(x, axis, -1.0), "level_db: got -1.0"),
        (lambda x, axis: metrics.percentile_envelope(x, axis, 40.0), "percentile: got 40.0"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(TensorsimError, match=message):
        call(torch.ones(20, 20), torch.arange(20.0))

from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.vision.pose2d.heatmaps import METHODS, HeatmapDecoder, sides_apart
from tests.stage import StageTester


def gaussians(centres: Tensor, height: int = 64, width: int = 48, sigma: float = 2.0) -> Tensor:
    """Maps (..., h, w) with a peak of height 1 at ``uv`` (..., 2)."""
    u = torch.arange(width, dtype=centres.dtype) - centres[..., 0, None]
    v = torch.arange(height, dtype=centres.dtype) - centres[..., 1, None]
    return torch.exp(-(v[..., :, None] ** 2 + u[..., None, :] ** 2) / (2 * sigma**2))


def noisy_maps(batch: tuple[int, ...], dtype: torch.dtype = torch.float32) -> Tensor:
    """Two people per map and noise, peaks also at the border."""
    generator = torch.Generator().manual_seed(3)
    maps = torch.zeros(*batch, 5, 20, 16, dtype=torch.float64)
    for height in (1.0, 0.6):
        centres = torch.rand(*batch, 5, 2, generator=generator, dtype=torch.float64)
        maps += height * gaussians(centres * torch.tensor([15.0, 19.0]), 20, 16)
    return (maps + 0.02 * torch.rand(maps.shape, generator=generator, dtype=torch.float64)).to(dtype)


class TestQuarter(StageTester):
    method = "quarter"

    def make(self) -> nn.Module:
        return HeatmapDecoder(self.method)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (noisy_maps(batch, dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(48),), r"expected \(..., h, w\)"),
            ((torch.zeros(2, 17, 0, 48),), "with pixels"),
            ((torch.zeros(2, 17, 64, 0),), "with pixels"),
            ((torch.zeros(2, 17, 64, 48, dtype=torch.int64),), "floating"),
        ]


class TestDark(TestQuarter):
    method = "dark"


class TestExpected(TestQuarter):
    method = "expected"


class TestSidesApart(TestDark):
    def make(self) -> nn.Module:
        return HeatmapDecoder(self.method, pairs=((0, 1), (2, 4)))

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        few = (torch.zeros(2, 4, 64, 48),)
        return [*super().bad_inputs(), (few, r"got shape \[2, 4, 64, 48\], expected .* at least 5 maps")]


def two_peaks(first: float, second: float) -> Tensor:
    """A map of two legs: peaks of these heights at (12, 50) and (30, 48)."""
    places = gaussians(torch.tensor([[12.0, 50.0], [30.0, 48.0]]))
    return first * places[0] + second * places[1]


@pytest.mark.parametrize(
    ("left", "right", "places"),
    [
        # Both legs in both maps: the side whose map has more of the other leg goes there.
        ((0.75, 0.74), (0.77, 0.72), (30.0, 12.0)),
        ((0.75, 0.70), (0.77, 0.76), (12.0, 30.0)),
        # They differ as they are.
        ((0.75, 0.70), (0.72, 0.77), (12.0, 30.0)),
        # One leg hides the other.
        ((0.80, 0.10), (0.80, 0.15), (12.0, 12.0)),
        # A thing that looks like a foot to one map alone.
        ((0.55, 0.15), (0.55, 0.43), (12.0, 12.0)),
    ],
)
def test_sides_take_different_places_where_there_are_two(
    left: tuple[float, float], right: tuple[float, float], places: tuple[float, float]
) -> None:
    maps = torch.stack([torch.rand(64, 48), two_peaks(*left), two_peaks(*right)])
    points, scores = HeatmapDecoder("dark", stride=1, pairs=((1, 2),))(maps)
    torch.testing.assert_close(points[1:, 0], torch.tensor(places), atol=0.1, rtol=0)
    heights = [
        (one[0] if place == 12.0 else one[1]) for one, place in zip((left, right), places, strict=True)
    ]
    torch.testing.assert_close(scores[1:], torch.tensor(heights), atol=1e-3, rtol=0)
    alone, height = HeatmapDecoder("dark", stride=1)(maps)
    assert torch.equal(points[0], alone[0])
    assert torch.equal(scores[0], height[0])


def reference_apart(left: np.ndarray, right: np.ndarray, share: float, radius: float) -> list[np.ndarray]:
    """The definition, pixel by pixel."""

    def top(one: np.ndarray) -> tuple[int, int]:
        v, u = np.unravel_index(int(one.argmax()), one.shape)
        return int(v), int(u)

    def near(place: tuple[int, int], v: int, u: int) -> bool:
        return (v - place[0]) ** 2 + (u - place[1]) ** 2 <= radius**2

    def second(one: np.ndarray, beyond: tuple[int, int]) -> tuple[float, tuple[int, int]]:
        best = (0.0, (0, 0))
        for v in range(one.shape[0]):
            for u in range(one.shape[1]):
                around = one[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
                if one[v, u] == around.max() and not near(beyond, v, u) and one[v, u] > best[0]:
                    best = (float(one[v, u]), (v, u))
        return best

    def without(one: np.ndarray, place: tuple[int, int]) -> np.ndarray:
        kept = one.copy()
        for v in range(one.shape[0]):
            for u in range(one.shape[1]):
                if near(place, v, u):
                    kept[v, u] = 0.0
        return kept

    at_left, at_right = top(left), top(right)
    if np.hypot(at_left[0] - at_right[0], at_left[1] - at_right[1]) > radius - 1:
        return [left, right]
    (height_left, place_left), (height_right, place_right) = second(left, at_right), second(right, at_left)
    if height_left * right.max() > left.max() * height_right:
        if (height_left / left.max() + right[place_left] / right.max()) / 2 >= share:
            return [without(left, at_right), right]
    elif (height_right / right.max() + left[place_right] / left.max()) / 2 >= share:
        return [left, without(right, at_left)]
    return [left, right]


def test_sides_apart_equals_the_definition() -> None:
    generator = torch.Generator().manual_seed(5)
    places = torch.rand(60, 2, 2, generator=generator, dtype=torch.float64) * torch.tensor([15.0, 19.0])
    heights = 0.5 + 0.5 * torch.rand(60, 2, 2, generator=generator, dtype=torch.float64)
    peaks = gaussians(places, 20, 16, 1.5)
    maps = torch.einsum("nkp,npij->nkij", heights, peaks)
    apart = sides_apart(maps, torch.tensor([0]), torch.tensor([1]), 0.8, 4.0)
    changed = 0
    for one, found in zip(maps.numpy(), apart.numpy(), strict=True):
        expected = np.stack(reference_apart(one[0], one[1], 0.8, 4.0))
        np.testing.assert_array_equal(found, expected)
        changed += not np.array_equal(expected, one)
    assert 10 < changed < 50


@pytest.mark.parametrize("method", ["expected", "dark", "quarter"])
@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-3), (torch.bfloat16, 0.5)])
def test_maps_of_another_precision_than_the_decoder(method: str, dtype: torch.dtype, atol: float) -> None:
    decoder, maps = HeatmapDecoder(method), gaussians(torch.tensor([[10.3, 8.4], [5.0, 12.8]]), 20, 16)
    points, scores = decoder(maps.to(dtype))
    assert points.dtype == scores.dtype == dtype
    torch.testing.assert_close(points.float(), decoder(maps)[0], atol=atol, rtol=0)


def reference_quarter(heatmap: np.ndarray) -> tuple[float, float]:
    height, width = heatmap.shape
    y, x = np.unravel_index(np.argmax(heatmap), heatmap.shape)
    dx = dy = 0.0
    if 1 < x < width - 1 and y > 0:
        dx = np.sign(heatmap[y, x + 1] - heatmap[y, x - 1])
    if 1 < y < height - 1 and x > 0:
        dy = np.sign(heatmap[y + 1, x] - heatmap[y - 1, x])
    return x + 0.25 * dx, y + 0.25 * dy


def newton(f: np.ndarray, y: int, x: int) -> np.ndarray:
    gradient = 0.5 * np.array([f[y, x + 1] - f[y, x - 1], f[y + 1, x] - f[y - 1, x]])
    dxx = 0.25 * (f[y, x + 2] - 2 * f[y, x] + f[y, x - 2])
    dyy = 0.25 * (f[y + 2, x] - 2 * f[y, x] + f[y - 2, x])
    dxy = 0.25 * (f[y + 1, x + 1] - f[y - 1, x + 1] - f[y + 1, x - 1] + f[y - 1, x - 1])
    hessian = np.array([[dxx, dxy], [dxy, dyy]])
    return np.zeros(2) if np.linalg.det(hessian) == 0 else -np.linalg.inv(hessian) @ gradient


def reference_dark(heatmap: np.ndarray, kernel: int) -> tuple[float, float]:
    height, width = heatmap.shape
    y, x = np.unravel_index(np.argmax(heatmap), heatmap.shape)
    border = (kernel - 1) // 2
    padded = cv2.GaussianBlur(np.pad(heatmap, border), (kernel, kernel), 0)
    blurred = padded[border:-border, border:-border]
    f = np.log(np.maximum(blurred * heatmap.max() / blurred.max(), 1e-10))
    if not (1 < x < width - 2 and 1 < y < height - 2):
        return float(x), float(y)
    dx, dy = newton(f, int(y), int(x))
    return x + dx, y + dy


def reference_expected(heatmap: np.ndarray, sharpness: float, tolerance: float) -> tuple[float, float]:
    """The mean similarity to a point at every pixel, by the definition."""
    height, width = heatmap.shape
    share = np.exp(sharpness * np.maximum(heatmap, 0)) - 1
    spread = tolerance * max(height, width)
    v, u = np.mgrid[:height, :width]
    gain = np.zeros(heatmap.shape)
    for y in range(height):
        for x in range(width):
            gain[y, x] = (share * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * spread**2))).sum()
    y, x = (int(place) for place in np.unravel_index(np.argmax(gain), gain.shape))
    if not (1 < x < width - 2 and 1 < y < height - 2):
        return float(x), float(y)
    dx, dy = newton(np.log(gain), y, x)
    return x + dx, y + dy


def test_expected_equals_the_definition() -> None:
    maps = noisy_maps((12,), torch.float64)
    points, scores = HeatmapDecoder("expected").double()(maps)
    assert torch.equal(scores, maps.amax((-2, -1)))
    at_border = 0
    for heatmap, point in zip(maps.flatten(0, 1).numpy(), points.flatten(0, 1).numpy(), strict=True):
        expected = reference_expected(heatmap, 7.0, 0.07)
        # The kernel ends after three deviations, where it is 0.01.
        np.testing.assert_allclose(point / 4, expected, atol=0.1)
        at_border += float(expected[0]).is_integer() or float(expected[1]).is_integer()
    assert 2 < at_border < 58


def test_expected_takes_one_sharp_peak_as_it_is() -> None:
    maps = gaussians(torch.tensor([[20.3, 30.7], [11.8, 40.2]], dtype=torch.float64), sigma=1.5)
    expected, _ = HeatmapDecoder("expected").double()(maps)
    dark, _ = HeatmapDecoder("dark").double()(maps)
    torch.testing.assert_close(expected, dark, atol=0.1, rtol=0)  # pixels of the crop


def test_expected_takes_the_place_with_the_most_about_it() -> None:
    """One narrow peak against two that are a little lower and beside each other."""
    maps = gaussians(torch.tensor([[10.0, 20.0], [34.0, 44.0], [38.0, 48.0]]), sigma=1.5)
    map_of_three = maps[0] + 0.97 * torch.maximum(maps[1], maps[2])
    (u, v), score = HeatmapDecoder("expected", stride=1)(map_of_three)
    torch.testing.assert_close(torch.stack([u, v]), torch.tensor([36.0, 46.0]), atol=0.2, rtol=0)
    assert float(score) == pytest.approx(1.0, abs=1e-5)
    dark, _ = HeatmapDecoder("dark", stride=1)(map_of_three)
    torch.testing.assert_close(dark, torch.tensor([10.0, 20.0]), atol=0.1, rtol=0)


@pytest.mark.parametrize("method", ["quarter", "dark"])
def test_equals_the_definition(method: str) -> None:
    maps = noisy_maps((60,), torch.float64)
    points, scores = HeatmapDecoder(method).double()(maps)
    assert torch.equal(scores, maps.amax((-2, -1)))
    at_border = 0
    for heatmap, point in zip(maps.flatten(0, 1).numpy(), points.flatten(0, 1).numpy(), strict=True):
        expected = reference_quarter(heatmap) if method == "quarter" else reference_dark(heatmap, 11)
        np.testing.assert_allclose(point / 4, expected, atol=1e-5)
        at_border += float(expected[0]).is_integer() or float(expected[1]).is_integer()
    assert 10 < at_border < 290  # both sides of the gates are met


@pytest.mark.parametrize("kernel", [13, 17])  # OpenCV has tables of its own up to 9
def test_dark_with_other_kernels(kernel: int) -> None:
    maps = noisy_maps((4,), torch.float64)
    points, _ = HeatmapDecoder("dark", kernel).double()(maps)
    expected = [reference_dark(heatmap, kernel) for heatmap in maps.flatten(0, 1).numpy()]
    np.testing.assert_allclose(points.flatten(0, 1).numpy() / 4, expected, atol=1e-5)


def test_map_pixel_u_v_is_crop_pixel_4u_4v() -> None:
    crop_points = torch.tensor([[81.3, 122.9], [96.0, 128.0], [40.0, 200.4]], dtype=torch.float64)
    maps = gaussians(crop_points / 4)
    points, scores = HeatmapDecoder("dark").double()(maps)
    torch.testing.assert_close(points, crop_points, rtol=0, atol=2e-2)
    torch.testing.assert_close(scores, maps.amax((-2, -1)))
    points, _ = HeatmapDecoder("quarter")(maps)
    # (20.325, 30.725) -> (20, 31) moved right and up; (24, 32) has equal neighbours; (10, 50.1) moves down.
    expected = torch.tensor([[81.0, 123.0], [96.0, 128.0], [40.0, 201.0]], dtype=torch.float64)
    torch.testing.assert_close(points, expected)


@pytest.mark.parametrize("method", ["expected", "quarter", "dark"])
@pytest.mark.parametrize("across", [False, True])
def test_maps_of_a_single_row_or_column(method: str, across: bool) -> None:
    """Their edges have no neighbours: the point is the highest pixel itself."""
    line = torch.zeros(9)
    line[6] = 1.0
    points, scores = HeatmapDecoder(method)(line[None] if across else line[:, None])
    assert float(scores) == 1.0
    assert points.tolist() == ([24.0, 0.0] if across else [0.0, 24.0])


def test_another_stride() -> None:
    points, _ = HeatmapDecoder("dark", stride=8)(gaussians(torch.tensor([10.0, 20.0])))
    torch.testing.assert_close(points, torch.tensor([80.0, 160.0]), rtol=0, atol=1e-3)


@pytest.mark.parametrize("method", ["quarter", "dark"])
@pytest.mark.parametrize("level", [-1.0, 0.0])
def test_maps_without_a_peak_give_finite_points_and_tell_by_the_score(method: str, level: float) -> None:
    points, scores = HeatmapDecoder(method)(torch.full((2, 17, 64, 48), level))
    assert bool((points == 0).all())
    assert bool((scores == level).all())


def test_expected_is_finite_without_a_peak() -> None:
    points, scores = HeatmapDecoder("expected")(torch.full((2, 17, 64, 48), 0.5))
    assert bool((points >= 0).all())
    assert bool((points[..., 0] < 192).all())
    assert bool((points[..., 1] < 256).all())
    assert bool((scores == 0.5).all())


def test_no_maps() -> None:
    for method in METHODS:
        points, scores = HeatmapDecoder(method)(torch.zeros(0, 17, 64, 48))
        assert points.shape == (0, 17, 2)
        assert scores.shape == (0, 17)


@pytest.mark.parametrize("method", ["expected", "dark"])
def test_the_point_moves_with_its_map(method: str) -> None:
    # d point / d centre is the identity in crop pixels.
    centre = torch.tensor([20.2, 30.1], dtype=torch.float64, requires_grad=True)
    decoder = HeatmapDecoder(method).double()
    jacobian = torch.autograd.functional.jacobian(lambda c: decoder(gaussians(c))[0] / 4, centre)
    torch.testing.assert_close(jacobian, torch.eye(2, dtype=torch.float64), rtol=0, atol=1e-2)


def test_constructor_refuses() -> None:
    for arguments in (
        {"method": "udp"},
        {"kernel_size": 10},
        {"kernel_size": -1},
        {"stride": 0},
        {"tolerance": 0.0},
    ):
        with pytest.raises(TensorsimError, match="HeatmapDecoder"):
            HeatmapDecoder(**arguments)

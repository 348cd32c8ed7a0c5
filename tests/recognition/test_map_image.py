from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.recognition.map_image import MapToImage, area_weights, ridge_map
from tests.stage import StageTester, assert_same


def axis(bins: int = 10, step: float = 0.5) -> torch.Tensor:
    return (torch.arange(bins, dtype=torch.float64) - bins // 2) * step


class TestMapToImage(StageTester):
    scale = "db"

    def make(self) -> nn.Module:
        return MapToImage(axis(), (-1.9, 1.6), size=6, scale=self.scale)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(3)
        return (torch.rand((*batch, 10, 7), generator=generator, dtype=torch.float64).to(dtype) + 0.1,)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(7),), r"got shape \[7\], expected \(\.\.\., 10 bins, frames\)"),
            ((torch.zeros(9, 7),), r"got shape \[9, 7\], expected \(\.\.\., 10 bins, frames\)"),
            ((torch.zeros(10, 0),), "got an empty tensor"),
            ((-torch.ones(10, 7),), "got negative values"),
            ((torch.full((10, 7), float("nan")),), "NaN"),
            ((torch.zeros(10, 7, dtype=torch.int64),), "expected a real floating point tensor"),
        ]


class TestMapToImageLinear(TestMapToImage):
    scale = "linear"


class TestMapToImageOfSpectra(TestMapToImage):
    """Twice as many bins as its axis has, which share the extent."""

    def make(self) -> nn.Module:
        return MapToImage(axis(5, 1.0), (-1.9, 1.6), size=6, any_bins=True)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [((torch.zeros(7),), r"got shape \[7\], expected \(\.\.\., bins, frames\)")]


def finely_sampled(power: np.ndarray, low: float, high: float, size: int, fine: int = 9240) -> np.ndarray:
    """Mean over the pixel of a piecewise constant function of the first dimension, by brute force."""
    place = low + (np.arange(fine) + 0.5) * (high - low) / fine
    cell = np.floor(place).astype(int)
    inside = (cell >= 0) & (cell < len(power))
    values = np.where(inside[:, None], power[np.clip(cell, 0, len(power) - 1)], 0.0)
    count = inside.reshape(size, -1).sum(1)[:, None]
    return values.reshape(size, -1, power.shape[1]).sum(1) / np.maximum(count, 1)


@pytest.mark.parametrize("span", [(1.0, 9.0), (0.25, 7.6), (-4.0, 14.0), (4.1, 4.9)])
@pytest.mark.parametrize("size", [3, 8, 21])
def test_a_pixel_is_the_mean_power_of_what_it_covers(span: tuple[float, float], size: int) -> None:
    power = np.random.default_rng(0).random((10, 4))
    weights = area_weights(torch.arange(10, dtype=torch.float64), 1.0, *span, size)
    expected = finely_sampled(power, *span, size)
    torch.testing.assert_close(
        weights @ torch.from_numpy(power), torch.from_numpy(expected), rtol=0, atol=2e-2
    )
    sums = weights.sum(1)
    assert bool(((sums - 1).abs().lt(1e-12) | sums.eq(0)).all())


def test_one_bin_to_one_pixel_is_the_map_itself() -> None:
    magnitude = torch.rand(8, 8, dtype=torch.float64) + 0.01
    image = MapToImage(axis(8, 1.0), (-4.5, 3.5), size=8, scale="linear")(magnitude)
    assert_same(image, (magnitude / magnitude.max())[None], atol=1e-12)


def test_conventions_of_place() -> None:
    """Row 0 is the lowest value, column 0 the first instant, bins are centred on their value."""
    magnitude = torch.zeros(10, 10)
    magnitude[9, 0] = 1.0  # +2.0, first frame
    image = MapToImage(axis(), (-2.75, 2.25), size=10)(magnitude)[0]
    assert torch.nonzero(image).tolist() == [[9, 0]]


def test_decibels() -> None:
    magnitude = torch.tensor([[1.0, 0.1], [0.01, 1e-5]], dtype=torch.float64)
    image = MapToImage(axis(2, 1.0), (-1.5, 0.5), size=2, range_db=50.0)(magnitude)[0]
    expected = torch.tensor([[1.0, 0.6], [0.2, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-12)
    assert float(MapToImage(axis(2, 1.0), (-1.5, 0.5), size=2)(torch.zeros(2, 2)).max()) == 0.0


def test_speed_is_where_both_presets_show_it() -> None:
    """A scatterer of 2 m/s lies in the same row in both scenes, and nothing there depends on the gain."""
    rows = []
    for radar, bins in ((RadarConfig.free_space(), 1024), (RadarConfig.through_wall(), 256)):
        doppler_hz = np.fft.fftshift(np.fft.fftfreq(bins, 1 / radar.prf_hz))
        magnitude = torch.zeros(bins, 30)
        magnitude[int(np.argmin(np.abs(doppler_hz * radar.doppler_wavelength_m / 2 - 2.0)))] = 7.0
        image = MapToImage.doppler(radar)(magnitude)
        assert image.shape == (1, 224, 224)
        lit = torch.nonzero(image[0, :, 0])[:, 0].double().mean()
        rows.append(float(lit))
        assert_same(MapToImage.doppler(radar)(5 * magnitude), image, atol=1e-6)
    expected = (2.0 + 3.8) / 7.6 * 224 - 0.5
    assert rows == pytest.approx([expected, expected], abs=1.0)


def test_pictures_do_not_depend_on_the_doppler_window() -> None:
    """Windows of 0.06, 0.1 and 0.2 s have 512, 1024 and 2048 bins; bin F / 2 is speed 0 in all of them."""
    radar = RadarConfig.free_space()
    speed = radar.unambiguous_speed_m_s
    images = []
    for bins in (512, 1024, 2048):
        wave = torch.linspace(-1, 1, bins + 1, dtype=torch.float64)[:-1]
        images.append(MapToImage.doppler(radar, size=32, scale="linear")(1 + wave[:, None].expand(-1, 3)))
        step = 2 * speed / bins
        inside = MapToImage.doppler(radar, 3.5 * step, size=7).rows(bins)
        assert_same(inside[:, bins // 2 - 3 : bins // 2 + 4], torch.eye(7, dtype=torch.float64), atol=1e-9)
    for image in images:
        assert_same(image, images[-1], atol=3e-3)


def test_range_picture_and_merged_channels() -> None:
    radar = RadarConfig.through_wall()
    magnitude = torch.zeros(200, 12)
    magnitude[20] = 1.0  # 3.0 m
    image = MapToImage.range(radar, size=75)(magnitude)
    assert int(image[0, :, 5].argmax()) in (29, 30)
    doppler = MapToImage.doppler(radar, size=75)(torch.rand(256, 9))
    assert torch.cat([image, doppler], dim=-3).shape == (2, 75, 75)


def test_ridges_as_a_map() -> None:
    indices = torch.tensor([[0, 1, 2], [3, 1, 0]])
    magnitudes = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    expected = torch.tensor([[1.0, 0, 6], [0, 5, 0], [0, 0, 3], [4, 0, 0]])
    assert torch.equal(ridge_map(indices, magnitudes, 4), expected)
    assert torch.equal(ridge_map(indices.expand(2, 2, 3), magnitudes.expand(2, 2, 3), 4)[1], expected)
    with pytest.raises(TensorsimError, match="outside of 0 to 2"):
        ridge_map(indices, magnitudes, 3)
    with pytest.raises(TensorsimError, match=r"got shapes \[2, 3\] and \[3\]"):
        ridge_map(indices, magnitudes[0], 4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"axis": torch.zeros(4)}, "expected .* ascending"),
        ({"axis": torch.tensor([0.0, 1.0, 5.0])}, "axis: got steps from 1 to 4, expected equal ones"),
        ({"span": (1.0, 1.0)}, "the lower one first"),
        ({"size": 0}, "got 0, expected an integer of at least 1"),
        ({"scale": "log"}, "got 'log', expected one of"),
        ({"range_db": 0.0}, "expected a positive finite number"),
    ],
)
def test_refuses_bad_settings(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"axis": axis(), "span": (-1.0, 1.0)} | change
    with pytest.raises(TensorsimError, match=message):
        MapToImage(**arguments)

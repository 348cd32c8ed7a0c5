from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tensorsim.enhance.dncnn import MapDenoiser
from tensorsim.enhance.perona_malik import PeronaMalik
from tensorsim.errors import TensorsimError
from tests.stage import StageTester, assert_same


class TestPeronaMalik(StageTester):
    conductance = "exponential"

    def make(self) -> nn.Module:
        return PeronaMalik(iterations=3, threshold=0.2, conductance=self.conductance)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        generator = torch.Generator().manual_seed(1)
        return (torch.rand((*batch, 6, 9), generator=generator, dtype=torch.float64).to(dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(9),), r"got shape \[9\], expected \(\.\.\., H, W\)"),
            ((torch.zeros(0, 6, 9),), "got an empty tensor"),
            ((torch.full((6, 9), float("nan")),), "got NaN or infinite values"),
            ((torch.full((6, 9), float("inf")),), "got NaN or infinite values"),
            ((torch.zeros(6, 9, dtype=torch.uint8),), "expected a real floating point tensor"),
        ]


class TestPeronaMalikQuadratic(TestPeronaMalik):
    conductance = "quadratic"


class TestMapDenoiserOfPeronaMalik(TestPeronaMalik):
    """Tiles do not show."""

    def make(self) -> nn.Module:
        return MapDenoiser(PeronaMalik(iterations=3, threshold=0.2), tile=4)


def written_out(image: np.ndarray, iterations: int, threshold: float, conductance: str) -> np.ndarray:
    """Pixel by pixel; a neighbour beyond the border is as bright as the pixel itself or as the one beside it there."""
    for _ in range(iterations):
        padded, new = np.pad(image, 1, mode="edge"), image.copy()
        for i in range(image.shape[0]):
            for j in range(image.shape[1]):
                for dy in (-1, 0, 1):
                    for dx in (-1, 0, 1):
                        gradient = padded[i + 1 + dy, j + 1 + dx] - image[i, j]
                        ratio = (gradient / threshold) ** 2
                        c = np.exp(-ratio) if conductance == "exponential" else 1 / (1 + ratio)
                        new[i, j] += (0.5 if dy and dx else 1.0) * c * gradient / 8
        image = new
    return image


@pytest.mark.parametrize("conductance", ["exponential", "quadratic"])
def test_equals_the_equation_written_out(conductance: str) -> None:
    image = torch.rand(5, 7, dtype=torch.float64)
    expected = written_out(image.numpy(), 4, 0.15, conductance)
    assert_same(PeronaMalik(4, 0.15, conductance)(image), torch.from_numpy(expected), atol=1e-12)


def test_smooths_regions_and_keeps_edges() -> None:
    generator = torch.Generator().manual_seed(0)
    clean = torch.zeros(40, 40)
    clean[:, 20:] = 1.0
    noisy = clean + 0.05 * torch.randn(40, 40, generator=generator)
    found = PeronaMalik(15, 0.1)(noisy)
    assert float((found - clean).square().mean()) < 0.2 * float((noisy - clean).square().mean())
    # As wide a Gaussian blur takes the step between its two pixels down to a fifth.
    assert float((found[:, 20] - found[:, 19]).mean()) > 0.9
    # With a threshold far above all differences it is plain diffusion, which does not keep it.
    assert float((PeronaMalik(15, 100.0)(noisy)[:, 20] - PeronaMalik(15, 100.0)(noisy)[:, 19]).mean()) < 0.4


def test_brightness_is_kept() -> None:
    image = torch.rand(9, 8, dtype=torch.float64)
    torch.testing.assert_close(PeronaMalik(10, 0.3)(image).mean(), image.mean(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"iterations": 0}, "got 0, expected an integer of at least 1"),
        ({"threshold": 0.0}, "expected a positive finite number"),
        ({"conductance": "tukey"}, "got 'tukey', expected one of"),
    ],
)
def test_refuses_bad_settings(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        PeronaMalik(**arguments)

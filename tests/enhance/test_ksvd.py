from typing import Any

import numpy as np
import pytest
import torch

from tensorsim.enhance.ksvd import KSVD, cosine_dictionary, ksvd_denoise, noise_deviation
from tensorsim.errors import TensorsimError

pytest.importorskip("sklearn")


def texture(size: int = 40) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    return (0.5 + 0.25 * torch.sin(0.9 * x + 0.3 * y) + 0.25 * (x > size // 2)).double()


def test_noise_deviation() -> None:
    noise = 0.07 * torch.randn(120, 121, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert noise_deviation(noise + 0.5) == pytest.approx(0.07, rel=0.04)
    assert noise_deviation(torch.full((9, 9), 0.3)) == 0.0


def test_cosine_dictionary() -> None:
    """The first atom is flat, the others have no mean in at least one direction, all have norm 1."""
    atoms = cosine_dictionary(8, 64)
    norms = torch.linalg.vector_norm(atoms, dim=1)
    torch.testing.assert_close(norms, torch.ones_like(norms), rtol=0, atol=1e-12)
    torch.testing.assert_close(atoms[0], torch.full_like(atoms[0], 1 / 8), rtol=0, atol=1e-12)
    assert float(atoms[1:].sum(1).abs().max()) < 1e-12
    # With as many atoms as pixels it is the discrete cosine transform.
    from scipy.fft import dct

    basis = dct(np.eye(8), axis=0, norm="ortho")
    torch.testing.assert_close(atoms, torch.from_numpy(np.kron(basis, basis)), rtol=0, atol=1e-12)


def test_takes_noise_away() -> None:
    clean = texture()
    noisy = clean + 0.05 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(1)).double()
    found = ksvd_denoise(noisy, atoms=64, iterations=2)
    assert found.dtype == noisy.dtype
    assert float((found - clean).square().mean()) < 0.4 * float((noisy - clean).square().mean())
    torch.testing.assert_close(ksvd_denoise(noisy, atoms=64, iterations=2), found)


def test_leaves_a_flat_image_alone() -> None:
    image = torch.full((12, 12), 0.4)
    assert torch.equal(ksvd_denoise(image), image)


def test_a_map_has_no_gradient() -> None:
    maps = torch.full((12, 12), 0.4, requires_grad=True)
    assert not ksvd_denoise(maps).requires_grad
    noisy = torch.rand(9, 9, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert not KSVD()(noisy).requires_grad


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"image": torch.zeros(2, 12, 12)}, r"got shape \[2, 12, 12\], expected \(H, W\)"),
        ({"image": torch.zeros(7, 12)}, "expected at least 8x8"),
        ({"image": torch.full((12, 12), float("nan"))}, "NaN"),
        ({"image": torch.zeros(12, 12), "atoms": 60}, "got 60 atoms, expected a square number"),
        ({"image": torch.zeros(12, 12), "sigma": -1.0}, "got sigma -1.0, expected a finite number >= 0"),
        ({"image": torch.zeros(12, 12), "sigma": float("nan")}, "got sigma nan"),
        ({"image": torch.zeros(12, 12), "side": 0}, "side: got 0, expected an integer of at least 1"),
        ({"image": torch.zeros(12, 12), "iterations": 0}, "iterations: got 0"),
    ],
)
def test_refuses_bad_input(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        ksvd_denoise(**arguments)


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        (torch.full((2, 12, 12), float("nan")), "NaN"),
        (torch.full((2, 12, 12), float("inf")), "infinite"),
        (torch.zeros(0, 12, 12), "got an empty tensor"),
    ],
)
def test_refuses_bad_maps(maps: torch.Tensor, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        KSVD()(maps)


def test_noise_of_neighbouring_columns_that_are_alike_is_not_seen() -> None:
    """That of a Doppler-time map whose frames overlap, so that it stays as it is."""
    noise = torch.randn(120, 200, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    alike = torch.nn.functional.avg_pool1d(noise, 21, 1) * 21**0.5
    assert float(alike.std()) == pytest.approx(1.0, rel=0.1)
    assert noise_deviation(alike) < 0.3

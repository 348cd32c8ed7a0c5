from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import savgol_filter
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.motion.savgol import SavitzkyGolay, polynomial_basis, savitzky_golay
from tests.stage import StageTester, assert_same


def walk(shape: tuple[int, ...], dtype: torch.dtype = torch.float64) -> Tensor:
    """A random walk of metres along the axis of time, -3."""
    generator = torch.Generator().manual_seed(3)
    steps = torch.randn(shape, generator=generator, dtype=torch.float64) * 0.05
    return (steps.cumsum(-3) + 4).to(dtype)


class TestSavitzkyGolayStage(StageTester):
    def make(self) -> nn.Module:
        return SavitzkyGolay(5, 2)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (walk((*batch, 12, 3, 3), dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [
            ((torch.zeros(4, 14, 3),), r"4 samples along axis -3, expected at least the window of 5"),
            ((torch.zeros(0, 14, 3),), r"0 samples"),
            ((torch.zeros(14, 3),), r"shape \[14, 3\], expected an axis -3"),
            ((torch.full((12, 14, 3), float("nan")),), r"got NaN or infinite values"),
            ((torch.zeros(12, 14, 3, dtype=torch.int64),), r"expected a real floating point tensor"),
            ((torch.zeros(12, 14, 3, dtype=torch.complex64),), r"expected a real floating point tensor"),
        ]


class TestSavitzkyGolayThroughFFT(TestSavitzkyGolayStage):
    """A window long enough for the other way of summing it."""

    def make(self) -> nn.Module:
        return SavitzkyGolay(67, 2)

    def inputs(self, batch: tuple[int, ...], dtype: torch.dtype) -> tuple[Any, ...]:
        return (walk((*batch, 90, 2, 3), dtype),)

    def bad_inputs(self) -> list[tuple[tuple[Any, ...], str]]:
        return [((torch.zeros(66, 14, 3),), r"expected at least the window of 67")]


@settings(deadline=None, max_examples=60)
@given(half=st.integers(0, 60), order=st.integers(0, 4), extra=st.integers(0, 70))
def test_equals_scipy_from_end_to_end(half: int, order: int, extra: int) -> None:
    window = max(2 * half + 1, order + 1 + order % 2)
    x = walk((2, window + extra, 2, 3))
    expected = savgol_filter(x.numpy(), window, order, axis=-3, mode="interp")
    actual = SavitzkyGolay(window, order)(x).numpy()
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize(("window", "order"), [(11, 3), (33, 6), (121, 6)])
def test_coefficients_are_exact(window: int, order: int) -> None:
    """Against the normal equations in rational numbers, which have no rounding.

    (SciPy solves for powers of the sample number in floating point and loses eight digits at order 6.)
    """
    powers = [[Fraction(t) ** j for j in range(order + 1)] for t in range(-(window // 2), window // 2 + 1)]
    rows = [
        [*(sum(p[i] * p[j] for p in powers) for j in range(order + 1)), Fraction(int(i == 0))]
        for i in range(order + 1)
    ]
    for i, pivot in enumerate(rows):
        rows[i] = pivot = [v / pivot[i] for v in pivot]
        for k, row in enumerate(rows):
            if k != i:
                rows[k] = [a - row[i] * b for a, b in zip(row, pivot, strict=True)]
    expected = [float(sum(row[-1] * p for row, p in zip(rows, sample, strict=True))) for sample in powers]
    impulse = torch.zeros(3 * window, 1, 1, dtype=torch.float64)
    impulse[window + window // 2] = 1
    response = SavitzkyGolay(window, order)(impulse)[window : 2 * window, 0, 0]
    np.testing.assert_allclose(response.numpy(), expected[::-1], rtol=0, atol=1e-14)


@pytest.mark.parametrize("window", [11, 201])
def test_float32_is_scipy_to_the_last_digit_or_so(window: int) -> None:
    x = walk((300, 14, 3), torch.float32)
    actual = SavitzkyGolay(window, 3)(x)
    assert actual.dtype == torch.float32
    np.testing.assert_allclose(
        actual.numpy(), savgol_filter(x.numpy(), window, 3, axis=0), rtol=1e-6, atol=1e-7
    )


@pytest.mark.parametrize("dim", [0, 1, 2, -1])
def test_axis_of_time(dim: int) -> None:
    x = walk((15, 16, 17))
    expected = savgol_filter(x.numpy(), 9, 4, axis=dim)
    np.testing.assert_allclose(SavitzkyGolay(9, 4, dim=dim)(x).numpy(), expected, rtol=0, atol=1e-12)


def test_keeps_polynomials_up_to_its_order() -> None:
    time = torch.linspace(-1, 1, 40, dtype=torch.float64)
    cubic = (2 * time**3 - time**2 + 0.5).reshape(-1, 1, 1)
    assert_same(SavitzkyGolay(11, 3)(cubic), cubic, atol=1e-12)
    assert not torch.allclose(SavitzkyGolay(11, 1)(cubic), cubic, atol=1e-3)


def test_both_ways_of_summing_agree() -> None:
    x = walk((100, 2, 3))
    basis = SavitzkyGolay(21, 3).basis
    direct, fft = (
        savitzky_golay(x, basis, -3, direct_window=21),
        savitzky_golay(x, basis, -3, direct_window=20),
    )
    assert not torch.equal(direct, fft)
    assert_same(fft, direct, atol=1e-13)


def test_no_people() -> None:
    for window in (5, 101):
        assert SavitzkyGolay(window, 2)(torch.zeros(1, 0, 120, 14, 3)).shape == (1, 0, 120, 14, 3)


def test_smooths_real_motion_as_scipy_does(shared_data: Any) -> None:
    with np.load(shared_data / "mocap" / "cmu_14joints_120hz.npz") as clips:
        for name in clips.files[:5]:
            x = clips[name]
            expected = savgol_filter(x.astype(np.float64), 31, 3, axis=0)
            np.testing.assert_allclose(
                SavitzkyGolay(31, 3)(torch.from_numpy(x)).numpy(), expected, rtol=0, atol=1e-6
            )


def test_polynomials_of_high_order_span_their_space() -> None:
    """Against the projector by NumPy's Legendre polynomials, solved by least squares."""
    legendre = np.polynomial.legendre.legvander(np.linspace(-1, 1, 101), 40)
    expected = legendre @ np.linalg.pinv(legendre)
    basis = polynomial_basis(101, 40).numpy()
    np.testing.assert_allclose(basis @ basis.T, expected, atol=1e-10)


@pytest.mark.parametrize(
    ("window", "order", "message"),
    [
        (4, 2, "got a window of 4 samples, expected an odd positive number"),
        (-3, 0, "got a window of -3"),
        (0, 0, "got a window of 0"),
        (5, 5, "got order 5, expected 0 to 4 for a window of 5"),
        (5, -1, "got order -1"),
    ],
)
def test_refuses_a_filter_that_does_not_exist(window: int, order: int, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        SavitzkyGolay(window, order)

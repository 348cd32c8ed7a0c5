"""Savitzky-Golay smoothing along time.

Source: A. Savitzky and M. J. E. Golay, "Smoothing and differentiation of data by simplified least squares
procedures", Analytical Chemistry 36 (1964); P. A. Gorry, Analytical Chemistry 62 (1990), for the ends.
"""

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_finite, check_floating


def polynomial_basis(window: int, order: int) -> Tensor:
    """Orthonormal polynomials up to ``order`` on ``window`` equidistant points: (window, order + 1) float64.

    With this matrix Q, ``Q Q^T x`` is the least-squares polynomial through a window x, at the points of the
    window.
    """
    points = torch.linspace(-1, 1, window, dtype=torch.float64)
    # Legendre polynomials by their recurrence: powers of high order are nearly parallel.
    legendre = [torch.ones_like(points), points]
    for k in range(1, order):
        legendre.append(((2 * k + 1) * points * legendre[k] - k * legendre[k - 1]) / (k + 1))
    basis: Tensor = torch.linalg.qr(torch.stack(legendre[: order + 1], dim=-1))[0]
    return basis


def savitzky_golay(x: Tensor, basis: Tensor, dim: int, direct_window: int = 64) -> Tensor:
    """The centre value of each window's least-squares polynomial; at the ends, the whole first or last polynomial.

    Args:
        x: real tensor with at least ``window`` samples along ``dim``.
        basis: (window, order + 1) float64, see :func:`polynomial_basis`; the window is odd.
        dim: the time axis.
        direct_window: windows up to this length are summed sample by sample, longer ones use the FFT; memory stays
            a small multiple of x either way.

    Returns:
        Tensor of the same shape and dtype as ``x``; computed in float64.
    """
    window = basis.shape[0]
    half = window // 2
    frames = x.shape[dim]
    signal = x.to(torch.float64)
    kernel = basis @ basis[half]  # the row of Q Q^T that gives the middle of a window; symmetric
    if window <= direct_window or x.numel() == 0:
        middle = torch.zeros_like(signal.narrow(dim, 0, frames - 2 * half))
        for k in range(window):
            middle.addcmul_(signal.narrow(dim, k, frames - 2 * half), kernel[k])
    else:
        # Circular over the whole signal: the samples that wrap around are replaced at the ends.
        response = torch.fft.rfft(kernel, n=frames).conj()
        spectrum = torch.fft.rfft(signal.movedim(dim, -1)) * response
        middle = torch.fft.irfft(spectrum, n=frames)[..., : frames - 2 * half].movedim(-1, dim)
    first_window = signal.narrow(dim, 0, window).movedim(dim, -1)
    last_window = signal.narrow(dim, frames - window, window).movedim(dim, -1)
    start = first_window @ basis @ basis[:half].T
    end = last_window @ basis @ basis[half + 1 :].T
    return torch.cat([start.movedim(-1, dim), middle, end.movedim(-1, dim)], dim=dim).to(x.dtype)


class SavitzkyGolay(nn.Module):
    """Smooth along time; equals ``scipy.signal.savgol_filter(x, window, order, axis=dim, mode="interp")``.

    Args:
        window: odd number of samples.
        order: order of the polynomial, below ``window``.
        dim: the time axis; the default is that of joints (..., T, J, 3).

    Example:
        >>> SavitzkyGolay(11, 3)(torch.randn(2, 60, 14, 3)).shape  # (..., T, J, 3)
        torch.Size([2, 60, 14, 3])

    Raises:
        TensorsimError: a window that is not odd and positive, or an order that is not below it.
    """

    basis: Tensor

    def __init__(self, window: int, order: int, dim: int = -3) -> None:
        super().__init__()
        if window < 1 or window % 2 == 0:
            raise TensorsimError(
                f"SavitzkyGolay: got a window of {window} samples, expected an odd positive number"
            )
        if not 0 <= order < window:
            raise TensorsimError(
                f"SavitzkyGolay: got order {order}, expected 0 to {window - 1} for a window of {window}"
            )
        self.window = window
        self.order = order
        self.dim = dim
        self.register_buffer("basis", polynomial_basis(window, order), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Smooth ``x``, any shape with at least ``window`` samples along ``dim``; the same shape and dtype.

        Raises:
            TensorsimError: not real, NaN, no axis ``dim``, or fewer samples than the window.
        """
        check_floating(x, "SavitzkyGolay")
        if not -x.dim() <= self.dim < x.dim():
            raise TensorsimError(
                f"SavitzkyGolay: got shape {list(x.shape)}, expected an axis {self.dim} for time"
            )
        if x.shape[self.dim] < self.window:
            raise TensorsimError(
                f"SavitzkyGolay: got shape {list(x.shape)} with {x.shape[self.dim]} samples along axis "
                f"{self.dim}, expected at least the window of {self.window}"
            )
        check_finite(x, "SavitzkyGolay")
        return savitzky_golay(x, self.basis.to(torch.float64), self.dim)

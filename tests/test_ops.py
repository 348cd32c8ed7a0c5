"""Basic operations on tensors."""

import math

import numpy as np
import pytest
import torch

from tensorsim.ops import magnitude


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_magnitude_is_that_of_numpy_also_of_very_large_and_small_numbers(dtype: torch.dtype) -> None:
    limits = torch.finfo(dtype)
    x = torch.randn(3, 50, dtype=dtype, generator=torch.Generator().manual_seed(0))
    x[0, :5] = torch.tensor([0.0, 3.0 + 4.0j, -2.0j, limits.max / 2, limits.tiny * 2]).to(dtype)
    expected = np.abs(x.numpy().astype(np.complex128))
    for shown in (magnitude(x), magnitude(x.requires_grad_()).detach()):
        np.testing.assert_allclose(shown.numpy(), expected, rtol=2 * limits.eps)
    assert math.isclose(float(magnitude(x.detach())[0, 1]), 5.0, rel_tol=1e-6)


def test_magnitude_has_gradient_zero_at_zero() -> None:
    x = torch.tensor([0.0, 3.0 + 4.0j], dtype=torch.complex128, requires_grad=True)
    magnitude(x).sum().backward()
    assert x.grad is not None
    torch.testing.assert_close(x.grad, torch.tensor([0.0, 0.6 + 0.8j], dtype=torch.complex128))

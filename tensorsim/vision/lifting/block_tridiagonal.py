"""Linear systems along time in which frames are coupled only to their neighbours."""

import torch
from torch import Tensor


def solve_block_tridiagonal(diagonal: Tensor, below: Tensor, right: Tensor) -> Tensor:
    """Solve ``A x = right`` for symmetric positive definite, block tridiagonal A by its Cholesky factors.

    Args:
        diagonal: (..., K, n, n) blocks on the diagonal.
        below: (..., K - 1, n, n) blocks under it: rows of k + 1, columns of k.
        right: (..., K, n, c).

    Returns:
        (..., K, n, c). Differentiable.
    """
    blocks = diagonal.shape[-3]
    factors: list[Tensor] = []
    ties: list[Tensor] = []
    halfway: list[Tensor] = []
    for k in range(blocks):
        block, y = diagonal[..., k, :, :], right[..., k, :, :]
        if k > 0:
            block = block - torch.matmul(ties[k - 1], ties[k - 1].transpose(-1, -2))
            y = y - torch.matmul(ties[k - 1], halfway[k - 1])
        factor = torch.linalg.cholesky(block)
        factors.append(factor)
        halfway.append(torch.linalg.solve_triangular(factor, y, upper=False))
        if k < blocks - 1:
            tie = torch.linalg.solve_triangular(factor, below[..., k, :, :].transpose(-1, -2), upper=False)
            ties.append(tie.transpose(-1, -2))
    x: list[Tensor] = []
    for i in range(blocks):
        k = blocks - 1 - i
        y = halfway[k]
        if i > 0:
            y = y - torch.matmul(ties[k].transpose(-1, -2), x[i - 1])
        x.append(torch.linalg.solve_triangular(factors[k].transpose(-1, -2), y, upper=True))
    x.reverse()
    return torch.stack(x, dim=-3)

"""Maps that are computed piece by piece, with one column per pulse or frame."""

import torch
from torch import Tensor

from tensorsim.ops import safe_sqrt


def block_rms(magnitude: Tensor, block: int) -> Tensor:
    """Root mean square of every ``block`` columns: (..., R, M) -> (..., R, ceil(M / block)).

    The last block may be shorter.
    """
    if block == 1:
        return magnitude
    columns = magnitude.shape[-1]
    whole = columns // block * block
    power = magnitude.square()
    mean = power[..., :whole].unflatten(-1, (whole // block, block)).mean(-1)
    if whole < columns:
        mean = torch.cat((mean, power[..., whole:].mean(-1, keepdim=True)), -1)
    return safe_sqrt(mean)


def join_pulses(earlier: Tensor, later: Tensor) -> Tensor:
    """Concatenate (B, p, R) and (B, m, R) to (B, p + m, R); in memory time varies fastest, as in both."""
    if earlier.shape[1] == 0:
        return later
    return torch.cat((earlier.transpose(1, 2), later.transpose(1, 2)), -1).transpose(1, 2)


class Columns:
    """A map (R, columns) written piece by piece: concatenation at the end would need twice the memory.

    Every ``block`` columns are reduced to one by :func:`block_rms`.
    """

    def __init__(self, columns: int, block: int = 1) -> None:
        self.total, self.block, self.done = -(-columns // block), block, 0
        self.map: Tensor | None = None
        self.rest: Tensor | None = None

    def push(self, magnitude: Tensor) -> None:
        """Append columns (R, m)."""
        if self.rest is not None:
            magnitude = torch.cat((self.rest, magnitude), -1)
        whole = magnitude.shape[-1] // self.block * self.block
        self.rest = magnitude[:, whole:].clone() if self.block > 1 else None
        self._write(block_rms(magnitude[:, :whole], self.block))

    def _write(self, columns: Tensor) -> None:
        if self.map is None:
            self.map = columns.new_empty(columns.shape[0], self.total)
        self.map[:, self.done : self.done + columns.shape[1]] = columns
        self.done += columns.shape[1]

    def result(self) -> Tensor:
        """The whole map; call it after the last columns."""
        if self.rest is not None and self.rest.shape[1] > 0:
            self._write(block_rms(self.rest, self.block))
        assert self.map is not None
        return self.map

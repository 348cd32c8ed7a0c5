"""Constant false alarm rate (CFAR) detection: each cell is compared with the cells around it.

Sources: Finn and Johnson, RCA Review 29 (1968), for cell averaging; Rohling, IEEE Trans. AES-19 (1983), for ordered
statistics; Abramowitz and Stegun, *Handbook of Mathematical Functions*, 26.5 and 26.6, for means of several looks.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.config.checks import is_finite
from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_count,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    is_exporting,
)
from tensorsim.ops import flatten_batch, unflatten_batch

METHODS = ("cell-averaging", "ordered-statistic")
EDGES = ("circular", "reflect")


def cell_averaging_factor(false_alarm: float, cells: int, looks: int = 1) -> float:
    r"""Threshold over mean of N cells, each the mean of V independent exponentially distributed powers.

    The ratio of a cell to that mean has an F distribution of 2 V and 2 N V degrees of freedom, so that

    $$ P = I_{N / (N + a)}(N V, V) $$

    with the regularised incomplete beta function; for one look ``a = N (P^(-1/N) - 1)``.
    """
    from scipy.special import betaincinv

    return float(cells * (1 / betaincinv(cells * looks, looks, false_alarm) - 1))


def ordered_statistic_factor(false_alarm: float, cells: int, rank: int) -> float:
    """Threshold over the ``rank``-th smallest of N cells of exponentially distributed power.

    Solves ``P = prod over i = 0 ... rank - 1 of (N - i) / (N - i + a)`` for a by bisection.
    """

    def log_rate(factor: float) -> float:
        return sum(math.log((cells - i) / (cells - i + factor)) for i in range(rank))

    low, high = 0.0, 1.0
    while log_rate(high) > math.log(false_alarm):
        high *= 2
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if log_rate(middle) > math.log(false_alarm) else (low, middle)
    return high


def box_sum(x: Tensor, half_rows: int, half_columns: int) -> Tensor:
    """Sums over windows of (2 half_rows + 1) x (2 half_columns + 1): (B, H, W) -> smaller by 2 half on each axis."""
    total = F.pad(x.cumsum(-2), [0, 0, 1, 0])
    rows = 2 * half_rows + 1
    total = total[..., rows:, :] - total[..., :-rows, :]
    total = F.pad(total.cumsum(-1), [1, 0])
    columns = 2 * half_columns + 1
    return total[..., columns:] - total[..., :-columns]


class CfarDetector(nn.Module):
    """Two-dimensional CFAR detector.

    The reference cells of a cell are those of the rectangle that reaches ``guard + training`` cells to each side,
    minus the rectangle that reaches ``guard`` cells. The false alarm rate is the requested one if the reference cells
    are independent and their power is exponentially distributed (a square-law detector in Gaussian noise), or a mean
    of ``looks`` such powers.

    Args:
        guard: cells on each side of the cell that are left out, along both axes.
        training: reference cells beyond those on each side.
        false_alarm: probability of a false alarm, in (0, 1).
        method: ``"cell-averaging"`` compares with the mean of the reference cells, ``"ordered-statistic"`` with one
            of them in order of size.
        rank: which of the N cells that is, as a fraction of N; 0.75 is typical.
        edges: how each axis continues beyond its edges, ``"circular"`` or ``"reflect"``.
        looks: number of independent powers, such as those of antennas, averaged in each cell; for cell averaging.

    Shapes: power (..., H, W), not negative -> (..., H, W) bool. :meth:`threshold` is differentiable, a detection is
    not.

    Raises:
        TensorsimError: settings without reference cells, a probability or rank outside (0, 1), unknown names, fewer
            than one look, several with ordered statistics, an empty map or one smaller than the reach, negative
            power, NaN.
    """

    def __init__(
        self,
        guard: tuple[int, int],
        training: tuple[int, int],
        false_alarm: float = 1e-3,
        method: str = "cell-averaging",
        rank: float = 0.75,
        edges: tuple[str, str] = ("circular", "reflect"),
        looks: int = 1,
    ) -> None:
        super().__init__()
        for name, pair in (("guard", guard), ("training", training)):
            if not (isinstance(pair, tuple | list) and len(pair) == 2):
                raise TensorsimError(f"CfarDetector.{name}: got {pair!r}, expected cells along both axes")
            for cells in pair:
                check_count(cells, f"CfarDetector.{name}", 0)
        if max(training) == 0:
            raise TensorsimError(
                f"CfarDetector.training: got {training}, expected at least one training cell"
            )
        if not (is_finite(false_alarm) and is_finite(rank) and 0 < false_alarm < 1 and 0 < rank < 1):
            raise TensorsimError(
                f"CfarDetector: got false_alarm {false_alarm} and rank {rank}, expected both between 0 and 1"
            )
        check_choice(method, METHODS, "CfarDetector.method")
        if any(edge not in EDGES for edge in edges):
            raise TensorsimError(f"CfarDetector.edges: got {edges}, expected two of {EDGES}")
        check_count(looks, "looks")
        if looks > 1 and method == "ordered-statistic":
            raise TensorsimError(f"looks: got {looks} with the method {method!r}, expected 1")
        self.guard_rows, self.guard_columns = guard
        self.reach_rows, self.reach_columns = guard[0] + training[0], guard[1] + training[1]
        outer = (2 * self.reach_rows + 1) * (2 * self.reach_columns + 1)
        self.cells = outer - (2 * self.guard_rows + 1) * (2 * self.guard_columns + 1)
        self.ordered = method == "ordered-statistic"
        self.rank = max(1, round(rank * self.cells))
        if self.ordered:
            self.factor = ordered_statistic_factor(false_alarm, self.cells, self.rank)
        else:
            self.factor = cell_averaging_factor(false_alarm, self.cells, looks)
        self.row_edges, self.column_edges = edges

    @torch.jit.export
    def threshold(self, power: Tensor) -> Tensor:
        """Power (..., H, W) above which a cell counts as detected, for power (..., H, W)."""
        check_floating(power, "power")
        check_min_rank(power, 2, "power", "(..., H, W)")
        check_not_empty(power, "power")
        check_finite(power, "power")
        rows, columns = power.shape[-2], power.shape[-1]
        if rows <= self.reach_rows or columns <= self.reach_columns:
            raise TensorsimError(
                f"power: got shape {list(power.shape)}, expected more than the {self.reach_rows} x "
                f"{self.reach_columns} cells that the reference cells reach to each side"
            )
        if not is_exporting() and bool((power < 0).any()):
            raise TensorsimError(f"power: got a minimum of {float(power.min())}, expected no negative value")
        flat = flatten_batch(power, 2)
        flat = F.pad(flat, [0, 0, self.reach_rows, self.reach_rows], mode=self.row_edges)
        flat = F.pad(flat, [self.reach_columns, self.reach_columns, 0, 0], mode=self.column_edges)
        level = self._ordered(flat) if self.ordered else self._mean(flat)
        return unflatten_batch(self.factor * level, list(power.shape[:-2]))

    def _mean(self, padded: Tensor) -> Tensor:
        exact = padded.double()  # differences of running sums
        outer = box_sum(exact, self.reach_rows, self.reach_columns)
        rows, columns = self.reach_rows - self.guard_rows, self.reach_columns - self.guard_columns
        inner = exact[:, rows : exact.shape[1] - rows, columns : exact.shape[2] - columns]
        own = box_sum(inner, self.guard_rows, self.guard_columns)
        return ((outer - own) / self.cells).to(padded.dtype)

    def _ordered(self, padded: Tensor) -> Tensor:
        kept: list[Tensor] = []
        height, width = 2 * self.reach_rows + 1, 2 * self.reach_columns + 1
        rows, columns = padded.shape[1] - height + 1, padded.shape[2] - width + 1
        for i in range(height):
            for j in range(width):
                near = abs(i - self.reach_rows) <= self.guard_rows
                if not (near and abs(j - self.reach_columns) <= self.guard_columns):
                    kept.append(padded[:, i : i + rows, j : j + columns])
        return torch.kthvalue(torch.stack(kept, -1), self.rank, -1)[0]

    def forward(self, power: Tensor) -> Tensor:
        """Power (..., H, W) to detections (..., H, W)."""
        return power > self.threshold(power)

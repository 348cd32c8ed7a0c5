"""Ridges: the strongest local maxima of a Doppler-time map, followed through time."""

import itertools
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_finite, check_floating, check_min_rank


class Ridges(NamedTuple):
    """C ridges of a map.

    Attributes:
        indices: (..., C, K) int64 Doppler bin.
        magnitudes: (..., C, K) the map's value there.
    """

    indices: Tensor
    magnitudes: Tensor


def strongest_peaks(doppler_time: Tensor, count: int) -> Ridges:
    """The ``count`` largest local maxima along Doppler of each frame, largest first.

    (..., F, K) -> (..., C, K) with C = ``count``.

    The Doppler axis is a circle of PRF, so its ends are neighbours. Of a plateau the first bin counts. Where
    a frame has fewer maxima its largest is repeated, and a frame without any has them all at zero Doppler,
    bin F // 2.
    """
    bins = doppler_time.shape[-2]
    below, above = doppler_time.roll(1, -2), doppler_time.roll(-1, -2)
    peak = (doppler_time > below) & (doppler_time >= above)
    height = torch.where(peak, doppler_time, float("-inf"))
    found, index = torch.topk(height, count, dim=-2)
    missing = torch.isinf(found)
    first = torch.where(missing[..., :1, :], bins // 2, index[..., :1, :])
    index = torch.where(missing, first, index)
    return Ridges(index, doppler_time.gather(-2, index))


def connect(peaks: Ridges, orders: Tensor, bins: int) -> Ridges:
    """Reorder the peaks of each frame so that each row goes on where it was in the frame before.

    Between neighbouring frames that permutation of the peaks is taken whose bin jumps, around the circle of
    ``bins``, have the smallest sum. ``orders`` (C!, C) holds all permutations. The rows start in the order of
    magnitude.
    """
    index = peaks.indices.transpose(-1, -2)  # (..., K, C)
    frames, count = index.shape[-2], index.shape[-1]
    jump = (index[..., 1:, None, :] - index[..., :-1, :, None]).abs()  # (..., K - 1, from, to)
    jump = torch.minimum(jump, bins - jump)
    rows = torch.arange(count, device=index.device)
    cells = (rows * count + orders).flatten()
    cost = jump.flatten(-2).index_select(-1, cells).unflatten(-1, orders.shape).sum(-1)
    start = rows.expand(index[..., :1, :].shape)
    order = torch.cat((start, orders[cost.argmin(-1)]), -2)  # (..., K, C): row -> peak, frame to frame
    reach = 1
    while reach < frames:  # running composition of permutations, doubling its reach
        head, tail = order[..., :reach, :], order[..., reach:, :]
        order = torch.cat((head, tail.gather(-1, order[..., :-reach, :])), -2)
        reach *= 2
    order = order.transpose(-1, -2)
    return Ridges(peaks.indices.gather(-2, order), peaks.magnitudes.gather(-2, order))


class RidgeExtractor(nn.Module):
    """The ``count`` largest local maxima along Doppler per frame, connected through time.

    Args:
        count: number of ridges, 1 to 6.

    Shapes: (..., F, K) magnitude -> :class:`Ridges` with (..., count, K). See :func:`strongest_peaks` for
    frames with too few maxima and :func:`connect` for the rows. Bins have no gradient, magnitudes do.

    Raises:
        TensorsimError: a count outside 1 to 6, fewer Doppler bins than ridges, no frame, NaN.
    """

    orders: Tensor

    def __init__(self, count: int = 3) -> None:
        super().__init__()
        if not 1 <= count <= 6:
            raise TensorsimError(f"count: got {count}, expected 1 to 6 ridges")
        self.count = count
        orders = torch.tensor(list(itertools.permutations(range(count))))
        self.register_buffer("orders", orders, persistent=False)

    @torch.jit.export
    def peaks(self, doppler_time: Tensor) -> Ridges:
        """The maxima of each frame, not yet connected."""
        return strongest_peaks(doppler_time, self.count)

    @torch.jit.export
    def connect(self, peaks: Ridges, bins: int) -> Ridges:
        """Connect the maxima of all frames of a clip whose map has ``bins`` Doppler bins."""
        return connect(peaks, self.orders, bins)

    def forward(self, doppler_time: Tensor) -> Ridges:
        """Map (..., F, K) to ridges (..., count, K)."""
        check_floating(doppler_time, "map")
        check_min_rank(doppler_time, 2, "map", "(..., Doppler bins, frames)")
        if doppler_time.shape[-2] < self.count or doppler_time.shape[-1] == 0:
            raise TensorsimError(
                f"map: got shape {list(doppler_time.shape)}, expected (..., Doppler bins, frames) "
                f"with at least {self.count} bins and one frame"
            )
        check_finite(doppler_time, "map")
        return self.connect(self.peaks(doppler_time), doppler_time.shape[-2])

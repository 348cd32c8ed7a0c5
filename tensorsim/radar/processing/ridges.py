"""Ridges of a Doppler-time map: local maxima connected through time, or the best penalised paths."""

import itertools
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_count,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    is_exporting,
)
from tensorsim.ops import flatten_batch, unflatten_batch

#: More Doppler bins than any map has; an upper bound for counts of bins.
MAX_BINS = 65_536


class Ridges(NamedTuple):
    """C ridges of a map.

    Attributes:
        indices: (..., C, K) int64 Doppler bin.
        magnitudes: (..., C, K) value of the map in this bin.
    """

    indices: Tensor
    magnitudes: Tensor


def strongest_peaks(doppler_time: Tensor, count: int) -> Ridges:
    """Maximum local energy: the ``count`` largest local maxima along Doppler of each frame, largest first.

    (..., F, K) -> (..., C, K) with C = ``count``.

    The Doppler axis is periodic with the PRF, so its ends are neighbours. The first bin of a plateau counts. In a
    frame with fewer maxima the largest is repeated; in a frame without any, all are at zero Doppler, bin F // 2.
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
    """Reorder the peaks of each frame so that each row continues the same row of the frame before.

    Between neighbouring frames the permutation of the peaks with the smallest sum of bin jumps is used; jumps are
    taken modulo ``bins``. ``orders`` (C!, C) contains all permutations. The rows of the first frame are in order of
    magnitude.
    """
    index = peaks.indices.transpose(-1, -2)  # (..., K, C)
    frames, count = index.shape[-2], index.shape[-1]
    jump = (index[..., 1:, None, :] - index[..., :-1, :, None]).abs()  # (..., K - 1, from, to)
    jump = torch.minimum(jump, bins - jump)
    parts = [torch.arange(count, device=index.device).expand(index[..., :1, :].shape)]
    # Blocks of frames: six ridges have 720 permutations, whose costs would be larger than the map.
    blocks = [jump]
    if not is_exporting():
        clips = max(1, index[..., 0, 0].numel())
        blocks = list(jump.split(max(1, (1 << 18) // (clips * orders.numel())), -3))
    for block in blocks:
        cost = block[..., 0, :].index_select(-1, orders[:, 0])
        for row in range(1, count):
            cost = cost + block[..., row, :].index_select(-1, orders[:, row])
        parts.append(orders[cost.argmin(-1)])
    order = torch.cat(parts, -2)  # (..., K, C): row -> peak, frame to frame
    reach = 1
    while reach < frames:  # cumulative composition of permutations, over 1, 2, 4, ... frames
        head, tail = order[..., :reach, :], order[..., reach:, :]
        order = torch.cat((head, tail.gather(-1, order[..., :-reach, :])), -2)
        reach *= 2
    order = order.transpose(-1, -2)
    return Ridges(peaks.indices.gather(-2, order), peaks.magnitudes.gather(-2, order))


def check_map(doppler_time: Tensor, least_bins: int) -> None:
    """Refuse anything but a finite real map (..., F, K) with at least ``least_bins`` Doppler bins and one frame."""
    check_floating(doppler_time, "map")
    check_min_rank(doppler_time, 2, "map", "(..., Doppler bins, frames)")
    if doppler_time.shape[-2] < least_bins or doppler_time.shape[-1] == 0:
        raise TensorsimError(
            f"map: got shape {list(doppler_time.shape)}, expected (..., Doppler bins, frames) "
            f"with at least {least_bins} bins and one frame"
        )
    check_finite(doppler_time, "map")


class RidgeExtractor(nn.Module):
    """The ``count`` largest local maxima along Doppler per frame, connected through time.

    Args:
        count: number of ridges, 1 to 6.

    Shapes: (..., F, K) magnitude -> :class:`Ridges`: ``indices`` (..., count, K) int64 Doppler bins and ``magnitudes``
    (..., count, K), the values of the map in them. See :func:`strongest_peaks` for frames with too few maxima and
    :func:`connect` for the rows. Bins have no gradient, magnitudes do.

    Raises:
        TensorsimError: a count outside 1 to 6, fewer Doppler bins than ridges, no frame, NaN.
    """

    orders: Tensor

    def __init__(self, count: int = 3) -> None:
        super().__init__()
        check_count(count, "count", 1, 6)
        self.count = count
        orders = torch.tensor(list(itertools.permutations(range(count))))
        self.register_buffer("orders", orders, persistent=False)

    @torch.jit.export
    def peaks(self, doppler_time: Tensor) -> Ridges:
        """Maxima of each frame, not connected."""
        return strongest_peaks(doppler_time, self.count)

    @torch.jit.export
    def connect(self, peaks: Ridges, bins: int) -> Ridges:
        """Connect the maxima of all frames of a clip; its map has ``bins`` Doppler bins."""
        return connect(peaks, self.orders, bins)

    def forward(self, doppler_time: Tensor) -> Ridges:
        """Map (..., F, K) to ridges (..., count, K)."""
        check_map(doppler_time, self.count)
        return self.connect(self.peaks(doppler_time), doppler_time.shape[-2])


def best_path(gain: Tensor, jumps: Tensor, cost: Tensor) -> Tensor:
    """Bins (B, K) int64 of the path with the largest sum of gains minus jump costs (Viterbi, 1967).

    Args:
        gain: (B, F, K) gain of each bin.
        jumps: (D,) int64 allowed changes of bin from frame to frame, modulo F; of equal paths the first is taken.
        cost: (D,) cost of each jump.
    """
    bins, frames = gain.shape[1], gain.shape[2]
    here = torch.arange(bins, device=gain.device).unsqueeze(-1)
    origins = torch.remainder(here - jumps, bins)  # (F, D): possible bins in the frame before
    score = gain[:, :, 0]
    choices: list[Tensor] = []
    for frame in range(1, frames):
        best, choice = (score[:, origins] - cost).max(-1)
        choices.append(choice)
        score = best + gain[:, :, frame]
    at = score.argmax(-1, keepdim=True)  # (B, 1)
    path = [at]
    for back in range(frames - 1):
        jump = jumps[choices[frames - 2 - back].gather(1, at)]
        at = torch.remainder(at - jump, bins)
        path.append(at)
    return torch.cat(path, 1).flip(1)


class PathRidgeExtractor(nn.Module):
    """The ``count`` best smooth paths through a map, one after another, each optimal over the whole clip.

    The gain of a path in a frame is the level of its bin in dB, counted from ``floor_db`` below the map's peak; the
    cost of a change of bin is ``penalty_db * jump^2``. Where a component fades, the path continues straight; where
    two components cross, it stays on the stronger one. A band of bins around each path has no gain for the paths
    after it. Slower than :class:`RidgeExtractor`, and needs the whole clip.

    Args:
        count: number of ridges, at least 1.
        penalty_db: cost of a jump by one bin; four times as much for two bins.
        max_jump: largest jump from frame to frame, bins.
        band: bins on either side of a found path that belong to it.
        floor_db: bins at least this far below the map's peak have no gain.

    Shapes: (..., F, K) magnitude -> :class:`Ridges`: ``indices`` (..., count, K) int64 Doppler bins and ``magnitudes``
    (..., count, K), the values of the map in them. The Doppler axis is periodic with the PRF. The ridges of an empty
    map are at the first bin. Bins have no gradient, magnitudes do.

    Raises:
        TensorsimError: settings out of range, fewer than ``2 max_jump + 1`` Doppler bins, no frame, NaN.
    """

    jumps: Tensor

    def __init__(
        self,
        count: int = 3,
        penalty_db: float = 0.1,
        max_jump: int = 24,
        band: int = 8,
        floor_db: float = 40.0,
    ) -> None:
        super().__init__()
        for name, value, least in (("count", count, 1), ("max_jump", max_jump, 1), ("band", band, 0)):
            check_count(value, name, least, MAX_BINS)
        check_positive(penalty_db, "penalty_db")
        check_positive(floor_db, "floor_db")
        self.count, self.band = count, band
        self.penalty_db, self.floor_db = penalty_db, floor_db
        # Short jumps first: of equal paths the first is taken.
        jumps = torch.tensor(sorted(range(-max_jump, max_jump + 1), key=abs))
        self.register_buffer("jumps", jumps, persistent=False)

    def forward(self, doppler_time: Tensor) -> Ridges:
        """Map (..., F, K) to ridges (..., count, K)."""
        check_map(doppler_time, self.jumps.shape[0])
        lead = list(doppler_time.shape[:-2])
        maps = flatten_batch(doppler_time, 2)
        level = maps.detach()
        peak = level.amax((-2, -1), keepdim=True)
        level = level / torch.where(peak > 0, peak, 1.0)
        gain = 20 * level.clamp_min(10 ** (-self.floor_db / 20)).log10() + self.floor_db
        cost = self.penalty_db * self.jumps.to(gain.dtype).square()
        bins = gain.shape[1]
        axis = torch.arange(bins, device=gain.device).unsqueeze(-1)
        found: list[Tensor] = []
        for _ in range(self.count):
            path = best_path(gain, self.jumps, cost)
            found.append(path)
            distance = (axis - path.unsqueeze(1)).abs()  # (B, F, K)
            gain = torch.where(torch.minimum(distance, bins - distance) > self.band, gain, 0.0)
        indices = torch.stack(found, 1)
        return Ridges(unflatten_batch(indices, lead), unflatten_batch(maps.gather(1, indices), lead))

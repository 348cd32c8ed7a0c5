"""Radar maps to input images of a classifier: resampled in power, cropped to a span of the axis, scaled to [0, 1]."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_count,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    check_positive,
    check_size,
    is_exporting,
)

SCALES = ("db", "linear")


def area_weights(start: Tensor, width: float, low: float, high: float, size: int) -> Tensor:
    """Matrix (size, N) that averages N cells over ``size`` equal pixels between ``low`` and ``high``.

    Cell n covers ``start[n]`` to ``start[n] + width``. Row i contains the overlap of pixel i with each cell, divided by
    the sum of the row; a pixel outside all cells has a row of zeros.
    """
    pixel = (high - low) / size
    left = low + pixel * torch.arange(size, dtype=start.dtype, device=start.device).unsqueeze(-1)
    overlap = torch.minimum(left + pixel, start + width) - torch.maximum(left, start)
    # Overlaps of 1e-16 pixels due to rounding are 0: divided by their own sum they would become 1.
    share = torch.where(overlap > 1e-9 * pixel, overlap, torch.zeros_like(overlap))
    total = share.sum(-1, keepdim=True)
    return share / torch.where(total > 0, total, torch.ones_like(total))


def scaled(power: Tensor, scale: str, range_db: float) -> Tensor:
    """Power (..., H, W) to pixels in [0, 1], each image normalised by its own peak; an image of zeros stays 0.

    ``"linear"``: magnitude over peak. ``"db"``: decibels below the peak, with 0 at ``range_db`` or more below it.
    """
    peak = power.amax((-2, -1), keepdim=True)
    level = power / torch.where(peak > 0, peak, torch.ones_like(peak))
    if scale == "linear":
        # The square root of 0 has no gradient; 1e-20 is -200 dB.
        return torch.where(level > 1e-20, level.clamp_min(1e-20).sqrt(), torch.zeros_like(level))
    return 1 + 10 * level.clamp_min(10 ** (-range_db / 10)).log10() / range_db


class MapToImage(nn.Module):
    """Magnitude maps to images for a classifier.

    Every pixel is the mean power of the part of the map that it covers, so the image does not depend on the sampling
    of the map. Row 0 is the lowest value of the axis (positive speed = approaching), column 0 the first frame; the
    columns of the map fill the width of the image.

    Args:
        axis: (F,) value of each bin, ascending in equal steps; each bin covers a step around its value.
        any_bins: maps may divide the extent of the axis into another number of bins, as spectra do; the first bin
            keeps its value.
        span: (low, high) limits of the image on the axis. Outside the axis the image is 0.
        size: height and width in pixels.
        scale, range_db: see :func:`scaled`.

    Shapes: map (..., F, K) magnitude -> image (..., 1, size, size) in [0, 1]. Differentiable.

    Example:
        >>> doppler_picture = MapToImage.doppler(RadarConfig.through_wall())
        >>> doppler_picture(torch.rand(2, 256, 40)).shape  # (B, F, K)
        torch.Size([2, 1, 224, 224])

    Raises:
        TensorsimError: an axis that does not ascend in equal steps, a span without width, a size below 1, an unknown
            scale; a map without F rows (unless ``any_bins``), with negative values, or NaN.
    """

    def __init__(
        self,
        axis: Tensor,
        span: tuple[float, float],
        size: int = 224,
        scale: str = "db",
        range_db: float = 40.0,
        any_bins: bool = False,
    ) -> None:
        super().__init__()
        if axis.dim() != 1 or axis.shape[0] < 2 or not bool((axis.diff() > 0).all()):
            raise TensorsimError(
                f"MapToImage.axis: got shape {list(axis.shape)}, expected (F,) ascending, F at least 2"
            )
        steps = axis.double().diff()
        least, most = float(steps.min()), float(steps.max())
        if not most < 1.01 * least:
            raise TensorsimError(
                f"MapToImage.axis: got steps from {least:.4g} to {most:.4g}, expected equal ones"
            )
        low, high = span
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise TensorsimError(
                f"MapToImage.span: got {span}, expected two finite numbers, the lower one first"
            )
        check_count(size, "MapToImage.size")
        check_choice(scale, SCALES, "MapToImage.scale")
        check_positive(range_db, "MapToImage.range_db")
        self.size, self.scale, self.range_db = size, scale, range_db
        self.low, self.high = float(low), float(high)
        self.bins, self.any_bins = axis.shape[0], any_bins
        self.first = float(axis[0])
        self.extent = float(axis[-1] - axis[0]) * self.bins / (self.bins - 1)

    @classmethod
    def doppler(
        cls,
        radar: RadarConfig,
        speed_m_s: float = 3.8,
        size: int = 224,
        scale: str = "db",
        range_db: float = 40.0,
    ) -> "MapToImage":
        """For Doppler-time maps of any even number of bins, with radial speeds from ``-speed_m_s`` to ``speed_m_s``.

        The span is a speed, so that images of radars with different carriers are alike; 3.8 m/s is the unambiguous
        speed of the through-wall preset.
        """
        axis = torch.tensor([-radar.unambiguous_speed_m_s, 0.0], dtype=torch.float64)
        return cls(axis, (-speed_m_s, speed_m_s), size, scale, range_db, any_bins=True)

    @classmethod
    def range(
        cls,
        radar: RadarConfig,
        farthest_m: float = 7.5,
        size: int = 224,
        scale: str = "db",
        range_db: float = 40.0,
    ) -> "MapToImage":
        """For range-time maps of all range bins of a radar, with ranges up to ``farthest_m``."""
        axis = torch.arange(radar.samples_per_chirp // 2, dtype=torch.float64) * radar.range_resolution_m
        return cls(axis, (0.0, farthest_m), size, scale, range_db)

    @torch.jit.export
    def rows(self, bins: int, device: torch.device | None = None) -> Tensor:
        """Matrix (size, bins) that averages the bins of a map over each pixel."""
        step = self.extent / bins
        start = self.first + step * (torch.arange(bins, dtype=torch.float64, device=device) - 0.5)
        return area_weights(start, step, self.low, self.high, self.size)

    @torch.jit.export
    def average(self, power: Tensor) -> Tensor:
        """Mean of power (..., F, K) over each pixel: (..., size, size)."""
        bins, frames = power.shape[-2], power.shape[-1]
        start = torch.arange(frames, dtype=torch.float64, device=power.device)
        columns = area_weights(start, 1.0, 0.0, float(frames), self.size).to(power.dtype)
        rows = self.rows(bins, power.device).to(power.dtype)
        return torch.matmul(torch.matmul(rows, power), columns.transpose(0, 1))

    def forward(self, maps: Tensor) -> Tensor:
        """Magnitudes (..., F, K) to images (..., 1, size, size)."""
        layout = "(..., bins, frames)" if self.any_bins else f"(..., {self.bins} bins, frames)"
        check_floating(maps, "MapToImage")
        check_min_rank(maps, 2, "MapToImage", layout)
        if not self.any_bins:
            check_size(maps, -2, self.bins, "MapToImage", layout)
        check_not_empty(maps, "MapToImage")
        check_finite(maps, "MapToImage")
        if not is_exporting() and bool((maps < 0).any()):
            raise TensorsimError("MapToImage: got negative values, expected magnitudes")
        return scaled(self.average(maps.square()), self.scale, self.range_db).unsqueeze(-3)


def ridge_map(indices: Tensor, magnitudes: Tensor, bins: int) -> Tensor:
    """Doppler-time map of ridges alone: bins and magnitudes (..., C, K) -> (..., ``bins``, K), 0 elsewhere.

    Where two ridges meet, the larger magnitude is used. Differentiable with respect to the magnitudes.

    Raises:
        TensorsimError: shapes that differ, or bins outside the map.
    """
    if indices.shape != magnitudes.shape or indices.dim() < 2:
        raise TensorsimError(
            f"ridge_map: got shapes {list(indices.shape)} and {list(magnitudes.shape)}, expected both (..., C, K)"
        )
    if not is_exporting() and bool(((indices < 0) | (indices >= bins)).any()):
        raise TensorsimError(f"ridge_map: got bins outside of 0 to {bins - 1}")
    shape = list(magnitudes.shape)
    shape[-2] = bins
    return torch.zeros(shape, dtype=magnitudes.dtype, device=magnitudes.device).scatter_reduce(
        -2, indices, magnitudes, "amax"
    )

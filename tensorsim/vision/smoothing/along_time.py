"""Filters along the time of tracks: gap filling, robust smoothing, running quantiles."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.errors import is_exporting


def running_max(x: Tensor) -> Tensor:
    """The largest value so far along the last dimension: (..., T) -> (..., T)."""
    if is_exporting():  # ONNX has no such operation
        so_far = torch.ones(x.shape[-1], x.shape[-1], dtype=torch.bool, device=x.device).tril()
        return torch.where(so_far, x[..., None, :], x.amin(dim=-1)[..., None, None]).amax(dim=-1)
    return x.cummax(dim=-1)[0]


def raised_slowly(x: Tensor, reach: int) -> Tensor:
    """Values (..., T) raised beside large ones, nowhere lowered: the mean, over ``reach`` frames to both sides, of the
    largest value within ``reach`` frames. Around a single large value it falls off over twice as many."""
    if reach == 0 or x.numel() == 0:
        return x
    rows = x.reshape(-1, 1, x.shape[-1])
    highest = F.max_pool1d(rows, 2 * reach + 1, 1, reach)
    highest = F.pad(highest, [reach, reach], mode="replicate")
    return F.avg_pool1d(highest, 2 * reach + 1, 1).reshape(x.shape)


def nearest_valid(valid: Tensor) -> Tensor:
    """For every frame the index of the nearest valid one, itself if valid: (..., T) bool -> (..., T) int64.

    Without any valid frame each frame gets its own index.
    """
    time = torch.arange(valid.shape[-1], device=valid.device).expand(valid.shape)
    before, after = seen_beside(valid)
    nearest = torch.where(time - before <= after - time, before, after)
    return torch.where(valid.any(dim=-1, keepdim=True), nearest, time)


def fill_gaps(x: Tensor, valid: Tensor) -> Tensor:
    """Values (..., T) where ``valid`` (..., T), elsewhere those of the nearest valid frame."""
    return x.gather(-1, nearest_valid(valid))


def where_any(preferred: Tensor, fallback: Tensor) -> Tensor:
    """``preferred`` (..., T) bool for tracks in which it has any frame, ``fallback`` (..., T) for the others."""
    return torch.where(preferred.any(dim=-1, keepdim=True), preferred, fallback)


def brief_gaps(seen: Tensor, longest: int) -> Tensor:
    """Gaps (..., T) in ``seen`` (..., T) bool of at most ``longest`` frames, with seen frames on both sides."""
    before, after = seen_beside(seen)
    return ~seen & (after - before - 1 <= longest) & (before >= 0) & (after < seen.shape[-1])


def crossed_within(position: Tensor, seen: Tensor, step: float) -> Tensor:
    """Frames (..., T) between two seen ones that can be reached from one another with at most ``step`` per frame.

    Args:
        position: (..., T, D), read where ``seen``.
        seen: (..., T) bool.
        step: in units of the position.
    """
    before, after = seen_beside(seen)
    inside = (before >= 0) & (after < seen.shape[-1])
    last = seen.shape[-1] - 1
    start = position.gather(-2, before.clamp(0, last).unsqueeze(-1).expand(position.shape))
    stop = position.gather(-2, after.clamp(0, last).unsqueeze(-1).expand(position.shape))
    distance = torch.linalg.vector_norm(stop - start, dim=-1)
    return inside & (distance <= step * (after - before))


def gaps_with(event: Tensor, seen: Tensor) -> Tensor:
    """Unseen frames (..., T) of gaps between two seen ones in which an ``event`` (..., T) bool happens."""
    before, after = seen_beside(seen)
    last = seen.shape[-1] - 1
    inside = (before >= 0) & (after <= last) & ~seen
    count = (event & ~seen).to(torch.int64).cumsum(dim=-1)
    return inside & (count.gather(-1, after.clamp(0, last)) > count.gather(-1, before.clamp(0, last)))


def seen_beside(seen: Tensor) -> tuple[Tensor, Tensor]:
    """For each frame, the last seen one up to it and the first from it on (..., T); -T and 2 T if there is none."""
    frames = seen.shape[-1]
    time = torch.arange(frames, device=seen.device).expand(seen.shape)
    never = torch.full_like(time, -frames)
    before = running_max(torch.where(seen, time, never))
    after = -running_max(-torch.where(seen, time, -2 * never).flip(-1)).flip(-1)
    return before, after


def _kernel(sigma: float, frames: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Offsets in frames, and the Gaussian kernel there, truncated at 4 sigma and at the length of a film."""
    radius = min(int(4.0 * sigma) + 1, frames - 1)
    offset = torch.arange(-radius, radius + 1, dtype=like.dtype, device=like.device)
    return offset, torch.exp(-0.5 * (offset / sigma).square())


def _convolved(rows: Tensor, kernels: Tensor, most: int = 2**23) -> Tensor:
    """``F.conv1d`` of rows (R, 1, T) with odd kernels (C, 1, K), zero beyond the ends: (R, C, T).

    In double precision, torch makes K copies of every value; the rows are cut into pieces with ``most`` copies each.
    """
    frames, radius = rows.shape[-1], kernels.shape[-1] // 2
    if is_exporting() or rows.numel() * kernels.shape[-1] <= most:
        return F.conv1d(rows, kernels, padding=radius)
    piece = max(most // (rows.shape[0] * kernels.shape[-1]), 1)
    padded = F.pad(rows, [radius, radius])
    parts: list[Tensor] = []
    for start in range(0, frames, piece):
        stop = min(start + piece, frames)
        parts.append(F.conv1d(padded[..., start : stop + 2 * radius], kernels))
    return torch.cat(parts, dim=-1)


def gaussian_mean(x: Tensor, sigma: float) -> Tensor:
    """Values (..., T) averaged with a Gaussian of ``sigma`` frames, truncated at 4 sigma; zero beyond the ends."""
    kernel = _kernel(sigma, x.shape[-1], x)[1]
    rows = x.reshape(-1, 1, x.shape[-1])
    return _convolved(rows, (kernel / (sigma * math.sqrt(2 * math.pi)))[None, None]).reshape(x.shape)


def local_linear(x: Tensor, weights: Tensor, sigma: float, ridge: Tensor | None = None) -> Tensor:
    """Local linear regression along time with a Gaussian kernel (Fan and Gijbels, 1996, section 3.1).

    Reproduces straight lines exactly, up to the ends, for any weights, if there is no ridge. The kernel is truncated
    at 4 sigma; where all weights under it are zero, the result is the value itself.

    Args:
        x: (..., T) values.
        weights: (..., T) >= 0.
        sigma: standard deviation of the kernel in frames.
        ridge: (..., T) >= 0, draws the slope of each frame towards 0 (ridge regression): added to the variance of the
            times under the kernel, in sigma^2.

    Returns:
        (..., T). Differentiable.
    """
    frames = x.shape[-1]
    offset, kernel = _kernel(sigma, frames, x)
    moments = torch.stack([kernel, kernel * offset, kernel * offset.square()])[:, None]
    flat, w = x.reshape(-1, 1, frames), weights.reshape(-1, 1, frames)
    s = _convolved(w, moments)
    t = _convolved(w * flat, moments[:2])
    total = s[:, 0].clamp(min=1e-12)
    where, mean = s[:, 1] / total, t[:, 0] / total  # centres of gravity in time and value
    spread = s[:, 2] / total - where.square()
    # With a single frame under the kernel there is no slope.
    least = torch.full_like(spread, 1e-6)
    if ridge is not None:
        least = least + ridge.reshape(-1, frames)
    slope = (t[:, 1] / total - where * mean) / (spread.clamp(min=0.0) + least * sigma**2)
    return torch.where(s[:, 0] > 1e-12, mean - slope * where, flat[:, 0]).reshape(x.shape)


def ridge_in_gaps(weights: Tensor, sigma: float) -> Tensor:
    """Ridge (..., T) for :func:`local_linear` where there is less than half the weight that all 1 would give.

    So lines do not continue through a long gap: with a hundredth of the weight they lose a tenth of their slope.

    Args:
        weights: (..., T) > 0.
        sigma: standard deviation of the kernel in frames.
    """
    frames = weights.shape[-1]
    _, kernel = _kernel(sigma, frames, weights)
    w = weights.reshape(-1, 1, frames)
    there = _convolved(w, kernel[None, None])
    whole = _convolved(torch.ones_like(w), kernel[None, None])
    return 1e-3 * (whole / there.clamp(min=1e-12) - 2.0).clamp(min=0.0).reshape(weights.shape)


def masked_median(x: Tensor, valid: Tensor) -> Tensor:
    """Median (lower) of the valid values along the last dimension, kept with size one; 0 without any."""
    ordered = torch.where(valid, x, torch.full_like(x, float("inf"))).sort(dim=-1)[0]
    middle = ((valid.sum(dim=-1, keepdim=True) - 1) // 2).clamp(min=0)
    return torch.where(
        valid.any(dim=-1, keepdim=True), ordered.gather(-1, middle), torch.zeros_like(x[..., :1])
    )


def robust_smooth(
    x: Tensor,
    valid: Tensor,
    sigma: float,
    least: float,
    rounds: int = 3,
    precision: Tensor | None = None,
) -> Tensor:
    """Local linear smoothing, robust against outliers (lowess: Cleveland, 1979, with Cauchy weights).

    The bisquare weights of lowess are 0 beyond some residual. Several results can then be stable, each leaving out
    other values, and a tiny change of one value decides between them.

    Args:
        x: (..., T) values; those of invalid frames do not matter but must be finite.
        valid: (..., T) bool.
        sigma: standard deviation of the kernel in frames.
        least: residuals well below this one count fully, even if most are much smaller; positive, in the unit of x.
        rounds: number of reweightings by the residuals.
        precision: (..., T) positive, inverse variances in any unit; None: all values are equally good.

    Returns:
        (..., T), continued over invalid frames. Differentiable.
    """
    x = fill_gaps(x, valid)
    # Filled values get a small weight, in case a gap is longer than the kernel.
    base = valid.to(x.dtype)
    unit = torch.ones_like(x)
    if precision is not None:
        base, unit = base * precision, precision.sqrt()
    base = base + 1e-4
    ridge = ridge_in_gaps(base, sigma)
    smooth = local_linear(x, base, sigma, ridge)
    for _ in range(rounds):
        residual = unit * (x - smooth)
        # The usual 2.385 standard deviations; the median absolute value of a Gaussian is 0.6745 of one.
        limit = (2.385 / 0.6745 * masked_median(residual.abs(), valid)).clamp(min=least)
        smooth = local_linear(x, base / (1.0 + (residual / limit).square()), sigma, ridge)
    return smooth


def running_quantile(x: Tensor, window: int, quantile: float) -> Tensor:
    """Low (or any) quantile of a centred window of frames; the window is shortened at the ends.

    Args:
        x: (..., T) values.
        window: frames, made odd.
        quantile: 0 is the running minimum, 1 the maximum.

    Returns:
        (..., T). The gradient goes to the value that is taken.
    """
    half = min(window // 2, x.shape[-1] - 1)
    padded = F.pad(x, [half, half], value=float("inf"))
    inside = F.pad(torch.ones_like(x), [half, half]).unfold(-1, 2 * half + 1, 1).sum(dim=-1)
    rank = (quantile * (inside - 1.0)).round().long()
    return padded.unfold(-1, 2 * half + 1, 1).sort(dim=-1)[0].gather(-1, rank[..., None])[..., 0]

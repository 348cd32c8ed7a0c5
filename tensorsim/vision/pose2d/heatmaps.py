"""Heat maps to points: the highest pixel of each map or the place that is expected to score best, refined.

Pixel centres are at integers, and pixel (u, v) of a map stands for pixel (4u, 4v) of the crop: a network
trained on Gaussians drawn at keypoint / 4 is decoded without bias by multiplying with 4.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_count,
    check_floating,
    check_min_rank,
    check_positive,
)

METHODS = ("expected", "dark", "quarter")


def peak(maps: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Highest pixel of each map (..., h, w): column u and row v, int64, and its value, each (...)."""
    score, flat = maps.flatten(-2).max(-1)
    return flat % maps.shape[-1], flat // maps.shape[-1], score


def pixel(maps: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Values (...) of maps (..., h, w) at columns u and rows v, the nearest pixel where outside."""
    height, width = maps.shape[-2], maps.shape[-1]
    flat = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
    return maps.flatten(-2).gather(-1, flat.unsqueeze(-1)).squeeze(-1)


def decode_quarter(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Highest pixel, moved a quarter pixel towards its higher neighbour in each direction.

    A direction is not refined at the border: u needs 1 < u < w - 1 and v > 0, v likewise (as in
    mmpose).

    Args:
        maps: (..., h, w).

    Returns:
        Points (..., 2), ``uv`` in heat-map pixels, and scores (...), the heights of the peaks. Only the
        scores are differentiable.
    """
    height, width = maps.shape[-2], maps.shape[-1]
    u, v, score = peak(maps)
    du = (pixel(maps, u + 1, v) - pixel(maps, u - 1, v)).sign() * ((u > 1) & (u < width - 1) & (v > 0))
    dv = (pixel(maps, u, v + 1) - pixel(maps, u, v - 1)).sign() * ((v > 1) & (v < height - 1) & (u > 0))
    return torch.stack([u + 0.25 * du, v + 0.25 * dv], -1), score


def decode_dark(maps: Tensor, kernel: Tensor) -> tuple[Tensor, Tensor]:
    """Highest pixel p, moved to the peak of a Gaussian with the local derivatives of the map: p - H^-1 g.

    g and H are gradient and Hessian of the log of the smoothed map at p, by central differences (F. Zhang et
    al., "Distribution-Aware Coordinate Representation for Human Pose Estimation", CVPR 2020, eq. 9). The step
    is left out two pixels from the border and where H is singular.

    Args:
        maps: (..., h, w).
        kernel: (k,) smoothing kernel of each direction, k odd; maps count as zero outside.

    Returns:
        Points (..., 2), ``uv`` in heat-map pixels, and scores (...), the heights of the peaks. Both are
        differentiable with respect to the maps, with the highest pixel held fixed.
    """
    height, width = maps.shape[-2], maps.shape[-1]
    u, v, score = peak(maps)

    half = kernel.shape[0] // 2
    # Depthwise, because a convolution of single maps, one by one, takes over ten times as long.
    count = maps.shape[-3] if maps.dim() > 2 else 1
    smooth = maps.reshape(-1, count, height, width)
    column, row = kernel.view(1, 1, -1, 1), kernel.view(1, 1, 1, -1)
    smooth = F.conv2d(smooth, column.expand(count, -1, -1, -1), padding=[half, 0], groups=count)
    smooth = F.conv2d(smooth, row.expand(count, -1, -1, -1), padding=[0, half], groups=count).view(maps.shape)
    # Back to the original height, which matters only for the lower bound under the logarithm.
    tiny = 1e-10
    smooth = smooth * (score / smooth.amax((-2, -1)).clamp_min(tiny)).unsqueeze(-1).unsqueeze(-1)
    f = smooth.clamp_min(tiny).log()

    return torch.stack([u, v], -1) + newton_step(f, u, v), score


def newton_step(f: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Step -H^-1 g (..., 2) from pixels (u, v) to the peak of maps f (..., h, w), by central differences.

    Zero two pixels from the border and where the Hessian H is singular.
    """
    height, width = f.shape[-2], f.shape[-1]
    centre = pixel(f, u, v)
    gu = (pixel(f, u + 1, v) - pixel(f, u - 1, v)) / 2
    gv = (pixel(f, u, v + 1) - pixel(f, u, v - 1)) / 2
    huu = (pixel(f, u + 2, v) - 2 * centre + pixel(f, u - 2, v)) / 4
    hvv = (pixel(f, u, v + 2) - 2 * centre + pixel(f, u, v - 2)) / 4
    huv = pixel(f, u + 1, v + 1) - pixel(f, u - 1, v + 1) - pixel(f, u + 1, v - 1) + pixel(f, u - 1, v - 1)
    huv = huv / 4
    determinant = huu * hvv - huv * huv
    refined = (u > 1) & (u < width - 2) & (v > 1) & (v < height - 2) & (determinant != 0)
    determinant = torch.where(refined, determinant, torch.ones_like(determinant))
    step = torch.stack([huv * gv - hvv * gu, huv * gu - huu * gv], -1) / determinant.unsqueeze(-1)
    return step * refined.unsqueeze(-1)


def similarity(count: int, spread: float, like: Tensor) -> Tensor:
    """``exp(-(i - j)^2 / (2 spread^2))`` of pixels i and j of a row, (count, count); zero beyond three spreads."""
    place = torch.arange(count, dtype=like.dtype, device=like.device)
    distance = place.unsqueeze(-1) - place
    near = distance.abs() <= int(3 * spread) + 1
    return torch.exp(-distance.square() / (2 * spread * spread)) * near


def decode_expected(maps: Tensor, sharpness: float, tolerance: float) -> tuple[Tensor, Tensor]:
    """The place where a point is expected to be judged best: a Bayes decision instead of the highest pixel.

    A map m gives the probability of each pixel x: ``p ~ exp(sharpness m) - 1``, zero where that is not positive. A
    point found at q scores ``exp(-|x - q|^2 / (2 s^2))``, as in object keypoint similarity, with s ``tolerance`` times
    the longer side of the map. The q with the highest mean of that over p is found, to a fraction of a pixel as in
    :func:`decode_dark`. If a map has one sharp peak, that is its peak; for a blunt peak it is the middle, and for
    several peaks the one with the most probability around it. (J. O. Berger, "Statistical Decision Theory and Bayesian
    Analysis", 1985, section 4.4.)

    Args:
        maps: (..., h, w).
        sharpness: by how much high pixels count more than low ones.
        tolerance: share of the longer side of the map.

    Returns:
        Points (..., 2), ``uv`` in heat-map pixels, and scores (...), the heights of the highest peaks. Both are
        differentiable with respect to the maps, with the pixel that is nearest to the point held fixed.
    """
    # In half precision the top of a smooth map is flat.
    precise = maps if maps.dtype == torch.float64 else maps.float()
    spread = tolerance * max(maps.shape[-2], maps.shape[-1])
    level = precise.clamp_min(0.0)
    highest = level.amax((-2, -1), keepdim=True)
    # Over the exponential of the highest pixel, which may be large.
    share = (sharpness * (level - highest)).exp() - (-sharpness * highest).exp()
    # As products of matrices, a quarter of the time of a convolution with so wide a kernel.
    down, across = similarity(maps.shape[-2], spread, precise), similarity(maps.shape[-1], spread, precise)
    f = (down @ (share @ across)).clamp_min(1e-30).log()
    u, v, _ = peak(f)
    # The peak is within the pixel; more is the noise of a flat map.
    step = newton_step(f, u, v).clamp(-1.0, 1.0)
    return (torch.stack([u, v], -1) + step).to(maps.dtype), maps.flatten(-2).amax(-1)


def sides_apart(maps: Tensor, left: Tensor, right: Tensor, share: float = 0.7, radius: float = 4.0) -> Tensor:
    """Heat maps in which a left and a right point do not take the same place if there are two places.

    For a person seen from the side, a network finds both ankles but does not know which is the left one: both maps have
    two peaks of nearly the same height, and the higher one may be the same in both. Then one of the two maps loses that
    peak, chosen so that the product of the heights of both points is the largest. Points that do share a place, such as
    the ankles of a walker when one leg passes the other, have maps with one peak, and keep it.

    Args:
        maps: (..., K, h, w).
        left, right: (M,) int64, the maps of each pair.
        share: least height of the second peak as a share of the first, averaged over both maps: something that looks
            like a foot in only one of them is not one.
        radius: pixels of a map around a peak that belong to it.

    Returns:
        (..., K, h, w).
    """
    height, width = maps.shape[-2], maps.shape[-1]
    found = maps.detach().reshape(-1, maps.shape[-3], height, width)
    u, v, score = peak(found)
    distance = (u.index_select(1, left) - u.index_select(1, right)).square()
    distance = distance + (v.index_select(1, left) - v.index_select(1, right)).square()
    shared = (distance <= (radius - 1.0) ** 2).nonzero()
    # For S pairs that share one place: both maps and their peaks, left first.
    body = shared[:, :1]
    number = torch.stack([left, right], dim=-1).index_select(0, shared[:, 1])
    both, u, v, first = found[body, number], u[body, number], v[body, number], score[body, number]
    around = F.max_pool2d(both, 3, 1, 1)
    summits = torch.where(both >= around, both, 0.0)
    row = torch.arange(height, device=maps.device).unsqueeze(-1)
    column = torch.arange(width, device=maps.device)
    away = (column - u[..., None, None]).square() + (row - v[..., None, None]).square() > radius**2
    # What each map has beyond the peak of the other one, and what the other has there.
    away_from_other = away.flip(1)
    u_again, v_again, second = peak(summits * away_from_other)
    there = pixel(both.flip(1), u_again, v_again)
    floor = first.clamp(min=1e-10)
    again = (second / floor + there / floor.flip(1)) / 2
    moves_left = second[:, :1] * first[:, 1:] > first[:, :1] * second[:, 1:]
    goes = torch.cat([moves_left, ~moves_left], dim=1) & (again >= share)
    kept = torch.ones_like(found, dtype=torch.bool)
    kept = kept.index_put([body, number], ~goes[..., None, None] | away_from_other)
    return maps * kept.view(maps.shape)


class HeatmapDecoder(nn.Module):
    """Heat maps (..., h, w) to points of the crop, ``uv`` in crop pixels (..., 2), and scores (...).

    A map without a positive value still gives a pixel, the highest one or with ``"expected"`` the first one, and a
    score that is not positive.

    Args:
        method: ``"expected"`` (:func:`decode_expected`) or ``"dark"`` (:func:`decode_dark`), both differentiable, or
            ``"quarter"`` (:func:`decode_quarter`).
        kernel_size: k of the Gaussian that DARK smooths with, odd; sigma is 0.3 ((k - 1) / 2 - 1) + 0.8, that
            is 2 for 11.
        stride: how many crop pixels one heat-map pixel is wide.
        pairs: left and right maps of one body, by number, that are kept apart by :func:`sides_apart`.
        sharpness, tolerance: of ``"expected"``. The defaults were chosen on held-out people, for crops of 1.25 times
            the box and maps with peaks near 1.

    Raises:
        TensorsimError: another method, an even kernel, a stride below 1, a sharpness or tolerance that is not
            positive, integer or empty maps, fewer maps than ``pairs`` refers to.
    """

    kernel: Tensor
    left: Tensor
    right: Tensor

    def __init__(
        self,
        method: str = "dark",
        kernel_size: int = 11,
        stride: int = 4,
        pairs: tuple[tuple[int, int], ...] = (),
        sharpness: float = 7.0,
        tolerance: float = 0.07,
    ) -> None:
        super().__init__()
        check_choice(method, METHODS, "HeatmapDecoder.method")
        check_positive(sharpness, "HeatmapDecoder.sharpness")
        check_positive(tolerance, "HeatmapDecoder.tolerance")
        if kernel_size < 1 or kernel_size % 2 == 0:
            raise TensorsimError(
                f"HeatmapDecoder: got kernel_size {kernel_size}, expected a positive odd number"
            )
        check_count(stride, "HeatmapDecoder.stride")
        self.method = method
        self.stride = stride
        self.sharpness, self.tolerance = float(sharpness), float(tolerance)
        sigma = 0.3 * ((kernel_size - 1) / 2 - 1) + 0.8
        kernel = torch.signal.windows.gaussian(kernel_size, std=sigma, dtype=torch.float64)
        self.register_buffer("kernel", (kernel / kernel.sum()).float(), persistent=False)
        self.maps = 1 + max((number for pair in pairs for number in pair), default=-1)
        left, right = ([pair[side] for pair in pairs] for side in (0, 1))
        self.register_buffer("left", torch.tensor(left, dtype=torch.int64), persistent=False)
        self.register_buffer("right", torch.tensor(right, dtype=torch.int64), persistent=False)

    def forward(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """(..., h, w) -> points (..., 2) in crop pixels and scores (...)."""
        check_floating(maps, "HeatmapDecoder maps")
        check_min_rank(maps, 2, "HeatmapDecoder maps", "(..., h, w)")
        if maps.shape[-1] == 0 or maps.shape[-2] == 0:
            raise TensorsimError(
                f"HeatmapDecoder maps: got shape {list(maps.shape)}, expected (..., h, w) with pixels"
            )
        if self.maps > 0:
            check_min_rank(maps, 3, "HeatmapDecoder maps", "(..., K, h, w)")
            if maps.shape[-3] < self.maps:
                raise TensorsimError(
                    f"HeatmapDecoder maps: got shape {list(maps.shape)}, expected (..., K, h, w) with at least "
                    f"{self.maps} maps"
                )
            maps = sides_apart(maps, self.left, self.right)
        if self.method == "expected":
            points, scores = decode_expected(maps, self.sharpness, self.tolerance)
        elif self.method == "dark":
            points, scores = decode_dark(maps, self.kernel.to(maps.dtype))
        else:
            points, scores = decode_quarter(maps)
        return self.stride * points, scores

    def extra_repr(self) -> str:
        """What print shows, and what distinguishes cached keypoints from those of other settings."""
        spread = f", sharpness={self.sharpness:g}, tolerance={self.tolerance:g}" * (self.method == "expected")
        return f"{self.method}{spread}"

"""Metrics of radar maps and their differences: entropy, PSNR, SSIM, NMSE, and the error of the Doppler envelope.

A metric of a map depends on its normalisation, so every function states it. ``scale`` selects how maps are
normalised, each by its own peak:

- ``"linear"``: magnitude over peak, in [0, 1];
- ``"db"``: decibels below the peak, clipped at ``range_db`` (40) and mapped to [0, 1], as in pictures of maps.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
)


class Envelope(NamedTuple):
    """Envelope of a Doppler-time map; NaN in frames without any cell above the level.

    Attributes:
        upper: (..., K) its highest Doppler, in the units of the given axis.
        lower: (..., K) its lowest.
    """

    upper: Tensor
    lower: Tensor


def _check_map(x: Tensor, name: str) -> None:
    check_floating(x, name)
    check_min_rank(x, 2, name, "(..., Doppler or range bins, frames)")
    if x.shape[-1] == 0 or x.shape[-2] == 0:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected at least one bin and one frame")
    check_finite(x, name)
    if bool((x < 0).any()):
        raise TensorsimError(f"{name}: got negative values, expected magnitudes")


def _check_pair(maps: Tensor, reference: Tensor) -> None:
    _check_map(maps, "map")
    _check_map(reference, "reference")
    if maps.shape != reference.shape:
        raise TensorsimError(
            f"map: got shape {list(maps.shape)}, expected the reference's {list(reference.shape)}"
        )


def normalise(maps: Tensor, scale: str = "db", range_db: float = 40.0) -> Tensor:
    """Normalise magnitudes (..., F, K) to [0, 1] on a scale of this module; a map of zeros stays 0.

    Raises:
        TensorsimError: unknown scale, a range that is not positive, negative or NaN magnitudes.
    """
    _check_map(maps, "map")
    check_choice(scale, ("linear", "db"), "scale")
    check_positive(range_db, "range_db")
    peak = maps.amax((-2, -1), keepdim=True)
    level = maps / torch.where(peak > 0, peak, 1.0)
    if scale == "linear":
        return level
    return 1 + 20 * level.clamp_min(10 ** (-range_db / 20)).log10() / range_db


def entropy(maps: Tensor) -> Tensor:
    """Shannon entropy (...) in nats of the distribution of power over a map (..., F, K).

    ``-sum p ln p`` with ``p = |map|^2 / sum |map|^2``; a gain has no influence. 0 for a single point (and for a map of
    zeros), ``ln(F K)`` for a constant map; sharper maps have lower entropy. Differentiable; the gradient with respect
    to a cell of 0 is 0.

    >>> float(entropy(torch.eye(4)))  # four equal cells: ln 4
    1.3862943649291992
    """
    _check_map(maps, "map")
    power = maps.square()
    total = power.sum((-2, -1), keepdim=True)
    share = power / torch.where(total > 0, total, 1.0)
    # The slope of p ln p at 0 is infinite, that of the map's cell is 0; an empty cell counts 0, as one with p = 1 does.
    return torch.special.entr(torch.where(share > 0, share, 1.0)).sum((-2, -1))


def psnr(maps: Tensor, reference: Tensor, scale: str = "db", range_db: float = 40.0) -> Tensor:
    """Peak signal-to-noise ratio (...) in dB, ``-10 log10 mean (a - b)^2`` of the normalised maps; their peak is 1.

    Infinite for equal maps.

    >>> float(psnr(torch.ones(3, 3), torch.ones(3, 3)))
    inf
    """
    _check_pair(maps, reference)
    difference = normalise(maps, scale, range_db) - normalise(reference, scale, range_db)
    return -10 * difference.square().mean((-2, -1)).log10()


def nmse(maps: Tensor, reference: Tensor, scale: str = "linear", range_db: float = 40.0) -> Tensor:
    """Normalised mean square error (...), ``sum (a - b)^2 / sum b^2`` of the normalised maps, b the reference.

    NaN or infinite where the reference is 0 everywhere.
    """
    _check_pair(maps, reference)
    wanted = normalise(reference, scale, range_db)
    difference = normalise(maps, scale, range_db) - wanted
    return difference.square().sum((-2, -1)) / wanted.square().sum((-2, -1))


def ssim(maps: Tensor, reference: Tensor, scale: str = "db", range_db: float = 40.0) -> Tensor:
    """Mean structural similarity (...) of the normalised maps, in [-1, 1] (Wang et al., 2004).

    With their Gaussian window of 11 x 11, sigma 1.5, at positions wholly inside the map (kornia's ``ssim``).

    Raises:
        TensorsimError: also for maps smaller than 11 x 11.
    """
    from kornia.metrics import ssim as ssim_map

    _check_pair(maps, reference)
    if min(maps.shape[-2:]) < 11:
        raise TensorsimError(f"map: got shape {list(maps.shape)}, expected at least 11 x 11")
    pair = [normalise(x, scale, range_db).reshape(-1, 1, *x.shape[-2:]) for x in (maps, reference)]
    similarity = ssim_map(pair[0], pair[1], 11, max_val=1.0, eps=0.0, padding="valid")
    return similarity.mean((-3, -2, -1)).reshape(maps.shape[:-2])


def level_envelope(maps: Tensor, axis: Tensor, level_db: float = 20.0) -> Envelope:
    """Highest and lowest Doppler at which a map (..., F, K) is within ``level_db`` of its peak.

    ``axis`` (F,), ascending, gives Doppler in Hz or speed in m/s. Resolution one bin; no gradient.
    """
    _check_axis(maps, axis)
    check_positive(level_db, "level_db")
    peak = maps.amax((-2, -1), keepdim=True)
    inside = (maps >= peak * 10 ** (-level_db / 20)) & (peak > 0)
    values = axis.to(maps).unsqueeze(-1)
    upper = torch.where(inside, values, float("-inf")).amax(-2)
    lower = torch.where(inside, values, float("inf")).amin(-2)
    found = inside.any(-2)
    return Envelope(torch.where(found, upper, float("nan")), torch.where(found, lower, float("nan")))


def percentile_envelope(
    maps: Tensor, axis: Tensor, percentile: float = 95.0, floor_db: float = 40.0
) -> Envelope:
    """Doppler below which, and above which, ``percentile`` percent of the energy of each frame lies.

    Magnitudes more than ``floor_db`` below the peak of the map (..., F, K) are noise and set to 0. The energy of a bin
    is distributed evenly over its width, so the envelope is not quantised to bins. ``axis`` (F,): equal steps,
    ascending, Hz or m/s.
    """
    _check_axis(maps, axis)
    check_positive(floor_db, "floor_db")
    if not 50 < percentile < 100:
        raise TensorsimError(f"percentile: got {percentile}, expected between 50 and 100")
    peak = maps.amax((-2, -1), keepdim=True)
    power = torch.where(maps >= peak * 10 ** (-floor_db / 20), maps, 0.0).square()
    total = power.sum(-2, keepdim=True)
    share = power / torch.where(total > 0, total, 1.0)
    cumulative = share.cumsum(-2)
    width = axis[1] - axis[0]
    edges: list[Tensor] = []
    for quantile in (percentile / 100, 1 - percentile / 100):
        bin = (cumulative < quantile).sum(-2, keepdim=True).clamp_max(maps.shape[-2] - 1)
        within = (quantile - (cumulative - share).gather(-2, bin)) / share.gather(-2, bin)
        edge = axis.to(maps)[bin] + (within - 0.5) * width.to(maps)
        edges.append(torch.where(total > 0, edge, float("nan")).squeeze(-2))
    return Envelope(edges[0], edges[1])


def envelope_rmse(envelope: Envelope, reference: Envelope) -> Tensor:
    """Root mean square difference (...) of two envelopes, over upper and lower and the frames that both have.

    In the units of the envelopes: m/s for an axis of ``doppler_hz * wavelength / 2``. NaN without such frames.
    """
    difference = torch.stack((envelope.upper - reference.upper, envelope.lower - reference.lower))
    return difference.square().nanmean((0, -1)).sqrt()


def _check_axis(maps: Tensor, axis: Tensor) -> None:
    _check_map(maps, "map")
    if (
        axis.dim() != 1
        or axis.shape[0] != maps.shape[-2]
        or axis.shape[0] < 2
        or not bool((axis.diff() > 0).all())
    ):
        raise TensorsimError(
            f"axis: got shape {list(axis.shape)}, expected ({maps.shape[-2]},) ascending, one value per Doppler bin"
        )

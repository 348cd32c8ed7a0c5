"""Calibration of probabilities: the temperature that fits held-out logits, and how far confidence is from accuracy."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from tensorsim.errors import TensorsimError, check_count, check_finite, check_floating


def _check(logits: Tensor, labels: Tensor) -> None:
    check_floating(logits, "logits")
    if logits.dim() != 2 or len(logits) == 0 or labels.shape != logits.shape[:1]:
        raise TensorsimError(
            f"logits, labels: got shapes {list(logits.shape)} and {list(labels.shape)}, expected (N, classes) and (N,) "
            "with N at least 1"
        )
    check_finite(logits, "logits")
    classes = logits.shape[1]
    if labels.dtype != torch.int64 or bool(((labels < 0) | (labels >= classes)).any()):
        raise TensorsimError(
            f"labels: got {labels.dtype} from {labels.min()} to {labels.max()}, expected int64 from 0 to {classes - 1}"
        )


def fit_temperature(logits: Tensor, labels: Tensor) -> float:
    """The temperature T for which ``softmax(logits / T)`` gives held-out labels the highest likelihood.

    One number for all classes, so the most probable class stays the same (Guo et al., "On calibration of modern neural
    networks", ICML 2017). The negative log-likelihood has one minimum in ``1 / T``; it is found by golden section on
    ``log T`` between 0.05 and 20.

    Args:
        logits: (N, classes), of samples that were not trained on.
        labels: (N,) int64.

    Raises:
        TensorsimError: shapes that do not match, no samples, logits that are not finite, or labels out of range.
    """
    _check(logits, labels)
    logits = logits.detach().double()

    def loss(log_temperature: float) -> float:
        return float(F.cross_entropy(logits * torch.tensor(-log_temperature).double().exp(), labels))

    ratio = (5**0.5 - 1) / 2
    low, high = -3.0, 3.0
    inner, outer = high - ratio * (high - low), low + ratio * (high - low)
    below, above = loss(inner), loss(outer)
    for _ in range(40):
        if below < above:
            high, outer, above = outer, inner, below
            inner = high - ratio * (high - low)
            below = loss(inner)
        else:
            low, inner, below = inner, outer, above
            outer = low + ratio * (high - low)
            above = loss(outer)
    return float(torch.tensor((low + high) / 2).double().exp())


class Reliability(NamedTuple):
    """Bins of equal width of the confidence, from 0 to 1; values of empty bins are 0.

    Attributes:
        samples: (bins,) number of samples.
        confidence, accuracy: (bins,) float64, means over these samples.
    """

    samples: Tensor
    confidence: Tensor
    accuracy: Tensor


def reliability(probabilities: Tensor, labels: Tensor, bins: int = 10) -> Reliability:
    """How often the most probable class is right, by how probable it is (Guo et al., 2017).

    Args:
        probabilities: (N, classes), from 0 to 1.
        labels: (N,) int64.
        bins: number of bins.

    Raises:
        TensorsimError: shapes that do not match, no samples, probabilities or labels out of their range, or fewer
            than one bin.
    """
    _check(probabilities, labels)
    check_count(bins, "bins")
    if bool(((probabilities < 0) | (probabilities > 1 + 1e-5)).any()):
        raise TensorsimError(
            f"probabilities: got {float(probabilities.min()):.4g} to {float(probabilities.max()):.4g}, expected 0 to 1"
        )
    confidence, best = probabilities.detach().double().max(-1)
    place = (confidence * bins).long().clamp(max=bins - 1)
    count = torch.bincount(place, minlength=bins)
    sums = torch.zeros(2, bins, dtype=torch.float64)
    sums.index_add_(1, place, torch.stack([confidence, (best == labels).double()]))
    means = sums / count.clamp(min=1)
    return Reliability(count, means[0], means[1])


def expected_calibration_error(probabilities: Tensor, labels: Tensor, bins: int = 10) -> float:
    """Mean distance of confidence from accuracy over the bins of :func:`reliability`, with its arguments and errors."""
    found = reliability(probabilities, labels, bins)
    return float((found.samples * (found.confidence - found.accuracy).abs()).sum() / len(labels))

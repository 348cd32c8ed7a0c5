"""Calibration of probabilities: the temperature that fits held-out logits, and how far confidence is from accuracy."""

import torch
from torch import Tensor
from torch.nn import functional as F

from tensorsim.errors import TensorsimError, check_finite, check_floating


def _check(logits: Tensor, labels: Tensor) -> None:
    check_floating(logits, "logits")
    if logits.dim() != 2 or len(logits) == 0 or labels.shape != logits.shape[:1]:
        raise TensorsimError(
            f"logits, labels: got shapes {list(logits.shape)} and {list(labels.shape)}, expected (N, classes) and (N,) "
            "with N at least 1"
        )
    check_finite(logits, "logits")


def fit_temperature(logits: Tensor, labels: Tensor) -> float:
    """The temperature T for which ``softmax(logits / T)`` gives held-out labels the highest likelihood.

    One number for all classes, so the most probable class stays (Guo et al., "On calibration of modern neural
    networks", ICML 2017). The negative log-likelihood has one minimum in ``1 / T``; it is found by golden section on
    ``log T`` between 0.05 and 20.

    Args:
        logits: (N, classes), of samples that were not trained on.
        labels: (N,) int64.

    Raises:
        TensorsimError: shapes that do not go together, no samples, or logits that are not finite.
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


def expected_calibration_error(probabilities: Tensor, labels: Tensor, bins: int = 10) -> float:
    """Mean distance of confidence from accuracy, over bins of equal width of the confidence (Guo et al., 2017).

    Args:
        probabilities: (N, classes).
        labels: (N,) int64.
        bins: their number.

    Raises:
        TensorsimError: shapes that do not go together, no samples, or fewer than one bin.
    """
    _check(probabilities, labels)
    if bins < 1:
        raise TensorsimError(f"bins: got {bins}, expected at least 1")
    confidence, best = probabilities.double().max(-1)
    right = (best == labels).double()
    place = (confidence * bins).long().clamp(max=bins - 1)
    gap = torch.zeros(bins, dtype=torch.float64).index_add_(0, place, confidence - right)
    return float(gap.abs().sum() / len(labels))

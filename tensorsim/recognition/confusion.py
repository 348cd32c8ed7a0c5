"""Confusion matrix of a classifier."""

import torch
from torch import Tensor


def confusion(logits: Tensor, labels: Tensor) -> Tensor:
    """Counts (classes, classes) from logits (N, classes) and labels (N,): true class in rows, predicted in columns."""
    classes = logits.shape[-1]
    return torch.bincount(labels * classes + logits.argmax(-1), minlength=classes**2).view(classes, classes)

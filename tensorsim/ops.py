"""Tensor helpers shared by several subpackages; all can be scripted."""

import torch
from torch import Tensor


def flatten_batch(x: Tensor, rank: int) -> Tensor:
    """All dimensions before the last ``rank`` as one: (..., *) -> (B, *)."""
    return x.flatten(0, -rank - 1) if x.dim() > rank else x.unsqueeze(0)


def unflatten_batch(x: Tensor, lead: list[int]) -> Tensor:
    """The inverse: (B, *) -> (*lead, *)."""
    return x.reshape(lead + list(x.shape[1:]))


def times_as_fast(fps: float) -> int:
    """The frame rate as a multiple of 30 frames per second, rounded, at least 1: 1 below 45, 2 below 75."""
    return max(int(fps / 30.0 + 0.5), 1)


def of_person(values: Tensor, person: Tensor) -> Tensor:
    """Pick from values (N,) for people numbered (...); the last value applies to all further people."""
    return values[person.clamp(max=values.shape[0] - 1)]


def unit(x: Tensor) -> Tensor:
    """Vectors (..., D) scaled to length 1; finite, with a finite gradient, where they are 0."""
    return x / x.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()


def safe_sqrt(x: Tensor) -> Tensor:
    """Square root whose gradient at 0 is 0 instead of infinite."""
    if not x.requires_grad:
        return x.sqrt()
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def magnitude(x: Tensor) -> Tensor:
    """``|x|`` of complex numbers, with gradient 0 at 0.

    Without gradients by ``hypot``, which takes a third of the time of ``abs``; its gradient at 0 would be NaN.
    """
    if x.requires_grad:
        return x.abs()
    return torch.hypot(torch.real(x), torch.imag(x))

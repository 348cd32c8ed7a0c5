"""The order in which samples are shown."""

import functools

import torch
from torch import Tensor


@functools.lru_cache(maxsize=4)
def _epoch_order(epoch: int, count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed * 7919 + epoch)
    return torch.randperm(count, generator=generator)


def shuffled(index: int, count: int, seed: int) -> int:
    """Which of ``count`` samples is the ``index``-th of an endless stream, reshuffled in every epoch."""
    epoch, place = divmod(index, count)
    return int(_epoch_order(epoch, count, seed)[place])

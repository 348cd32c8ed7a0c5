"""Random numbers that depend on their position and a seed, not on the order in which they are drawn.

A pulse gets the same numbers whether a clip is computed whole or in pieces. See Salmon et al., *Parallel random
numbers: as easy as 1, 2, 3*, SC11; the mixing function is that of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014).
"""

import math

import torch
from torch import Tensor


def mix(x: Tensor) -> Tensor:
    """A bijection of int64 (...) that flips about half of the output bits when one input bit changes."""
    # Shifts of int64 keep the sign: the mask makes them logical. Constants are those of the source, as signed numbers.
    x = (x ^ ((x >> 30) & 0x3FFFFFFFF)) * -4658895280553007687
    x = (x ^ ((x >> 27) & 0x1FFFFFFFFF)) * -7723592293110705685
    return x ^ ((x >> 31) & 0x1FFFFFFFF)


def uniform(seed: int, pulse: Tensor, count: int) -> Tensor:
    """Numbers in (0, 1) for pulses (M,) int64: (M, count) float64, independent over seeds, pulses and columns."""
    column = torch.arange(count, dtype=torch.int64, device=pulse.device)
    row = mix(pulse.unsqueeze(-1) + mix(torch.full_like(column[:1], seed + 1) * -7046029254386353131))
    bits = mix(row + (column + 1) * -7046029254386353131)
    return (((bits >> 11) & 0x1FFFFFFFFFFFFF).double() + 0.5) / 2.0**53


def normal(seed: int, pulse: Tensor, count: int) -> Tensor:
    """Standard normal numbers for pulses (M,) int64: (M, count) float64 (Box and Muller)."""
    half = (count + 1) // 2
    both = uniform(seed, pulse, 2 * half)
    radius = (-2 * both[:, :half].log()).sqrt()
    angle = 2 * math.pi * both[:, half:]
    return torch.cat((radius * torch.cos(angle), radius * torch.sin(angle)), -1)[:, :count]

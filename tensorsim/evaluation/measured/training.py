"""Training of a small network on pictures that fit in memory."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import trange

#: A change of pictures (B, C, H, W) that keeps their labels.
Augment = Callable[[Tensor, torch.Generator], Tensor]


def square(pictures: Tensor, size: int) -> Tensor:
    """Pictures (N, 1, H, W) as (N, 1, size, size): larger sides are averaged, smaller ones interpolated."""
    return F.interpolate(pictures.float(), (size, size), mode="bilinear", antialias=True, align_corners=False)


def shift(shown: Tensor, most: int, dim: int, generator: torch.Generator) -> Tensor:
    """Pictures (B, C, H, W), each rolled along ``dim`` by up to ``most`` cells either way."""
    by = torch.randint(-most, most + 1, (shown.shape[0],), generator=generator)
    return torch.stack([torch.roll(picture, int(k), dim) for picture, k in zip(shown, by, strict=True)])


def warp(shown: Tensor, generator: torch.Generator, *, time: float, doppler: float, later: float) -> Tensor:
    """Pictures (B, C, H, W), each stretched and shifted at random, with bilinear interpolation; edges are repeated.

    Args:
        shown: the pictures.
        generator: source of the random numbers.
        time, doppler: largest change of the scale of columns and rows about the middle.
        later: largest shift along the columns, as a share of half their number.
    """
    count = shown.shape[0]
    draw = 2 * torch.rand(3, count, generator=generator) - 1
    turn = torch.zeros(count, 2, 3)
    turn[:, 0, 0], turn[:, 1, 1] = 1 + time * draw[0], 1 + doppler * draw[1]
    turn[:, 0, 2] = later * draw[2]
    grid = F.affine_grid(turn, list(shown.shape), align_corners=False)
    return F.grid_sample(shown, grid, padding_mode="border", align_corners=False)


def drop_cells(shown: Tensor, most: float, generator: torch.Generator) -> Tensor:
    """Pictures (B, C, H, W), each with a random share of up to ``most`` of its cells removed."""
    share = most * torch.rand(shown.shape[0], 1, 1, 1, generator=generator)
    return shown * (torch.rand(shown.shape, generator=generator) >= share)


def fit_pictures(
    net: nn.Module,
    pictures: Tensor,
    labels: Tensor,
    *,
    steps: int,
    augment: Augment,
    learning_rate: float = 3e-3,
    weights: Tensor | None = None,
    batch: int = 64,
    seed: int = 0,
    quiet: bool = True,
) -> None:
    """Train a network in place: AdamW, one cycle of the learning rate, cross-entropy with smoothed labels.

    Args:
        net: changed in place; left in evaluation mode.
        pictures, labels: (N, C, H, W) and (N,) int64.
        steps: batches.
        augment: applied to every batch.
        learning_rate: peak learning rate.
        weights: (N,) how often each picture is drawn relative to the others; None draws all equally often.
        batch: pictures per step, drawn with replacement.
        seed: seed of order, augmentation and dropout.
        quiet: no progress bar.
    """
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    optimiser = torch.optim.AdamW(net.parameters(), lr=learning_rate, weight_decay=2e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, learning_rate, total_steps=steps + 1)
    chance = torch.ones(len(labels)) if weights is None else weights
    net.train().to(memory_format=torch.channels_last)
    for _ in trange(steps, desc="training", unit="step", disable=quiet):
        chosen = torch.multinomial(chance, batch, replacement=True, generator=generator)
        shown = augment(pictures[chosen], generator).contiguous(memory_format=torch.channels_last)
        # In float32: bfloat16 gradients of depthwise convolutions are sometimes NaN (torch 2.14).
        loss = F.cross_entropy(net(shown), labels[chosen], label_smoothing=0.1)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    net.eval()


@torch.no_grad()
def predict(net: nn.Module, pictures: Tensor, batch: int = 256) -> Tensor:
    """Logits (N, classes) of pictures (N, C, H, W)."""
    return torch.cat([net(part) for part in pictures.split(batch)])

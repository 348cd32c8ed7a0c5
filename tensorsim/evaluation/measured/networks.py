"""The small network of the measured sets, and how it is trained on pictures that fit the memory."""

from collections.abc import Callable
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

#: A change of pictures (B, C, H, W) that keeps their labels.
Augment = Callable[[Tensor, torch.Generator], Tensor]


class PictureNet(nn.Module):
    """Four convolutions, then mean and maximum along time; what happens when in a clip matters little.

    Args:
        classes: number of classes.
        rows: height of the pictures.
        channels: of the input.
        width: channels of the first convolution; the last has four times as many.

    Shapes: pictures (B, channels, rows, columns), any number of columns from 8 on -> logits (B, classes).
    """

    def __init__(self, classes: int, rows: int, channels: int = 1, width: int = 16) -> None:
        super().__init__()
        sizes = (channels, width, 2 * width, 3 * width, 4 * width)
        layers: list[nn.Module] = []
        for i, (before, after) in enumerate(pairwise(sizes)):
            layers += [nn.Conv2d(before, after, 3, padding=1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
            if i < 3:
                layers.append(nn.MaxPool2d(2))
                rows //= 2
        self.features = nn.Sequential(*layers)
        self.drop = nn.Dropout(0.3)
        self.head = nn.Linear(2 * sizes[-1] * rows, classes)

    def forward(self, pictures: Tensor) -> Tensor:
        """Pictures (B, C, H, W) to logits (B, classes)."""
        maps = self.features(pictures)
        both = torch.cat([maps.mean(-1), maps.amax(-1)], dim=1).flatten(1)
        logits: Tensor = self.head(self.drop(both))
        return logits


def fit_pictures(
    net: nn.Module,
    pictures: Tensor,
    labels: Tensor,
    *,
    epochs: int,
    augment: Augment | None = None,
    learning_rate: float = 2e-3,
    weights: Tensor | None = None,
    batch: int = 64,
    seed: int = 0,
) -> None:
    """Train a network in place: AdamW, one cycle of the learning rate, cross-entropy with smoothed labels.

    Args:
        net: changed in place; left in evaluation mode.
        pictures, labels: (N, C, H, W) and (N,) int64.
        epochs: passes.
        augment: applied to every batch.
        learning_rate: the largest one.
        weights: (N,) how often each picture is drawn relative to the others; None is once in each pass.
        batch: pictures per step.
        seed: of order, augmentation and dropout.
    """
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    optimiser = torch.optim.AdamW(net.parameters(), lr=learning_rate, weight_decay=1e-2)
    steps = max(1, len(labels) // batch) * epochs
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, learning_rate, total_steps=steps + 1)
    chance = torch.ones(len(labels)) if weights is None else weights
    net.train()
    order = torch.empty(0, dtype=torch.int64)
    size = min(batch, len(labels))
    for _ in range(steps):
        if len(order) < size:
            order = torch.multinomial(chance, len(labels), weights is not None, generator=generator)
        chosen, order = order[:size], order[size:]
        shown = pictures[chosen]
        if augment is not None:
            shown = augment(shown, generator)
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

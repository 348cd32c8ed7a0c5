"""Anisotropic diffusion: smooths regions but not edges.

Source: P. Perona, J. Malik, "Scale-space and edge detection using anisotropic diffusion", IEEE Transactions on Pattern
Analysis and Machine Intelligence 12 (1990), equations 7 to 10, here also with the four diagonal neighbours.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import (
    check_choice,
    check_count,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    check_positive,
)

CONDUCTANCES = ("exponential", "quadratic")


def diffuse(images: Tensor, threshold: float, exponential: bool) -> Tensor:
    """One step of diffusion of images (B, 1, H, W), without flow over the border.

    ``I + 1/8 sum over neighbours of w c(dI) dI``: dI is the difference to the neighbour, w is 1 for the four direct and
    1/2 for the four diagonal neighbours, c is ``exp(-(dI / K)^2)`` or ``1 / (1 + (dI / K)^2)`` with K = ``threshold``.
    Step sizes up to 1/6 are stable.
    """
    height, width = images.shape[-2], images.shape[-1]
    padded = F.pad(images, [1, 1, 1, 1], mode="replicate")
    flow = torch.zeros_like(images)
    for dy in range(3):
        for dx in range(3):
            if dy != 1 or dx != 1:
                difference = padded[..., dy : dy + height, dx : dx + width] - images
                ratio = (difference / threshold).square()
                conductance = torch.exp(-ratio) if exponential else 1 / (1 + ratio)
                flow = flow + (1.0 if dy == 1 or dx == 1 else 0.5) * conductance * difference
    return images + flow / 8


class PeronaMalik(nn.Module):
    """Anisotropic diffusion of images in [0, 1].

    Args:
        iterations: number of steps; also the radius of the receptive field in pixels.
        threshold: K; differences well above it are edges and are preserved.
        conductance: ``"exponential"`` favours strong edges, ``"quadratic"`` large regions.

    Shapes: (..., H, W) -> (..., H, W). Differentiable.

    Raises:
        TensorsimError: fewer than one iteration, a threshold that is not positive, an unknown conductance; an input
            that is not real, has fewer than two dimensions, is empty, or has NaN or infinity.
    """

    def __init__(self, iterations: int = 5, threshold: float = 0.1, conductance: str = "exponential") -> None:
        super().__init__()
        check_count(iterations, "PeronaMalik.iterations")
        check_positive(threshold, "PeronaMalik.threshold")
        check_choice(conductance, CONDUCTANCES, "PeronaMalik.conductance")
        self.reach = iterations
        self.threshold = threshold
        self.exponential = conductance == "exponential"

    def forward(self, images: Tensor) -> Tensor:
        """Diffused images (..., H, W)."""
        check_floating(images, "PeronaMalik")
        check_min_rank(images, 2, "PeronaMalik", "(..., H, W)")
        check_not_empty(images, "PeronaMalik")
        check_finite(images, "PeronaMalik")
        x = images.reshape(-1, 1, images.shape[-2], images.shape[-1])
        for _ in range(self.reach):
            x = diffuse(x, self.threshold, self.exponential)
        return x.reshape(images.shape)

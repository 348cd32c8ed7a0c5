"""Anisotropic diffusion: smooths inside regions and not across edges.

Source: P. Perona, J. Malik, "Scale-space and edge detection using anisotropic diffusion", IEEE Transactions on Pattern
Analysis and Machine Intelligence 12 (1990), equations 7 to 10, here with the four diagonal neighbours as well.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tensorsim.errors import TensorsimError, check_floating, check_min_rank, check_not_empty, check_positive

CONDUCTANCES = ("exponential", "quadratic")


def diffuse(images: Tensor, threshold: float, exponential: bool) -> Tensor:
    """One step of diffusion of images (B, 1, H, W); nothing flows over the border.

    ``I + 1/8 sum over neighbours of w c(dI) dI``, dI the difference to the neighbour, w 1 beside and 1/2 across, c
    ``exp(-(dI / K)^2)`` or ``1 / (1 + (dI / K)^2)`` with K = ``threshold``. Steps up to 1/6 are stable.
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
        iterations: steps; also the reach of an output pixel in pixels.
        threshold: K, differences much above it are edges and stay.
        conductance: ``"exponential"`` favours strong edges, ``"quadratic"`` wide regions.

    Shapes: (..., H, W) -> (..., H, W). Differentiable.

    Raises:
        TensorsimError: fewer than one iteration, a threshold that is not positive, an unknown conductance; an input
            that is not real, has fewer than two dimensions or is empty.
    """

    def __init__(self, iterations: int = 5, threshold: float = 0.1, conductance: str = "exponential") -> None:
        super().__init__()
        if iterations < 1:
            raise TensorsimError(f"PeronaMalik.iterations: got {iterations}, expected at least 1")
        check_positive(threshold, "PeronaMalik.threshold")
        if conductance not in CONDUCTANCES:
            raise TensorsimError(
                f"PeronaMalik.conductance: got {conductance!r}, expected one of {CONDUCTANCES}"
            )
        self.reach = iterations
        self.threshold = threshold
        self.exponential = conductance == "exponential"

    def forward(self, images: Tensor) -> Tensor:
        """Diffused images (..., H, W)."""
        check_floating(images, "PeronaMalik")
        check_min_rank(images, 2, "PeronaMalik", "(..., H, W)")
        check_not_empty(images, "PeronaMalik")
        x = images.reshape(-1, 1, images.shape[-2], images.shape[-1])
        for _ in range(self.reach):
            x = diffuse(x, self.threshold, self.exponential)
        return x.reshape(images.shape)

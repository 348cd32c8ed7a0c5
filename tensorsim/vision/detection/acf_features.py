"""Aggregate channel features (ACF): ten channels of an image on cells of 4x4 pixels, and their pyramid.

Source: P. Dollár, R. Appel, S. Belongie, P. Perona, "Fast feature pyramids for object detection", IEEE Transactions on
Pattern Analysis and Machine Intelligence 36 (2014). Between the octaves of the pyramid the channels are not computed
but resampled, and scaled by a power of the ratio of sizes.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

#: L, u, v; the magnitude of the gradient; six orientations.
CHANNELS = 10
#: Side of a cell in pixels.
CELL = 4


def triangle_filter(x: Tensor, radius: int) -> Tensor:
    """Smooth (B, C, H, W) by a separable triangle of ``2 radius + 1`` pixels; edges are repeated."""
    ramp = 1.0 + radius - torch.arange(-radius, radius + 1, device=x.device, dtype=x.dtype).abs()
    kernel = (ramp / ramp.sum()).expand(x.shape[1], 1, 1, 2 * radius + 1)
    x = F.conv2d(F.pad(x, [radius, radius, 0, 0], mode="replicate"), kernel, groups=x.shape[1])
    x = F.pad(x, [0, 0, radius, radius], mode="replicate")
    return F.conv2d(x, kernel.transpose(2, 3), groups=x.shape[1])


def luv(images: Tensor) -> Tensor:
    """RGB images (B, 3, H, W) in [0, 1] as CIE L, u, v, shifted and scaled to [0, 1]."""
    linear = torch.where(images > 0.04045, ((images + 0.055) / 1.055).clamp(min=0.0).pow(2.4), images / 12.92)
    r, g, b = linear[:, 0], linear[:, 1], linear[:, 2]
    x = 0.412453 * r + 0.357580 * g + 0.180423 * b
    y = 0.212671 * r + 0.715160 * g + 0.072169 * b
    z = 0.019334 * r + 0.119193 * g + 0.950227 * b
    lightness = torch.where(y > 0.008856, 116 * y.clamp(min=1e-6).pow(1 / 3) - 16, 903.3 * y)
    total = (x + 15 * y + 3 * z).clamp(min=1e-6)
    # The white point of D65.
    u = 13 * lightness * (4 * x / total - 0.197939)
    v = 13 * lightness * (9 * y / total - 0.468311)
    return torch.stack([lightness / 270, (u + 88) / 270, (v + 134) / 270], dim=1)


def gradients(x: Tensor, radius: int = 5, constant: float = 0.005) -> tuple[Tensor, Tensor]:
    """Magnitude, divided by its local mean, and orientation in [0, pi), of the channel with the strongest gradient.

    (B, C, H, W) to (B, H, W) each.
    """
    across, down = F.pad(x, [1, 1, 0, 0], mode="replicate"), F.pad(x, [0, 0, 1, 1], mode="replicate")
    gx = (across[..., 2:] - across[..., :-2]) / 2
    gy = (down[..., 2:, :] - down[..., :-2, :]) / 2
    power = gx.square() + gy.square()
    best = power.argmax(1, keepdim=True)
    magnitude = power.gather(1, best).sqrt()
    orientation = torch.remainder(torch.atan2(gy.gather(1, best), gx.gather(1, best)), math.pi)
    normalised = magnitude / (triangle_filter(magnitude, radius) + constant)
    return normalised.squeeze(1), orientation.squeeze(1)


def aggregate_channels(images: Tensor, cell: int = CELL) -> Tensor:
    """The ten channels of RGB images (B, 3, H, W) in [0, 1]: (B, 10, H // 4, W // 4)."""
    colour = triangle_filter(luv(images), 1)
    magnitude, orientation = gradients(colour)
    place = orientation * (6 / math.pi)
    bins: list[Tensor] = []
    for k in range(6):
        apart = (place - k).abs()
        bins.append(magnitude * (1 - torch.minimum(apart, 6 - apart)).clamp(min=0.0))
    whole = torch.cat([colour, magnitude.unsqueeze(1), torch.stack(bins, 1)], dim=1)
    return triangle_filter(F.avg_pool2d(whole, cell), 1)


def rescaled(channels: Tensor, height: int, width: int, ratio: float, exponent: float = 0.11) -> Tensor:
    """Channels (B, 10, h, w) as they would be for an image ``ratio`` times as large.

    Gradients follow the power law with the published exponent, colour is only resampled.
    """
    moved = F.interpolate(channels, [height, width], mode="bilinear", align_corners=False)
    return torch.cat([moved[:, :3], moved[:, 3:] * ratio**-exponent], dim=1)


def pyramid(
    images: Tensor, rows: int, columns: int, octaves_up: int = 0, per_octave: int = 8, cell: int = CELL
) -> tuple[list[Tensor], list[float]]:
    """Channels of images at all scales down to a window of ``rows`` x ``columns`` cells, and the scales.

    Args:
        images: (B, 3, H, W) RGB in [0, 1].
        rows, columns: cells of the smallest level.
        octaves_up: how often the image is first doubled in size, for small people.
        per_octave: levels per octave, of which one is computed and the others resampled.
        cell: side of a cell in pixels.

    Returns:
        Channels (B, 10, h, w) of each level, largest first, and its scale relative to the image; both empty for an
        image that is smaller than a window.
    """
    height, width = images.shape[-2], images.shape[-1]
    levels: list[Tensor] = []
    scales: list[float] = []
    exact = 2.0**octaves_up
    while height * exact >= cell * rows and width * exact >= cell * columns:
        h, w = int(height * exact), int(width * exact)
        whole = images
        if exact != 1.0:
            whole = F.interpolate(images, [h, w], mode="bilinear", align_corners=False, antialias=exact < 1)
        channels = aggregate_channels(whole)
        for step in range(per_octave):
            ratio = 2.0 ** (-step / per_octave)
            cells = [int(h * ratio / cell + 0.5), int(w * ratio / cell + 0.5)]
            if cells[0] >= rows and cells[1] >= columns:
                level = channels if step == 0 else rescaled(channels, cells[0], cells[1], ratio)
                levels.append(level)
                scales.append(exact * ratio)
        exact = exact / 2
    return levels, scales

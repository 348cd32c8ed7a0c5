"""Changes of range from feet that stand on the floor.

The size of a body gives its range with an error of some per cent, and that error changes within a second, which looks
like motion along the line of sight. A foot that does not move in the picture does not move in the world, and the pose
says how far the hips are in front of it or behind it. Together they tell how the range changes from frame to frame,
though not the range itself.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.vision.smoothing.along_time import local_linear


def squared_speed(image: Tensor, seen: Tensor, fps: float, smoothing_s: float) -> Tensor:
    """Squared speeds (..., J, T - 1) in pixels per second of points (..., T, J, 2) that are smoothed along time."""
    points = image.transpose(-3, -2).transpose(-2, -1)
    weights = seen.transpose(-2, -1).unsqueeze(-2).expand_as(points).to(points.dtype) + 1e-4
    smooth = local_linear(points, weights, smoothing_s * fps)
    return ((smooth[..., 1:] - smooth[..., :-1]) * fps).square().sum(dim=-2)


def range_over_feet(
    hips_range: Tensor,
    image: Tensor,
    depth: Tensor,
    seen: Tensor,
    body_px: Tensor,
    precision: Tensor,
    fps: float,
) -> Tensor:
    """Correct how ranges change while a foot stands on the floor or the whole body is at rest.

    While a foot at depth d relative to the hips stands, ``y(t + 1) - y(t) = d(t) - d(t + 1)``. A foot counts as
    standing if it is slow in the picture (0.3 standing heights per second) and also along the line of sight, where its
    speed is that of the range and d together (0.4 m/s, more where the range is less precise): both feet of somebody who
    walks straight towards the camera are slow in the picture. While only one foot stands, seven tenths of its change
    and three tenths of the given one are used, because the near and the far leg are easily confused during a step. A
    body is at rest, and y does not change, if all joints but two are slow (0.08 heights per second) and so is the range
    (0.2 m/s). All these limits are standard deviations of Gaussian weights. The sum of the changes drifts away from the
    given ranges; their mean difference over 2.5 s is added, so that slow changes of the given ranges remain. This is
    done twice: which foot stands is seen better in the ranges of the first round than in the given ones.

    Args:
        hips_range: (..., T) m, from size and floor, smoothed.
        image: (..., T, 14, 2) joints in pixels.
        depth: (..., T, 14) of the joints relative to the hips, m.
        seen: (..., T, 14) bool, the joints that are seen inside the picture.
        body_px: (..., T) standing heights in pixels.
        precision: (..., T) positive, of the given range: 1 for an upright body.
        fps: frames per second.

    Returns:
        (..., T) m. Differentiable.
    """
    if hips_range.shape[-1] < 2:
        return hips_range
    steps = hips_range[..., 1:] - hips_range[..., :-1]
    both_seen = (seen[..., 1:, :] & seen[..., :-1, :]).transpose(-2, -1)
    unit = body_px[..., 1:].unsqueeze(-2).square()
    weight = precision[..., 1:]

    ankles = depth[..., 10:14:3].transpose(-2, -1)  # joints 10 and 13
    ankles = local_linear(ankles, torch.ones_like(ankles), 0.06 * fps)
    about = ankles[..., :-1] - ankles[..., 1:]
    across = squared_speed(image[..., 10:14:3, :], seen[..., 10:14:3], fps, 0.06) / unit
    slow = torch.exp(-0.5 * across / 0.3**2) * both_seen[..., 10:14:3, :].all(dim=-2, keepdim=True)
    across = torch.where(both_seen, squared_speed(image, seen, fps, 0.2) / unit, 0.0)
    third = across.topk(3, dim=-2)[0][..., 2, :]
    still = torch.exp(-0.5 * third / 0.08**2) * (both_seen.sum(dim=-2) >= 6)

    found = hips_range
    for _ in range(2):
        speeds = (found[..., 1:] - found[..., :-1]) * fps
        slides = speeds.unsqueeze(-2) - about * fps
        slides = local_linear(slides, torch.ones_like(slides), 0.12 * fps)
        stands = slow * torch.exp(-0.5 * weight.unsqueeze(-2) * (slides / 0.4).square())
        change = (stands * about).sum(dim=-2) / stands.sum(dim=-2).clamp(min=1e-6)
        believed = torch.maximum(stands.amin(dim=-2), 0.7 * stands.amax(dim=-2))

        drifts = local_linear(speeds, torch.ones_like(speeds), 0.12 * fps)
        rests = still * torch.exp(-0.5 * weight * (drifts / 0.2).square())
        change = change * believed / (believed + rests).clamp(min=1e-6)
        believed = torch.maximum(believed, rests)

        way = F.pad((steps + believed * (change - steps)).cumsum(dim=-1), [1, 0])
        # The ridge makes this a mean without slope: a steady drift of a standing person is an error of the size as
        # well.
        level = torch.full_like(way, 30.0)
        found = way + local_linear(hips_range - way, precision, 2.5 * fps, ridge=level)
    return found

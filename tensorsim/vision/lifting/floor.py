"""The floor under people: its distance gives that of a person who stands, kneels or lies on it.

The size of a body in the image gives its distance while it is upright. For somebody who crouches, falls or lies it says
little, as many poses look alike. There the floor helps: the lowest joint of a body rests on it, and it is as high as
where the same person last stood or will stand next. Heights of the floor are those of a standing ankle; any other joint
that rests on the floor has about as much flesh around it.
"""

import torch
from torch import Tensor

from tensorsim.body.skeleton import lowest_ankle, mid_hips
from tensorsim.vision.smoothing.along_time import fill_gaps, local_linear, masked_median, running_quantile


def lowered(joints: Tensor, drop: Tensor) -> Tensor:
    """Joints (..., 14, 3) moved down by ``drop`` (...)."""
    return torch.cat([joints[..., :2], joints[..., 2:] - drop[..., None, None]], dim=-1)


def upright_share(joints: Tensor, height: Tensor) -> Tensor:
    """How upright bodies are: 1 from a vertical extent of 0.78 standing heights (0.88 when standing), 0 below 0.6.

    Args:
        joints: (..., 14, 3) m.
        height: (...) standing heights, m.
    """
    extent = (joints[..., 2].amax(dim=-1) - joints[..., 2].amin(dim=-1)) / height
    return ((extent - 0.6) / 0.18).clamp(0.0, 1.0)


def looks_bent(image: Tensor, seen: Tensor) -> Tensor:
    """Whether legs and trunk, all seen, do not look like those of a standing body.

    In a standing body the trunk is 0.6 times as long as the legs (0.4 to 0.9 with steps, leaning and cameras that look
    down), is in line with them within 40 degrees, and at least one leg is straight: thigh and shank together are at
    most 1.25 times as long as the line from hip to ankle. This does not rely on the lifter, which may mistake a crouch
    for somebody who stands further away.

    Args:
        image: (..., 14, 2) joints in pixels of a camera without roll.
        seen: (..., 14) bool.

    Returns:
        (...) bool, false where a joint of trunk or legs is hidden.
    """
    ankles = 0.5 * (image[..., 10, :] + image[..., 13, :])
    hips = mid_hips(image)
    trunk, legs = hips - image[..., 1, :], ankles - hips
    trunk_px, legs_px = torch.linalg.vector_norm(trunk, dim=-1), torch.linalg.vector_norm(legs, dim=-1)
    bones = torch.zeros_like(trunk_px)
    for first in (8, 11):
        thigh = torch.linalg.vector_norm(image[..., first + 1, :] - image[..., first, :], dim=-1)
        shank = torch.linalg.vector_norm(image[..., first + 2, :] - image[..., first + 1, :], dim=-1)
        stretched = torch.linalg.vector_norm(image[..., first + 2, :] - image[..., first, :], dim=-1)
        # A straight leg is enough: the other one may be lifted.
        ratio = (thigh + shank) / stretched.clamp(min=1e-3)
        bones = ratio if first == 8 else torch.minimum(bones, ratio)
    aligned = (trunk * legs).sum(dim=-1) > 0.766 * trunk_px * legs_px
    ratio = trunk_px / legs_px.clamp(min=1e-3)
    stands = aligned & (ratio > 0.4) & (ratio < 0.9) & (bones < 1.25) & (legs[..., 1] > 0.0)
    return ~stands & seen[..., 1] & seen[..., 8:].all(dim=-1)


def range_on_floor(rise: Tensor, depth: Tensor, floor: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Depth of the hips at which the lowest joint of a body rests on the floor.

    With the hips at depth y, joint j is at ``rise_j (y + depth_j)`` above the camera; at the largest y with no joint
    below the floor, one rests on it.

    Args:
        rise: (..., 14) by how much the line of sight of a joint rises per metre along the optical axis.
        depth: (..., 14) of the joints relative to the hips, m.
        floor: (...) height above the camera (so negative), m.
        seen: (..., 14) bool, the joints that count.

    Returns:
        (...) metres, and by how many metres it changes per metre of floor height, (...) positive; both infinite where
        no line of sight leads down to the floor.
    """
    down = seen & (rise < -0.03) & (floor < 0.0)[..., None]
    slope = torch.where(down, rise, torch.full_like(rise, -1.0))
    y = torch.where(down, floor[..., None] / slope - depth, torch.full_like(rise, float("inf")))
    nearest, index = y.min(dim=-1)
    gain = -1.0 / slope.gather(-1, index[..., None])[..., 0]
    return nearest, torch.where(nearest < float("inf"), gain, nearest)


def fused_range(
    by_size: Tensor, upright: Tensor, by_floor: Tensor, gain: Tensor, stood: Tensor, height: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, weighted by precision, of the ranges from body size, from the floor and from where the person stood.

    The range from the size of an upright body is accurate to 3 %, and used alone; otherwise to 15 %, with the long
    tails of a Cauchy distribution about where the person stood: somebody who lies may seem twice as far away. The
    height of the floor is accurate to 6 cm where the person stood, with 12 cm more per metre from there (the camera's
    tilt, a mattress). Hips are within three tenths of the standing height from there. All these are standard
    deviations. The weights change smoothly, so that a person who lies still does not jump from one range to another.

    Args:
        by_size: (...) metres.
        upright: (...) of :func:`upright_share`.
        by_floor, gain: (...) of :func:`range_on_floor`.
        stood: (...) metres, in the nearest frame in which the person stood; infinite if there is none, and then the
            floor is not used either.
        height: (...) standing heights, m.

    Returns:
        (...) metres, the share of the size in it, and its precision: 1 for that of an upright body, less for others.
    """
    known = stood < float("inf")
    usable = known & (by_floor > 0.3) & (by_floor < 100.0)
    stood = torch.where(known, stood, by_size)
    by_floor = torch.where(usable, by_floor, stood)
    gain = torch.where(usable, gain, torch.ones_like(gain))
    bent = 1.0 - upright
    size = 1.0 / (by_size * (0.03 + 0.12 * bent)).square().clamp(min=1e-4)
    size = size / (1.0 + bent * ((by_size / stood).log() / 0.15).square())
    floor = usable * bent / (gain.square() * (0.06**2 + (0.12 * (by_floor - stood)).square()))
    place = known * bent / (0.3 * height).square()
    total = size + floor + place
    fused = (size * by_size + floor * by_floor + place * stood) / total
    precision = ((0.03 * by_size).square().clamp(min=1e-4) * total).clamp(min=1e-3, max=1.0)
    return fused, size / total, precision


def floor_under(joints: Tensor, valid: Tensor, fps: float, window_s: float) -> Tensor:
    """Height of the floor under people (..., T): a low running quantile of the lower ankle, smoothed.

    Args:
        joints: (..., T, 14, 3) m.
        valid: (..., T) bool, the frames that determine the floor; the others take that of the nearest one.
        fps: frames per second.
        window_s: of the quantile; longer than a jump.
    """
    low = fill_gaps(lowest_ankle(joints), valid)
    window = int(window_s * fps)
    low = running_quantile(low, window, 0.15)
    return local_linear(low, torch.ones_like(low), max(0.2 * window, 0.5))


def on_the_same_floor(floor: Tensor, hips_range: Tensor, valid: Tensor) -> Tensor:
    """Whether people stand on the same floor as the nearest one, allowing for an error of the camera's tilt.

    A small object mistaken for a person, such as a post, seems far away because of its size, so its feet would be far
    below the floor: by more than two metres, and so far that on the floor it would be less than a third as tall as a
    person. A child, half as tall as an adult, is kept.

    Args:
        floor: (..., P, T) height of the floor under each, above the camera (so negative), m.
        hips_range: (..., P, T) m.
        valid: (..., P, T) bool.

    Returns:
        (..., P) bool. True for the nearest one, and for all if its feet are above the camera.
    """
    if valid.shape[-2] == 0:
        return valid.any(dim=-1)
    away = masked_median(hips_range, valid)[..., 0]
    away = torch.where(valid.any(dim=-1), away, torch.full_like(away, float("inf")))
    level = masked_median(floor, valid)[..., 0]
    nearest = level.gather(-1, away.argmin(dim=-1, keepdim=True))
    # A tilt that is 8 degrees off moves feet that are 14 m away by two metres.
    return (nearest >= 0.0) | (level > 3.0 * nearest) | (level > nearest - 2.0)

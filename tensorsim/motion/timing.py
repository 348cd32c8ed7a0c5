"""Time profiles of movements: from rest to rest, there and back, accelerating, falling over."""

import math

import torch
from torch import Tensor

#: m/s^2.
GRAVITY = 9.81


def minimum_jerk(share: Tensor) -> Tensor:
    """``10 s^3 - 15 s^4 + 6 s^5``: from 0 to 1 with the least jerk (Flash and Hogan 1985)."""
    return share**3 * (10 + share * (6 * share - 15))


def segment(time: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """:func:`minimum_jerk` of the time from ``start`` to ``end``: 0 before, 1 after."""
    return minimum_jerk(((time - start) / (end - start)).clamp(0.0, 1.0))


def there_and_back(time: Tensor, out: Tensor, hold: Tensor | float, back: Tensor) -> Tensor:
    """From 0 to 1 in ``out`` seconds from time 0, held for ``hold``, and back to 0 in ``back``; see :func:`segment`."""
    return segment(time, torch.zeros_like(out), out) - segment(time, out + hold, out + hold + back)


def bell(time: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """``sin^2`` that is 0 at ``start``, 1 in the middle and 0 at ``end``; 0 outside."""
    share = ((time - start) / (end - start)).clamp(0.0, 1.0)
    return torch.sin(math.pi * share).square()


def travel(time: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Equivalent seconds at full speed, for a speed that rises by :func:`minimum_jerk` from start to end."""
    span = end - start
    share = ((time - start) / span).clamp(0.0, 1.0)
    return span * share**4 * (2.5 + share * (share - 3)) + (time - end).clamp(min=0.0)


def landing(share: Tensor, brake: float = 0.2) -> Tensor:
    """``s^2``, a fall from rest, with braking: 0 up to ``s = 0``, 1 from ``1 + brake`` on, without a jump in speed.

    It is the square, stopped at 1 and smoothed by a triangle of length ``brake``, in closed form: the second difference
    of its second integral.
    """
    half = brake / 2

    def twice_integrated(s: Tensor) -> Tensor:
        s = s.clamp(min=0.0)
        return torch.where(s < 1, s**4 / 12, 1 / 12 + (s - 1) / 3 + (s - 1).square() / 2)

    before, now, after = (twice_integrated(share - i * half) for i in (2, 1, 0))
    return (after - 2 * now + before) / half**2


def toppling_angles(step_s: float, smooth_s: float) -> Tensor:
    """Fall of a 1.75 m rod about its foot: angles from the vertical in degrees, every ``step_s`` seconds.

    ``theta'' = (1.5 g / 0.95 H) sin(theta) - 0.25 theta'`` from 4 degrees and 0.6 rad/s to a stop at 88 degrees,
    smoothed by a Hann window of ``smooth_s``, from rest.

    Returns:
        (L,) angles, the first 0, the last 88. Bodies of height H take ``sqrt(H / 1.75)`` times as long.
    """
    pull = 1.5 * GRAVITY / (0.95 * 1.75)
    angle, speed = math.radians(4.0), 0.6
    angles = []
    while angle < math.radians(88.0):
        angles.append(angle)
        half = speed + step_s / 2 * (pull * math.sin(angle) - 0.25 * speed)
        middle = angle + step_s / 2 * speed
        angle += step_s * half
        speed += step_s * (pull * math.sin(middle) - 0.25 * half)
    lead = round(0.25 / step_s)  # tips from standing to 4 degrees at 0.6 rad/s before gravity takes over
    s = torch.arange(lead, dtype=torch.float64) / lead
    first, rate = angles[0], 0.6 * lead * step_s
    # The quintic from rest at 0 to this angle and speed with the rod's acceleration.
    bend = (pull * math.sin(first) - 0.25 * 0.6) * (lead * step_s) ** 2
    tip = (
        (10 * first - 4 * rate + bend / 2) * s**3
        + (-15 * first + 7 * rate - bend) * s**4
        + (6 * first - 3 * rate + bend / 2) * s**5
    )
    window = round(smooth_s / step_s)
    still = torch.full((2 * window,), math.radians(88.0), dtype=torch.float64)
    curve = torch.cat([torch.zeros(window), tip, torch.tensor(angles, dtype=torch.float64), still])
    kernel = torch.hann_window(window, periodic=False, dtype=torch.float64)
    smooth = torch.nn.functional.conv1d(curve[None, None], (kernel / kernel.sum())[None, None])[0, 0]
    return torch.rad2deg(smooth)

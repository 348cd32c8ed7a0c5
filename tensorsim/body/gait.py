"""Walking: the joint angles of a gait cycle as functions of phase and speed.

Source: R. Boulic, N. Magnenat-Thalmann, D. Thalmann, "A global human walking model with real-time kinematic
personification", The Visual Computer 6 (1990), 344-358. Speeds are relative: leg lengths (thigh and shank, hip
to ankle) per second, valid from 0 to 3.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, check_finite, check_floating

_DEGREE = math.pi / 180


class Gait(NamedTuple):
    """Angles (radians) and translations (leg lengths) of a walking body; signs are those of ``BodyPose``.

    Attributes:
        hip, knee, ankle, shoulder, elbow: (..., T, 2) flexion, right then left; of the ankle, toes up.
        trunk: (..., T, 3) pitch (forward), roll and twist (counter-clockwise seen from above).
        pelvis: (..., T, 2) roll (right side down) and yaw (counter-clockwise).
        translation: (..., T, 3) of the middle of the hips: right, forward, up; up is never positive.
    """

    hip: Tensor
    knee: Tensor
    ankle: Tensor
    shoulder: Tensor
    elbow: Tensor
    trunk: Tensor
    pelvis: Tensor
    translation: Tensor


def cycle_s(relative_speed: Tensor) -> Tensor:
    """Seconds of a full cycle, two steps: 1.346 / sqrt(RV)."""
    return 1.346 / relative_speed.sqrt()


def stance_share(relative_speed: Tensor) -> Tensor:
    """The share of a cycle for which a foot is on the floor: (0.752 Tc - 0.143 s) / Tc."""
    return 0.752 - 0.143 / cycle_s(relative_speed)


def periodic_pchip(knots: Tensor, values: Tensor, phase: Tensor) -> Tensor:
    """Shape-preserving piecewise cubic of period 1 (Fritsch and Butland 1984, as in SciPy and MATLAB).

    Args:
        knots: (..., K) ascending, K >= 2, all within one period: last - first <= 1 (equal: the two are one point).
        values: (..., K).
        phase: (..., T), any real numbers.

    Returns:
        (..., T), continuous with its first derivative; never beyond the values of the knots.
    """
    step = torch.cat([knots[..., 1:] - knots[..., :-1], 1 + knots[..., :1] - knots[..., -1:]], dim=-1)
    step = step.clamp(min=1e-9)
    secant = (values.roll(-1, -1) - values) / step
    before, step_before = secant.roll(1, -1), step.roll(1, -1)
    w1, w2 = 2 * step + step_before, step + 2 * step_before
    monotone = before * secant > 0
    one = torch.ones_like(secant)
    safe_before, safe_after = torch.where(monotone, before, one), torch.where(monotone, secant, one)
    harmonic = (w1 + w2) / (w1 / safe_before + w2 / safe_after)
    slope = torch.where(monotone, harmonic, torch.zeros_like(harmonic))

    first = knots[..., :1]
    since_first = torch.remainder(phase - first, 1.0)
    place = torch.searchsorted((knots - first).contiguous(), since_first.contiguous(), right=True) - 1
    next_place = torch.remainder(place + 1, knots.shape[-1])
    h = step.gather(-1, place)
    t = (since_first - (knots - first).gather(-1, place)) / h
    y0, y1 = values.gather(-1, place), values.gather(-1, next_place)
    d0, d1 = slope.gather(-1, place), slope.gather(-1, next_place)
    s = 1 - t
    return y0 * s**2 * (1 + 2 * t) + y1 * t**2 * (1 + 2 * s) + h * s * t * (d0 * s - d1 * t)


def control_points(relative_speed: Tensor) -> dict[str, tuple[Tensor, Tensor]]:
    """Published control points by joint: phases (..., K) and degrees (..., K), for a right limb at phase 0.

    Three ranges of speed: below 0.5, below 1.3, and above.
    """
    rv = relative_speed
    u, w = (rv - 1.3) / 1.7, (rv - 0.5) / 0.8
    rds = stance_share(rv)

    def points(*numbers: Tensor | float) -> Tensor:
        return torch.stack([number * torch.ones_like(rv) for number in numbers], dim=-1)

    def by_speed(slow: Tensor, medium: Tensor, fast: Tensor) -> Tensor:
        column = rv.unsqueeze(-1)
        return torch.where(column < 0.5, slow, torch.where(column < 1.3, medium, fast))

    hip_x = points(-0.1, 0.5, 0.9)
    knee_x = points(0.17, 0.4, 0.75, 1)
    ankle_x = points(0, 0.08, 0.5, rds, 0.85)
    elbow_x = points(0.05, 0.5, 0.9)
    return {
        "hip": (
            by_speed(hip_x, hip_x, points(0.2 * u - 0.1, 0.5, 0.9)),
            by_speed(
                points(50 * rv, -30 * rv, 50 * rv), points(25, -15, 25), points(5 * u + 25, -15, 6 * u + 25)
            ),
        ),
        "knee": (
            by_speed(knee_x, knee_x, points(0.17 - 0.05 * u, 0.4, 0.75 - 0.05 * u, 1 - 0.03 * u)),
            by_speed(
                points(3, 3, 140 * rv, 3), points(3, 3, 70, 3), points(22 * u + 3, 3, 70 - 5 * u, 3 + 3 * u)
            ),
        ),
        "ankle": (
            by_speed(ankle_x, ankle_x, points(0, 0.08, 0.5 - 0.1 * u, rds, 0.85)),
            by_speed(
                points(-3, -30 * rv - 3, 22 * rv - 3, -34 * rv - 3, -3),
                points(-3, -18, 8, -20, -3),
                points(5 * u - 3, 4 * u - 18, 8 - 3 * u, -8 * u - 20, 5 * u - 3),
            ),
        ),
        "thorax": (
            points(0.1, 0.4, 0.6, 0.9),
            points(4 / 3 * rv, -1.5 * rv, -4 / 3 * rv, 1.5 * rv),
        ),
        "elbow": (
            by_speed(
                elbow_x, points(0.05, 0.01 * w + 0.5, 0.9), points(0.05, 0.04 * u + 0.51, 0.9 - 0.1 * u)
            ),
            by_speed(
                points(6 * rv + 3, 34 * rv + 3, 10 * rv + 3),
                points(8 * w + 6, 24 * w + 20, 9 * w + 8),
                points(14 - 6 * u, 44 + 26 * u, 17 - 6 * u),
            ),
        ),
    }


def pelvis_roll(relative_speed: Tensor, phase: Tensor) -> Tensor:
    """Roll (..., T) of the pelvis in degrees, right side down: it drops on the side of the swinging leg."""
    a = 1.66 * relative_speed
    t = torch.remainder(phase, 1.0)

    def wave(start: float, length: float) -> Tensor:
        return torch.cos(2 * math.pi * (t - start) / length)

    right_stance = torch.where(t < 0.15, wave(0.0, 0.3) - 1, -1 - wave(0.15, 0.7))
    left_stance = torch.where(t < 0.65, 1 - wave(0.5, 0.3), 1 + wave(0.65, 0.7))
    return a * torch.where(t < 0.5, right_stance, left_stance)


def boulic_gait(relative_speed: Tensor, phase: Tensor) -> Gait:
    """The body at phases of the gait cycle; phase 0 is the heel strike of the right foot.

    The published signs of lateral shift, trunk pitch and the yaw of pelvis and thorax refer to other axes;
    here the body sways over the standing foot, bows forward, and turns the side of the leading leg forward.

    Args:
        relative_speed: (...) RV, leg lengths per second, above 0 and at most 3.
        phase: (..., T) cycles.

    Returns:
        A :class:`Gait` in the dtype of ``phase``. Differentiable.

    Raises:
        TensorsimError: a speed outside the range of the model, or shapes that do not fit together.
    """
    check_floating(phase, "phase")
    check_finite(phase, "phase")
    if phase.dim() < 1 or phase.shape[:-1] != relative_speed.shape:
        raise TensorsimError(
            f"boulic_gait: got speeds of shape {list(relative_speed.shape)} and phases of shape "
            f"{list(phase.shape)}, expected (...) and (..., T)"
        )
    outside = relative_speed[~((relative_speed > 0) & (relative_speed <= 3))]
    if len(outside):
        raise TensorsimError(
            f"relative_speed: got {float(outside[0]):g}, expected above 0 and at most 3 leg lengths per second"
        )
    relative_speed = relative_speed.to(phase.dtype)
    curves = control_points(relative_speed)
    rv = relative_speed.unsqueeze(-1)

    def both(joint: str) -> Tensor:
        sides = [periodic_pchip(curves[joint][0], curves[joint][1], phase + shift) for shift in (0.0, 0.5)]
        return torch.stack(sides, dim=-1) * _DEGREE

    def sine(cycles: Tensor) -> Tensor:
        return torch.sin(2 * math.pi * cycles)

    quick = rv > 0.5
    # The printed signs of slow sway and surge are the opposite: with them the body would jump by twice their size at
    # a speed of 0.5.
    sway = torch.where(quick, -0.032, 0.128 * rv**2 - 0.128 * rv)
    surge = torch.where(quick, -0.021, 0.084 * rv**2 - 0.084 * rv)
    bow = torch.where(quick, 2.0, -8 * rv**2 + 8 * rv)
    rise = 0.015 * rv
    translation = torch.stack(
        [
            -sway * sine(phase - 0.1),
            surge * sine(2 * phase + 2 * (0.625 - stance_share(rv))),
            -rise + rise * sine(2 * phase - 0.35),
        ],
        dim=-1,
    )
    pitch = bow - bow * sine(2 * phase - 0.1)
    twist = -periodic_pchip(curves["thorax"][0], curves["thorax"][1], phase)
    yaw = 4 * rv * torch.cos(2 * math.pi * phase)
    swing = 9.88 * rv
    arm_phase = torch.stack([phase, phase + 0.5], dim=-1)
    shoulder = 3 - (swing / 2).unsqueeze(-1) - swing.unsqueeze(-1) * torch.cos(2 * math.pi * arm_phase)
    return Gait(
        hip=both("hip"),
        knee=both("knee"),
        ankle=both("ankle"),
        shoulder=shoulder * _DEGREE,
        elbow=both("elbow"),
        trunk=torch.stack([pitch, torch.zeros_like(pitch), twist], dim=-1) * _DEGREE,
        pelvis=torch.stack([pelvis_roll(relative_speed.unsqueeze(-1), phase), yaw], dim=-1) * _DEGREE,
        translation=translation,
    )

"""People who move like those in front of the measured radars, at any instants."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import mid_hips, mirror
from tensorsim.motion.act import Act
from tensorsim.motion.activities import perform
from tensorsim.motion.limb_scatterers import SEGMENTS
from tensorsim.motion.people import People, PeopleConfig, draw_people
from tensorsim.motion.resample import evaluate_cubic, natural_spline_curvature
from tensorsim.motion.scripts import walk
from tensorsim.vision.smoothing.kalman import (
    PANEL_MEASUREMENT_NOISE,
    PANEL_PROCESS_NOISE,
    REFERENCE_FPS,
    KalmanSmoother,
)

#: Joints are computed at this rate and interpolated by a C2 spline.
KNOT_HZ = 120.0

Script = Callable[[Tensor, People], Act]


class Draw:
    """Uniform and normal random numbers (N, 1) float64, from one generator."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count, self.generator = count, generator

    def __call__(self, low: float, high: float, columns: int = 1) -> Tensor:
        """Uniform (N, columns)."""
        share = torch.rand(self.count, columns, generator=self.generator, dtype=torch.float64)
        return low + (high - low) * share

    def normal(self, *shape: int) -> Tensor:
        """Standard normal (N, *shape)."""
        return torch.randn(self.count, *shape, generator=self.generator, dtype=torch.float64)


def smooth_noise(draw: Draw, frames: int, rate_hz: float, band_hz: Tensor, columns: int) -> Tensor:
    """Gaussian noise (N, frames, columns), standard deviation 1, spectrum ``1 / (1 + (f / band)^4)``, band (N, 1)."""
    white = draw.normal(frames, columns)
    frequency = torch.fft.rfftfreq(frames, 1 / rate_hz, dtype=torch.float64)
    shape = 1 / (1 + (frequency / band_hz) ** 4)
    noise = torch.fft.irfft(torch.fft.rfft(white, dim=1) * shape[..., None].sqrt(), n=frames, dim=1)
    return noise / noise.std(dim=1, keepdim=True).clamp(min=1e-9)


@dataclass(frozen=True)
class Unrest:
    """Small movements that people make on top of their activity.

    Attributes:
        sway_m: standard deviation of the whole body, (low, high).
        limbs_m: standard deviation of the wrists, smaller for elbows and head, (low, high).
    """

    sway_m: tuple[float, float] = (0.002, 0.008)
    limbs_m: tuple[float, float] = (0.0, 0.03)


#: Share of the limbs' unrest in each of the 14 joints.
_LIMB_SHARE = (0.5, 0.2, 0.2, 0.6, 1.0, 0.2, 0.6, 1.0, 0.1, 0.2, 0.0, 0.1, 0.2, 0.0)


def add_unrest(joints: Tensor, draw: Draw, unrest: Unrest) -> Tensor:
    """Sway of the body and unrest of the limbs on top of joints (N, K, 14, 3) at ``KNOT_HZ``."""
    frames = joints.shape[1]
    sway = smooth_noise(draw, frames, KNOT_HZ, draw(0.2, 0.6), 3) * draw(*unrest.sway_m)[..., None]
    limbs = smooth_noise(draw, frames, KNOT_HZ, draw(0.3, 1.0), 14 * 3).unflatten(-1, (14, 3))
    share = torch.tensor(_LIMB_SHARE, dtype=torch.float64)[:, None]
    height = (joints[..., 2:] / 1.4).clamp(0.0, 1.0)  # feet do not sway
    lively = draw(*unrest.limbs_m)[..., None, None] * draw(0.0, 1.0)[..., None, None]
    return joints + height * sway[:, :, None] + lively * share * limbs


def stage_people(
    count: int, draw: Draw, config: PeopleConfig, speed_m_s: tuple[float, float] | None
) -> People:
    """Draw people; ``speed_m_s``, if given, are bounds of speeds beyond those of ``PeopleConfig``."""
    people = draw_people(count, config, draw.generator)
    if speed_m_s is not None:
        people = people._replace(speed_m_s=draw(*speed_m_s)[:, 0])
    return people


def act_out(script: Script, time: Tensor, people: People) -> Tensor:
    """Joints (N, K, 14, 3) of people following a script from the origin, heading as drawn; the left-handed mirrored."""
    joints = perform(script, time, people)
    joints = torch.where(people.left_handed[:, None, None, None], mirror(joints), joints)
    return (rotation(2, people.heading_rad)[:, None, None] @ joints[..., None])[..., 0]


def smooth_as_paper(joints: Tensor) -> Tensor:
    """Joints (N, K, 14, 3) as smoothed by the paper's smoother at 30 fps: limbs lose motion above 2 Hz."""
    # Four times as many measurements per second, each with four times the variance, have the same weight.
    noise = PANEL_MEASUREMENT_NOISE * KNOT_HZ / REFERENCE_FPS
    return KalmanSmoother(PANEL_PROCESS_NOISE, noise)(joints, None, KNOT_HZ)


def place(joints: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
    """Move people (N, K, 14, 3) to (N, 1) x and y at the first knot."""
    hips = mid_hips(joints[:, :1])
    shift = torch.stack([x_m - hips[..., 0], y_m - hips[..., 1], torch.zeros_like(x_m)], dim=-1)
    return joints + shift[:, :, None]


def to_and_fro(
    script: Script, time: Tensor, people: People, draw: Draw, leg_m: Tensor, turn_s: Tensor, first_m: Tensor
) -> Tensor:
    """People (N, K, 14, 3) who walk straight for ``leg_m``, turn round in ``turn_s``, come back, and so on.

    Args:
        script: a gait along +y at the person's speed.
        time: (N, K) s.
        people: N people with their headings at the start.
        draw: random numbers.
        leg_m, turn_s: (N, 1).
        first_m: (N, 1) part of the first leg already covered at time 0.
    """
    speed = people.speed_m_s[:, None]
    straight = leg_m / speed
    cycle = straight + turn_s
    since = time + first_m / speed
    number = torch.floor(since / cycle)
    within = since - number * cycle
    turning = ((within - straight) / turn_s).clamp(0.0, 1.0)
    eased = turning**2 * (3 - 2 * turning)
    sense = torch.where(draw(0.0, 1.0) < 0.5, -1.0, 1.0)
    heading = math.pi * (number + eased) * sense
    # Slower through the turn.
    pace = 1 - draw(0.55, 0.9) * torch.sin(math.pi * turning).square()
    return along(script, heading, pace, people)


def along(script: Script, heading_rad: Tensor, pace: Tensor, people: People) -> Tensor:
    """People (N, K, 14, 3) who walk in the direction of their own heading plus ``heading_rad`` (N, K).

    Args:
        script: a gait along +y at the person's speed.
        heading_rad: (N, K) counter-clockwise seen from above, at ``KNOT_HZ``.
        pace: (N, K) fraction of the person's speed; the gait slows down with it.
        people: N people.
    """
    speed = people.speed_m_s[:, None]
    step = 1 / KNOT_HZ
    clock = torch.cumsum(pace, dim=1) * step
    joints = perform(script, clock, people)
    gone = speed * clock
    velocity = speed * pace
    x = torch.cumsum(-velocity * torch.sin(heading_rad), dim=1) * step
    y = torch.cumsum(velocity * torch.cos(heading_rad), dim=1) * step
    back = torch.stack([torch.zeros_like(gone), -gone, torch.zeros_like(gone)], dim=-1)
    turned = (rotation(2, heading_rad)[:, :, None] @ (joints + back[:, :, None])[..., None])[..., 0]
    path = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
    joints = turned + path[:, :, None]
    return (rotation(2, people.heading_rad)[:, None, None] @ joints[..., None])[..., 0]


def dim_limbs(rcs: Tensor, draw: Draw, low_db: float, high_db: float, per_segment: int) -> Tensor:
    """Cross sections (N, K, S) with a gain drawn for each segment of each body; the torso is unchanged.

    Args:
        rcs: cross sections of :class:`~tensorsim.motion.LimbScatterers`.
        draw: random numbers.
        low_db, high_db: bounds of the mean gain of a body; segments differ from it by 3 dB rms.
        per_segment: scatterers per segment.
    """
    gain_db = draw(low_db, high_db) + 3 * draw.normal(len(SEGMENTS))
    gain_db[:, 1] = 0.0  # the torso
    return rcs * 10 ** (gain_db.repeat_interleave(per_segment, 1) / 10).unsqueeze(1)


def walk_to_and_fro(
    time: Tensor,
    people: People,
    draw: Draw,
    leg_m: tuple[float, float],
    turn_s: tuple[float, float],
    turns: bool,
) -> tuple[Tensor, Tensor]:
    """People who walk towards or away from the radar, and turn round or walk straight on.

    Args:
        time: (N, K) s.
        people: N people.
        draw: random numbers.
        leg_m, turn_s: bounds of the length of straight parts and of the duration of a turn.
        turns: whether they turn round.

    Returns:
        Joints (N, K, 14, 3), and the offset (N, 1) from the mean y of the walk to the y of its start.
    """
    people = people._replace(heading_rad=people.heading_rad + torch.pi * (draw(0, 1)[:, 0] < 0.5))
    leg = draw(*leg_m)
    if turns:
        joints = to_and_fro(walk, time, people, draw, leg, draw(*turn_s), draw(0.0, 1.0) * leg)
    else:
        joints = act_out(walk, time, people)
    y = mid_hips(joints)[..., 1]
    return joints, y[:, :1] - y.mean(1, keepdim=True)


def at_instants(joints: Tensor, time_s: Tensor) -> Tensor:
    """Joints (N, K, 14, 3) at ``KNOT_HZ`` to (N, M, 14, 3) at instants (M,) s after the first."""
    return evaluate_cubic(
        joints, natural_spline_curvature(joints, 1 / KNOT_HZ), 1 / KNOT_HZ, time_s.double() * KNOT_HZ
    )


def in_beam(positions: Tensor, rcs: Tensor, height_m: float, width_deg: Tensor) -> Tensor:
    """Cross sections (N, K, S) weighted by a Gaussian two-way beam that is narrow in elevation.

    Args:
        positions: (N, K, S, 3) m.
        rcs: (N, K, S) m^2.
        height_m: height of the antennas, at x = y = 0.
        width_deg: (N, 1) full width of the two-way beam at half power.
    """
    across = positions[..., 2] - height_m
    elevation = torch.rad2deg(torch.atan2(across, positions[..., :2].norm(dim=-1)))
    return rcs * torch.exp(-4 * math.log(2) * (elevation / width_deg[..., None]).square())


def at_half_the_pulse_rate(echo: Tensor) -> Tensor:
    """Echo (..., M) as seen by a radar of half the pulse rate: Doppler beyond half of the axis wraps.

    Every second pulse, interpolated to all M (even) by a Fourier transform, so that the Doppler axis is the same.
    """
    pulses = echo.shape[-1]
    quarter = pulses // 4
    slow = torch.fft.fftshift(torch.fft.fft(echo[..., ::2]), dim=-1)
    before = pulses // 2 - quarter
    whole = F.pad(slow, [before, pulses - before - slow.shape[-1]])
    return 2 * torch.fft.ifft(torch.fft.ifftshift(whole, dim=-1))


def linear(values: Tensor, time_s: Tensor) -> Tensor:
    """Values (N, K, S) at ``KNOT_HZ`` to (N, M, S) at instants (M,), by linear interpolation."""
    at = (time_s * KNOT_HZ).clamp(max=values.shape[1] - 1.001)
    before = torch.floor(at).long()
    share = (at - before)[:, None].to(values.dtype)
    return torch.lerp(values.index_select(1, before), values.index_select(1, before + 1), share)


def knots(duration_s: float) -> Tensor:
    """Instants of the knots of a clip, with some beyond its end."""
    return torch.arange(round(duration_s * KNOT_HZ) + 8, dtype=torch.float64) / KNOT_HZ

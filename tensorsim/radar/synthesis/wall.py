"""A homogeneous wall: where it stands, and what a slab normal to y does to a wave.

Refractive index ``n = sqrt(eps_r (1 - j tan d)) = n' - j n''``; the time factor is ``exp(+j w t)``.
Coefficients follow Balanis, *Advanced Engineering Electromagnetics*, ch. 5 (Fresnel, for waves that are plane
at the wall) and Born and Wolf, *Principles of Optics*, 7.6 (the slab). Propagation phase is counted once, in
the delay: coefficients keep the interfaces and the loss only.
"""

import math
import sys
import warnings
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.config import SPEED_OF_LIGHT_M_S, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, TensorsimWarning

#: One-way loss from which a wall is reported as opaque: the two-way echo is then 80 dB down.
OPAQUE_DB = 40.0

#: Faces closer than this to the antenna plane touch it.
CONTACT_M = 1e-9


class Slab(NamedTuple):
    """A slab between air and air, for a wave that arrives at some angle; tensors (...) of one shape.

    Attributes:
        reflection: complex ``G``, air to wall; wall to air is ``-G``, and one passage through both faces is
            ``T12 T21 = 1 - G^2``.
        loss_neper: ``alpha d``, attenuation of one passage at the frequency asked for.
        excess_s: delay of one passage over the air it replaces, ``d (n' cos t - cos i) / c``.
        bounce_s: delay of a pair of internal bounces, ``2 d n' cos t / c``.
    """

    reflection: Tensor
    loss_neper: Tensor
    excess_s: Tensor
    bounce_s: Tensor


def refractive_index(relative_permittivity: Tensor, loss_tangent: Tensor) -> tuple[Tensor, Tensor]:
    """``(n', n'')`` of ``n = n' - j n'' = sqrt(eps_r (1 - j tan d))``, differentiable at ``tan d = 0`` as well."""
    modulus = relative_permittivity * (1 + loss_tangent.square()).sqrt()
    real = ((modulus + relative_permittivity) / 2).sqrt()
    return real, relative_permittivity * loss_tangent / (2 * real)


def fresnel(
    relative_permittivity: Tensor, loss_tangent: Tensor, cos_incidence: Tensor, polarization: str
) -> Tensor:
    """Reflection coefficient of an interface from air, complex (...).

    ``"te"``: field normal to the plane of incidence, ``(cos i - n cos t) / (cos i + n cos t)``; ``"tm"``: in
    that plane, ``(cos t - n cos i) / (cos t + n cos i)``. Signs are those of the electric field, so that both
    are ``(1 - n) / (1 + n)`` at normal incidence.
    """
    real, imaginary = refractive_index(relative_permittivity, loss_tangent)
    n = torch.complex(real, -imaginary)
    cos_refracted = (1 - (1 - cos_incidence.square()) / n.square()).sqrt()
    if polarization == "te":
        return (cos_incidence - n * cos_refracted) / (cos_incidence + n * cos_refracted)
    return (cos_refracted - n * cos_incidence) / (cos_refracted + n * cos_incidence)


def slab_coefficients(
    relative_permittivity: Tensor,
    loss_tangent: Tensor,
    thickness_m: Tensor,
    frequency_hz: float,
    cos_incidence: Tensor,
    polarization: str = "te",
    speed_m_s: float = SPEED_OF_LIGHT_M_S,
) -> Slab:
    """The slab for a wave at this cosine (...) of the angle of incidence; 1 is normal.

    The ray bends by ``n'``; the loss follows from the imaginary part of ``n cos t``.
    """
    real, imaginary = refractive_index(relative_permittivity, loss_tangent)
    n = torch.complex(real, -imaginary)
    sin_square = 1 - cos_incidence.square()
    wave_number = 2 * math.pi * frequency_hz / speed_m_s
    along = n * (1 - sin_square / n.square()).sqrt()  # n cos t of the lossy medium
    cos_refracted = (1 - sin_square / real.square()).sqrt()
    return Slab(
        fresnel(relative_permittivity, loss_tangent, cos_incidence, polarization),
        -wave_number * thickness_m * along.imag,
        thickness_m * (real * cos_refracted - cos_incidence) / speed_m_s,
        2 * thickness_m * real * cos_refracted / speed_m_s,
    )


def transmission(slab: Slab, bounces: int) -> Tensor:
    """``T_k = (1 - G^2) G^(2k) exp(-(2k + 1) alpha d)``: through the slab after k pairs of internal bounces."""
    straight = (1 - slab.reflection.square()) * torch.exp(-slab.loss_neper)
    if bounces == 0:
        return straight
    return straight * (slab.reflection * torch.exp(-slab.loss_neper)).pow(2 * bounces)


def airy(slab: Slab, frequency_hz: float) -> tuple[Tensor, Tensor]:
    """``(R, T)``: reflection and transmission of the whole slab with all its bounces, both at ``frequency_hz``.

    Relative to the near face, and to a straight passage: its phase is not in T, since delays hold it.
    ``T = T_0 / (1 - q)`` and ``R = G (1 - q / G^2) / (1 - q)`` with ``q = G^2 exp(-2 alpha d - j 2 pi f t)``, t
    the delay of a pair of bounces: the sum of :func:`transmission` over all k with the phases of their delays.
    """
    phase = 2 * math.pi * frequency_hz * slab.bounce_s
    turn = torch.polar(torch.exp(-2 * slab.loss_neper), -phase)
    rest = 1 - slab.reflection.square() * turn
    return slab.reflection * (1 - turn) / rest, transmission(slab, 0) / rest


def refracted_leg(
    lateral_m: Tensor, air_m: Tensor, thickness_m: Tensor, index: Tensor
) -> tuple[Tensor, Tensor]:
    """Snell's path through a slab: ``(cos i, optical length)``, each (...).

    ``lateral_m`` (...) is the offset along the wall, ``air_m`` (...) > 0 the air to cross, both sides together.
    The tangent of the angle of incidence solves ``air tan i + d tan t = lateral`` with ``sin i = n' sin t``.
    Newton's iteration from the straight line converges monotonically, quadratically in the end: eight steps
    leave 1e-12 m even at grazing incidence. It runs without gradients; one more step with them gives the
    derivative of the implicit function, exactly.
    """
    lateral, air, thickness, n = lateral_m.detach(), air_m.detach(), thickness_m.detach(), index.detach()
    tangent = lateral / (air + thickness)
    for _ in range(8):
        under = (n.square() + (n.square() - 1) * tangent.square()).sqrt()
        offset = air * tangent + thickness * tangent / under
        tangent = tangent + (lateral - offset) / (air + thickness * n.square() / under.pow(3))
    under = (n.square() + (n.square() - 1) * tangent.square()).sqrt()
    slope = air + thickness * n.square() / under.pow(3)
    under = (index.square() + (index.square() - 1) * tangent.square()).sqrt()
    tangent = tangent + (lateral_m - air_m * tangent - thickness_m * tangent / under) / slope
    secant = (1 + tangent.square()).sqrt()
    cos_refracted = (1 - (tangent / (secant * index)).square()).sqrt()
    return 1 / secant, air_m * secant + index * thickness_m / cos_refracted


def wall_tensors(wall: WallConfig) -> tuple[Tensor, Tensor, Tensor]:
    """``(eps_r, tan d, d)`` as float64 tensors ()."""
    values = torch.tensor(
        [wall.relative_permittivity, wall.loss_tangent, wall.size_m[1]], dtype=torch.float64
    )
    permittivity, loss_tangent, thickness = values.unbind()
    return permittivity.clone(), loss_tangent.clone(), thickness.clone()


def one_way_loss_db(wall: WallConfig, frequency_hz: float) -> float:
    """Loss of one straight passage at normal incidence, ``-20 log10 |T0|``."""
    slab = slab_coefficients(*wall_tensors(wall), frequency_hz, torch.ones((), dtype=torch.float64))
    return -20 * math.log10(max(float(transmission(slab, 0).abs()), sys.float_info.min))


def near_face_m(wall: WallConfig) -> float:
    """The y of the face towards the radar."""
    return wall.center_m[1] - wall.size_m[1] / 2


def place_wall(wall: WallConfig | None, radar: RadarConfig) -> WallConfig | None:
    """The wall as the echo uses it: in front of all antennas, or None where there is no wall.

    A wall of thickness 0 is no wall. A wall that contains an antenna (the original application's default
    centre is the transmitter) moves along y until its near face touches the antenna plane, with a warning.

    Raises:
        TensorsimError: the whole wall is behind the antennas.
    """
    if wall is None or wall.size_m[1] == 0.0:
        return None
    x, y, z = wall.center_m
    half = wall.size_m[1] / 2
    antennas_y = [antenna[1] for antenna in radar.tx_positions_m + radar.rx_positions_m]
    plane, rear_antenna = max(antennas_y), min(antennas_y)
    if y + half <= rear_antenna + CONTACT_M:
        raise TensorsimError(
            f"wall: its far face is at y = {y + half:.4g} m, expected in front of the antennas "
            f"at y = {plane:.4g} m: behind them there is nothing to pass through"
        )
    if y - half < plane + CONTACT_M:
        if y - half < plane - CONTACT_M:
            warnings.warn(
                f"wall: spans y = {y - half:.4g} to {y + half:.4g} m and contains the antennas "
                f"at y = {plane:.4g} m; moved so that its near face touches the antenna plane",
                TensorsimWarning,
                stacklevel=2,
            )
        wall = replace(wall, center_m=(x, plane + half, z))
    loss_db = one_way_loss_db(wall, radar.carrier_hz)
    if loss_db > OPAQUE_DB:
        warnings.warn(
            f"wall: {-loss_db:.0f} dB one way at {radar.carrier_hz / 1e9:g} GHz, "
            "next to nothing comes back through it",
            TensorsimWarning,
            stacklevel=2,
        )
    return wall

"""Through-the-wall propagation: position of a homogeneous wall, and transmission through a slab normal to y.

Refractive index ``n = sqrt(eps_r (1 - j tan d)) = n' - j n''``; the time factor is ``exp(+j w t)``.
Coefficients follow Balanis, *Advanced Engineering Electromagnetics*, ch. 5 (Fresnel, for waves that are plane
at the wall) and Born and Wolf, *Principles of Optics*, 7.6 (the slab). The propagation phase is counted once, in
the delay; the coefficients contain interfaces and loss only. The paper counts it in both:
:func:`paper_transmission`.
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

#: Faces closer than this to the antenna plane count as touching it.
CONTACT_M = 1e-9


class Slab(NamedTuple):
    """A slab between air and air, for a wave that arrives at some angle; tensors (...) of one shape.

    Attributes:
        reflection: complex ``G``, air to wall; wall to air is ``-G``, and one passage through both faces is
            ``T12 T21 = 1 - G^2``.
        loss_neper: ``alpha d``, attenuation of one passage at the given frequency in neper.
        excess_s: additional delay of one passage compared with air in seconds, ``d (n' cos t - cos i) / c``.
        bounce_s: delay of a pair of internal bounces in seconds, ``2 d n' cos t / c``.
    """

    reflection: Tensor
    loss_neper: Tensor
    excess_s: Tensor
    bounce_s: Tensor


class WallTerms(NamedTuple):
    """Two-way echoes of a target behind a wall; the last dimension is the number of internal bounce pairs.

    Attributes:
        gain: (..., 3) complex factor of the received wave: ``T0^2``, ``2 T0 T1``, ``T1^2``.
        delay_s: (..., 3) delay of each in seconds, beyond that of the same path in air.
    """

    gain: Tensor
    delay_s: Tensor


def refractive_index(relative_permittivity: Tensor, loss_tangent: Tensor) -> tuple[Tensor, Tensor]:
    """``(n', n'')`` of ``n = n' - j n'' = sqrt(eps_r (1 - j tan d))``, differentiable at ``tan d = 0`` as well."""
    modulus = relative_permittivity * (1 + loss_tangent.square()).sqrt()
    real = ((modulus + relative_permittivity) / 2).sqrt()
    return real, relative_permittivity * loss_tangent / (2 * real)


def fresnel(
    relative_permittivity: Tensor, loss_tangent: Tensor, cos_incidence: Tensor, polarization: str
) -> Tensor:
    r"""Reflection coefficient of an interface from air, complex (...).

    ``"te"``, with the field normal to the plane of incidence, and ``"tm"``, with the field in that plane:

    $$ \Gamma_{TE} = \frac{\cos i - n \cos t}{\cos i + n \cos t}, \quad
    \Gamma_{TM} = \frac{\cos t - n \cos i}{\cos t + n \cos i} $$

    Signs are those of the electric field, so that both are $(1 - n) / (1 + n)$ at normal incidence.
    """
    real, imaginary = refractive_index(relative_permittivity, loss_tangent)
    n = torch.complex(real, -imaginary)
    # For a wall of air the quotient is 0 / 0 at grazing incidence and beyond, where no wave arrives.
    cos_incidence = cos_incidence.clamp_min(1e-9)
    cos_refracted = (n.square() - 1 + cos_incidence.square()).sqrt() / n
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
    r"""Coefficients of a slab for a plane wave.

    The ray is refracted by the real part of $n = \sqrt{\varepsilon_r (1 - j \tan \delta)} = n' - j n''$; the loss
    follows from the imaginary part of $n \cos t$. At normal incidence

    $$ \alpha = \frac{2 \pi f}{c} n'' $$

    Args:
        relative_permittivity, loss_tangent, thickness_m: () or (...), see :func:`wall_tensors`.
        frequency_hz: frequency of the loss.
        cos_incidence: (...) cosine of the angle of incidence, 1 for normal incidence.
        polarization: ``"te"`` or ``"tm"``, see :func:`fresnel`.
        speed_m_s: speed of light.
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


def bounce_ratio(slab: Slab, bounces: int) -> Tensor:
    """``T_k / T_0 = (G exp(-alpha d))^(2k)`` of :func:`transmission`, even where T_0 underflows to 0."""
    return (slab.reflection * torch.exp(-slab.loss_neper)).pow(2 * bounces)


def transmission(slab: Slab, bounces: int) -> Tensor:
    """One-way transmission ``T_k = T12 T21 G^(2k) exp(-(2k + 1) alpha d)`` with k pairs of internal bounces.

    ``T12 T21 = (1 + G) (1 - G)``. Complex (...), without the propagation phase, which the delay contains.
    """
    straight = (1 - slab.reflection.square()) * torch.exp(-slab.loss_neper)
    if bounces == 0:
        return straight
    return straight * bounce_ratio(slab, bounces)


def passage_phase(slab: Slab, passages: int, frequency_hz: float) -> Tensor:
    """Propagation phase ``exp(-j beta d)`` of a passage, raised to the number of passages."""
    angle = -passages * math.pi * frequency_hz * slab.bounce_s  # a pair of bounces is 2 d long
    return torch.polar(torch.ones_like(angle), angle)


def paper_transmission(slab: Slab, bounces: int, frequency_hz: float) -> Tensor:
    r""":func:`transmission` as the paper prints it.

    $$ T_k e^{-j (2 k + 1) \beta d}, \quad \beta = \frac{2 \pi f}{c} n' \cos t $$

    The propagation phase of the wall is then counted twice, here and in the delay.
    """
    return transmission(slab, bounces) * passage_phase(slab, 2 * bounces + 1, frequency_hz)


def two_way_wall_transmission(slab: Slab) -> WallTerms:
    """Two-way transmission of a wall, term by term: without, with one and with two pairs of bounces.

    $$ (T_0 + T_1)^2 = T_0^2 + 2 T_0 T_1 + T_1^2 $$

    Both legs of the path pass the wall; :func:`transmission` is for one leg. Each leg is delayed by ``excess_s``,
    and each pair of internal bounces adds ``bounce_s``::

        T0^2     2 excess                direct
        2 T0 T1  2 excess + bounce       one bounce pair, on the way to the target or back
        T1^2     2 excess + 2 bounce     one bounce pair on both

    The paper keeps ``T0^2`` and ``T1^2`` only. Inputs are not checked.

    Args:
        slab: coefficients (...) of the wall, see :func:`slab_coefficients`.

    Returns:
        :class:`WallTerms`: ``gain`` (..., 3) complex and ``delay_s`` (..., 3) seconds, in the order of the table.
    """
    t0, t1 = transmission(slab, 0), transmission(slab, 1)
    excess, bounce = 2 * slab.excess_s, slab.bounce_s
    return WallTerms(
        torch.stack((t0.square(), 2 * t0 * t1, t1.square()), -1),
        torch.stack((excess, excess + bounce, excess + 2 * bounce), -1),
    )


def airy(slab: Slab, frequency_hz: float) -> tuple[Tensor, Tensor]:
    """``(R, T)``: reflection and transmission of the whole slab with all internal bounces at ``frequency_hz``.

    R refers to the near face. T refers to a straight passage, whose phase is in the delay and not in T.
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
    """Refracted path through a slab by Snell's law: ``(cos i, optical length in metres)``, each (...).

    The tangent of the angle of incidence solves ``air tan i + d tan t = lateral`` with ``sin i = n' sin t``.
    Newton's iteration from the straight line converges monotonically and finally quadratically: after eight steps
    the error is 1e-12 m even at grazing incidence. It runs without gradients; one more step with gradients gives
    the exact derivative of the implicit function.

    Args:
        lateral_m: (...) distance between the ends along the wall.
        air_m: (...) > 0, distance through air normal to the wall, both sides together.
        thickness_m: d.
        index: n'.
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
    """Loss of one straight passage in dB at normal incidence, ``-20 log10 |T0|``."""
    slab = slab_coefficients(*wall_tensors(wall), frequency_hz, torch.ones((), dtype=torch.float64))
    return -20 * math.log10(max(float(transmission(slab, 0).abs()), sys.float_info.min))


def near_face_m(wall: WallConfig) -> float:
    """The y coordinate in metres of the face towards the radar."""
    return wall.center_m[1] - wall.size_m[1] / 2


def place_wall(wall: WallConfig | None, radar: RadarConfig) -> WallConfig | None:
    """Check the position of a wall and move it in front of the antennas if it contains one of them.

    The original application's default wall is centred on the transmitter. Such a wall is moved along y until its
    near face touches the antenna plane, with a warning. A wall that attenuates by more than ``OPAQUE_DB`` one way
    gives a warning too.

    Returns:
        The wall, or None for no wall or one of thickness 0.

    Raises:
        TensorsimError: the whole wall is behind the antennas, or between them.
    """
    if wall is None or wall.size_m[1] == 0.0:
        return None
    x, y, z = wall.center_m
    half = wall.size_m[1] / 2
    antennas_y = [antenna[1] for antenna in radar.tx_positions_m + radar.rx_positions_m]
    plane = max(antennas_y)
    if y + half <= plane + CONTACT_M:
        raise TensorsimError(
            f"wall: its far face is at y = {y + half:.4g} m, expected in front of all antennas, the foremost at "
            f"y = {plane:.4g} m: a wall behind them has no effect, and one between them is not computed"
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
            "targets behind it are practically invisible",
            TensorsimWarning,
            stacklevel=2,
        )
    return wall

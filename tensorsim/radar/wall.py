"""A homogeneous wall: where it stands, and what a slab normal to y does to a wave.

Refractive index ``n = sqrt(eps_r (1 - j tan d)) = n' - j n''``; the time factor is ``exp(+j w t)``.
Coefficients follow Balanis, *Advanced Engineering Electromagnetics*, ch. 5 (normal incidence). Propagation
phase is counted once, in the delay: coefficients keep the interfaces and the loss ``exp(-alpha d)`` only.
"""

import math
import sys
import warnings
from dataclasses import replace
from typing import NamedTuple

from tensorsim.config import SPEED_OF_LIGHT_M_S, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, TensorsimWarning

#: One-way loss from which a wall is reported as opaque: the two-way echo is then 80 dB down.
OPAQUE_DB = 40.0

#: Faces closer than this to the antenna plane touch it.
CONTACT_M = 1e-9


class Slab(NamedTuple):
    """One-way coefficients of a slab at normal incidence, for a leg from air through the wall into air.

    Attributes:
        reflection: ``G = (1 - n) / (1 + n)``, air to wall.
        straight: ``T0 = (1 + G)(1 - G) exp(-alpha d)``, no internal bounce.
        bounced: ``T1 = (1 + G) G^2 (1 - G) exp(-3 alpha d)``, one pair of internal bounces.
        excess_s: ``d (n' - 1) / c``, extra delay of the straight leg over air.
        bounce_s: ``2 d n' / c``, extra delay of the pair of bounces.
    """

    reflection: complex
    straight: complex
    bounced: complex
    excess_s: float
    bounce_s: float


def slab_coefficients(wall: WallConfig, frequency_hz: float) -> Slab:
    """Coefficients of ``wall``; the loss ``alpha = (2 pi f / c) n''`` is taken at ``frequency_hz``."""
    n = wall.refractive_index
    thickness = wall.size_m[1]
    loss = math.exp(2 * math.pi * frequency_hz / SPEED_OF_LIGHT_M_S * n.imag * thickness)  # n.imag = -n''
    reflection = (1 - n) / (1 + n)
    interfaces = (1 + reflection) * (1 - reflection)
    return Slab(
        reflection=reflection,
        straight=interfaces * loss,
        bounced=interfaces * reflection**2 * loss**3,
        excess_s=thickness * (n.real - 1) / SPEED_OF_LIGHT_M_S,
        bounce_s=2 * thickness * n.real / SPEED_OF_LIGHT_M_S,
    )


def one_way_loss_db(wall: WallConfig, frequency_hz: float) -> float:
    """Loss of one straight passage, ``-20 log10 |T0|``."""
    straight = abs(slab_coefficients(wall, frequency_hz).straight)
    return -20 * math.log10(max(straight, sys.float_info.min))


def near_face_m(wall: WallConfig) -> float:
    """The y of the face towards the radar."""
    return wall.center_m[1] - wall.size_m[1] / 2


def place_wall(wall: WallConfig | None, radar: RadarConfig) -> WallConfig | None:
    """The wall as the echo uses it: in front of both antennas, or None where there is no wall.

    A wall of thickness 0 is no wall. A wall that contains an antenna (the original application's default
    centre is the transmitter) moves along y until its near face touches the antenna plane, with a warning.

    Raises:
        TensorsimError: the whole wall is behind the antennas.
    """
    if wall is None or wall.size_m[1] == 0.0:
        return None
    x, y, z = wall.center_m
    half = wall.size_m[1] / 2
    plane, rear_antenna = max(radar.tx_m[1], radar.rx_m[1]), min(radar.tx_m[1], radar.rx_m[1])
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

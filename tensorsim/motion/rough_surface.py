"""Radar cross sections of skin and clothes: rough surfaces, large compared with the wavelength.

A surface with Gaussian slopes reflects wherever a facet happens to face the radar (Barrick, *Rough surface
scattering based on the specular point theory*, IEEE Trans. Antennas Propag. 16, 1968). Facets are many wavelengths
apart, so that powers add.
"""

import math

import torch
from torch import Tensor

from tensorsim.errors import check_positive

VACUUM_PERMITTIVITY = 8.8541878128e-12


def skin_permittivity(frequency_hz: float) -> complex:
    """Relative permittivity of dry skin (Gabriel, Lau and Gabriel, Phys. Med. Biol. 41, 1996, part III)."""
    check_positive(frequency_hz, "frequency_hz")
    omega = 2 * math.pi * frequency_hz
    fast = 32.0 / (1 + 1j * omega * 7.23e-12)
    slow = 1100.0 / (1 + (1j * omega * 32.48e-9) ** 0.8)
    return 4.0 + fast + slow + 0.0002 / (1j * omega * VACUUM_PERMITTIVITY)


def skin_reflectivity(frequency_hz: float) -> float:
    """Power reflectivity of skin at normal incidence: 0.34 at 77 GHz, 0.52 at 5.8 GHz."""
    index = skin_permittivity(frequency_hz) ** 0.5
    return abs((1 - index) / (1 + index)) ** 2


def patch_rcs(area: Tensor, cosine: Tensor, roughness: float) -> Tensor:
    """Cross section of flat patches of a perfectly reflecting rough surface.

    ``sigma = A / (2 s^2) sec^4 th exp(-tan^2 th / (2 s^2))``, which sums to nearly ``pi r^2 (1 + s^2)`` over a
    large sphere of radius r and, for s -> 0 over any smooth body, to ``pi R1 R2`` of geometrical optics.

    Args:
        area: (...) m^2.
        cosine: (...) of the angle between normal and direction to the radar; patches that face away reflect nothing.
        roughness: s, root mean square slope along each axis; much less than 1.

    Returns:
        (...) m^2, smooth in the cosine.
    """
    square = cosine.clamp_min(0.1).square()
    return area / (2 * roughness**2) * torch.exp((1 - 1 / square) / (2 * roughness**2)) / square.square()


def cylinder_rcs(area: Tensor, sine_squared: Tensor, roughness: float) -> Tensor:
    """Cross section of rough cylinders: :func:`patch_rcs` integrated around the circumference.

    ``sigma = a l sqrt(pi / 2) / s sec^3 th (1 + s^2 cos^2 th) exp(-tan^2 th / (2 s^2))``, th being the tilt of
    the axis out of the plane that the radar sees broadside.

    Args:
        area: (...) radius times length a l, m^2.
        sine_squared: (...) squared sine of the tilt.
        roughness: as for patches.

    Returns:
        (...) m^2.
    """
    cos2 = (1 - sine_squared).clamp_min(1e-3)
    shape = cos2**-1.5 * (1 + roughness**2 * cos2) * torch.exp((1 - 1 / cos2) / (2 * roughness**2))
    return area * math.sqrt(math.pi / 2) / roughness * shape

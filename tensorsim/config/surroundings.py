"""Walls and floors."""

from dataclasses import dataclass

from tensorsim.config.checks import (
    Vector,
    is_finite,
    make_plain,
    require_position,
    require_ranges,
    require_vector,
)
from tensorsim.exceptions import TensorsimError
from tensorsim.limits import check_range


@dataclass(frozen=True)
class WallConfig:
    """A homogeneous slab normal to y.

    The default centre puts the near face of the panel's wall on the antenna plane. (The paper's centre
    (-0.1, 0, 1.5) puts the antennas inside the slab; the simulator then moves the wall here, with a warning.)

    Attributes:
        center_m: centre (x, y, z) in metres.
        size_m: width (along x), thickness (along y) and height (along z) in metres.
        relative_permittivity: real part of the relative permittivity.
        loss_tangent: ratio of the imaginary to the real part of the permittivity.

    Raises:
        TensorsimError: an unphysical size or permittivity.
    """

    center_m: Vector = (-0.1, 0.12, 1.5)
    size_m: Vector = (5.0, 0.24, 2.5)
    relative_permittivity: float = 6.0
    loss_tangent: float = 0.03

    def __post_init__(self) -> None:
        make_plain(self)
        require_position("WallConfig", center_m=self.center_m)
        require_vector("WallConfig", size_m=self.size_m)
        if self.size_m[0] <= 0 or self.size_m[1] < 0 or self.size_m[2] <= 0:
            raise TensorsimError(
                f"WallConfig.size_m: got {self.size_m}, expected positive width and height and thickness >= 0"
            )
        for value in self.size_m:
            check_range(value, "length", "WallConfig.size_m")
        require_ranges(self, relative_permittivity="relative permittivity", loss_tangent="loss tangent")

    @property
    def refractive_index(self) -> complex:
        """Complex refractive index, n = sqrt(eps_r (1 - j tan d)) = n' - j n''."""
        return (self.relative_permittivity * (1 - 1j * self.loss_tangent)) ** 0.5


@dataclass(frozen=True)
class FloorConfig:
    """A smooth reflecting floor, the plane z = 0.

    Attributes:
        relative_permittivity: of the material; the default is concrete (ITU-R P.2040-3, table 3).
        loss_tangent: of the material.
        reflection: a constant reflection coefficient instead of Fresnel's, for a measured floor.

    Raises:
        TensorsimError: unphysical numbers.
    """

    relative_permittivity: float = 5.24
    loss_tangent: float = 0.03
    reflection: float | None = None

    def __post_init__(self) -> None:
        make_plain(self)
        require_ranges(self, relative_permittivity="relative permittivity", loss_tangent="loss tangent")
        if self.reflection is not None and not (is_finite(self.reflection) and -1 <= self.reflection <= 1):
            raise TensorsimError(f"FloorConfig.reflection: got {self.reflection}, expected between -1 and 1")

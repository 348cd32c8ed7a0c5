"""Antenna patterns: amplitude of an antenna towards a direction, relative to its peak.

Boresight is +y. Angles of a direction (x, y, z): azimuth ``atan2(x, y)``, positive to the right (+x), and
elevation ``atan2(z, hypot(x, y))``, positive upwards. Patterns give **amplitude relative to the peak**, the
square root of relative gain; the peak gain itself is ``RadarConfig.antenna_gain_dbi``. See Balanis, *Antenna
Theory*, ch. 2.
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.config.checks import is_finite
from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    check_size,
)


def check_directions(direction: Tensor) -> None:
    """Refuse anything but real (..., 3)."""
    check_floating(direction, "direction")
    check_min_rank(direction, 1, "direction", "(..., 3)")
    check_size(direction, -1, 3, "direction", "(..., 3)")


def angles(direction: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuth and elevation (...) in radians of directions (..., 3) of any length."""
    x, y, z = direction.unbind(-1)
    return torch.atan2(x, y), torch.atan2(z, (x.square() + y.square()).clamp_min(1e-30).sqrt())


class CosineAntenna(nn.Module):
    """Cosine-power pattern: relative gain ``cos(a)^q`` at an angle a from +y, 0 for angles above 90 degrees.

    Args:
        exponent: q > 0 of the gain.
        beamwidth_rad: instead of it, full width at half power in (0, pi), ``cos(beamwidth / 2)^q = 1/2``.

    Shapes: directions (..., 3) of any length -> amplitude (...). Differentiable.

    Raises:
        TensorsimError: not exactly one of the two given, or a number out of range; directions of another shape.
    """

    def __init__(self, exponent: float | None = None, beamwidth_rad: float | None = None) -> None:
        super().__init__()
        if exponent is not None and beamwidth_rad is None:
            check_positive(exponent, "exponent")
            self.exponent = float(exponent)
        elif beamwidth_rad is not None and exponent is None:
            if not (is_finite(beamwidth_rad) and 0 < beamwidth_rad < math.pi):
                raise TensorsimError(f"beamwidth_rad: got {beamwidth_rad}, expected between 0 and pi")
            # log(cos(a)), accurate for narrow beams too.
            self.exponent = math.log(0.5) / math.log1p(-2 * math.sin(beamwidth_rad / 4) ** 2)
        else:
            raise TensorsimError(
                f"CosineAntenna: got exponent {exponent} and beamwidth_rad {beamwidth_rad}, "
                "expected one of them"
            )

    def forward(self, direction: Tensor) -> Tensor:
        """(..., 3) to (...)."""
        check_directions(direction)
        length = direction.square().sum(-1).clamp_min(1e-30).sqrt()
        cosine = direction[..., 1] / length
        ahead = cosine > 0
        return torch.where(ahead, torch.where(ahead, cosine, 1.0).pow(self.exponent / 2), 0.0)


class TabulatedAntenna(nn.Module):
    """A measured pattern, interpolated bilinearly in dB between the angles of a table.

    Args:
        azimuth_rad: (A,) ascending angles, A >= 2.
        elevation_rad: (E,) ascending angles, E >= 2.
        gain_db: (E, A) gain relative to the peak. Directions outside the table get the value at its edge.

    Shapes: directions (..., 3) of any length -> amplitude (...). Differentiable between the nodes.

    Raises:
        TensorsimError: angles that do not ascend, a table of another shape, NaN; directions of another shape.
    """

    azimuth_rad: Tensor
    elevation_rad: Tensor
    gain_db: Tensor

    def __init__(self, azimuth_rad: Tensor, elevation_rad: Tensor, gain_db: Tensor) -> None:
        super().__init__()
        azimuth, elevation = torch.as_tensor(azimuth_rad).double(), torch.as_tensor(elevation_rad).double()
        table = torch.as_tensor(gain_db).double()
        for name, axis in (("azimuth_rad", azimuth), ("elevation_rad", elevation)):
            check_finite(axis, name)
            if axis.dim() != 1 or axis.numel() < 2 or not bool((axis.diff() > 0).all()):
                raise TensorsimError(f"{name}: got {axis.tolist()}, expected at least two ascending angles")
        if list(table.shape) != [elevation.numel(), azimuth.numel()]:
            raise TensorsimError(
                f"gain_db: got shape {list(table.shape)}, expected {[elevation.numel(), azimuth.numel()]} "
                "(elevation, azimuth)"
            )
        check_finite(table, "gain_db")
        self.register_buffer("azimuth_rad", azimuth, persistent=False)
        self.register_buffer("elevation_rad", elevation, persistent=False)
        self.register_buffer("gain_db", table, persistent=False)

    def _cell(self, axis: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
        """Lower node and position within the cell (0 to 1) of angles (...), clamped to the table."""
        angle = torch.maximum(torch.minimum(angle, axis[-1]), axis[0])
        index = (torch.searchsorted(axis, angle.detach(), right=True) - 1).clamp(0, axis.numel() - 2)
        return index, (angle - axis[index]) / (axis[index + 1] - axis[index])

    def forward(self, direction: Tensor) -> Tensor:
        """(..., 3) to (...)."""
        check_directions(direction)
        azimuth, elevation = angles(direction)
        table = self.gain_db.to(direction.dtype)
        column, right = self._cell(self.azimuth_rad.to(direction.dtype), azimuth.contiguous())
        row, up = self._cell(self.elevation_rad.to(direction.dtype), elevation.contiguous())
        low = torch.lerp(table[row, column], table[row, column + 1], right)
        high = torch.lerp(table[row + 1, column], table[row + 1, column + 1], right)
        return torch.exp(torch.lerp(low, high, up) * (math.log(10) / 20))

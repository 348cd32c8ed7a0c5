"""Propagation paths: delay and complex gain of every way a wave takes over a scatterer.

Bistatic everywhere: a path has a leg from the transmitter and a leg to the receiver. Its amplitude is the
radar equation for unit transmit power on the legs of that path,
``a = sqrt(Gt Gr lambda^2 sigma / ((4 pi)^3 R1^2 R2^2))``, ``lambda = c / fc`` (Richards, *Fundamentals of
Radar Signal Processing*, ch. 2), times the wall's complex factor. In the IF, which is transmitted times
conjugate of received, that factor appears conjugated.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import SPEED_OF_LIGHT_M_S, RadarConfig, Vector, WallConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.wall import near_face_m, slab_coefficients


class Paths(NamedTuple):
    """What a wave meets on its way to S scatterers and back.

    Attributes:
        delay_s: (..., S, W) float64 seconds, W ways per scatterer, the direct one first.
        gain: (..., S, W) complex128 amplitude in the IF for unit transmit power; 0 for a missing way.
    """

    delay_s: Tensor
    gain: Tensor


def safe_sqrt(x: Tensor) -> Tensor:
    """Square root whose gradient at 0 is 0 instead of infinite."""
    positive = x > 0
    return torch.where(positive, torch.where(positive, x, 1.0).sqrt(), 0.0)


def leg_length(position: Tensor, antenna: tuple[float, float, float], shortest: float) -> Tensor:
    """Distance (...) from ``antenna`` to ``position`` (..., 3) in metres, not below ``shortest``."""
    x, y, z = position.unbind(-1)
    square = (x - antenna[0]).square() + (y - antenna[1]).square() + (z - antenna[2]).square()
    return square.clamp_min(shortest * shortest).sqrt()


def passes_face(
    position: Tensor,
    antenna: tuple[float, float, float],
    face_y: float,
    center: tuple[float, float],
    half_size: tuple[float, float],
) -> Tensor:
    """Whether the straight leg from ``antenna`` to ``position`` (..., 3) enters the near face of the wall.

    The face is the rectangle at ``y = face_y`` with this centre (x, z) and half size (x, z); the antenna is
    on it or in front of it. Returns (...) bool.
    """
    x, y, z = position.unbind(-1)
    beyond = y > face_y
    part = (face_y - antenna[1]) / torch.where(beyond, y - antenna[1], 1.0)
    hit_x = antenna[0] + part * (x - antenna[0])
    hit_z = antenna[2] + part * (z - antenna[2])
    return beyond & ((hit_x - center[0]).abs() <= half_size[0]) & ((hit_z - center[1]).abs() <= half_size[1])


def mirror(antenna: Vector, face_y: float) -> Vector:
    """Image of an antenna in the plane y = face_y: ``P' = P - 2 ((P - w) . n) n``."""
    return (antenna[0], 2 * face_y - antenna[1], antenna[2])


class PropagationPaths(nn.Module):
    """Ways from the transmitter over each scatterer to the receiver.

    Without a wall there is one way. With a wall, geometry decides per scatterer and position:

    - in front of the near face: direct; with ``multipath`` also the images of the antennas in the near face,
      a (mirrored transmitter, times G), b (mirrored receiver, times G), c (both, times G^2);
    - behind it: each leg that enters through the face is multiplied by T0 and delayed by ``d (n' - 1) / c``,
      so the direct way has T0^2. With ``multipath`` also one leg bounced (2 T0 T1, later by ``2 d n' / c``)
      and both (T1^2, later by twice that). ``wall_paths="paper"`` leaves 2 T0 T1 out, as the paper does;
    - behind it, but a leg passes beside the wall (a rectangle in x and z): that leg is free space.

    A scatterer inside the slab counts as behind it; edges do not diffract. The mirror for targets in front is
    not limited to the rectangle. The loss of the wall is taken at fc, as lambda is. Legs are not taken below
    lambda / (4 pi), where the radar equation has lost its meaning. Antennas have the same gain in every
    direction.

    Args:
        radar: antennas, gain and carrier.
        wall: what :func:`~tensorsim.radar.wall.place_wall` made of the wall; None is free space.
        multipath: whether to include the bounced or mirrored ways of a wall.
        wall_paths: ``"series"`` or ``"paper"``.

    Shapes: positions (..., S, 3) metres, rcs (..., S) m^2 -> :class:`Paths` of (..., S, W). All float64.
    Differentiable by both; the choice between the cases is not.

    Raises:
        TensorsimError: unknown ``wall_paths``.
    """

    gain_table: Tensor
    excess_table: Tensor

    def __init__(
        self,
        radar: RadarConfig,
        wall: WallConfig | None = None,
        multipath: bool = False,
        wall_paths: str = "series",
    ) -> None:
        super().__init__()
        if wall_paths not in ("series", "paper"):
            raise TensorsimError(f"wall_paths: got {wall_paths!r}, expected 'series' or 'paper'")
        gain = 10 ** (radar.antenna_gain_dbi / 10)
        self.scale = gain * radar.wavelength_m / (4 * math.pi) ** 1.5
        self.speed_m_s = SPEED_OF_LIGHT_M_S
        self.shortest_m = radar.wavelength_m / (4 * math.pi)
        self.tx = (float(radar.tx_m[0]), float(radar.tx_m[1]), float(radar.tx_m[2]))
        self.rx = (float(radar.rx_m[0]), float(radar.rx_m[1]), float(radar.rx_m[2]))
        self.has_wall = wall is not None
        self.ways = 4 if wall is not None and multipath else 1
        self.face_y, self.center, self.half_size = 0.0, (0.0, 0.0), (0.0, 0.0)
        # Rows: how many legs pass the wall (0, 1, 2), then 3 = in front of it. Columns: ways.
        factor = [[1.0 + 0j, 0.0, 0.0, 0.0]] * 4
        excess = [[0.0] * 4] * 4
        if wall is not None:
            slab = slab_coefficients(wall, radar.carrier_hz)
            t0, t1, g = slab.straight, slab.bounced, slab.reflection
            one, bounce = slab.excess_s, slab.bounce_s
            mixed = 2 * t0 * t1 if wall_paths == "series" else 0.0
            factor = [[1, 0, 0, 0], [t0, t1, 0, 0], [t0**2, mixed, t1**2, 0], [1, g, g, g**2]]
            excess = [
                [0, 0, 0, 0],
                [one, one + bounce, 0, 0],
                [2 * one, 2 * one + bounce, 2 * one + 2 * bounce, 0],
                [0, 0, 0, 0],
            ]
            self.face_y = near_face_m(wall)
            self.center = (wall.center_m[0], wall.center_m[2])
            self.half_size = (wall.size_m[0] / 2, wall.size_m[2] / 2)
        self.tx_image = mirror(self.tx, self.face_y)
        self.rx_image = mirror(self.rx, self.face_y)
        table = torch.tensor(factor, dtype=torch.complex128)[:, : self.ways]
        delay = torch.tensor(excess, dtype=torch.float64)[:, : self.ways]
        self.register_buffer("gain_table", torch.view_as_real(table.conj().resolve_conj()), persistent=False)
        self.register_buffer("excess_table", delay, persistent=False)

    def forward(self, positions: Tensor, rcs: Tensor) -> Paths:
        """(..., S, 3) metres and (..., S) m^2, both float64, to delays and gains (..., S, W)."""
        strength = self.scale * safe_sqrt(rcs).unsqueeze(-1)
        out = leg_length(positions, self.tx, self.shortest_m).unsqueeze(-1)
        back = leg_length(positions, self.rx, self.shortest_m).unsqueeze(-1)
        if not self.has_wall:  # the tables say the same, at twice the cost
            real = strength / (out * back)
            return Paths((out + back) / self.speed_m_s, torch.complex(real, torch.zeros_like(real)))
        front = positions[..., 1] <= self.face_y
        passed = passes_face(positions, self.tx, self.face_y, self.center, self.half_size).long()
        passed = passed + passes_face(positions, self.rx, self.face_y, self.center, self.half_size).long()
        case = torch.where(front, 3, passed)
        if self.ways > 1:
            mirrored = front.unsqueeze(-1)
            out_image = leg_length(positions, self.tx_image, self.shortest_m).unsqueeze(-1)
            back_image = leg_length(positions, self.rx_image, self.shortest_m).unsqueeze(-1)
            out_image = torch.where(mirrored, out_image, out)
            back_image = torch.where(mirrored, back_image, back)
            out = torch.cat((out, out_image, out, out_image), -1)
            back = torch.cat((back, back, back_image, back_image), -1)
        delay = (out + back) / self.speed_m_s + self.excess_table.double()[case]
        factor = self.gain_table.double()[case]
        return Paths(delay, torch.view_as_complex((strength / (out * back)).unsqueeze(-1) * factor))

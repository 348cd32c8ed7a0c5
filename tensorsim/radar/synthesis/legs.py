"""Legs of a propagation path: delay and complex factor between one antenna and a scatterer.

A leg has several alternatives: straight (through a wall in between), in air, with internal bounces in the wall,
reflected by the near face of the wall, reflected by the floor. :mod:`~tensorsim.radar.synthesis.paths` combines a
leg from the transmitter and a leg to the receiver into a path.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import SPEED_OF_LIGHT_M_S, FloorConfig, RadarConfig, WallConfig
from tensorsim.ops import safe_sqrt
from tensorsim.radar.synthesis.wall import (
    Slab,
    bounce_ratio,
    fresnel,
    near_face_m,
    paper_transmission,
    passage_phase,
    refracted_leg,
    refractive_index,
    slab_coefficients,
    transmission,
)


class Legs(NamedTuple):
    """One half of the paths: from an antenna to S scatterers, X alternatives each.

    Attributes:
        delay_s: (..., S, X) seconds.
        factor: (..., S, X) complex amplitude of the wave, including 1 / length.
        through: (..., S) bool, whether the straight leg passes the wall.
    """

    delay_s: Tensor
    factor: Tensor
    through: Tensor


def leg_length(position: Tensor, antenna: Tensor, shortest: float) -> Tensor:
    """Distance (...) from ``antenna`` (..., 3) to ``position`` (..., 3) in metres, at least ``shortest``."""
    x, y, z = position.unbind(-1)
    ax, ay, az = antenna.unbind(-1)
    square = (x - ax).square() + (y - ay).square() + (z - az).square()
    return square.clamp_min(shortest * shortest).sqrt()


def flipped(vector: Tensor, axis: int) -> Tensor:
    """Vectors (..., 3) reflected by a plane through the origin that is normal to ``axis`` (0 x, 1 y, 2 z)."""
    parts = [vector[..., 0], vector[..., 1], vector[..., 2]]
    parts[axis] = -parts[axis]
    return torch.stack(parts, -1)


def mirror_image(position: Tensor, face_y: float) -> Tensor:
    """Mirror method: the image (..., 3) of a point in the wall face at ``y = face_y``, for a wall normal to y.

    ``P' = P - 2 ((P - w) . n) n`` for any point w of the face and its normal n.
    """
    x, y, z = position.unbind(-1)
    return torch.stack((x, 2 * face_y - y, z), -1)


def mirror_delays(
    positions: Tensor, tx_m: Tensor, rx_m: Tensor, face_y: float, speed_m_s: float = SPEED_OF_LIGHT_M_S
) -> Tensor:
    r"""Mirror method: delays (..., 3) of the echoes of a target in front of a wall that the wall reflects.

    With the images $T'$ and $R'$ of the antennas $T$ and $R$ in the wall face (see :func:`mirror_image`):

    $$ \tau_a = \frac{|P - T'| + |P - R|}{c}, \quad \tau_b = \frac{|P - T| + |P - R'|}{c}, \quad
    \tau_c = \frac{|P - T'| + |P - R'|}{c} $$

    Path a is reflected on the way to the target, b on the way back, c on both. The amplitudes of a and b have the
    factor $\Gamma$ of the wall face, that of c has $\Gamma^2$.

    Args:
        positions: (..., 3) metres, in front of the face.
        tx_m, rx_m: (3,) or (..., 3) metres.
        face_y: y of the wall face, whose normal is y, in metres.
        speed_m_s: speed of light c in m/s.

    Returns:
        (..., 3) seconds: a, b, c.

    Inputs are not checked; positions behind the face get delays as well.
    """
    out, back = leg_length(positions, tx_m, 0.0), leg_length(positions, rx_m, 0.0)
    out_image = leg_length(positions, mirror_image(tx_m, face_y), 0.0)
    back_image = leg_length(positions, mirror_image(rx_m, face_y), 0.0)
    return torch.stack((out_image + back, out + back_image, out_image + back_image), -1) / speed_m_s


def passes_face(
    position: Tensor,
    antenna: Tensor,
    face_y: float,
    center: tuple[float, float],
    half_size: tuple[float, float],
    folded: bool = False,
) -> Tensor:
    """Whether the straight leg from ``antenna`` to ``position`` (both (..., 3)) enters the near face of the wall.

    Args:
        position: (..., 3) metres.
        antenna: (..., 3) metres, on the plane of the face or in front of it.
        face_y: y of the face, a rectangle normal to y.
        center: (x, z) of its centre.
        half_size: half of its size in (x, z).
        folded: the leg is reflected by the floor; a crossing at height -z counts as one at z.

    Returns:
        (...) bool.
    """
    x, y, z = position.unbind(-1)
    ax, ay, az = antenna.unbind(-1)
    behind = y > face_y
    part = (face_y - ay) / torch.where(behind, y - ay, 1.0)
    hit_x = ax + part * (x - ax)
    hit_z = az + part * (z - az)
    if folded:
        hit_z = hit_z.abs()
    return behind & ((hit_x - center[0]).abs() <= half_size[0]) & ((hit_z - center[1]).abs() <= half_size[1])


class TracedLegs(nn.Module):
    """Computes the alternatives of a leg and holds their constants; base class of ``PropagationPaths``."""

    relative_permittivity: Tensor
    loss_tangent: Tensor
    thickness_m: Tensor
    orders: int
    paper: bool
    attenuates: bool
    with_bounces: bool
    with_images: bool
    with_floor: bool

    @torch.jit.unused
    def _shape_legs(
        self,
        radar: RadarConfig,
        wall: WallConfig | None,
        incidence: str,
        polarization: str,
        floor: FloorConfig | None,
        antenna: nn.Module | None,
    ) -> None:
        self.speed_m_s = SPEED_OF_LIGHT_M_S
        self.carrier_hz = float(radar.carrier_hz)
        self.shortest_m = radar.wavelength_m / (4 * math.pi)
        self.has_wall = wall is not None
        self.oblique, self.airy = incidence != "normal", incidence == "airy" and wall is not None
        self.polarization, self.floor_polarization = polarization, "tm" if polarization == "te" else "te"
        self.face_y, self.center, self.half_size = 0.0, (0.0, 0.0), (0.0, 0.0)
        if wall is not None:
            self.face_y = float(near_face_m(wall))
            self.center = (float(wall.center_m[0]), float(wall.center_m[2]))
            self.half_size = (wall.size_m[0] / 2, wall.size_m[2] / 2)
        floor = floor or FloorConfig(reflection=0.0)
        self.floor_permittivity, self.floor_loss = floor.relative_permittivity, floor.loss_tangent
        self.floor_fresnel = floor.reflection is None
        self.floor_reflection = 0.0 if floor.reflection is None else float(floor.reflection)
        self.has_pattern = antenna is not None
        self.antenna = nn.Identity() if antenna is None else antenna

    def _slab(self, position: Tensor, antenna: Tensor) -> Slab:
        """Coefficients of the wall for straight legs; () at normal incidence, else (..., S)."""
        permittivity, loss_tangent = self.relative_permittivity.double(), self.loss_tangent.double()
        thickness = self.thickness_m.double()
        if not self.oblique:
            cosine = torch.ones_like(thickness)
            return slab_coefficients(
                permittivity, loss_tangent, thickness, self.carrier_hz, cosine, self.polarization
            )
        x, y, z = (position - antenna).unbind(-1)
        air = (y - thickness).clamp_min(self.shortest_m)  # a scatterer inside the slab counts as behind it
        lateral = safe_sqrt(x.square() + z.square())
        index = refractive_index(permittivity, loss_tangent)[0]
        cosine, length = refracted_leg(lateral, air, thickness, index)
        slab = slab_coefficients(
            permittivity, loss_tangent, thickness, self.carrier_hz, cosine, self.polarization
        )
        straight = (lateral.square() + (air + thickness).square()).sqrt()
        return Slab(slab.reflection, slab.loss_neper, (length - straight) / self.speed_m_s, slab.bounce_s)

    def _transmission(self, slab: Slab, bounces: int) -> Tensor:
        """Transmission of one leg with this many bounce pairs; without attenuation, relative to that with none."""
        if self.attenuates and self.paper:
            return paper_transmission(slab, bounces, self.carrier_hz)
        if self.attenuates:
            return transmission(slab, bounces)
        ratio = bounce_ratio(slab, bounces)
        return ratio * passage_phase(slab, 2 * bounces, self.carrier_hz) if self.paper else ratio

    def _face_reflection(self, cosine: Tensor) -> Tensor:
        """Reflection coefficient G of the near face for this cosine of the angle of incidence."""
        if not self.oblique:
            cosine = torch.ones_like(cosine)
        permittivity, loss_tangent = self.relative_permittivity.double(), self.loss_tangent.double()
        return fresnel(permittivity, loss_tangent, cosine, self.polarization)

    def _spread(self, direction: Tensor, length: Tensor) -> Tensor:
        """Amplitude of a leg: the antenna pattern divided by the length."""
        if self.has_pattern:
            return self.antenna(direction) / length
        return 1 / length

    def _legs(self, position: Tensor, antenna: Tensor) -> Legs:
        """All alternatives between an antenna and the scatterers (..., S, 3); missing ones have factor 0."""
        length = leg_length(position, antenna, self.shortest_m)
        spread = self._spread(position - antenna, length)
        in_air, spread = length / self.speed_m_s, torch.complex(spread, torch.zeros_like(spread))
        delays, factors = [in_air, in_air, in_air], [spread, spread, torch.zeros_like(spread)]
        through = torch.zeros_like(length, dtype=torch.bool)
        if self.has_wall:
            through = passes_face(position, antenna, self.face_y, self.center, self.half_size)
            slab = self._slab(position, antenna)
            delays[0] = in_air + torch.where(through, slab.excess_s, 0.0)
            factors[0] = spread * torch.where(through, self._transmission(slab, 0), 1.0)
            for order in range(1, self.orders + 1):
                bounced = torch.zeros_like(spread)
                if self.with_bounces:
                    bounced = spread * torch.where(through, self._transmission(slab, order), 0.0)
                delays.append(delays[0] + order * slab.bounce_s)
                factors.append(bounced)
            if self.with_images:
                image = mirror_image(antenna, self.face_y)
                front = position[..., 1] <= self.face_y
                length = leg_length(position, image, self.shortest_m)
                offset = flipped(position - image, 1)  # direction at the antenna itself
                cosine = offset[..., 1] / length
                mirrored = self._spread(offset, length) * self._face_reflection(cosine)
                delays[3] = torch.where(front, length / self.speed_m_s, delays[3])
                factors[3] = torch.where(front, mirrored, factors[3])
        if self.with_floor:
            delays[2], factors[2] = self._floor_leg(position, antenna)
        return Legs(torch.stack(delays, -1), torch.stack(factors, -1), through)

    def _floor_leg(self, position: Tensor, antenna: Tensor) -> tuple[Tensor, Tensor]:
        """Delay and factor (..., S) of the leg reflected by the floor, from the image of the antenna in z = 0."""
        image = flipped(antenna, 2)
        length = leg_length(position, image, self.shortest_m)
        offset = position - image
        spread = self._spread(flipped(offset, 2), length)
        if self.floor_fresnel:
            cosine = (offset[..., 2] / length).clamp(0.0, 1.0)
            permittivity = torch.full_like(cosine, self.floor_permittivity)
            loss_tangent = torch.full_like(cosine, self.floor_loss)
            reflection = fresnel(permittivity, loss_tangent, cosine, self.floor_polarization)
            # Fresnel's coefficient is that of the field along the floor; vertical antennas receive the vertical one.
            if self.floor_polarization == "tm":
                reflection = -reflection
        else:
            constant = torch.full_like(length, self.floor_reflection)
            reflection = torch.complex(constant, torch.zeros_like(constant))
        above = (position[..., 2] >= 0) & (antenna[..., 2] >= 0)
        factor = torch.where(above, spread * reflection, 0.0)
        delay = length / self.speed_m_s
        if self.has_wall:
            through = passes_face(position, image, self.face_y, self.center, self.half_size, True)
            slab = self._slab(position, image)
            delay = delay + torch.where(through, slab.excess_s, 0.0)
            factor = factor * torch.where(through, self._transmission(slab, 0), 1.0)
        return delay, factor

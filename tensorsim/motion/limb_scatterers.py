"""Scatterers along the body segments, with the aspect-dependent radar cross section of ellipsoids.

Segment lengths are from Winter, *Biomechanics and Motor Control of Human Movement* (after Drillis and
Contini), thicknesses those of typical adults, all as fractions of the body height.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.body.proportions import ANKLE_HEIGHT, SHANK, THIGH, TRUNK, UPPER_ARM
from tensorsim.config import JOINTS, Vector
from tensorsim.errors import TensorsimError, check_count, check_positive
from tensorsim.motion.scatterers import RIGHTWARD, check_antenna, check_people, one_scene, weights
from tensorsim.ops import unit

#: Distance from the ankle forward to the toes (a foot is 0.152 long).
TOES = 0.12
#: Points that segments run between: the joints, and points derived from them.
POINTS = (*JOINTS, "right_toes", "left_toes")


class Segment(NamedTuple):
    """An ellipsoid of the body. Lengths are fractions of the body height.

    Attributes:
        name: name of the segment.
        start, end: weighted means of :data:`POINTS` between which its scatterers lie.
        semi_axes: to the right of the body, forward, and along the segment; the first two are equal for limbs,
            whose rotation about their own axis cannot be known from joints.
    """

    name: str
    start: dict[str, float]
    end: dict[str, float]
    semi_axes: tuple[float, float, float]


def _limbs(side: str) -> tuple[Segment, ...]:
    shoulder, elbow, wrist = f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist"
    hip, knee, ankle, toes = f"{side}_hip", f"{side}_knee", f"{side}_ankle", f"{side}_toes"
    return (
        Segment(f"{side}_upper_arm", {shoulder: 1.0}, {elbow: 1.0}, (0.028, 0.028, UPPER_ARM / 2)),
        # A loosely closed hand makes the forearm (0.146) longer by 0.054.
        Segment(f"{side}_forearm", {elbow: 1.0}, {elbow: -0.37, wrist: 1.37}, (0.022, 0.022, 0.1)),
        Segment(f"{side}_thigh", {hip: 1.0}, {knee: 1.0}, (0.045, 0.045, THIGH / 2)),
        Segment(f"{side}_shank", {knee: 1.0}, {ankle: 1.0}, (0.03, 0.03, SHANK / 2)),
        Segment(f"{side}_foot", {ankle: 1.0}, {toes: 1.0}, (0.025, 0.025, 0.076)),
    )


SEGMENTS = (
    # The joint called head is the nose, at about mid-height of the head.
    Segment("head", {"neck": 0.4, "head": 0.6}, {"neck": -0.4, "head": 1.4}, (0.05, 0.05, 0.066)),
    Segment("torso", {"neck": 1.0}, {"right_hip": 0.5, "left_hip": 0.5}, (0.092, 0.067, TRUNK / 2)),
    *_limbs("right"),
    *_limbs("left"),
)


def toes_of(knee: Tensor, ankle: Tensor, right: Tensor, toes_m: float, sole_m: float) -> Tensor:
    """Toes (..., 2, 3) m of feet perpendicular to the shanks and to ``right`` (..., 1, 3), the body's right."""
    shank = unit(ankle - knee)
    forward = unit(torch.cross(right.expand_as(shank), shank, dim=-1))
    return ankle + toes_m * forward + sole_m * shank


def bisector(points: Tensor, tx: Tensor, rx: Tensor) -> Tensor:
    """Unit vectors (..., 3) midway between the directions from points (..., 3) to transmitter and receiver (3,).

    The bistatic cross section of a smooth body is the monostatic one seen from there (Crispin and Siegel,
    *Methods of Radar Cross Section Analysis*; Kell, Proc. IEEE 53, 1965), except near forward scattering.
    """
    return unit(unit(tx - points) + unit(rx - points))


def ellipsoid_rcs(semi_axes: Tensor, cosines_squared: Tensor) -> Tensor:
    """Radar cross section of a conducting ellipsoid, large compared with the wavelength.

    ``sigma = pi a^2 b^2 c^2 / (a^2 sin^2 th cos^2 ph + b^2 sin^2 th sin^2 ph + c^2 cos^2 th)^2``
    (Trott, IEEE Trans. Antennas Propag. 55, 2007).

    Args:
        semi_axes: (..., 3) a, b, c in metres.
        cosines_squared: (..., 3) squared cosines between the direction to the radar and the axes, which are
            ``sin^2 th cos^2 ph, sin^2 th sin^2 ph, cos^2 th``; they sum to 1.

    Returns:
        (...) m^2.
    """
    square = semi_axes.square()
    return math.pi * square.prod(-1) / (square * cosines_squared).sum(-1).square()


class LimbScatterers(nn.Module):
    """Scatterers along head, torso, arms, legs and feet whose cross section follows the aspect.

    Each of the 12 :data:`SEGMENTS` is an ellipsoid of a body of ``height_m``, positioned and oriented by the joints.
    Its cross section, seen from the bisector of transmitter and receiver, is divided equally in energy among
    ``per_segment`` points along it. The ellipsoid is conducting; skin reflects part of that power. A walking body
    totals -4 to -8 dBsm from all sides. The closed form is geometrical optics: at 2 GHz, where limbs are as thick
    as the wavelength, it is only a rough guide.
    Feet are taken as perpendicular to the shank and to the line of hips and shoulders: the 14 joints do not show them.

    Args:
        tx_m, rx_m: transmitter and receiver in metres (for an array, its centre).
        per_segment: points per segment.
        height_m: body height.
        reflectivity: power reflectivity of skin; 0.34 is that of dry skin at normal incidence at 77 GHz
            (relative permittivity about 6.6 - 9.0j, Gabriel et al., Phys. Med. Biol. 41, 1996); it is higher at
            lower frequencies.

    Example:
        >>> positions, fade = torch.randn(3, 100, 14, 3), torch.ones(3, 100)  # 3 people, 100 pulses
        >>> points, rcs = LimbScatterers(tx_m=(-0.1, 0.0, 1.5), rx_m=(0.1, 0.0, 1.5))(positions, fade)
        >>> points.shape, rcs.shape
        (torch.Size([100, 108, 3]), torch.Size([100, 108]))

    Raises:
        TensorsimError: an antenna without three finite numbers, ``per_segment`` below 1, ``height_m`` not
            positive, ``reflectivity`` outside (0, 1].
    """

    tx: Tensor
    rx: Tensor
    semi_axes: Tensor
    points: Tensor
    axes: Tensor
    right: Tensor
    knees: Tensor
    ankles: Tensor

    def __init__(
        self,
        tx_m: Vector,
        rx_m: Vector,
        per_segment: int = 3,
        height_m: float = 1.75,
        reflectivity: float = 0.34,
    ) -> None:
        super().__init__()
        check_antenna("tx_m", tx_m)
        check_antenna("rx_m", rx_m)
        check_positive(height_m, "height_m")
        check_count(per_segment, "per_segment", 1, 1000)
        if not 0 < reflectivity <= 1:
            raise TensorsimError(f"reflectivity: got {reflectivity}, expected above 0, at most 1")
        self.toes_m = TOES * height_m
        self.sole_m = ANKLE_HEIGHT * height_m / 2
        self.share = reflectivity / per_segment
        self.per_segment = per_segment
        start = weights(POINTS, *(s.start for s in SEGMENTS))
        end = weights(POINTS, *(s.end for s in SEGMENTS))
        along = (torch.arange(per_segment, dtype=torch.float64).reshape(-1, 1) + 0.5) / per_segment
        points = start.unsqueeze(1) + along * (end - start).unsqueeze(1)
        semi_axes = torch.tensor([s.semi_axes for s in SEGMENTS], dtype=torch.float64) * height_m
        knees = weights(JOINTS, {"right_knee": 1.0}, {"left_knee": 1.0})
        ankles = weights(JOINTS, {"right_ankle": 1.0}, {"left_ankle": 1.0})
        self.register_buffer("right", weights(JOINTS, RIGHTWARD), persistent=False)
        self.register_buffer("knees", knees, persistent=False)
        self.register_buffer("ankles", ankles, persistent=False)
        self.register_buffer("tx", torch.tensor(tx_m, dtype=torch.float64), persistent=False)
        self.register_buffer("rx", torch.tensor(rx_m, dtype=torch.float64), persistent=False)
        self.register_buffer("points", points.flatten(0, 1), persistent=False)
        self.register_buffer("axes", end - start, persistent=False)
        self.register_buffer("semi_axes", semi_axes, persistent=False)

    def forward(self, positions: Tensor, fade: Tensor) -> tuple[Tensor, Tensor]:
        """Joints (..., P, M, 14, 3) m and fade (..., P, M) to scatterers of one scene, person after person.

        Any range of pulses; P may be 0. Differentiable.

        Returns:
            Positions (..., M, 12 n P, 3) m and cross sections (..., M, 12 n P) m^2 with n = ``per_segment``.

        Raises:
            TensorsimError: wrong ranks or dtypes, or shapes that do not match.
        """
        check_people(positions, fade, 14)
        right = self.right.to(positions.dtype) @ positions
        ankle = self.ankles.to(positions.dtype) @ positions
        toes = toes_of(self.knees.to(positions.dtype) @ positions, ankle, right, self.toes_m, self.sole_m)
        body = torch.cat((positions, toes), -2)
        points = self.points.to(positions.dtype) @ body
        along = unit(self.axes.to(positions.dtype) @ body)
        across = unit(right - (right * along).sum(-1, keepdim=True) * along)

        view = bisector(points, self.tx.to(positions.dtype), self.rx.to(positions.dtype))
        view = view.unflatten(-2, (-1, self.per_segment))
        across2 = (view * across.unsqueeze(-2)).sum(-1).square()
        along2 = (view * along.unsqueeze(-2)).sum(-1).square()
        cosines = torch.stack((across2, 1 - across2 - along2, along2), -1)
        rcs = self.share * ellipsoid_rcs(self.semi_axes.to(positions.dtype).unsqueeze(-2), cosines)
        return one_scene(points, rcs.flatten(-2), fade)

"""Propagation paths: delay and complex gain of every way a wave takes over a scatterer.

Bistatic everywhere: a way has a leg from the transmitter and a leg to the receiver. Its amplitude is the
radar equation for unit transmit power on the legs of that way,
``a = sqrt(Gt Gr lambda^2 sigma / ((4 pi)^3 R1^2 R2^2))``, ``lambda = c / fc`` (Richards, *Fundamentals of
Radar Signal Processing*, ch. 2), times the complex factors of wall and floor. In the IF, which is transmitted
times conjugate of received, those factors appear conjugated.

Every leg has a few alternatives: straight, bounced inside the wall, mirrored in it, mirrored in the floor.
A way is a pair of them, one per leg.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import FloorConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError
from tensorsim.ops import safe_sqrt
from tensorsim.radar.synthesis.legs import TracedLegs, flipped, leg_length, passes_face
from tensorsim.radar.synthesis.wall import wall_tensors

#: What a scene may consist of; :class:`PropagationPaths` says what each is.
PATH_NAMES = ("direct", "direct_in_air", "wall_bounces", "wall_images", "floor", "leakage", "wall_echo")

#: What the echo can be differentiated by, besides positions and RCS.
LEARNABLE = ("relative_permittivity", "loss_tangent", "thickness_m", "tx_m", "rx_m")


class Paths(NamedTuple):
    """What a wave meets on its way to S scatterers and back.

    Attributes:
        delay_s: (..., S, W) float64 seconds, W ways per scatterer.
        gain: (..., S, W) complex128 amplitude in the IF for unit transmit power; 0 for a missing way.
    """

    delay_s: Tensor
    gain: Tensor


class Resonance(NamedTuple):
    """What :func:`~tensorsim.radar.synthesis.wall.airy` needs of both legs of each way: (..., S, W, 2), 0 in air.

    Attributes:
        square: complex ``G^2``.
        loss_neper: ``alpha d`` at fc.
        bounce_s: delay of a pair of bounces.
    """

    square: Tensor
    loss_neper: Tensor
    bounce_s: Tensor


def chosen_paths(
    multipath: bool, leakage: bool, wall_echo: bool, direct: bool, floor: bool, paths: tuple[str, ...] | None
) -> tuple[str, ...]:
    """The names of the paths of a scene: those asked for, or those that the switches stand for."""
    if paths is None:
        groups = {
            ("direct",): direct,
            ("wall_bounces", "wall_images"): multipath,
            ("leakage",): leakage,
            ("wall_echo",): wall_echo,
            ("floor",): floor,
        }
        return tuple(name for group, wanted in groups.items() if wanted for name in group)
    for name in paths:
        if name not in PATH_NAMES:
            raise TensorsimError(f"paths: got {name!r}, expected some of {', '.join(PATH_NAMES)}")
    if "floor" in paths and not floor:
        raise TensorsimError("paths: got 'floor' without a floor, expected floor=FloorConfig(...)")
    return tuple(paths)


class PropagationPaths(TracedLegs):
    """The list of the paths of a scene.

    ==================  ===================================================================================
    ``direct``          straight to the scatterer and back. Each leg that enters the wall through its near face
                        is multiplied by T0 and delayed by the slab's excess; a leg beside the wall (a
                        rectangle in x and z) is free space.
    ``direct_in_air``   the same as if there were no wall: the ablation "without wall attenuation".
    ``wall_bounces``    through the wall with up to ``bounces`` pairs of internal bounces on a leg (T_k, k
                        bounce delays later): all combinations of both legs but the direct one.
                        ``wall_paths="paper"`` leaves 2 T0 T1 out, as the paper does.
    ``wall_images``     scatterers in front of the wall: the images of the antennas in the near face, a
                        (mirrored transmitter, times G), b (mirrored receiver, times G), c (both, times G^2).
    ``floor``           the images of the antennas in z = 0, times the floor's reflection coefficient:
                        floor-direct, direct-floor, floor-floor. These legs pass the wall without bounces.
    ``leakage``         transmitter to receiver: ``10^(-isolation/20)``, delay ``|Ptx - Prx| / c``.
    ``wall_echo``       transmitter - near face - receiver, the Friis equation on the mirrored path:
                        ``lambda sqrt(Gt Gr) / (4 pi R) G`` with ``R = |Ptx' - Prx|``.
    ==================  ===================================================================================

    ``ways`` names the W ways of a scatterer, in order: (out, back) pairs such as ``"direct"``, ``"wall 1-0"``
    (one bounce or the image on the way out), ``"floor-direct"``; ``static_ways`` those without a scatterer.
    ``wall k-l`` means bounces behind the wall and images in front of it: geometry decides, per scatterer.

    A scatterer inside the slab counts as behind it; edges do not diffract. The mirror for targets in front is
    not limited to the rectangle. The loss of the wall is taken at fc, as lambda is. Legs are not taken below
    lambda / (4 pi), where the radar equation has lost its meaning.

    Args:
        radar: antennas, gain and carrier.
        wall: what :func:`~tensorsim.radar.synthesis.wall.place_wall` made of the wall; None is free space.
        names: which paths, of ``PATH_NAMES``.
        wall_paths: ``"series"`` or ``"paper"``.
        incidence: ``"normal"`` takes every leg as normal to the wall; ``"oblique"`` bends it by Snell's law
            and takes Fresnel's coefficients at its angle; ``"airy"`` is oblique with all internal bounces in
            closed form (see :class:`~tensorsim.radar.EchoSynthesizer`), instead of ``wall_bounces``.
        polarization: ``"te"`` (field along the wall: vertical antennas) or ``"tm"`` at the wall; the floor
            sees the other.
        bounces: largest number of pairs of internal bounces on a leg.
        floor: reflects, if ``names`` has ``floor``.
        antenna: pattern of all antennas (see :mod:`~tensorsim.radar.synthesis.antenna`); None is isotropic.
        learnable: which of ``LEARNABLE`` are parameters; the others are buffers. The near face stays where it
            is when the thickness changes.

    Shapes: positions (..., S, 3) metres, rcs (..., S) m^2 -> :class:`Paths` of (..., S, W). All float64.
    Several antennas: (..., M, S, 3), (..., M, S) -> (..., V, M, S, W), channel ``v = k A + a`` for transmitter
    k and receiver a. Differentiable by both and by what is learnable; the choice between the cases is not.

    Raises:
        TensorsimError: unknown options; a learnable wall without a wall.
    """

    tx_m: Tensor
    rx_m: Tensor
    out_ways: Tensor
    back_ways: Tensor
    turn: Tensor
    ways: list[str]
    static_ways: list[str]

    def __init__(
        self,
        radar: RadarConfig,
        wall: WallConfig | None = None,
        names: tuple[str, ...] = ("direct",),
        wall_paths: str = "series",
        incidence: str = "normal",
        polarization: str = "te",
        bounces: int = 1,
        floor: FloorConfig | None = None,
        antenna: nn.Module | None = None,
        learnable: tuple[str, ...] = (),
    ) -> None:
        super().__init__()
        for option, value, known in (
            ("wall_paths", wall_paths, ("series", "paper")),
            ("incidence", incidence, ("normal", "oblique", "airy")),
            ("polarization", polarization, ("te", "tm")),
        ):
            if value not in known:
                raise TensorsimError(f"{option}: got {value!r}, expected one of {known}")
        if bounces < 1:
            raise TensorsimError(f"bounces: got {bounces}, expected at least 1")
        self._shape_legs(radar, wall, incidence, polarization, floor, antenna)
        self.paper = wall_paths == "paper"
        self.peak_gain = 10 ** (radar.antenna_gain_dbi / 10)
        self.scale = self.peak_gain * radar.wavelength_m / (4 * math.pi) ** 1.5
        self.coupling = 10 ** (-radar.isolation_db / 20)
        self._list_ways(names, bounces)
        self._own_constants(radar, wall, learnable)

    @torch.jit.unused
    def _list_ways(self, names: tuple[str, ...], bounces: int) -> None:
        """Alternatives of a leg, by index: 0 straight, 1 in air, 2 mirrored in the floor, 2 + k wall order k."""
        air, floor = 1, 2
        self.with_bounces = "wall_bounces" in names and not self.airy
        self.with_images = "wall_images" in names
        self.orders = 0
        if self.has_wall and (self.with_bounces or self.with_images):
            self.orders = bounces if self.with_bounces else 1
        ways: list[tuple[str, int, int]] = []
        if "direct" in names:
            ways.append(("direct", 0, 0))
        if "direct_in_air" in names:
            ways.append(("direct_in_air", air, air))
        for total in range(1, 2 * self.orders + 1):
            for out in range(min(total, self.orders), max(0, total - self.orders) - 1, -1):
                back = total - out
                ways.append((f"wall {out}-{back}", floor + out if out else 0, floor + back if back else 0))
        self.with_floor = "floor" in names
        if self.with_floor:
            ways += [("floor-direct", floor, 0), ("direct-floor", 0, floor), ("floor-floor", floor, floor)]
        static = [name for name in ("leakage", "wall_echo") if name in names]
        self.ways = [name for name, _, _ in ways]
        self.static_ways = [name for name in static if self.has_wall or name != "wall_echo"]
        self.plain = not (self.has_wall or self.with_floor or self.has_pattern) and len(ways) == 1
        for name, index in (("out_ways", 1), ("back_ways", 2)):
            self.register_buffer(
                name, torch.tensor([w[index] for w in ways], dtype=torch.long), persistent=False
            )

    @torch.jit.unused
    def _own_constants(self, radar: RadarConfig, wall: WallConfig | None, learnable: tuple[str, ...]) -> None:
        permittivity, loss_tangent, thickness = wall_tensors(wall or WallConfig())
        constants = {
            "relative_permittivity": permittivity,
            "loss_tangent": loss_tangent,
            "thickness_m": thickness,
            "tx_m": torch.tensor(radar.tx_m, dtype=torch.float64),
            "rx_m": torch.tensor(radar.rx_m, dtype=torch.float64),
        }
        for name in learnable:
            if name not in LEARNABLE:
                raise TensorsimError(f"learnable: got {name!r}, expected some of {', '.join(LEARNABLE)}")
            if wall is None and name not in ("tx_m", "rx_m"):
                raise TensorsimError(f"learnable: got {name!r} without a wall, expected a wall")
        for name, value in constants.items():
            if name in learnable:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value, persistent=False)
        self.has_array = radar.has_array
        self.transmitters, self.receivers = len(radar.tx_positions_m), len(radar.rx_positions_m)
        turn = torch.arange(self.transmitters, dtype=torch.float64) / self.transmitters
        turn = turn.repeat_interleave(self.receivers)[:, None, None, None]
        self.register_buffer("turn", turn, persistent=False)

    def _antennas(self) -> tuple[Tensor, Tensor]:
        """Transmitter and receiver of the channels: (3,) each, or (V, 1, 1, 3)."""
        tx, rx = self.tx_m.double(), self.rx_m.double()
        if not self.has_array:
            return tx, rx
        tx = tx.reshape(-1, 1, 3).expand(-1, self.receivers, -1).reshape(-1, 1, 1, 3)
        rx = rx.reshape(1, -1, 3).expand(self.transmitters, -1, -1).reshape(-1, 1, 1, 3)
        return tx, rx

    def _channels(self, positions: Tensor, step: Tensor | None) -> Tensor:
        """Positions as each channel sees them: (..., V, M, S, 3), or as they are for one channel."""
        if not self.has_array:
            return positions
        positions = positions.unsqueeze(-4)
        if step is not None and self.transmitters > 1:
            positions = positions + self.turn.double() * step.unsqueeze(-4)
        return positions

    def forward(self, positions: Tensor, rcs: Tensor, step: Tensor | None = None) -> Paths:
        """(..., S, 3) metres and (..., S) m^2, both float64, to delays and gains (..., S, W).

        ``step`` (..., S, 3) is the way of each scatterer until the next pulse: transmitters that fire in turn
        see it part of that way on. Without it, scatterers stand still within a pulse interval.
        """
        tx, rx = self._antennas()
        position = self._channels(positions, step)
        strength = self.scale * safe_sqrt(rcs.unsqueeze(-3) if self.has_array else rcs)
        if self.plain:  # what follows says the same, at several times the cost
            out = leg_length(position, tx, self.shortest_m)
            back = leg_length(position, rx, self.shortest_m)
            real = (strength / (out * back)).unsqueeze(-1)
            delay = ((out + back) / self.speed_m_s).unsqueeze(-1)
            return Paths(delay, torch.complex(real, torch.zeros_like(real)))
        legs_out, legs_back = self._legs(position, tx), self._legs(position, rx)
        delay = legs_out.delay_s.index_select(-1, self.out_ways)
        delay = delay + legs_back.delay_s.index_select(-1, self.back_ways)
        factor = legs_out.factor.index_select(-1, self.out_ways)
        factor = factor * legs_back.factor.index_select(-1, self.back_ways)
        if self.paper:  # keeps equal orders on both legs; 2 T0 T1 are the ways of unequal ones
            unequal = (self.out_ways != self.back_ways) & (self.out_ways != 2) & (self.back_ways != 2)
            both = (legs_out.through & legs_back.through).unsqueeze(-1)
            factor = torch.where(both & unequal, 0.0, factor)
        return Paths(delay, (strength.unsqueeze(-1) * factor).conj().resolve_conj())

    @torch.jit.export
    def resonance(self, positions: Tensor, step: Tensor | None = None) -> Resonance:
        """What the wall does over frequency to each leg of the ways of :meth:`forward`."""
        tx, rx = self._antennas()
        position = self._channels(positions, step)
        squares: list[Tensor] = []
        losses: list[Tensor] = []
        bounces: list[Tensor] = []
        for antenna, ways in [(tx, self.out_ways), (rx, self.back_ways)]:
            image = flipped(antenna, 2)
            straight, floor = self._slab(position, antenna), self._slab(position, image)
            through = passes_face(position, antenna, self.face_y, self.center, self.half_size).unsqueeze(-1)
            below = passes_face(position, image, self.face_y, self.center, self.half_size, True).unsqueeze(-1)
            by_floor = ways == 2
            passes = torch.where(by_floor, below, through & (ways == 0))
            g, g_floor = straight.reflection.unsqueeze(-1), floor.reflection.unsqueeze(-1)
            a, a_floor = straight.loss_neper.unsqueeze(-1), floor.loss_neper.unsqueeze(-1)
            t, t_floor = straight.bounce_s.unsqueeze(-1), floor.bounce_s.unsqueeze(-1)
            squares.append(torch.where(passes, torch.where(by_floor, g_floor, g).square(), 0.0))
            losses.append(torch.where(passes, torch.where(by_floor, a_floor, a), 0.0))
            bounces.append(torch.where(passes, torch.where(by_floor, t_floor, t), 0.0))
        return Resonance(torch.stack(squares, -1), torch.stack(losses, -1), torch.stack(bounces, -1))

    @torch.jit.export
    def static(self) -> Paths:
        """Paths without a scatterer, one column per name of ``static_ways``: (W,), or (V, 1, W)."""
        tx, rx = self._antennas()
        if self.has_array:
            tx, rx = tx.squeeze(-2), rx.squeeze(-2)
        delays: list[Tensor] = []
        gains: list[Tensor] = []
        for name in self.static_ways:
            if name == "leakage":
                length = leg_length(tx, rx, 0.0)
                real = torch.full_like(length, self.coupling)
                gains.append(torch.complex(real, torch.zeros_like(real)))
            else:
                image = self._mirrored(tx)
                length = leg_length(image, rx, self.shortest_m)
                offset = image - rx
                cosine = (offset[..., 1] / length).clamp(0.0, 1.0)
                friis = self.peak_gain * self.shortest_m / length
                if self.has_pattern:  # out of one antenna and into the other at the same angle
                    friis = friis * self.antenna(offset) * self.antenna(flipped(-offset, 1))
                gains.append((friis * self._face_reflection(cosine)).conj().resolve_conj())
            delays.append(length / self.speed_m_s)
        if len(delays) == 0:
            nothing = (tx + rx)[..., :0]
            return Paths(nothing, torch.complex(nothing, nothing))
        return Paths(torch.stack(delays, -1), torch.stack(gains, -1))

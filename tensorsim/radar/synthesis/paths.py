"""Propagation paths: delay and complex gain of every path from transmitter to scatterer to receiver.

The delay model is bistatic: a path has a leg from the transmitter and a leg to the receiver. Its amplitude is the
radar equation on its own two legs, :func:`radar_equation_amplitude`, times the complex factors of wall and floor.
The IF is the transmitted times the conjugate of the received wave, so these factors enter it conjugated.

Every leg has alternatives (:mod:`~tensorsim.radar.synthesis.legs`): straight, with bounces inside the wall,
reflected by the wall, reflected by the floor. A path is a pair of them, one per leg.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import FloorConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, check_choice, check_count
from tensorsim.ops import safe_sqrt
from tensorsim.radar.synthesis.legs import TracedLegs, flipped, leg_length, mirror_image, passes_face
from tensorsim.radar.synthesis.wall import wall_tensors

#: Names of the path groups of a scene, explained in :class:`PropagationPaths`.
PATH_NAMES = ("direct", "direct_in_air", "wall_bounces", "wall_images", "floor", "leakage", "wall_echo")

#: Constants that can be learnable parameters, besides positions and RCS as inputs.
LEARNABLE = ("relative_permittivity", "loss_tangent", "thickness_m", "tx_m", "rx_m")


class Paths(NamedTuple):
    """Delays and gains of P paths via each of S scatterers.

    Attributes:
        delay_s: (..., S, P) float64 seconds.
        gain: (..., S, P) complex128 amplitude in the IF for unit transmit power, conjugate of that of the
            received wave; 0 for a missing path.
    """

    delay_s: Tensor
    gain: Tensor


class Resonance(NamedTuple):
    """Slab constants for :func:`~tensorsim.radar.synthesis.wall.airy`, both legs of each path: (..., S, P, 2).

    All are 0 for legs in air.

    Attributes:
        square: complex ``G^2``.
        loss_neper: ``alpha d`` at fc.
        bounce_s: delay of a pair of internal bounces, seconds.
    """

    square: Tensor
    loss_neper: Tensor
    bounce_s: Tensor


def radar_equation_amplitude(
    rcs_m2: Tensor,
    tx_range_m: Tensor,
    rx_range_m: Tensor,
    wavelength_m: float,
    tx_gain: float = 1.0,
    rx_gain: float = 1.0,
) -> Tensor:
    r"""Bistatic radar equation: amplitude of the echo of a scatterer for unit transmit power.

    $$ a = \sqrt{\frac{G_t G_r \lambda^2 \sigma}{(4 \pi)^3 R_1^2 R_2^2}} $$

    (Richards, *Fundamentals of Radar Signal Processing*, ch. 2).

    Args:
        rcs_m2: (...) radar cross section $\sigma$ in m^2.
        tx_range_m, rx_range_m: (...) lengths $R_1$ and $R_2$ of the two legs of the path in metres.
        wavelength_m: $\lambda = c / f_c$ in metres.
        tx_gain, rx_gain: $G_t$ and $G_r$, linear power gains.

    Returns:
        (...) real, square root of received over transmitted power. Differentiable; the gradient at an RCS of 0 is 0.

    Inputs are not checked; a range of 0 gives an infinite amplitude.

    >>> one = torch.ones(())
    >>> float(radar_equation_amplitude(one, 2 * one, 2 * one, 0.01) / radar_equation_amplitude(one, one, one, 0.01))
    0.25
    """
    scale = math.sqrt(tx_gain * rx_gain) * wavelength_m / (4 * math.pi) ** 1.5
    return scale * safe_sqrt(rcs_m2) / (tx_range_m * rx_range_m)


def chosen_paths(
    multipath: bool, leakage: bool, wall_echo: bool, direct: bool, floor: bool, paths: tuple[str, ...] | None
) -> tuple[str, ...]:
    """Names of the path groups of a scene: ``paths`` if given, else those that the switches select."""
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
    """Delays and gains of all propagation paths of a scene, by the delay model and the mirror method.

    ==================  ===================================================================================
    ``direct``          straight to the scatterer and back. Each leg that enters the wall through its near face
                        is multiplied by T0 and delayed by the slab's excess; a leg that misses the wall (a
                        rectangle in x and z) is in free space.
    ``direct_in_air``   the same without the wall: the ablation "without wall attenuation".
    ``wall_bounces``    through the wall with up to ``bounces`` pairs of internal bounces on a leg (T_k, k
                        bounce delays later): all combinations of both legs except the direct one.
    ``wall_images``     scatterers in front of the wall: the images of the antennas in the near face, a
                        (mirrored transmitter, times G), b (mirrored receiver, times G), c (both, times G^2);
                        see :func:`~tensorsim.radar.synthesis.legs.mirror_delays`.
    ``floor``           the images of the antennas in z = 0, times the floor's reflection coefficient:
                        floor-direct, direct-floor, floor-floor. These legs pass the wall without bounces. The
                        coefficient is that of the field the antennas receive: for vertical antennas, the vertical
                        field's (Balanis, *Antenna Theory*, 4.8), 1 over metal and -1 at grazing incidence.
    ``leakage``         transmitter to receiver: ``10^(-isolation/20)``, delay ``|Ptx - Prx| / c``.
    ``wall_echo``       transmitter - near face - receiver, the Friis equation on the mirrored path:
                        ``lambda sqrt(Gt Gr) / (4 pi R) G`` with ``R = |Ptx' - Prx|``.
    ==================  ===================================================================================

    A scatterer inside the slab counts as behind it. There is no diffraction at the edges. The mirror for targets
    in front of the wall is not limited to the rectangle. The loss of the wall and lambda are those at fc. Legs
    are at least lambda / (4 pi) long: the radar equation does not hold for shorter ones.

    Args:
        radar: antennas, gain and carrier.
        wall: a wall in front of the antennas, see :func:`~tensorsim.radar.synthesis.wall.place_wall`; None is
            free space.
        names: path groups to include, of ``PATH_NAMES``.
        wall_paths: ``"series"``, or ``"paper"`` for the paper's formula: without ``2 T0 T1``
            (:func:`~tensorsim.radar.synthesis.wall.two_way_wall_transmission`), and with the propagation phase
            of the wall in the amplitude as well as in the delay
            (:func:`~tensorsim.radar.synthesis.wall.paper_transmission`).
        incidence: ``"normal"`` treats every leg as normal to the wall; ``"oblique"`` refracts it by Snell's law
            with the Fresnel coefficients at its angle; ``"airy"`` is oblique with all internal bounces in
            closed form (see :class:`~tensorsim.radar.EchoSynthesizer`), instead of ``wall_bounces``.
        polarization: ``"te"`` (field parallel to the wall: vertical antennas) or ``"tm"`` at the wall; at the
            floor it is the other one.
        bounces: largest number of pairs of internal bounces on a leg.
        floor: the floor, used if ``names`` has ``floor``.
        antenna: pattern of all antennas (see :mod:`~tensorsim.radar.synthesis.antenna`); None is isotropic.
        learnable: which of ``LEARNABLE`` are parameters; the others are buffers. The position of the near face
            does not depend on the thickness.
        wall_attenuation: False is the ablation "without wall attenuation": a leg through the wall keeps its delay and
            loses nothing, and bounces in the wall keep their ratio to it. Reflections by the wall are not changed.

    Shapes: positions (..., S, 3) metres, rcs (..., S) m^2 -> :class:`Paths` of (..., S, P). All float64.
    Several antennas: (..., M, S, 3), (..., M, S) -> (..., V, M, S, P), channel ``v = k A + a`` for transmitter
    k and receiver a. Differentiable with respect to both and to learnable constants, for a fixed
    choice of paths.

    Attributes:
        path_names: names of the P paths of a scatterer, in order: pairs of legs such as ``"direct"``,
            ``"wall 1-0"`` (one bounce pair on the way to the scatterer, none on the way back),
            ``"floor-direct"``. ``wall k-l`` means bounces for a scatterer behind the wall and images for one in
            front of it.
        static_names: names of the paths without a scatterer.
        scale: amplitude of an RCS of 1 m^2 for legs of 1 m.

    Raises:
        TensorsimError: unknown options; ``wall_paths="paper"`` with ``incidence="airy"``, whose closed form has
            no separate bounces; a learnable constant of a wall without a wall.
    """

    tx_m: Tensor
    rx_m: Tensor
    out_legs: Tensor
    back_legs: Tensor
    turn: Tensor
    path_names: list[str]
    static_names: list[str]

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
        wall_attenuation: bool = True,
    ) -> None:
        super().__init__()
        check_choice(wall_paths, ("series", "paper"), "wall_paths")
        check_choice(incidence, ("normal", "oblique", "airy"), "incidence")
        check_choice(polarization, ("te", "tm"), "polarization")
        if wall_paths == "paper" and incidence == "airy":
            raise TensorsimError(
                "wall_paths: got 'paper' with incidence 'airy', which sums all bounces; expected 'normal' or 'oblique'"
            )
        check_count(bounces, "bounces")
        self._shape_legs(radar, wall, incidence, polarization, floor, antenna)
        self.paper = wall_paths == "paper"
        self.attenuates = wall_attenuation
        self.peak_gain = 10 ** (radar.antenna_gain_dbi / 10)
        self.wavelength_m = radar.wavelength_m
        self.scale = self.peak_gain * radar.wavelength_m / (4 * math.pi) ** 1.5
        self.coupling = 10 ** (-radar.isolation_db / 20)
        self._list_paths(names, bounces)
        self._own_constants(radar, wall, learnable)

    @torch.jit.unused
    def _list_paths(self, names: tuple[str, ...], bounces: int) -> None:
        """Pairs of leg alternatives, by index: 0 straight, 1 in air, 2 reflected by the floor, 2 + k wall order k."""
        air, floor = 1, 2
        self.with_bounces = "wall_bounces" in names and not self.airy
        self.with_images = "wall_images" in names
        self.orders = 0
        if self.has_wall and (self.with_bounces or self.with_images):
            self.orders = bounces if self.with_bounces else 1
        paths: list[tuple[str, int, int]] = []
        if "direct" in names:
            paths.append(("direct", 0, 0))
        if "direct_in_air" in names:
            paths.append(("direct_in_air", air, air))
        for total in range(1, 2 * self.orders + 1):
            for out in range(min(total, self.orders), max(0, total - self.orders) - 1, -1):
                back = total - out
                paths.append((f"wall {out}-{back}", floor + out if out else 0, floor + back if back else 0))
        self.with_floor = "floor" in names
        if self.with_floor:
            paths += [("floor-direct", floor, 0), ("direct-floor", 0, floor), ("floor-floor", floor, floor)]
        static = [name for name in ("leakage", "wall_echo") if name in names]
        self.path_names = [name for name, _, _ in paths]
        self.static_names = [name for name in static if self.has_wall or name != "wall_echo"]
        self.plain = not (self.has_wall or self.with_floor or self.has_pattern) and len(paths) == 1
        for name, index in (("out_legs", 1), ("back_legs", 2)):
            self.register_buffer(
                name, torch.tensor([p[index] for p in paths], dtype=torch.long), persistent=False
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
        """Positions at the pulse of each channel: (..., V, M, S, 3); unchanged for one channel."""
        if not self.has_array:
            return positions
        positions = positions.unsqueeze(-4)
        if step is not None and self.transmitters > 1:
            positions = positions + self.turn.double() * step.unsqueeze(-4)
        return positions

    def forward(self, positions: Tensor, rcs: Tensor, step: Tensor | None = None) -> Paths:
        """(..., S, 3) metres and (..., S) m^2, both float64, to delays and gains (..., S, P).

        ``step`` (..., S, 3) is the displacement of each scatterer until the next pulse: transmitter k of K, which
        fires later, sees ``k / K`` of it. Without it, scatterers stand still within a pulse interval.
        """
        tx, rx = self._antennas()
        position = self._channels(positions, step)
        if self.has_array:
            rcs = rcs.unsqueeze(-3)
        if self.plain:  # a shortcut: the code below gives the same result at several times the cost
            out = leg_length(position, tx, self.shortest_m)
            back = leg_length(position, rx, self.shortest_m)
            real = radar_equation_amplitude(
                rcs, out, back, self.wavelength_m, self.peak_gain, self.peak_gain
            ).unsqueeze(-1)
            delay = ((out + back) / self.speed_m_s).unsqueeze(-1)
            return Paths(delay, torch.complex(real, torch.zeros_like(real)))
        legs_out, legs_back = self._legs(position, tx), self._legs(position, rx)
        delay = legs_out.delay_s.index_select(-1, self.out_legs)
        delay = delay + legs_back.delay_s.index_select(-1, self.back_legs)
        factor = legs_out.factor.index_select(-1, self.out_legs)
        factor = factor * legs_back.factor.index_select(-1, self.back_legs)
        if self.paper:  # the paper has equal orders on both legs only, without 2 T0 T1
            unequal = (self.out_legs != self.back_legs) & (self.out_legs != 2) & (self.back_legs != 2)
            both = (legs_out.through & legs_back.through).unsqueeze(-1)
            factor = torch.where(both & unequal, 0.0, factor)
        strength = self.scale * safe_sqrt(rcs)  # radar equation; the factors of the legs contain 1 / length
        return Paths(delay, (strength.unsqueeze(-1) * factor).conj().resolve_conj())

    @torch.jit.export
    def resonance(self, positions: Tensor, step: Tensor | None = None) -> Resonance:
        """Slab constants of each leg of the paths of :meth:`forward`, for the closed sum of bounces."""
        tx, rx = self._antennas()
        position = self._channels(positions, step)
        squares: list[Tensor] = []
        losses: list[Tensor] = []
        bounces: list[Tensor] = []
        for antenna, legs in [(tx, self.out_legs), (rx, self.back_legs)]:
            image = flipped(antenna, 2)
            straight, floor = self._slab(position, antenna), self._slab(position, image)
            through = passes_face(position, antenna, self.face_y, self.center, self.half_size).unsqueeze(-1)
            below = passes_face(position, image, self.face_y, self.center, self.half_size, True).unsqueeze(-1)
            by_floor = legs == 2
            passes = torch.where(by_floor, below, through & (legs == 0))
            g, g_floor = straight.reflection.unsqueeze(-1), floor.reflection.unsqueeze(-1)
            a, a_floor = straight.loss_neper.unsqueeze(-1), floor.loss_neper.unsqueeze(-1)
            t, t_floor = straight.bounce_s.unsqueeze(-1), floor.bounce_s.unsqueeze(-1)
            squares.append(torch.where(passes, torch.where(by_floor, g_floor, g).square(), 0.0))
            losses.append(torch.where(passes, torch.where(by_floor, a_floor, a), 0.0))
            bounces.append(torch.where(passes, torch.where(by_floor, t_floor, t), 0.0))
        return Resonance(torch.stack(squares, -1), torch.stack(losses, -1), torch.stack(bounces, -1))

    @torch.jit.export
    def static(self) -> Paths:
        """Paths without a scatterer, one per name in ``static_names``: (P,), or (V, 1, P)."""
        tx, rx = self._antennas()
        if self.has_array:
            tx, rx = tx.squeeze(-2), rx.squeeze(-2)
        delays: list[Tensor] = []
        gains: list[Tensor] = []
        for name in self.static_names:
            if name == "leakage":
                length = leg_length(tx, rx, 0.0)
                real = torch.full_like(length, self.coupling)
                gains.append(torch.complex(real, torch.zeros_like(real)))
            else:
                image = mirror_image(tx, self.face_y)
                length = leg_length(image, rx, self.shortest_m)
                offset = image - rx
                cosine = (offset[..., 1] / length).clamp(0.0, 1.0)
                friis = self.peak_gain * self.shortest_m / length
                if self.has_pattern:  # specular: the same angle at both antennas
                    friis = friis * self.antenna(offset) * self.antenna(flipped(-offset, 1))
                gains.append((friis * self._face_reflection(cosine)).conj().resolve_conj())
            delays.append(length / self.speed_m_s)
        if len(delays) == 0:
            nothing = (tx + rx)[..., :0]
            return Paths(nothing, torch.complex(nothing, nothing))
        return Paths(torch.stack(delays, -1), torch.stack(gains, -1))

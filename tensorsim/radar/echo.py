"""The echo: IF samples of an FMCW radar that sees moving scatterers.

    f(t) = fc + mu t,   IF(t) = sum over paths of conj(a) exp(+j 2 pi (fc tau + mu tau t - mu tau^2 / 2))

with ``t = n / fs``: transmitted times conjugate of received, so the beat frequency is positive and the phase
of an approaching target decreases. See Jankiraman, *FMCW Radar Design*, ch. 2; the sign and the ``mu tau^2 /
2`` follow from the mixing product itself.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import SPEED_OF_LIGHT_M_S, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, check_finite, check_floating, check_min_rank, is_exporting
from tensorsim.radar.paths import PropagationPaths, mirror
from tensorsim.radar.wall import near_face_m, place_wall, slab_coefficients


class EchoParts(NamedTuple):
    """The parts of an IF, each (..., M, N) complex; zero where the scene has no such part.

    Attributes:
        direct: straight to every target and back, through a wall if there is one.
        multipath: the bounced and mirrored ways, if the synthesizer was made with ``multipath``.
        leakage: from transmitter to receiver.
        wall_echo: static reflection of the wall.
    """

    direct: Tensor
    multipath: Tensor
    leakage: Tensor
    wall_echo: Tensor


def check_scene(positions: Tensor, rcs: Tensor) -> Tensor:
    """Refuse a scene that has no echo; returns the RCS per pulse, (..., M, S).

    ``positions`` (..., M, S, 3); ``rcs`` (..., M, S) per pulse, (..., S) per clip, or (S,) for all clips:
    told apart by rank.
    """
    layout = "(..., pulses, scatterers, 3) metres"
    check_floating(positions, "positions")
    check_floating(rcs, "rcs")
    check_min_rank(positions, 3, "positions", layout)
    shape = list(positions.shape)
    if shape[-1] != 3:
        raise TensorsimError(f"positions: got shape {shape}, expected {layout}")
    if shape[-3] == 0:
        raise TensorsimError(f"positions: got shape {shape}, expected at least one pulse")
    per_pulse = shape[:-1]
    per_clip = shape[:-3] + shape[-2:-1]
    got = list(rcs.shape)
    if got != per_pulse and got != per_clip and got != shape[-2:-1]:
        raise TensorsimError(
            f"rcs: got shape {got}, expected {per_clip} (per clip) or {per_pulse} (per pulse) m^2"
        )
    check_finite(positions, "positions")
    check_finite(rcs, "rcs")
    if not is_exporting() and bool((rcs < 0).any()):
        raise TensorsimError(f"rcs: got a minimum of {float(rcs.min())} m^2, expected no negative value")
    if got == per_clip:
        rcs = rcs.unsqueeze(-2)
    return rcs.expand(per_pulse)


def phasor(cycles: Tensor) -> Tensor:
    """``exp(j 2 pi cycles)`` as complex."""
    angle = cycles * (2 * math.pi)
    return torch.view_as_complex(torch.stack((angle.cos(), angle.sin()), -1))


def beat_sum(
    delay_s: Tensor,
    gain: Tensor,
    carrier_hz: float,
    slope_hz_per_s: float,
    sample_rate_hz: float,
    coarse: Tensor,
    fine: Tensor,
) -> Tensor:
    """Sum over paths of ``gain exp(j 2 pi (fc tau + mu tau n / fs - mu tau^2 / 2))`` for n = 0, 1, ...

    The exponential factors over ``n = Q n1 + n2``, so the sum is a product of two small matrices per pulse
    instead of N exponentials per path. Phases are wrapped to one cycle in float64 before they take the
    precision of the result: at 77 GHz a float32 phase would leave a floor at -60 dB.

    Args:
        delay_s: (L, P) float64.
        gain: (L, P) complex128.
        carrier_hz: fc, the start of the sweep.
        slope_hz_per_s: mu.
        sample_rate_hz: fs.
        coarse: (N1,) 0, 1, ..., N1 - 1 in the real precision of the result.
        fine: (Q,) 0, 1, ..., Q - 1 likewise.

    Returns:
        (L, N1 * Q) complex.
    """
    start = carrier_hz * delay_s - 0.5 * slope_hz_per_s * delay_s.square()
    step = slope_hz_per_s / sample_rate_hz * delay_s
    stride = step * fine.shape[0]
    start = (start - start.round()).to(fine.dtype)
    step = (step - step.round()).to(fine.dtype)
    stride = (stride - stride.round()).to(fine.dtype)
    left = phasor(start.unsqueeze(-2) + coarse.unsqueeze(-1) * stride.unsqueeze(-2))  # (L, N1, P)
    right = phasor(step.unsqueeze(-1) * fine)  # (L, P, Q)
    left = left * gain.to(left.dtype).unsqueeze(-2)
    return torch.matmul(left, right).flatten(-2)


class EchoSynthesizer(nn.Module):
    """IF samples of a scene, free of noise.

    Args:
        radar: the radar.
        wall: a wall in the scene; see :class:`~tensorsim.radar.paths.PropagationPaths` for what it does to
            the echo of a target, and :func:`~tensorsim.radar.wall.place_wall` for where it may stand.
        multipath: include the bounced and mirrored ways of the wall; without a wall there are none.
        leakage: include the direct coupling from transmitter to receiver: amplitude ``10^(-isolation/20)``,
            delay ``|Ptx - Prx| / c``.
        wall_echo: include the static specular echo transmitter - near face - receiver, by the Friis equation
            on the mirrored path: ``lambda sqrt(Gt Gr) / (4 pi R) G`` with ``R = |Ptx' - Prx|``.
        wall_paths: ``"series"``, or ``"paper"`` for the terms that the paper keeps.
        direct: include the direct way to each target; off, only bounced and mirrored ways are left.
        pulse_chunk: pulses that are worked on at a time; bounds the working memory.

    Shapes:
        positions (..., M, S, 3) metres in the world frame, rcs (..., S) m^2 per clip, (..., M, S) per pulse
        or (S,) -> (..., M, N) complex for transmit power 1. S = 0 is an empty scene: zeros, plus leakage and
        wall echo.

    The result is complex64, and complex128 after ``.double()``; geometry is float64 always, so float64
    positions keep their digits. Differentiable by positions and RCS (the gradient of sqrt(RCS) at RCS 0 is
    set to 0).

    Raises:
        TensorsimError: wrong ranks or shapes, no pulse, NaN, negative RCS.
    """

    coarse: Tensor
    fine: Tensor
    leakage_if: Tensor
    wall_echo_if: Tensor

    def __init__(
        self,
        radar: RadarConfig,
        wall: WallConfig | None = None,
        multipath: bool = False,
        leakage: bool = False,
        wall_echo: bool = False,
        wall_paths: str = "series",
        direct: bool = True,
        pulse_chunk: int = 1024,
    ) -> None:
        super().__init__()
        if pulse_chunk < 1:
            raise TensorsimError(f"pulse_chunk: got {pulse_chunk}, expected at least 1")
        wall = place_wall(wall, radar)
        self.paths = PropagationPaths(radar, wall, multipath, wall_paths)
        self.carrier_hz = float(radar.carrier_hz)
        self.slope_hz_per_s = float(radar.slope_hz_per_s)
        self.sample_rate_hz = float(radar.sample_rate_hz)
        self.samples = radar.samples_per_chirp
        self.direct, self.leakage, self.wall_echo = direct, leakage, wall_echo
        self.pulse_chunk = pulse_chunk
        fine = math.isqrt(self.samples - 1) + 1
        self.register_buffer("fine", torch.arange(fine).float(), persistent=False)
        self.register_buffer("coarse", torch.arange(-(-self.samples // fine)).float(), persistent=False)

        coupling = 10 ** (-radar.isolation_db / 20)
        leakage_if = self._static_path(math.dist(radar.tx_m, radar.rx_m), complex(coupling))
        wall_if = torch.zeros_like(leakage_if)
        if wall is not None:
            shortest = radar.wavelength_m / (4 * math.pi)
            length = max(math.dist(mirror(radar.tx_m, near_face_m(wall)), radar.rx_m), shortest)
            friis = 10 ** (radar.antenna_gain_dbi / 10) * shortest / length
            reflection = slab_coefficients(wall, radar.carrier_hz).reflection
            wall_if = self._static_path(length, friis * reflection.conjugate())
        self.register_buffer("leakage_if", leakage_if, persistent=False)
        self.register_buffer("wall_echo_if", wall_if, persistent=False)

    @torch.jit.unused
    def _static_path(self, length_m: float, gain: complex) -> Tensor:
        """IF (N, 2), real and imaginary part in float64, of a path that does not move."""
        delay = torch.tensor([[length_m / SPEED_OF_LIGHT_M_S]], dtype=torch.float64)
        factor = torch.tensor([[gain]], dtype=torch.complex128)
        pulse = beat_sum(
            delay,
            factor,
            self.carrier_hz,
            self.slope_hz_per_s,
            self.sample_rate_hz,
            self.coarse.double(),
            self.fine.double(),
        )
        return torch.view_as_real(pulse[0, : self.samples].contiguous())

    @torch.jit.export
    def target_echo(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """Echo of the targets alone, unchecked and in one go: (..., S, 3) m and (..., S) m^2 -> (..., N)."""
        paths = self.paths(positions.double(), rcs.double())
        first = 0 if self.direct else 1
        return self._sum(paths.delay_s[..., first:], paths.gain[..., first:])

    def _sum(self, delay_s: Tensor, gain: Tensor) -> Tensor:
        """IF (..., N) of paths (..., S, W)."""
        pulses = beat_sum(
            delay_s.flatten(-2),
            gain.flatten(-2),
            self.carrier_hz,
            self.slope_hz_per_s,
            self.sample_rate_hz,
            self.coarse,
            self.fine,
        )
        return pulses[..., : self.samples]

    @torch.jit.export
    def parts(self, positions: Tensor, rcs: Tensor) -> EchoParts:
        """What the IF is made of, part by part and whatever is switched on; arguments as in forward."""
        rcs = check_scene(positions, rcs)
        paths = self.paths(positions.double(), rcs.double())
        direct = self._sum(paths.delay_s[..., :1], paths.gain[..., :1])
        multipath = self._sum(paths.delay_s[..., 1:], paths.gain[..., 1:])
        leakage = torch.view_as_complex(self.leakage_if.to(self.fine.dtype)).expand(direct.shape)
        wall_echo = torch.view_as_complex(self.wall_echo_if.to(self.fine.dtype)).expand(direct.shape)
        return EchoParts(direct, multipath, leakage, wall_echo)

    @torch.jit.export
    def static_echo(self) -> Tensor:
        """IF (N,) of what does not move and is switched on: leakage and wall echo."""
        total = torch.zeros_like(self.leakage_if)
        if self.leakage:
            total = total + self.leakage_if
        if self.wall_echo:
            total = total + self.wall_echo_if
        return torch.view_as_complex(total.to(self.fine.dtype))

    def forward(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """(..., M, S, 3) metres and (..., S) or (..., M, S) m^2 to IF (..., M, N)."""
        rcs = check_scene(positions, rcs).flatten(0, -2)
        pulses = positions.flatten(0, -3)
        static = self.static_echo()
        chunks: list[Tensor] = []
        for start in range(0, pulses.shape[0], self.pulse_chunk):
            stop = start + self.pulse_chunk
            chunks.append(self.target_echo(pulses[start:stop], rcs[start:stop]) + static)
        return torch.cat(chunks).unflatten(0, list(positions.shape[:-2]))

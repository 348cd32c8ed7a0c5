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

from tensorsim.config import FloorConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, check_finite, check_floating, check_min_rank, is_exporting
from tensorsim.ops import flatten_batch, unflatten_batch
from tensorsim.radar.synthesis.paths import Paths, PropagationPaths, Resonance, chosen_paths
from tensorsim.radar.synthesis.wall import place_wall


class SideChannels(NamedTuple):
    """Ground truth of every way W over every scatterer, each (..., M, S, W) float64.

    With several antennas (..., V, M, S, W).

    Attributes:
        range_m: ``c tau / 2``, where the way shows in a range profile.
        radial_speed_m_s: its rate of change, positive = approaching as on the Doppler axis; central
            differences, one-sided at the ends of the clip, 0 for a clip of one pulse.
        amplitude: ``|a|`` of the IF for unit transmit power, 0 for a missing way.
    """

    range_m: Tensor
    radial_speed_m_s: Tensor
    amplitude: Tensor


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
    if 0 in shape[:-2]:
        raise TensorsimError(f"positions: got shape {shape}, expected at least one pulse of one clip")
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
    return torch.complex(angle.cos(), angle.sin())


def tones(first: Tensor, step: Tensor, index: Tensor) -> Tensor:
    """``first exp(j 2 pi step n)`` for n of ``index``: (...) complex, (...) cycles, (N,) 0, 1, ... -> (..., N).

    The exponential factors over ``n = Q n1 + n2``: about ``2 sqrt(N)`` sines and cosines and N products.
    """
    fine = math.ceil(math.sqrt(index.shape[0]))
    step = step.unsqueeze(-1)
    outer = first.unsqueeze(-1) * phasor(step * index[::fine])
    inner = phasor(step * index[:fine])
    return (outer.unsqueeze(-1) * inner.unsqueeze(-2)).flatten(-2)[..., : index.shape[0]]


def tone_sum(first: Tensor, step: Tensor, coarse: Tensor, fine: Tensor) -> Tensor:
    """Sum over P tones of ``first exp(j 2 pi step n)`` for n = 0, 1, ..., N1 Q - 1.

    The exponential factors over ``n = Q n1 + n2``, so the sum is a product of two small matrices per pulse
    instead of N exponentials per tone.

    Args:
        first: (L, P) complex.
        step: (L, P) cycles in float64; wrapped to one before they take the precision of the result.
        coarse: (N1,) 0, 1, ..., N1 - 1 in the real precision of the result.
        fine: (Q,) 0, 1, ..., Q - 1 likewise.

    Returns:
        (L, N1 * Q) complex.
    """
    stride = step * fine.shape[0]
    step = (step - step.round()).to(fine.dtype)
    stride = (stride - stride.round()).to(fine.dtype)
    right = tones(torch.ones_like(first), step, fine)  # (L, P, Q)
    left = tones(first, stride, coarse)  # (L, P, N1)
    return torch.matmul(left.transpose(-1, -2), right).flatten(-2)


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

    Phases are wrapped to one cycle in float64 before they take the precision of the result: at 77 GHz a float32
    phase would leave a floor at -60 dB.

    Args:
        delay_s: (L, P) float64.
        gain: (L, P) complex128.
        carrier_hz: fc, the start of the sweep.
        slope_hz_per_s: mu.
        sample_rate_hz: fs.
        coarse, fine: see :func:`tone_sum`.

    Returns:
        (L, N1 * Q) complex.
    """
    start = carrier_hz * delay_s - 0.5 * slope_hz_per_s * delay_s.square()
    first = phasor((start - start.round()).to(fine.dtype))
    first = first * gain.to(first.dtype)
    return tone_sum(first, slope_hz_per_s / sample_rate_hz * delay_s, coarse, fine)


def dispersed_sum(
    paths: Paths,
    resonance: Resonance,
    carrier_hz: float,
    slope_hz_per_s: float,
    time_s: Tensor,
) -> Tensor:
    """:func:`beat_sum` of ways whose gain depends on the frequency of the sweep: (..., S, W) -> (..., N).

    The wave that arrives at ``t_n`` has the frequency ``f = fc + mu (t_n - tau)``, and each leg multiplies it
    by ``T(f) / T_0(fc) = exp(-alpha d (f / fc - 1)) / (1 - G^2 exp(-2 alpha d f / fc - j 2 pi f t))``: the
    closed sum of all internal bounces over the straight passage, t the delay of a pair. The phase of the straight
    passage is in ``tau`` and not in this factor; that the k-th bounce is k t late enters by the frequency
    alone, which leaves out ``mu (k t)^2 / 2`` cycles (2e-4 for the default wall).
    """
    echo = paths.gain.new_zeros(list(paths.gain.shape[:-2]) + list(time_s.shape))
    for s in range(paths.gain.shape[-2]):  # all at once would hold S W N complex numbers per pulse
        delay = paths.delay_s[..., s, :, None]
        cycles = carrier_hz * delay + slope_hz_per_s * delay * (time_s - 0.5 * delay)
        frequency = (carrier_hz + slope_hz_per_s * (time_s - delay)).unsqueeze(-2)  # (..., W, 1, N)
        relative = frequency / carrier_hz
        neper, bounce = resonance.loss_neper[..., s, :, :, None], resonance.bounce_s[..., s, :, :, None]
        turn = torch.polar(torch.exp(-2 * neper * relative), -2 * math.pi * bounce * frequency)
        leg = torch.exp(-neper * (relative - 1)) / (1 - resonance.square[..., s, :, :, None] * turn)
        factor = (leg[..., 0, :] * leg[..., 1, :]).conj() * paths.gain[..., s, :, None]
        echo = echo + (phasor(cycles - cycles.round()) * factor).sum(-2)
    return echo


class EchoSynthesizer(nn.Module):
    """IF samples of a scene, free of noise.

    Args:
        radar: the radar. Several transmitters or receivers give the IF an antenna dimension.
        wall: a wall in the scene; see :class:`~tensorsim.radar.synthesis.paths.PropagationPaths` for what it does to
            the echo of a target, and :func:`~tensorsim.radar.synthesis.wall.place_wall` for where it may stand.
        multipath: include the bounced and mirrored ways of the wall; without a wall there are none.
        leakage: include the direct coupling from transmitter to receiver.
        wall_echo: include the static echo of the wall's near face.
        wall_paths: ``"series"``, or ``"paper"`` for the terms that the paper keeps.
        direct: include the direct way to each target; off, only bounced and mirrored ways are left.
        pulse_chunk: pulses that are worked on at a time; bounds the working memory.
        incidence: ``"normal"``, ``"oblique"`` or ``"airy"``: how legs pass the wall.
        polarization: ``"te"`` or ``"tm"`` at the wall, for the latter two.
        bounces: largest number of pairs of internal bounces on a leg.
        floor: a floor that reflects.
        antenna: pattern of all antennas (:mod:`~tensorsim.radar.synthesis.antenna`); None is isotropic.
        paths: names of the paths to include, of ``tensorsim.radar.synthesis.paths.PATH_NAMES``, instead of what
            ``direct``, ``multipath``, ``leakage``, ``wall_echo`` and ``floor`` stand for.
        learnable: which of ``tensorsim.radar.synthesis.paths.LEARNABLE`` are parameters of ``.paths``, by that name.

    Shapes:
        positions (..., M, S, 3) metres in the world frame, rcs (..., S) m^2 per clip, (..., M, S) per pulse
        or (S,) -> (..., M, N) complex for transmit power 1. S = 0 is an empty scene: zeros, plus leakage and
        wall echo. Several antennas: (..., V, M, N), channel ``v = k A + a`` for transmitter k and receiver a.

    Transmitter k of K fires ``k / (K PRF)`` after the start of the pulse interval; the positions of that
    instant are interpolated linearly between pulses, and extrapolated after the last.

    The result is complex64, and complex128 after ``.double()``; geometry is float64 always, so float64
    positions keep their digits. Differentiable by positions, RCS (the gradient of sqrt(RCS) at RCS 0 is set
    to 0) and what is learnable.

    Raises:
        TensorsimError: wrong ranks or shapes, no pulse, NaN, negative RCS; unknown options.
    """

    coarse: Tensor
    fine: Tensor

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
        incidence: str = "normal",
        polarization: str = "te",
        bounces: int = 1,
        floor: FloorConfig | None = None,
        antenna: nn.Module | None = None,
        paths: tuple[str, ...] | None = None,
        learnable: tuple[str, ...] = (),
    ) -> None:
        super().__init__()
        if pulse_chunk < 1:
            raise TensorsimError(f"pulse_chunk: got {pulse_chunk}, expected at least 1")
        names = chosen_paths(multipath, leakage, wall_echo, direct, floor is not None, paths)
        wall = place_wall(wall, radar)
        self.paths = PropagationPaths(
            radar, wall, names, wall_paths, incidence, polarization, bounces, floor, antenna, learnable
        )
        self.carrier_hz = float(radar.carrier_hz)
        self.slope_hz_per_s = float(radar.slope_hz_per_s)
        self.sample_rate_hz = float(radar.sample_rate_hz)
        self.prf_hz = float(radar.prf_hz)
        self.samples = radar.samples_per_chirp
        self.pulse_chunk = pulse_chunk
        # Tones of about this many paths and pulses stay in the cache.
        self.tone_block = 2**15
        fine = math.isqrt(self.samples - 1) + 1
        self.register_buffer("fine", torch.arange(fine).float(), persistent=False)
        self.register_buffer("coarse", torch.arange(-(-self.samples // fine)).float(), persistent=False)

    @torch.jit.export
    def target_echo(self, positions: Tensor, rcs: Tensor, step: Tensor | None = None) -> Tensor:
        """Echo of the targets alone, unchecked and in one go.

        (..., S, 3) m and (..., S) m^2 -> (..., N); several antennas (..., M, S, 3) -> (..., V, M, N). ``step``:
        see :meth:`PropagationPaths.forward <tensorsim.radar.synthesis.paths.PropagationPaths.forward>`.
        """
        paths = self.paths(positions.double(), rcs.double(), step)
        if self.paths.airy:
            resonance = self.paths.resonance(positions.double(), step)
            return self._dispersed(paths, resonance)
        return self._sum(paths.delay_s.flatten(-2), paths.gain.flatten(-2), self.fine.dtype)

    def _dispersed(self, paths: Paths, resonance: Resonance) -> Tensor:
        time = torch.arange(self.samples, device=self.fine.device).double() / self.sample_rate_hz
        pulses = dispersed_sum(paths, resonance, self.carrier_hz, self.slope_hz_per_s, time)
        return pulses.to(torch.complex(self.fine, self.fine).dtype)

    def _sum(self, delay_s: Tensor, gain: Tensor, dtype: torch.dtype) -> Tensor:
        """IF (..., N) of paths (..., P)."""
        lead = list(delay_s.shape[:-1])
        delay_s, gain = flatten_batch(delay_s, 1), flatten_batch(gain, 1)
        step = max(1, self.tone_block // max(1, delay_s.shape[1]))
        parts: list[Tensor] = []
        for first in range(0, delay_s.shape[0], step):
            parts.append(
                beat_sum(
                    delay_s[first : first + step],
                    gain[first : first + step],
                    self.carrier_hz,
                    self.slope_hz_per_s,
                    self.sample_rate_hz,
                    self.coarse.to(dtype),
                    self.fine.to(dtype),
                )
            )
        pulses = unflatten_batch(torch.cat(parts), lead)
        return pulses[..., : self.samples]

    @torch.jit.export
    def static_echo(self) -> Tensor:
        """IF (N,) of what does not move: leakage and wall echo; (V, 1, N) for several antennas."""
        static = self.paths.static()
        parts = torch.view_as_real(self._sum(static.delay_s, static.gain, torch.float64))
        return torch.view_as_complex(parts.to(self.fine.dtype).contiguous())

    def forward(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """(..., M, S, 3) metres and (..., S) or (..., M, S) m^2 to IF (..., M, N) or (..., V, M, N)."""
        rcs = check_scene(positions, rcs).flatten(0, -2)
        pulses = positions.flatten(0, -3)
        step = self._step(positions)
        static = self.static_echo()
        echo = static.new_empty(list(static.shape[:-2]) + [pulses.shape[0], self.samples])  # noqa: RUF005 (TorchScript)
        chunks: list[Tensor] = []
        for start in range(0, pulses.shape[0], self.pulse_chunk):
            stop = start + self.pulse_chunk
            ahead = None if step is None else step[start:stop]
            chunk = self.target_echo(pulses[start:stop], rcs[start:stop], ahead) + static
            if chunk.requires_grad:  # a write into a slice would cost the backward pass a copy of the whole
                chunks.append(chunk)
            else:
                echo[..., start:stop, :] = chunk
        if len(chunks) > 0:
            echo = torch.cat(chunks, -2)
        echo = echo.unflatten(-2, list(positions.shape[:-2]))
        return echo.movedim(0, -3) if self.paths.has_array else echo

    def _step(self, positions: Tensor) -> Tensor | None:
        """Way to the next pulse, (pulses of all clips, S, 3), where transmitters need it."""
        if self.paths.transmitters == 1:
            return None
        positions = positions.double()
        if positions.shape[-3] == 1:
            return torch.zeros_like(positions).flatten(0, -3)
        step = positions.diff(dim=-3)
        return torch.cat((step, step[..., -1:, :, :]), -3).flatten(0, -3)

    @torch.jit.export
    def contributions(self, positions: Tensor, rcs: Tensor, groups: Tensor) -> Tensor:
        """IF of each group of scatterers by each way: (..., G, W, M, N), or (..., G, W, V, M, N).

        ``groups`` (S,) int64 numbers the group of each scatterer: their person, or 0 ... S - 1 for each alone.
        The ways are named by ``.paths.ways``. Summed over G and W, with :meth:`static_echo`, they are the echo.
        """
        rcs = check_scene(positions, rcs)
        if groups.dim() != 1 or groups.shape[0] != positions.shape[-2] or groups.is_floating_point():
            raise TensorsimError(
                f"groups: got {list(groups.shape)} {groups.dtype}, expected one integer per scatterer, "
                f"[{positions.shape[-2]}]"
            )
        if groups.numel() == 0 or len(self.paths.ways) == 0:
            raise TensorsimError(
                "contributions: got a scene without scatterers or ways, expected some of each"
            )
        if bool((groups < 0).any()):
            raise TensorsimError(f"groups: got {int(groups.min())}, expected numbers from 0")
        step = self._step(positions)
        if step is not None:
            step = step.reshape(positions.shape)
        paths = self.paths(positions.double(), rcs.double(), step)
        resonance = self.paths.resonance(positions.double(), step) if self.paths.airy else None
        people: list[Tensor] = []
        for group in range(int(groups.max()) + 1):
            gain = torch.where((groups == group).unsqueeze(-1), paths.gain, 0.0)
            ways: list[Tensor] = []
            for way in range(gain.shape[-1]):
                one = Paths(paths.delay_s[..., way : way + 1], gain[..., way : way + 1])
                if resonance is None:
                    ways.append(self._sum(one.delay_s.squeeze(-1), one.gain.squeeze(-1), self.fine.dtype))
                else:
                    slab = Resonance(
                        resonance.square[..., way : way + 1, :],
                        resonance.loss_neper[..., way : way + 1, :],
                        resonance.bounce_s[..., way : way + 1, :],
                    )
                    ways.append(self._dispersed(one, slab))
            people.append(torch.stack(ways, positions.dim() - 3))
        return torch.stack(people, positions.dim() - 3)

    @torch.jit.export
    def side_channels(self, positions: Tensor, rcs: Tensor) -> SideChannels:
        """Range, radial speed and amplitude of each way over each scatterer; arguments as in forward."""
        rcs = check_scene(positions, rcs)
        step = self._step(positions)
        if step is not None:
            step = step.reshape(positions.shape)
        paths = self.paths(positions.double(), rcs.double(), step)
        length = paths.delay_s * (self.paths.speed_m_s / 2)
        speed = torch.zeros_like(length)
        if length.shape[-3] > 1:
            change = length.diff(dim=-3)
            before = torch.cat((change[..., :1, :, :], change), -3)
            after = torch.cat((change, change[..., -1:, :, :]), -3)
            speed = (before + after) * (-0.5 * self.prf_hz)
        return SideChannels(length, speed, paths.gain.abs())

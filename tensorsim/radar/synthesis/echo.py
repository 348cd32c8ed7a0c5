"""Echo synthesis: intermediate frequency (IF) samples of an FMCW radar, from moving scatterers.

The formula is :func:`~tensorsim.radar.synthesis.dechirp.intermediate_frequency`; its delays and gains come from
:class:`~tensorsim.radar.synthesis.paths.PropagationPaths`, and the module here adds up the paths in blocks.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import FloorConfig, RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, check_count, check_scatterers, check_scene
from tensorsim.ops import flatten_batch, unflatten_batch
from tensorsim.protocols import check_instance
from tensorsim.radar.synthesis.dechirp import beat_sum, dispersed_sum
from tensorsim.radar.synthesis.paths import Paths, PropagationPaths, Resonance, chosen_paths
from tensorsim.radar.synthesis.wall import place_wall


class SideChannels(NamedTuple):
    """Ground truth of each of P paths via each scatterer, (..., M, S, P) float64.

    With several antennas (..., V, M, S, P).

    Attributes:
        range_m: ``c tau / 2``, the position of the path in a range profile.
        radial_speed_m_s: its rate of change, positive = approaching as on the Doppler axis; central
            differences, one-sided at the ends of the clip, 0 for a clip of one pulse.
        amplitude: ``|a|`` of the IF for unit transmit power, 0 for a missing path.
    """

    range_m: Tensor
    radial_speed_m_s: Tensor
    amplitude: Tensor


class EchoSynthesizer(nn.Module):
    """Noise-free IF samples of a scene: the dechirped echo of all propagation paths.

    Args:
        radar: the radar. Several transmitters or receivers give the IF an antenna dimension.
        wall: a wall in the scene; see :class:`~tensorsim.radar.synthesis.paths.PropagationPaths` for its effect on
            the echo of a target, and :func:`~tensorsim.radar.synthesis.wall.place_wall` for its position.
        multipath: include the paths that bounce inside the wall or are reflected by it; none without a wall.
        leakage: include the direct coupling from transmitter to receiver.
        wall_echo: include the static echo of the wall's near face.
        wall_paths: ``"series"``, or ``"paper"`` for the paper's formula of the wall; see
            :class:`~tensorsim.radar.synthesis.paths.PropagationPaths`.
        direct: include the direct path to each target; False leaves multipath only.
        pulse_chunk: pulses processed at a time; limits the working memory.
        incidence: ``"normal"``, ``"oblique"`` or ``"airy"``: how legs pass the wall.
        polarization: ``"te"`` or ``"tm"`` at the wall, for ``"oblique"`` and ``"airy"``.
        bounces: largest number of pairs of internal bounces on a leg.
        floor: a reflecting floor.
        antenna: pattern of all antennas (:mod:`~tensorsim.radar.synthesis.antenna`); None is isotropic.
        paths: names of the path groups to include, from ``tensorsim.radar.synthesis.paths.PATH_NAMES``; replaces
            ``direct``, ``multipath``, ``leakage``, ``wall_echo`` and ``floor``.
        learnable: which of ``tensorsim.radar.synthesis.paths.LEARNABLE`` are parameters of ``.paths``, by that name.
        wall_attenuation: False lets echoes through the wall keep their power; their delay is not changed.

    Shapes:
        positions (..., M, S, 3) metres in the world frame, rcs (..., S) m^2 per clip, (..., M, S) per pulse
        or (S,) -> (..., M, N) complex for transmit power 1. S = 0 is an empty scene: zeros, plus leakage and
        wall echo. Several antennas: (..., V, M, N), channel ``v = k A + a`` for transmitter k and receiver a.

    Transmitter k of K fires ``k / (K PRF)`` after the start of the pulse interval; the positions at that
    instant are interpolated linearly between pulses, and extrapolated after the last.

    The result is complex64, and complex128 after ``.double()``; geometry is always computed in float64.
    Differentiable with respect to positions, RCS (the gradient of sqrt(RCS) at RCS 0 is set to 0) and learnable
    constants.

    >>> scene = EchoSynthesizer(RadarConfig.free_space())
    >>> scene(torch.tensor([[[0.0, 3.0, 1.0]]]), torch.ones(1)).shape  # one pulse, one scatterer at 3 m
    torch.Size([1, 400])

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
        wall_attenuation: bool = True,
    ) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        parts = (("wall", wall, WallConfig), ("floor", floor, FloorConfig), ("antenna", antenna, nn.Module))
        for name, part, kind in parts:
            if part is not None:
                check_instance(part, kind, name)
        check_count(pulse_chunk, "pulse_chunk")
        names = chosen_paths(multipath, leakage, wall_echo, direct, floor is not None, paths)
        wall = place_wall(wall, radar)
        self.paths = PropagationPaths(
            radar, wall, names, wall_paths, incidence, polarization, bounces, floor, antenna, learnable,
            wall_attenuation,
        )  # fmt: skip
        self.carrier_hz = float(radar.carrier_hz)
        self.slope_hz_per_s = float(radar.slope_hz_per_s)
        self.sample_rate_hz = float(radar.sample_rate_hz)
        self.prf_hz = float(radar.prf_hz)
        self.samples = radar.samples_per_chirp
        self.pulse_chunk = pulse_chunk
        # Block size: tones of about this many paths times pulses fit in the cache.
        self.tone_block = 2**13
        fine = math.isqrt(self.samples - 1) + 1
        self.register_buffer("fine", torch.arange(fine).float(), persistent=False)
        self.register_buffer("coarse", torch.arange(-(-self.samples // fine)).float(), persistent=False)

    @torch.jit.export
    def target_echo(self, positions: Tensor, rcs: Tensor, step: Tensor | None = None) -> Tensor:
        """Echo of the targets alone, without pulse chunks.

        (..., S, 3) m and (..., S) m^2 -> (..., N); several antennas (..., M, S, 3) -> (..., V, M, N). ``step``:
        see :meth:`PropagationPaths.forward <tensorsim.radar.synthesis.paths.PropagationPaths.forward>`.
        """
        check_scatterers(positions, rcs)
        paths = self.paths(positions.double(), rcs.double(), step)
        if self.paths.airy:
            resonance = self.paths.resonance(positions.double(), step)
            return self._dispersed(paths, resonance)
        return self._sum(paths.delay_s.flatten(-2), paths.gain.flatten(-2), self.fine.dtype)

    def _dispersed(self, paths: Paths, resonance: Resonance) -> Tensor:
        time = torch.arange(self.samples, device=self.fine.device).double() / self.sample_rate_hz
        pulses = dispersed_sum(
            paths, resonance, self.carrier_hz, self.slope_hz_per_s, time, self.paths.attenuates
        )
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
        """IF (N,) of the static paths, leakage and wall echo; (V, 1, N) for several antennas."""
        static = self.paths.static()
        parts = torch.view_as_real(self._sum(static.delay_s, static.gain, torch.float64))
        return torch.view_as_complex(parts.to(self.fine.dtype).contiguous())

    def forward(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """(..., M, S, 3) metres and (..., S) or (..., M, S) m^2 to IF (..., M, N) or (..., V, M, N)."""
        rcs = check_scene(positions, rcs).flatten(0, -2)
        pulses = positions.flatten(0, -3)
        step = self.displacements(positions)
        step = None if step is None else step.flatten(0, -3)
        static = self.static_echo()
        echo = static.new_empty(list(static.shape[:-2]) + [pulses.shape[0], self.samples])  # noqa: RUF005 (TorchScript)
        chunks: list[Tensor] = []
        for start in range(0, pulses.shape[0], self.pulse_chunk):
            stop = start + self.pulse_chunk
            ahead = None if step is None else step[start:stop]
            chunk = self.target_echo(pulses[start:stop], rcs[start:stop], ahead) + static
            if chunk.requires_grad:  # for a write into a slice, the backward pass would copy the whole tensor
                chunks.append(chunk)
            else:
                echo[..., start:stop, :] = chunk
        if len(chunks) > 0:
            echo = torch.cat(chunks, -2)
        echo = echo.unflatten(-2, list(positions.shape[:-2]))
        return echo.movedim(0, -3) if self.paths.has_array else echo

    @torch.jit.export
    def displacements(self, positions: Tensor) -> Tensor | None:
        """Displacements up to the next pulse, (..., M, S, 3) like ``positions``; None for one transmitter.

        The last pulse repeats that of the pulse before.
        """
        if self.paths.transmitters == 1:
            return None
        positions = positions.double()
        if positions.shape[-3] == 1:
            return torch.zeros_like(positions)
        step = positions.diff(dim=-3)
        return torch.cat((step, step[..., -1:, :, :]), -3)

    @torch.jit.export
    def pulse_times(self, start: int, count: int) -> Tensor:
        """Times (count,) in seconds, float64, of pulses ``start`` onwards."""
        pulse = torch.arange(count, dtype=torch.float64, device=self.fine.device)
        return (start + pulse) / self.prf_hz

    @torch.jit.export
    def contributions(self, positions: Tensor, rcs: Tensor, groups: Tensor) -> Tensor:
        """IF of each group of scatterers by each path: (..., G, P, M, N), or (..., G, P, V, M, N).

        The sum over G and P plus :meth:`static_echo` is the echo. ``.paths.path_names`` has the names of the paths.

        Args:
            positions, rcs: as in forward.
            groups: (S,) int64 group number of each scatterer, from 0: its person, or 0 ... S - 1 for each alone.

        Raises:
            TensorsimError: as forward; groups of another shape or negative; no scatterers or no paths.
        """
        rcs = check_scene(positions, rcs)
        if groups.dim() != 1 or groups.shape[0] != positions.shape[-2] or groups.is_floating_point():
            raise TensorsimError(
                f"groups: got {list(groups.shape)} {groups.dtype}, expected one integer per scatterer, "
                f"[{positions.shape[-2]}]"
            )
        if groups.numel() == 0 or len(self.paths.path_names) == 0:
            raise TensorsimError(
                "contributions: got a scene without scatterers or paths, expected at least one of each"
            )
        if bool((groups < 0).any()):
            raise TensorsimError(f"groups: got {int(groups.min())}, expected numbers from 0")
        step = self.displacements(positions)
        paths = self.paths(positions.double(), rcs.double(), step)
        resonance = self.paths.resonance(positions.double(), step) if self.paths.airy else None
        parts: list[Tensor] = []
        for group in range(int(groups.max()) + 1):
            gain = torch.where((groups == group).unsqueeze(-1), paths.gain, 0.0)
            by_path: list[Tensor] = []
            for path in range(gain.shape[-1]):
                one = Paths(paths.delay_s[..., path : path + 1], gain[..., path : path + 1])
                if resonance is None:
                    by_path.append(self._sum(one.delay_s.squeeze(-1), one.gain.squeeze(-1), self.fine.dtype))
                else:
                    slab = Resonance(
                        resonance.square[..., path : path + 1, :],
                        resonance.loss_neper[..., path : path + 1, :],
                        resonance.bounce_s[..., path : path + 1, :],
                    )
                    by_path.append(self._dispersed(one, slab))
            parts.append(torch.stack(by_path, positions.dim() - 3))
        return torch.stack(parts, positions.dim() - 3)

    @torch.jit.export
    def side_channels(self, positions: Tensor, rcs: Tensor) -> SideChannels:
        """Range, radial speed and amplitude of each path via each scatterer; arguments as in forward."""
        rcs = check_scene(positions, rcs)
        step = self.displacements(positions)
        paths = self.paths(positions.double(), rcs.double(), step)
        length = paths.delay_s * (self.paths.speed_m_s / 2)
        speed = torch.zeros_like(length)
        if length.shape[-3] > 1:
            change = length.diff(dim=-3)
            before = torch.cat((change[..., :1, :, :], change), -3)
            after = torch.cat((change, change[..., -1:, :, :]), -3)
            speed = (before + after) * (-0.5 * self.prf_hz)
        return SideChannels(length, speed, paths.gain.abs())

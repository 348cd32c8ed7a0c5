"""The whole radar chain: from scatterers to range-time maps, a Doppler-time map and ridges."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import ProcessingConfig, RadarConfig, SceneConfig, WallConfig
from tensorsim.config.processing import Mti
from tensorsim.errors import TensorsimError, check_scene, is_exporting
from tensorsim.ops import flatten_batch, magnitude, safe_sqrt, unflatten_batch
from tensorsim.protocols import check_instance
from tensorsim.radar.options import configured, echo_of, refuse_conflicts
from tensorsim.radar.processing.ambiguity import SpeedCheck, check_unambiguous
from tensorsim.radar.processing.columns import Columns, block_rms, join_pulses
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import FollowingGate, RangeProfile
from tensorsim.radar.processing.ridges import RidgeExtractor, Ridges
from tensorsim.radar.recorder import Recorder, stretches
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.front_end import Levels
from tensorsim.radar.synthesis.noise import decibels
from tensorsim.types import RadarMaps

#: ``source(start, stop)`` returns pulses start to stop of a scene: positions (stop - start, S, 3) and RCS.
Source = Callable[[int, int], tuple[Tensor, Tensor]]

#: Largest size in bytes of the echoes that :meth:`RadarSimulator.stream` keeps: 20 s in free space.
KEPT_BYTES = 2**28


class Pending(NamedTuple):
    """What later pulses of B clips need from earlier ones.

    Attributes:
        profiles: (B, p, V R) complex, the last profiles that entered the moving target indicator.
        moving: (B, q, V R) complex, the part of its output that later Doppler frames still need.
    """

    profiles: Tensor
    moving: Tensor


class Piece(NamedTuple):
    """What m consecutive pulses add to the maps of B clips.

    Attributes:
        profiles: (B, m, V R) complex, with noise; the channels of V antennas are concatenated.
        moving: (B, m', V R) complex, after the moving target indicator; fewer pulses in the first piece.
        doppler_time: (B, F, k) frames completed by these pulses.
        pending: what the next piece needs.
    """

    profiles: Tensor
    moving: Tensor
    doppler_time: Tensor
    pending: Pending


class RadarSimulator(nn.Module):
    """Echo, receiver noise, range profiles, moving target indicator, Doppler-time map and ridges of a scene.

    The IF of a clip is never held as a whole: it is synthesised and turned into profiles ``pulse_chunk`` pulses at a
    time. The profiles are, since their noise depends on the mean power of the clip; the noise is drawn in the range
    bins, with the covariance that windowed white noise has there
    (:class:`~tensorsim.radar.synthesis.noise.ProfileNoise`). ``stream`` takes clips of any length: it computes long
    ones twice instead of holding their profiles. ``doppler_time`` computes that map alone, for data sets: fastest
    with ``engine="range-bins"``, few ``near_bins`` and a ``range_gate_m``.

    Args:
        radar: the radar, or a whole :class:`~tensorsim.SceneConfig`.
        wall: a wall in the scene.
        processing: how the signal becomes maps; None: the defaults, with ``options``.
        antenna, learnable: see :class:`~tensorsim.radar.EchoSynthesizer`.
        echo: an :class:`~tensorsim.radar.EchoSynthesizer` in place of one made from the scene.
        mti: the method of a :class:`~tensorsim.radar.MovingTargetIndicator`, or a module of that class.
        doppler, ridges: modules in place of those made from ``processing``.
        seed: for the room's reflectors, the sensor's vibration and the phase noise.
        **options: fields of :class:`~tensorsim.SceneConfig` (unless one is given) and of
            :class:`~tensorsim.ProcessingConfig` by name: ``multipath=True``, ``snr_db=20.0``, ``ridge_count=1``, ...
            Here ``multipath`` is off by default.

    A scene without echoes gets the noise of one with a target of 1 m^2 at 3 m in free space. With ``near_bins`` the
    relative error is ``simulator.recorder.engine.bins.truncation`` (1.3 % for 8 with Hamming, 0.06 % with Hann).
    Noise is drawn for a few chunks of pulses at a time, so another ``pulse_chunk`` gives another realisation for the
    same seed.

    Shapes: positions (..., M, S, 3) m, rcs (..., S), (..., M, S) or (S,) m^2 ->
    :class:`~tensorsim.types.RadarMaps` in float32, or float64 after ``.double()``. Differentiable, except for the
    ridge bins.

    Several antennas form one radar: range-time maps are root mean squares over the V channels, Doppler-time maps add
    their powers, and every channel has its own noise. :meth:`profiles` returns the individual channels, for angles
    and points (:class:`~tensorsim.radar.AngleMapper`, :class:`~tensorsim.radar.PointDetector`).

    Attributes:
        range_time_block: pulses per column of the range-time maps.
        min_pulses: the shortest clip that has a Doppler frame.

    Raises:
        TensorsimError: see the stages; a module of the wrong class; maps of a clip shorter than ``min_pulses``;
            motion too fast for the PRF (eager mode only, like the warnings about targets beyond the range axis or a
            fixed gate; see :class:`~tensorsim.radar.processing.ambiguity.SpeedCheck`).
    """

    def __init__(
        self,
        radar: RadarConfig | SceneConfig,
        wall: WallConfig | None = None,
        *,
        processing: ProcessingConfig | None = None,
        antenna: nn.Module | None = None,
        learnable: tuple[str, ...] = (),
        echo: EchoSynthesizer | None = None,
        mti: Mti | MovingTargetIndicator | None = None,
        doppler: DopplerTimeMap | None = None,
        ridges: RidgeExtractor | None = None,
        seed: int = 0,
        **options: Any,
    ) -> None:
        super().__init__()
        if isinstance(mti, str):
            options["mti"] = mti
        elif mti is not None:
            check_instance(mti, MovingTargetIndicator, "mti")
        if echo is not None:
            check_instance(echo, EchoSynthesizer, "echo")
        for name, part in (("doppler", doppler), ("ridges", ridges)):
            if part is not None:
                check_instance(part, nn.Module, name)
        scene, processing = configured(radar, wall, processing, options)
        ready: dict[str, nn.Module | None] = {"echo": echo, "doppler": doppler, "ridges": ridges}
        ready["mti"] = mti if isinstance(mti, nn.Module) else None
        given = {
            *options,
            *(["antenna"] if antenna is not None else []),
            *(["learnable"] if learnable else []),
        }
        refuse_conflicts(ready, scene, processing, given)
        scene.check_engine(processing.engine)
        radar = scene.radar
        if radar.has_array and processing.integration == "coherent":
            raise TensorsimError(
                "integration: got 'coherent' with several antennas, expected 'noncoherent' or 'paper': their phases "
                "differ with the direction"
            )
        self.echo = echo or echo_of(scene, processing.pulse_chunk, antenna, learnable)
        gate_m = processing.range_gate_m
        self.fixed_gate_m = None if isinstance(gate_m, float | int) else gate_m
        self.range_profile = RangeProfile(radar, processing.range_window, self.fixed_gate_m)
        self.recorder = Recorder(scene, processing, self.echo, self.range_profile, seed)
        self.noise = self.recorder.noise
        self.channels, self.has_array = self.recorder.channels, radar.has_array
        self.gate: nn.Module | None = None
        if isinstance(gate_m, float | int):
            self.gate = FollowingGate(radar, self.range_profile.range_m, gate_m)
        self.mti = (
            mti if isinstance(mti, MovingTargetIndicator) else MovingTargetIndicator(processing.mti, radar)
        )
        self.doppler = doppler or DopplerTimeMap(
            radar, processing.window_s, processing.overlap, processing.integration
        )
        self.ridges = ridges or RidgeExtractor(processing.ridge_count)
        # Chunks per piece: few enough that the allocator reuses their memory, but not too few, since pieces overlap.
        self.piece_chunks = 8
        self.range_time_block = 1
        if processing.display_rate_hz is not None:
            self.range_time_block = max(1, round(radar.prf_hz / processing.display_rate_hz))
        self.min_pulses = self.doppler.length + self.mti.lost_pulses
        self.radar, self.one_channel = radar, scene.receiver.real

    def forward(self, positions: Tensor, rcs: Tensor) -> RadarMaps:
        """Positions (..., M, S, 3) m and RCS (..., S) or (..., M, S) m^2 to maps."""
        positions, rcs, lead = self._scene(positions, rcs)
        pulses = positions.shape[1]
        self._check_pulses(pulses)
        echoes, levels = self.recorder.echoes(positions, rcs, self.span(positions))
        noise = torch.zeros_like(levels.signal)
        pending = self._nothing_pending(positions)
        range_time: list[Tensor] = []
        range_time_mti: list[Tensor] = []
        doppler_times: list[Tensor] = []
        for start, points, sections, way in self._stretches(positions, rcs):
            fresh, noise_energy = self.recorder.received(points, sections, start, way, levels, echoes)
            piece = self._piece(fresh, points, sections, pending)
            range_time.append(self._shown(piece.profiles))
            range_time_mti.append(self._shown(piece.moving))
            doppler_times.append(piece.doppler_time)
            pending, noise = piece.pending, noise + noise_energy
        doppler_time = torch.cat(doppler_times, -1)
        ridges = self.ridges(doppler_time)
        # Without noise the ratio is infinite, and no gradient flows through it.
        signal = levels.signal.detach() if self.recorder.noise.noiseless else levels.signal
        snr_db = decibels(signal, noise / (pulses * self.echo.samples)).to(doppler_time.dtype)
        return RadarMaps(
            unflatten_batch(block_rms(torch.cat(range_time, -1), self.range_time_block), lead),
            unflatten_batch(block_rms(torch.cat(range_time_mti, -1), self.range_time_block), lead),
            unflatten_batch(doppler_time, lead),
            unflatten_batch(ridges.indices, lead),
            unflatten_batch(ridges.magnitudes, lead),
            unflatten_batch(snr_db, lead),
        )

    @torch.jit.export
    def doppler_time(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """Only the Doppler-time map (..., F, K) of :meth:`forward`; identical for the same seed."""
        positions, rcs, lead = self._scene(positions, rcs)
        self._check_pulses(positions.shape[1])
        echoes, levels = self.recorder.echoes(positions, rcs, self.span(positions))
        pending = self._nothing_pending(positions)
        parts: list[Tensor] = []
        for start, points, sections, way in self._stretches(positions, rcs):
            fresh, _ = self.recorder.received(points, sections, start, way, levels, echoes)
            piece = self._piece(fresh, points, sections, pending)
            parts.append(piece.doppler_time)
            pending = piece.pending
        return unflatten_batch(torch.cat(parts, -1), lead)

    @torch.jit.export
    def profiles(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """Received complex range profiles, (..., M, R), or (..., V, M, R) for the V channels of an array.

        Channel ``v = k A + a`` is transmitter k with receiver a; transmitters fire in turn, see
        :func:`~tensorsim.radar.align_transmitters`. For the same seed, the profiles are those of :meth:`forward`.
        """
        positions, rcs, lead = self._scene(positions, rcs)
        echoes, levels = self.recorder.echoes(positions, rcs, self.span(positions))
        parts: list[Tensor] = []
        for start, points, sections, way in self._stretches(positions, rcs):
            parts.append(self.recorder.received(points, sections, start, way, levels, echoes)[0])
        profiles = torch.cat(parts, 1)
        if self.has_array:
            profiles = profiles.unflatten(-1, [self.channels, -1]).transpose(1, 2)
        return unflatten_batch(profiles, lead)

    def _scene(self, positions: Tensor, rcs: Tensor) -> tuple[Tensor, Tensor, list[int]]:
        """Positions (B, M, S, 3) and RCS (B, M, S) of a scene, checked, and its leading dimensions."""
        rcs = check_scene(positions, rcs)
        if not torch.jit.is_scripting() and not is_exporting():
            check_unambiguous(positions, rcs, self.radar, self.fixed_gate_m, self.one_channel)
        return flatten_batch(positions, 3), flatten_batch(rcs, 2), list(positions.shape[:-3])

    def _stretches(self, positions: Tensor, rcs: Tensor) -> list[tuple[int, Tensor, Tensor, Tensor | None]]:
        return stretches(positions, rcs, self.echo.displacements(positions), self.span(positions))

    def span(self, positions: Tensor) -> int:
        """Number of pulses processed, and for which noise is drawn, at a time; for positions (B, M, S, 3)."""
        if self.mti.whole_clip:
            return positions.shape[1]
        return max(self.piece_chunks * self.recorder.step(positions), self.mti.lost_pulses + 1)

    @torch.no_grad()
    def stream(self, source: Source, pulses: int) -> RadarMaps:
        """Maps of one clip of ``pulses`` pulses whose positions come from ``source`` piece by piece.

        The result equals :meth:`forward` on the whole clip (including the noise for the same seed), without leading
        dimensions and without gradients. Memory does not grow with the clip, except for the maps themselves; set
        ``display_rate_hz`` to limit these. The source is called twice for every piece and must return the same both
        times.

        Raises:
            TensorsimError: as forward; also an ``mti`` that needs the whole clip.
        """
        if self.mti.whole_clip:
            raise TensorsimError(
                f"stream: got mti {self.mti.method!r}, expected 'two-pulse' or 'n-pulse', which do not need the "
                "whole clip"
            )
        self._check_pulses(pulses)
        speeds = SpeedCheck(self.radar, self.fixed_gate_m, self.one_channel)
        levels = Levels(torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
        # Echoes of a short clip are kept for the second pass, in which noise is added to them.
        bins = self.range_profile.range_m.shape[0] * self.channels
        echoes: list[Tensor] = []
        keeps = self.recorder.front_end is None and 8 * pulses * bins <= KEPT_BYTES
        for start, positions, rcs, ahead in self._pieces(source, pulses):
            speeds.add(positions, rcs)
            if self.recorder.needs_levels:
                profiles, energies = self.recorder.survey(positions, rcs, start, ahead)
                levels = self.recorder.add(levels, energies, pulses)
                if keeps:
                    echoes.append(profiles)
        speeds.judge()

        seen = pulses - self.mti.lost_pulses
        range_time = Columns(pulses, self.range_time_block)
        range_time_mti = Columns(seen, self.range_time_block)
        doppler_time = Columns(self.doppler.frames(seen))
        # Small tensors kept from every piece would pin the freed memory of the large ones between them.
        peak_bins, peak_magnitudes = Columns(doppler_time.total), Columns(doppler_time.total)
        pending: list[Pending] = []
        noise = torch.zeros_like(levels.signal)
        for start, positions, rcs, ahead in self._pieces(source, pulses):
            before = pending[0] if pending else self._nothing_pending(positions)
            there = Levels(levels.signal.to(positions.device), levels.arriving.to(positions.device))
            fresh, noise_energy = self.recorder.received(positions, rcs, start, ahead, there, echoes)
            piece = self._piece(fresh, positions, rcs, before)
            pending, noise = [piece.pending], noise + noise_energy.to(noise)
            range_time.push(self._shown(piece.profiles)[0])
            range_time_mti.push(self._shown(piece.moving)[0])
            doppler_time.push(piece.doppler_time[0])
            peaks = self.ridges.peaks(piece.doppler_time[0])
            peak_bins.push(peaks.indices)
            peak_magnitudes.push(peaks.magnitudes)
        ridges = self.ridges.connect(Ridges(peak_bins.result(), peak_magnitudes.result()), self.doppler.bins)
        whole = doppler_time.result()
        return RadarMaps(
            range_time.result(),
            range_time_mti.result(),
            whole,
            ridges.indices,
            ridges.magnitudes,
            decibels(levels.signal, noise / (pulses * self.echo.samples))[0].to(whole),
        )

    @torch.no_grad()
    def advance(self, positions: Tensor, rcs: Tensor, first: int, pending: Pending | None) -> Piece:
        """Maps of the next pulses of an endless scene.

        The noise is that of an empty scene (see the class), as the power of later pulses is not yet known. Not for
        several transmitters, receiver effects, or a moving target indicator that needs the whole clip; this is not
        checked here.

        Args:
            positions: (B, m, S, 3) metres; in the first piece, m must exceed the ``lost_pulses`` of the moving target
                indicator.
            rcs: (B, m, S) m^2.
            first: number of the first of these pulses.
            pending: from the previous piece; None for the first one.
        """
        rcs = check_scene(positions, rcs)
        pending = self._nothing_pending(positions) if pending is None else pending
        nothing = torch.zeros(positions.shape[0], dtype=torch.float64, device=positions.device)
        fresh, _ = self.recorder.received(positions, rcs, first, None, Levels(nothing, nothing), [])
        return self._piece(fresh, positions, rcs, pending)

    def _pieces(self, source: Source, pulses: int) -> Iterator[tuple[int, Tensor, Tensor, Tensor | None]]:
        """Checked pieces of a source: first pulse number, positions (1, m, S, 3), RCS (1, m, S), displacements.

        All but the last have the same length, normally a multiple of ``pulse_chunk``. The displacements up to the
        next pulse (1, m, S, 3) are for transmitters that fire in turn, else None; to compute them, the source is
        asked for one more pulse, or for the previous one.
        """
        span = max(self.piece_chunks * self.recorder.pulse_chunk, self.mti.lost_pulses + 1)
        for start in range(0, pulses, span):
            own = min(span, pulses - start)
            in_turn = self.echo.paths.transmitters > 1
            stop = min(start + own + in_turn, pulses)
            # The last pulse repeats the displacement of the one before.
            first = start - 1 if in_turn and stop == start + 1 and start > 0 else start
            positions, rcs = source(first, stop)
            if positions.dim() != 3 or positions.shape[0] != stop - first:
                raise TensorsimError(
                    f"source({first}, {stop}): got positions of shape {list(positions.shape)}, expected "
                    f"({stop - first}, scatterers, 3)"
                )
            rcs = check_scene(positions, rcs)
            ahead = self.echo.displacements(positions)
            here = slice(start - first, start - first + own)
            yield start, positions[None, here], rcs[None, here], None if ahead is None else ahead[None, here]

    def _check_pulses(self, pulses: int) -> None:
        if pulses < self.min_pulses:
            raise TensorsimError(
                f"positions: got {pulses} pulses, expected at least {self.min_pulses} for one Doppler window"
            )

    def _nothing_pending(self, positions: Tensor) -> Pending:
        """The empty :class:`Pending` before the first pulse of positions (B, M, S, 3)."""
        bins = self.range_profile.range_m.shape[0] * self.channels
        nothing = self.echo.static_echo().new_zeros([positions.shape[0], 0, bins])
        return Pending(nothing, nothing)

    def _shown(self, profiles: Tensor) -> Tensor:
        """Magnitude (B, R, m) of profiles (B, m, V R), root mean square over the antennas."""
        shown = magnitude(profiles.transpose(1, 2))
        if self.channels == 1:
            return shown
        return safe_sqrt(shown.unflatten(1, [self.channels, -1]).square().mean(1))

    def _piece(self, fresh: Tensor, positions: Tensor, rcs: Tensor, pending: Pending) -> Piece:
        """Maps of the next pulses, given what is pending from the earlier ones.

        ``fresh`` (B, m, V R) are their received profiles; positions (B, m, S, 3), RCS (B, m, S).
        """
        profiles = join_pulses(pending.profiles, fresh)
        moving = self.mti(profiles)
        if self.gate is not None:
            late = positions.shape[1] - moving.shape[1]
            gated: list[Tensor] = []
            for channel in moving.chunk(self.channels, 2):
                gated.append(self.gate(channel, positions[:, late:], rcs[:, late:]))
            moving = torch.cat(gated, 2)
        waiting = join_pulses(pending.moving, moving)
        count = self.doppler.frames(waiting.shape[1])
        if count > 0:
            doppler_time = self.doppler(waiting[:, : (count - 1) * self.doppler.hop + self.doppler.length])
        else:
            doppler_time = fresh.abs().new_zeros([fresh.shape[0], self.doppler.bins, 0])
        last = profiles[:, profiles.shape[1] - self.mti.lost_pulses :]
        return Piece(fresh, moving, doppler_time, Pending(last, waiting[:, count * self.doppler.hop :]))

"""The radar chain whole: scatterers in, range-time maps, Doppler-time map and ridges out."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import ProcessingConfig, RadarConfig, SceneConfig, WallConfig
from tensorsim.config.processing import Mti
from tensorsim.errors import TensorsimError, is_exporting
from tensorsim.ops import flatten_batch, unflatten_batch
from tensorsim.radar.options import configured, echo_of, refuse_conflicts
from tensorsim.radar.processing.ambiguity import SpeedCheck, check_unambiguous
from tensorsim.radar.processing.columns import Columns, block_rms, join_pulses
from tensorsim.radar.processing.doppler import DopplerTimeMap
from tensorsim.radar.processing.mti import MovingTargetIndicator
from tensorsim.radar.processing.range_profile import FollowingGate, RangeProfile
from tensorsim.radar.processing.ridges import RidgeExtractor, Ridges
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.echo import EchoSynthesizer, check_scene
from tensorsim.radar.synthesis.engines import RangeBinEngine, TimeEngine
from tensorsim.radar.synthesis.noise import ProfileNoise, ReceiverNoise, decibels
from tensorsim.types import RadarMaps

#: ``source(start, stop)`` gives pulses start to stop of a scene: positions (stop - start, S, 3) and RCS.
Source = Callable[[int, int], tuple[Tensor, Tensor]]


class Pending(NamedTuple):
    """What later pulses of B clips need of earlier ones.

    Attributes:
        profiles: (B, p, R) complex, the last ones that the moving target indicator has seen.
        moving: (B, q, R) complex, what it made of them as far as later Doppler frames need it.
    """

    profiles: Tensor
    moving: Tensor


class Piece(NamedTuple):
    """What a stretch of m pulses adds to the maps of B clips.

    Attributes:
        profiles: (B, m, R) complex, with noise.
        moving: (B, m', R) complex; fewer in the first piece.
        doppler_time: (B, F, k) frames that the pulses complete.
        pending: for the next piece.
        noise_energy: (B,).
    """

    profiles: Tensor
    moving: Tensor
    doppler_time: Tensor
    pending: Pending
    noise_energy: Tensor


class RadarSimulator(nn.Module):
    """Echo, receiver noise, range profiles, moving target indicator, Doppler-time map and ridges of a scene.

    The IF is never held whole: it is made and turned into profiles ``pulse_chunk`` pulses at a time. The profiles
    are, since the noise in them is set by the mean power of the clip; it is drawn where they are, with the
    covariance that windowed white noise has there (:class:`~tensorsim.radar.synthesis.noise.ProfileNoise`). ``stream``
    takes clips of any length without holding their profiles, and makes them twice for it; ``doppler_time`` makes
    that map alone, for data sets: fastest with ``engine="range-bins"``, few ``near_bins`` and a ``range_gate_m``.

    Args:
        radar: the radar, or a whole :class:`~tensorsim.SceneConfig`.
        wall: a wall in the scene.
        processing: how the signal becomes maps; None: the defaults, with ``options``.
        antenna, learnable: see :class:`~tensorsim.radar.EchoSynthesizer`.
        echo: an :class:`~tensorsim.radar.EchoSynthesizer` in place of one made from the scene.
        mti: the method of a :class:`~tensorsim.radar.MovingTargetIndicator`, or a module of that class.
        doppler, ridges: modules in place of those made from ``processing``.
        **options: fields of :class:`~tensorsim.SceneConfig` (beside a radar) and of
            :class:`~tensorsim.ProcessingConfig` by name: ``multipath=True``, ``snr_db=20.0``, ``ridge_count=1``, ...
            Here ``multipath`` is off unless it is asked for.

    A scene without echo gets the noise of one with a target of 1 m^2 at 3 m in free space. With ``near_bins`` the
    relative error is ``simulator.engine.bins.truncation`` (1.3 % for 8 with Hamming, 0.06 % with Hann). Noise is drawn
    for a few chunks of pulses at a time, so with one seed another ``pulse_chunk`` is another realisation.

    Shapes: positions (..., M, S, 3) m, rcs (..., S), (..., M, S) or (S,) m^2 ->
    :class:`~tensorsim.types.RadarMaps` in float32, or float64 after ``.double()``. Differentiable but for
    ridge bins.

    Attributes:
        range_time_block: pulses per column of the range-time maps.
        min_pulses: the shortest clip that has a Doppler frame.

    Raises:
        TensorsimError: see the stages; a clip shorter than ``min_pulses``; motion that the PRF cannot follow
            (eager only, like its warning; see :class:`~tensorsim.radar.processing.ambiguity.SpeedCheck`).
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
        **options: Any,
    ) -> None:
        super().__init__()
        if isinstance(mti, str):
            options["mti"] = mti
        scene, processing = configured(radar, wall, processing, options)
        ready: dict[str, nn.Module | None] = {"echo": echo, "doppler": doppler, "ridges": ridges}
        refuse_conflicts(ready, options, wall, antenna, learnable)
        radar = scene.radar
        if radar.has_array:
            raise TensorsimError(
                "radar: got several antennas, expected one transmitter and one receiver; for an array call the "
                "EchoSynthesizer and the stages after it, and AngleMapper for the angles"
            )
        self.echo = echo or echo_of(scene, processing.pulse_chunk, antenna, learnable)
        self.noise = ReceiverNoise(
            scene.snr_db,
            scene.noise_reference,
            empty_power=(self.echo.paths.scale / 3.0**2) ** 2,
            bandwidth_hz=radar.sample_rate_hz,
            noise_figure_db=scene.noise_figure_db,
            transmit_power_w=scene.transmit_power_w,
        )
        gate_m = processing.range_gate_m
        fixed = None if isinstance(gate_m, float | int) else gate_m
        self.range_profile = RangeProfile(radar, processing.range_window, fixed)
        total = scene.noise_reference == "total"
        self.engine: nn.Module = TimeEngine(self.echo, self.range_profile, total)
        if processing.engine == "range-bins":
            bins = RangeBinSynthesizer(self.echo, self.range_profile, processing.near_bins)
            self.engine = RangeBinEngine(bins, total)
        self.profile_noise = ProfileNoise(self.range_profile.window)
        self.gate: nn.Module | None = None
        if isinstance(gate_m, float | int):
            self.gate = FollowingGate(radar, self.range_profile.range_m, gate_m)
        self.mti = mti if isinstance(mti, MovingTargetIndicator) else MovingTargetIndicator(processing.mti)
        self.doppler = doppler or DopplerTimeMap(
            radar, processing.window_s, processing.overlap, processing.integration
        )
        self.ridges = ridges or RidgeExtractor(processing.ridge_count)
        self.pulse_chunk = processing.pulse_chunk
        # Chunks in a piece: few, so that the allocator reuses their memory; not few, since pieces overlap.
        self.piece_chunks = 8
        self.range_time_block = 1
        if processing.display_rate_hz is not None:
            self.range_time_block = max(1, round(radar.prf_hz / processing.display_rate_hz))
        self.min_pulses = self.doppler.length + self.mti.lost_pulses
        self.radar = radar

    def forward(self, positions: Tensor, rcs: Tensor) -> RadarMaps:
        """Positions (..., M, S, 3) m and RCS (..., S) or (..., M, S) m^2 to maps."""
        lead = list(positions.shape)[:-3]
        positions, rcs = self._scene(positions, rcs)
        pulses = positions.shape[1]
        echoes, signal = self._echoes(positions, rcs)
        noise = torch.zeros_like(signal)
        pending = self._nothing_pending(positions)
        range_time: list[Tensor] = []
        range_time_mti: list[Tensor] = []
        doppler_times: list[Tensor] = []
        span = self._span(positions)
        for start in range(0, pulses, span):
            stop = start + span
            piece = self._piece(echoes.pop(0), positions[:, start:stop], rcs[:, start:stop], signal, pending)
            range_time.append(piece.profiles.transpose(1, 2).abs())
            range_time_mti.append(piece.moving.transpose(1, 2).abs())
            doppler_times.append(piece.doppler_time)
            pending, noise = piece.pending, noise + piece.noise_energy
        doppler_time = torch.cat(doppler_times, -1)
        ridges = self.ridges(doppler_time)
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
        """Only the Doppler-time map (..., F, K) of :meth:`forward`; with one seed the same."""
        lead = list(positions.shape)[:-3]
        positions, rcs = self._scene(positions, rcs)
        pulses = positions.shape[1]
        echoes, signal = self._echoes(positions, rcs)
        pending = self._nothing_pending(positions)
        parts: list[Tensor] = []
        span = self._span(positions)
        for start in range(0, pulses, span):
            stop = start + span
            piece = self._piece(echoes.pop(0), positions[:, start:stop], rcs[:, start:stop], signal, pending)
            parts.append(piece.doppler_time)
            pending = piece.pending
        return unflatten_batch(torch.cat(parts, -1), lead)

    def _scene(self, positions: Tensor, rcs: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (B, M, S, 3) and RCS (B, M, S) of a scene, checked."""
        rcs = check_scene(positions, rcs)
        self._check_pulses(positions.shape[-3])
        if not torch.jit.is_scripting() and not is_exporting():
            check_unambiguous(positions, rcs, self.radar)
        return flatten_batch(positions, 3), flatten_batch(rcs, 2)

    def _span(self, positions: Tensor) -> int:
        """Pulses in a piece."""
        if self.mti.whole_clip:
            return positions.shape[1]
        return max(self.piece_chunks * self._step(positions), self.mti.lost_pulses + 1)

    @torch.no_grad()
    def stream(self, source: Source, pulses: int) -> RadarMaps:
        """Maps of one clip of ``pulses`` pulses whose positions come from ``source`` piece by piece.

        The result equals :meth:`forward` on the whole clip (with one seed, noise included), without leading
        dimensions and without gradients. Memory does not grow with the clip but for the maps themselves; set
        ``display_rate_hz``. The source is asked twice for every piece and must answer the same.

        Raises:
            TensorsimError: as forward; also an ``mti`` that needs the whole clip.
        """
        if self.mti.whole_clip:
            raise TensorsimError(
                f"stream: got mti {self.mti.method!r}, expected 'two-pulse' or 'n-pulse', which do not need the "
                "whole clip"
            )
        self._check_pulses(pulses)
        speeds = SpeedCheck(self.radar)
        signal = torch.zeros(1, dtype=torch.float64)
        for positions, rcs in self._pieces(source, pulses):
            speeds.add(positions, rcs)
            if not self.noise.noiseless:
                signal = signal + self._profiles(positions, rcs)[1].to(signal) / (pulses * self.echo.samples)
        speeds.judge()

        seen = pulses - self.mti.lost_pulses
        range_time = Columns(pulses, self.range_time_block)
        range_time_mti = Columns(seen, self.range_time_block)
        doppler_time = Columns(self.doppler.frames(seen))
        # Small tensors kept from every piece would pin the freed memory of the large ones between them.
        peak_bins, peak_magnitudes = Columns(doppler_time.total), Columns(doppler_time.total)
        pending: list[Pending] = []
        noise = torch.zeros_like(signal)
        for positions, rcs in self._pieces(source, pulses):
            before = pending[0] if pending else self._nothing_pending(positions)
            fresh = self._profiles(positions, rcs)[0]
            piece = self._piece(fresh, positions, rcs, signal.to(positions.device), before)
            pending, noise = [piece.pending], noise + piece.noise_energy.to(noise)
            range_time.push(piece.profiles[0].T.abs())
            range_time_mti.push(piece.moving[0].T.abs())
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
            decibels(signal, noise / (pulses * self.echo.samples))[0].to(whole),
        )

    @torch.no_grad()
    def advance(self, positions: Tensor, rcs: Tensor, pending: Pending | None) -> Piece:
        """Maps of the next pulses of a scene without end.

        The noise is that of an empty scene, see the class, as the power of what is still to come is not known.

        Args:
            positions: (B, m, S, 3) metres, m above the ``lost_pulses`` of the moving target indicator.
            rcs: (B, m, S) m^2.
            pending: of the piece before; None begins.
        """
        pending = self._nothing_pending(positions) if pending is None else pending
        profiles, energy = self._profiles(positions, check_scene(positions, rcs))
        return self._piece(profiles, positions, rcs, torch.zeros_like(energy), pending)

    def _pieces(self, source: Source, pulses: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Positions (1, m, S, 3) and RCS (1, m, S) of a source, checked; m a multiple of ``pulse_chunk``."""
        span = max(self.piece_chunks * self.pulse_chunk, self.mti.lost_pulses + 1)
        for start in range(0, pulses, span):
            stop = min(start + span, pulses)
            positions, rcs = source(start, stop)
            if positions.dim() != 3 or positions.shape[0] != stop - start:
                raise TensorsimError(
                    f"source({start}, {stop}): got positions of shape {list(positions.shape)}, expected "
                    f"({stop - start}, scatterers, 3)"
                )
            yield positions.unsqueeze(0), check_scene(positions, rcs).unsqueeze(0)

    def _check_pulses(self, pulses: int) -> None:
        if pulses < self.min_pulses:
            raise TensorsimError(
                f"positions: got {pulses} pulses, expected at least {self.min_pulses} for one Doppler window"
            )

    def _nothing_pending(self, positions: Tensor) -> Pending:
        """What is pending before the first pulse of positions (B, M, S, 3)."""
        bins = self.range_profile.range_m.shape[0]
        nothing = self.echo.static_echo().new_zeros([positions.shape[0], 0, bins])
        return Pending(nothing, nothing)

    def _piece(
        self, fresh: Tensor, positions: Tensor, rcs: Tensor, signal: Tensor, pending: Pending
    ) -> Piece:
        """Maps of the next pulses, after those of which ``pending`` is left.

        Their profiles (B, m, R) free of noise, positions (B, m, S, 3), RCS (B, m, S); ``signal`` (B,) is the mean
        power that the noise refers to.
        """
        noise_energy = torch.zeros_like(signal)
        if not self.noise.noiseless:
            noise, noise_energy = self.profile_noise(fresh.transpose(1, 2), self.noise.noise_power(signal))
            fresh = fresh + noise.transpose(1, 2)
        profiles = join_pulses(pending.profiles, fresh)
        moving = self.mti(profiles)
        if self.gate is not None:
            late = positions.shape[1] - moving.shape[1]
            moving = self.gate(moving, positions[:, late:], rcs[:, late:])
        waiting = join_pulses(pending.moving, moving)
        count = self.doppler.frames(waiting.shape[1])
        if count > 0:
            doppler_time = self.doppler(waiting[:, : (count - 1) * self.doppler.hop + self.doppler.length])
        else:
            doppler_time = fresh.abs().new_zeros([fresh.shape[0], self.doppler.bins, 0])
        last = profiles[:, profiles.shape[1] - self.mti.lost_pulses :]
        return Piece(
            fresh,
            moving,
            doppler_time,
            Pending(last, waiting[:, count * self.doppler.hop :]),
            noise_energy,
        )

    def _echoes(self, positions: Tensor, rcs: Tensor) -> tuple[list[Tensor], Tensor]:
        """Profiles free of noise, piece by piece, and the mean power (B,) of the noise reference."""
        pulses, span = positions.shape[1], self._span(positions)
        pieces: list[Tensor] = []
        total = torch.zeros([positions.shape[0]], dtype=torch.float64, device=positions.device)
        for start in range(0, pulses, span):
            profiles, energy = self._profiles(
                positions[:, start : start + span], rcs[:, start : start + span]
            )
            pieces.append(profiles)
            total = total + energy
        return pieces, total / (pulses * self.echo.samples)

    def _profiles(self, positions: Tensor, rcs: Tensor) -> tuple[Tensor, Tensor]:
        """Profiles (B, M, R) free of noise, stored with time running fastest, and the energy (B,) of the reference."""
        total = torch.zeros([positions.shape[0]], dtype=torch.float64, device=positions.device)
        chunks: list[Tensor] = []
        step = self._step(positions)
        for start in range(0, positions.shape[1], step):
            profiles, energy = self.engine(positions[:, start : start + step], rcs[:, start : start + step])
            # Without noise the ratio is infinite, and no gradient goes through it.
            total = total + (energy.detach() if self.noise.noiseless else energy)
            chunks.append(profiles.transpose(1, 2))
        return torch.cat(chunks, -1).transpose(1, 2), total

    def _step(self, positions: Tensor) -> int:
        """Pulses of every clip to work on at a time."""
        return max(1, self.pulse_chunk // max(1, positions.shape[0]))

"""The radar chain whole: scatterers in, range-time maps, Doppler-time map and ridges out."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig, WallConfig
from tensorsim.errors import TensorsimError, check_positive, is_exporting
from tensorsim.radar.ambiguity import SpeedCheck, check_unambiguous
from tensorsim.radar.doppler import DopplerTimeMap
from tensorsim.radar.echo import EchoSynthesizer, check_scene
from tensorsim.radar.mti import MovingTargetIndicator
from tensorsim.radar.noise import ReceiverNoise, decibels, energy
from tensorsim.radar.range_profile import RangeProfile, flatten_batch, unflatten_batch
from tensorsim.radar.ridges import RidgeExtractor, Ridges
from tensorsim.types import RadarMaps

#: ``source(start, stop)`` gives pulses start to stop of a scene: positions (stop - start, S, 3) and RCS.
Source = Callable[[int, int], tuple[Tensor, Tensor]]


class Piece(NamedTuple):
    """What a stretch of m pulses adds to the maps of B clips.

    Attributes:
        range_time: (B, R, m).
        range_time_mti: (B, R, m'); one less in the first piece.
        doppler_time: (B, F, k) frames that the pulses complete.
        pending: (B, p, R) complex profiles that later frames need.
        noise_energy: (B,).
    """

    range_time: Tensor
    range_time_mti: Tensor
    doppler_time: Tensor
    pending: Tensor
    noise_energy: Tensor


def block_rms(magnitude: Tensor, block: int) -> Tensor:
    """Root of the mean power of ``block`` columns at a time: (..., R, M) -> (..., R, ceil(M / block)).

    The last block may be shorter.
    """
    if block == 1:
        return magnitude
    columns = magnitude.shape[-1]
    whole = columns // block * block
    power = magnitude.square()
    mean = power[..., :whole].unflatten(-1, (whole // block, block)).mean(-1)
    if whole < columns:
        mean = torch.cat((mean, power[..., whole:].mean(-1, keepdim=True)), -1)
    return mean.sqrt()


class _BlockStream:
    """:func:`block_rms` of columns that arrive piece by piece."""

    def __init__(self, block: int) -> None:
        self.block = block
        self.rest: list[Tensor] = []
        self.done: list[Tensor] = []

    def push(self, magnitude: Tensor) -> None:
        magnitude = torch.cat([*self.rest, magnitude], -1)
        whole = magnitude.shape[-1] // self.block * self.block
        self.done.append(block_rms(magnitude[..., :whole], self.block))
        self.rest = [magnitude[..., whole:].clone()]

    def result(self) -> Tensor:
        rest = [block_rms(x, self.block) for x in self.rest if x.shape[-1] > 0]
        return torch.cat(self.done + rest, -1)


class RadarSimulator(nn.Module):
    """Echo, receiver noise, range profiles, moving target indicator, Doppler-time map and ridges of a scene.

    The IF is never held whole: it is made and turned into profiles ``pulse_chunk`` pulses at a time, twice
    when noise is wanted, because the noise is set by the mean power of the clip. ``stream`` does the same for
    clips of any length without holding their profiles either.

    Args:
        radar: the radar.
        wall, multipath, leakage, wall_echo, wall_paths, direct: see
            :class:`~tensorsim.radar.echo.EchoSynthesizer`.
        snr_db, noise_reference: see :class:`~tensorsim.radar.noise.ReceiverNoise`; a scene without echo gets
            the noise of one with a target of 1 m^2 at 3 m in free space. ``"absolute"`` takes the bandwidth
            from the sample rate.
        noise_figure_db, transmit_power_w: for ``noise_reference="absolute"``.
        range_window: see :class:`~tensorsim.radar.range_profile.RangeProfile`.
        mti: see :class:`~tensorsim.radar.mti.MovingTargetIndicator`.
        window_s, overlap, integration: see :class:`~tensorsim.radar.doppler.DopplerTimeMap`.
        ridge_count: see :class:`~tensorsim.radar.ridges.RidgeExtractor`.
        pulse_chunk: pulses worked on at a time, over all clips of a batch. Noise is drawn chunk by chunk, so
            with one seed another chunk is another realisation.
        display_rate_hz: reduce the two range-time maps to about this many columns per second, each the root
            of the mean power of its pulses; None keeps every pulse.

    Shapes: positions (..., M, S, 3) m, rcs (..., S), (..., M, S) or (S,) m^2 ->
    :class:`~tensorsim.types.RadarMaps` in float32, or float64 after ``.double()``. Differentiable but for
    ridge bins.

    Attributes:
        range_time_block: pulses per column of the range-time maps.
        min_pulses: the shortest clip that has a Doppler frame.

    Raises:
        TensorsimError: see the stages; a clip shorter than ``min_pulses``; motion that the PRF cannot follow
            (eager only, like its warning; see :class:`~tensorsim.radar.ambiguity.SpeedCheck`).
    """

    def __init__(
        self,
        radar: RadarConfig,
        wall: WallConfig | None = None,
        multipath: bool = False,
        leakage: bool = False,
        wall_echo: bool = False,
        wall_paths: str = "series",
        direct: bool = True,
        snr_db: float | None = 50.0,
        noise_reference: str = "echo",
        noise_figure_db: float = 10.0,
        transmit_power_w: float = 0.01,
        range_window: str | None = "hamming",
        mti: str = "two-pulse",
        window_s: float = 0.1,
        overlap: float = 0.9,
        integration: str = "noncoherent",
        ridge_count: int = 3,
        pulse_chunk: int = 1024,
        display_rate_hz: float | None = None,
    ) -> None:
        super().__init__()
        self.echo = EchoSynthesizer(
            radar, wall, multipath, leakage, wall_echo, wall_paths, direct, pulse_chunk
        )
        self.noise = ReceiverNoise(
            snr_db,
            noise_reference,
            empty_power=(self.echo.paths.scale / 3.0**2) ** 2,
            bandwidth_hz=radar.sample_rate_hz,
            noise_figure_db=noise_figure_db,
            transmit_power_w=transmit_power_w,
        )
        self.range_profile = RangeProfile(radar, range_window)
        self.mti = MovingTargetIndicator(mti)
        self.doppler = DopplerTimeMap(radar, window_s, overlap, integration)
        self.ridges = RidgeExtractor(ridge_count)
        self.pulse_chunk = pulse_chunk
        # Chunks in a piece: few, so that the allocator reuses their memory; not few, since pieces overlap.
        self.piece_chunks = 8
        self.range_time_block = 1
        if display_rate_hz is not None:
            check_positive(display_rate_hz, "display_rate_hz")
            self.range_time_block = max(1, round(radar.prf_hz / display_rate_hz))
        self.min_pulses = self.doppler.length + self.mti.lost_pulses
        self.radar = radar

    def forward(self, positions: Tensor, rcs: Tensor) -> RadarMaps:
        """Positions (..., M, S, 3) m and RCS (..., S) or (..., M, S) m^2 to maps."""
        rcs = check_scene(positions, rcs)
        shape = list(positions.shape)
        self._check_pulses(shape[-3])
        if not torch.jit.is_scripting() and not is_exporting():
            check_unambiguous(positions, rcs, self.radar)
        lead = shape[:-3]
        positions, rcs = flatten_batch(positions, 3), flatten_batch(rcs, 2)
        pulses = positions.shape[1]
        signal = self._energy(positions, rcs) / (pulses * self.echo.samples)
        noise = torch.zeros_like(signal)
        pending = self._nothing_pending(positions)
        range_time: list[Tensor] = []
        range_time_mti: list[Tensor] = []
        doppler_times: list[Tensor] = []
        span = pulses if self.mti.method == "mean" else self.piece_chunks * self._step(positions)
        for start in range(0, pulses, span):
            stop = start + span
            piece = self._piece(positions[:, start:stop], rcs[:, start:stop], signal, pending)
            range_time.append(piece.range_time)
            range_time_mti.append(piece.range_time_mti)
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

    @torch.no_grad()
    def stream(self, source: Source, pulses: int) -> RadarMaps:
        """Maps of one clip of ``pulses`` pulses whose positions come from ``source`` piece by piece.

        The result equals :meth:`forward` on the whole clip (with one seed, noise included), without leading
        dimensions and without gradients. Memory does not grow with the clip but for the maps themselves; set
        ``display_rate_hz``. The source is asked twice for every piece and must answer the same.

        Raises:
            TensorsimError: as forward; also ``mti="mean"``, which needs the whole clip.
        """
        if self.mti.method != "two-pulse":
            raise TensorsimError(
                f"stream: got mti {self.mti.method!r}, expected 'two-pulse': a mean needs the clip whole"
            )
        self._check_pulses(pulses)
        speeds = SpeedCheck(self.radar)
        signal = torch.zeros(1, dtype=torch.float64)
        for positions, rcs in self._pieces(source, pulses):
            speeds.add(positions, rcs)
            if not self.noise.noiseless:
                signal = signal + self._energy(positions, rcs).to(signal) / (pulses * self.echo.samples)
        speeds.judge()

        range_time, range_time_mti = _BlockStream(self.range_time_block), _BlockStream(self.range_time_block)
        total = self.doppler.frames(pulses - self.mti.lost_pulses)
        maps: list[Tensor] = []
        peaks: list[Ridges] = []
        pending: list[Tensor] = []
        noise, frames = torch.zeros_like(signal), 0
        for positions, rcs in self._pieces(source, pulses):
            before = pending[0] if pending else self._nothing_pending(positions)
            piece = self._piece(positions, rcs, signal.to(positions.device), before)
            pending, noise = [piece.pending], noise + piece.noise_energy.to(noise)
            range_time.push(piece.range_time[0])
            range_time_mti.push(piece.range_time_mti[0])
            part = piece.doppler_time[0]
            maps = maps or [part.new_empty(self.doppler.bins, total)]  # one map: joining parts would take two
            maps[0][:, frames : frames + part.shape[1]] = part
            peaks.append(self.ridges.peaks(part))
            frames += part.shape[1]
        found = Ridges(
            torch.cat([p.indices for p in peaks], -1), torch.cat([p.magnitudes for p in peaks], -1)
        )
        ridges = self.ridges.connect(found, self.doppler.bins)
        return RadarMaps(
            range_time.result(),
            range_time_mti.result(),
            maps[0],
            ridges.indices,
            ridges.magnitudes,
            decibels(signal, noise / (pulses * self.echo.samples))[0].to(maps[0]),
        )

    def _pieces(self, source: Source, pulses: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Positions (1, m, S, 3) and RCS (1, m, S) of a source, checked; m a multiple of ``pulse_chunk``."""
        span = self.piece_chunks * self.pulse_chunk
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

    def _nothing_pending(self, positions: Tensor) -> Tensor:
        """Pending profiles (B, 0, R) before the first pulse of positions (B, M, S, 3)."""
        return self.echo.static_echo().new_zeros([positions.shape[0], 0, self.echo.samples // 2])

    def _piece(self, positions: Tensor, rcs: Tensor, signal: Tensor, pending: Tensor) -> Piece:
        """Maps of the next pulses (B, m, S, 3), (B, m, S), after those whose profiles are ``pending``."""
        fresh, noise_energy = self._profiles(positions, rcs, signal)
        profiles = torch.cat((pending.transpose(1, 2), fresh.transpose(1, 2)), -1).transpose(1, 2)
        moving = self.mti(profiles)
        unseen = moving[:, max(0, pending.shape[1] - self.mti.lost_pulses) :]
        count = self.doppler.frames(moving.shape[1])
        if count > 0:
            doppler_time = self.doppler(moving[:, : (count - 1) * self.doppler.hop + self.doppler.length])
        else:
            doppler_time = fresh.abs().new_zeros([fresh.shape[0], self.doppler.bins, 0])
        return Piece(
            fresh.transpose(1, 2).abs(),
            unseen.transpose(1, 2).abs(),
            doppler_time,
            profiles[:, count * self.doppler.hop :],
            noise_energy,
        )

    def _energy(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """Energy (B,) over pulses and samples of the noise reference: (B, M, S, 3), (B, M, S)."""
        total = torch.zeros([positions.shape[0]], dtype=torch.float64, device=positions.device)
        if self.noise.noiseless:
            return total
        static = self.echo.static_echo()
        step = self._step(positions)
        for start in range(0, positions.shape[1], step):
            stop = start + step
            signal = self.echo.target_echo(positions[:, start:stop], rcs[:, start:stop])
            if self.noise.reference == "total":
                signal = signal + static
            total = total + energy(signal)
        return total

    def _profiles(self, positions: Tensor, rcs: Tensor, signal: Tensor) -> tuple[Tensor, Tensor]:
        """Profiles (B, M, R), stored with time running fastest, for noise set by the mean signal power (B,).

        Also the energy (B,) of the noise that was drawn.
        """
        power = self.noise.noise_power(signal)
        total = torch.zeros_like(signal)
        static = self.echo.static_echo()
        chunks: list[Tensor] = []
        step = self._step(positions)
        for start in range(0, positions.shape[1], step):
            stop = start + step
            samples = self.echo.target_echo(positions[:, start:stop], rcs[:, start:stop]) + static
            if not self.noise.noiseless:
                noise = self.noise.draw(samples, power)
                total = total + energy(noise)
                samples += noise
            chunks.append(self.range_profile(samples).transpose(1, 2))
        return torch.cat(chunks, -1).transpose(1, 2), total

    def _step(self, positions: Tensor) -> int:
        """Pulses of every clip to work on at a time."""
        return max(1, self.pulse_chunk // max(1, positions.shape[0]))

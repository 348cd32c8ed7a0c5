"""What a radar records of a scene: range profiles with the noise and other effects of its receiver."""

from typing import Any

import torch
from torch import Tensor, nn

from tensorsim.config import ProcessingConfig, SceneConfig
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.closed_form import RangeBinSynthesizer
from tensorsim.radar.synthesis.clutter import RoomClutter
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.engines import RangeBinEngine, TimeEngine, channels_as_bins
from tensorsim.radar.synthesis.front_end import FrontEnd, Levels
from tensorsim.radar.synthesis.noise import ProfileNoise, ReceiverNoise, energy


def receiver_noise(scene: SceneConfig, echo: EchoSynthesizer) -> ReceiverNoise:
    """The thermal noise of a scene; without echoes, that for a target of 1 m^2 at 3 m in free space."""
    return ReceiverNoise(
        scene.snr_db,
        scene.noise_reference,
        empty_power=(echo.paths.scale / 3.0**2) ** 2,
        bandwidth_hz=scene.radar.sample_rate_hz,
        noise_figure_db=scene.noise_figure_db,
        transmit_power_w=scene.transmit_power_w,
    )


def stretches(
    positions: Tensor, rcs: Tensor, ahead: Tensor | None, span: int
) -> list[tuple[int, Tensor, Tensor, Tensor | None]]:
    """Split a scene every ``span`` pulses: number of the first pulse, positions, RCS and displacements, as views.

    Args:
        positions: (B, M, S, 3) m.
        rcs: (B, M, S) m^2.
        ahead: (B, M, S, 3) m, see :mod:`~tensorsim.radar.synthesis.engines`, or None.
        span: pulses; the last stretch may be shorter.
    """
    parts: list[tuple[int, Tensor, Tensor, Tensor | None]] = []
    for start in range(0, positions.shape[1], span):
        way = None if ahead is None else ahead[:, start : start + span]
        parts.append((start, positions[:, start : start + span], rcs[:, start : start + span], way))
    return parts


class Recorder(nn.Module):
    """Computes the received range profiles of scatterers, a piece of the clip at a time.

    Noise and converters depend on the mean powers of the whole clip (:class:`Levels`), so every scene is processed
    twice: :meth:`survey` measures the powers, :meth:`received` gives the profiles. With an ideal receiver the profiles
    of the first pass are kept, and noise is added to them; otherwise a :class:`FrontEnd` processes the samples.

    Args:
        scene: radar, noise, receiver, clutter, interference.
        processing: the engine and ``pulse_chunk``.
        echo: synthesises the echo of the scene.
        profile: converts samples to range profiles.
        seed: for clutter and phase noise.

    Shapes: positions (B, m, S, 3) m and RCS (B, m, S) m^2, which are not checked here, to profiles (B, m, V R): the
    channels of V antennas are concatenated.

    Attributes:
        channels: V.
        needs_levels: whether the levels have an effect.
    """

    def __init__(
        self,
        scene: SceneConfig,
        processing: ProcessingConfig,
        echo: EchoSynthesizer,
        profile: RangeProfile,
        seed: int = 0,
    ) -> None:
        super().__init__()
        radar = scene.radar
        self.noise = receiver_noise(scene, echo)
        total, clutter = scene.noise_reference == "total", None
        if scene.clutter is not None:
            clutter = RoomClutter(scene.clutter.reflectors, jitter_m=scene.clutter.jitter_m, seed=seed)
        # With a front end it is a TimeEngine: see SceneConfig.check_engine.
        self.engine: Any = TimeEngine(echo, profile, total, clutter)
        if processing.engine == "range-bins":
            bins = RangeBinSynthesizer(echo, profile, processing.near_bins, processing.energy_stride)
            self.engine = RangeBinEngine(bins, total, clutter)
        self.front_end: FrontEnd | None = None
        if scene.sampled_effects:
            self.front_end = FrontEnd(scene, self.noise, seed)
        self.echo = echo
        self.profile, self.profile_noise = profile, ProfileNoise(profile.window)
        self.samples, self.pulse_chunk = echo.samples, processing.pulse_chunk
        self.channels = len(radar.tx_positions_m) * len(radar.rx_positions_m)
        self.needs_levels = not self.noise.noiseless or self.front_end is not None

    def echoes(self, positions: Tensor, rcs: Tensor, span: int) -> tuple[list[Tensor], Levels]:
        """Noise-free profiles in pieces of ``span`` pulses (none with a front end), and the levels of the clips."""
        pieces: list[Tensor] = []
        nothing = torch.zeros([positions.shape[0]], dtype=torch.float64, device=positions.device)
        levels = Levels(nothing, nothing)
        for start, points, sections, way in stretches(
            positions, rcs, self.echo.displacements(positions), span
        ):
            profiles, energies = self.survey(points, sections, start, way)
            if self.front_end is None:
                pieces.append(profiles)
            levels = self.add(levels, energies, positions.shape[1])
        return pieces, levels

    def add(self, levels: Levels, energies: Levels, pulses: int) -> Levels:
        """Add the energies of another piece to the mean powers of clips of this many pulses."""
        samples = pulses * self.samples
        signal = levels.signal + energies.signal.to(levels.signal) / samples
        return Levels(signal, levels.arriving + energies.arriving.to(levels.arriving) / samples)

    def survey(
        self, positions: Tensor, rcs: Tensor, first: int, ahead: Tensor | None
    ) -> tuple[Tensor, Levels]:
        """Noise-free profiles, with time varying fastest in memory, and energies (B,) of pulses ``first`` onwards.

        ``ahead`` (B, m, S, 3): see :mod:`~tensorsim.radar.synthesis.engines`.

        With a front end the profiles are empty: what it records depends on the levels of the whole clip.
        """
        signal = torch.zeros([positions.shape[0]], dtype=torch.float64, device=positions.device)
        arriving = torch.zeros_like(signal)
        chunks: list[Tensor] = []
        for start, points, sections, way in stretches(positions, rcs, ahead, self.step(positions)):
            if self.front_end is not None:
                samples, reference = self.engine.samples(points, sections, first + start, way)
                heard = energy(self.front_end.arriving(samples, first + start))
                arriving = arriving + heard.reshape([heard.shape[0], -1]).mean(-1)
                chunks.append(samples.new_zeros([samples.shape[0], 0, 0]))
            else:
                profiles, reference = self.engine(points, sections, first + start, way)
                chunks.append(profiles.transpose(1, 2))
            # Without noise the ratio is infinite, and no gradient flows through it.
            signal = signal + (reference if self.needs_levels else reference.detach())
        return torch.cat(chunks, -1).transpose(1, 2), Levels(signal, arriving)

    def received(
        self,
        positions: Tensor,
        rcs: Tensor,
        first: int,
        ahead: Tensor | None,
        levels: Levels,
        echoes: list[Tensor],
    ) -> tuple[Tensor, Tensor]:
        """Profiles of pulses ``first`` onwards with all receiver effects, and the energy (B,) of the receiver noise.

        If ``echoes`` holds noise-free profiles, the first piece is removed from it and used instead of recomputed.
        """
        if self.front_end is not None:
            chunks: list[Tensor] = []
            energies = torch.zeros_like(levels.signal)
            for start, points, sections, way in stretches(positions, rcs, ahead, self.step(positions)):
                samples, _ = self.engine.samples(points, sections, first + start, way)
                samples, drawn = self.front_end(samples, levels, first + start)
                chunks.append(channels_as_bins(self.profile(samples)).transpose(1, 2))
                energies = energies + drawn
            return torch.cat(chunks, -1).transpose(1, 2), energies
        clean = echoes.pop(0) if len(echoes) > 0 else self.survey(positions, rcs, first, ahead)[0]
        if self.noise.noiseless:
            return clean, torch.zeros_like(levels.signal)
        noise, drawn = self.drawn(clean, self.noise.noise_power(levels.signal))
        return noise.add_(clean), drawn

    def drawn(self, clean: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
        """Noise in the shape of profiles (B, m, V R), with power (B,) per sample, and its energy (B,)."""
        # Every channel has its own noise.
        like = clean.transpose(1, 2).reshape([clean.shape[0] * self.channels, -1, clean.shape[1]])
        noise, energies = self.profile_noise(like, power.repeat_interleave(self.channels))
        noise = noise.reshape([clean.shape[0], -1, clean.shape[1]]).transpose(1, 2)
        return noise, energies.reshape([-1, self.channels]).mean(-1)

    def step(self, positions: Tensor) -> int:
        """Number of pulses per clip to process at a time."""
        return max(1, self.pulse_chunk // max(1, positions.shape[0]))

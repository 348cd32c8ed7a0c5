"""The receiver of a scene: its effects on the samples of the echo, one after another."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import InterferenceConfig, RadarConfig, SceneConfig
from tensorsim.errors import TensorsimError
from tensorsim.ops import safe_sqrt
from tensorsim.radar.synthesis.interference import Interference
from tensorsim.radar.synthesis.noise import ReceiverNoise, energy
from tensorsim.radar.synthesis.phase_noise import LEVELS_DBC_HZ, OFFSETS_HZ, PhaseNoise
from tensorsim.radar.synthesis.receiver import QuadratureImbalance, RealReceiver, quantise


class Levels(NamedTuple):
    """Mean powers per sample of B clips.

    Attributes:
        signal: (B,) power of the signal that the receiver noise refers to.
        arriving: (B,) power of everything that reaches the receiver, free of noise.
    """

    signal: Tensor
    arriving: Tensor


def interfering_radar(radar: RadarConfig, other: InterferenceConfig) -> RadarConfig:
    """A radar in the same band at another position, whose sweeps follow one another almost without a pause.

    Raises:
        TensorsimError: sweeps that are too short or too long for a radar.
    """
    chirp_s = radar.chirp_s * other.chirp_ratio
    try:
        return replace(
            radar, tx_m=other.position_m, rx_m=other.position_m, chirp_s=chirp_s, prf_hz=0.99 / chirp_s
        )
    except TensorsimError as error:
        raise TensorsimError(
            f"InterferenceConfig.chirp_ratio: got {other.chirp_ratio:g}, expected sweeps of a radar ({error})"
        ) from error


def oscillator(radar: RadarConfig, level_dbc_hz: float, seed: int) -> PhaseNoise:
    """Phase noise with this level 1 MHz from the carrier: the typical curve, shifted."""
    shift = level_dbc_hz - LEVELS_DBC_HZ[OFFSETS_HZ.index(1e6)]
    return PhaseNoise(radar, OFFSETS_HZ, tuple(level + shift for level in LEVELS_DBC_HZ), seed)


class FrontEnd(nn.Module):
    """Converts the arriving IF to the recorded samples.

    The effects follow the order of a real receiver: phase noise, interference, thermal noise, I/Q imbalance, DC
    offset, converters, one channel instead of two. Phase noise of the echo cancels in part, as it comes from the same
    oscillator; that of the interference does not. The offset and the converters' full scale are relative to the mean
    powers of the whole clip. Phase noise and interference depend on the pulse number, so that a clip processed in
    pieces gives the same result; they are the same for all antennas and all clips of a batch.

    Args:
        scene: its radar, interference and receiver.
        noise: thermal noise.
        seed: of the phase noise.

    Shapes: IF (B, M, N) or (B, V, M, N) complex, :class:`Levels` of the clip, number of the first pulse -> samples
        likewise, and the energy (B,) of the thermal noise, mean over antennas. Differentiable, except for quantisation.

    Raises:
        TensorsimError: see the stages.
    """

    def __init__(self, scene: SceneConfig, noise: ReceiverNoise, seed: int = 0) -> None:
        super().__init__()
        receiver = scene.receiver
        self.noise = noise
        self.phase_noise: PhaseNoise | None = None
        if receiver.phase_noise_dbc_hz is not None:
            self.phase_noise = oscillator(scene.radar, receiver.phase_noise_dbc_hz, seed)
        self.interference: nn.Module | None = None
        if scene.interference is not None:
            heard = scene.interference
            other = interfering_radar(scene.radar, heard)
            self.interference = Interference(
                scene.radar, other, heard.delay_s, heard.power_ratio_db, self.phase_noise
            )
        self.imbalance: nn.Module | None = None
        if receiver.iq_imbalance_db != 0 or receiver.iq_phase_rad != 0:
            self.imbalance = QuadratureImbalance(receiver.iq_imbalance_db, receiver.iq_phase_rad)
        self.real: nn.Module | None = RealReceiver() if receiver.real else None
        offset_db = receiver.dc_offset_db
        self.offset_ratio = 0.0 if offset_db is None else 10 ** (offset_db / 10)
        self.bits = 0 if receiver.adc_bits is None else receiver.adc_bits
        self.headroom = 10 ** (receiver.adc_headroom_db / 10)

    @torch.jit.export
    def arriving(self, samples: Tensor, start: int) -> Tensor:
        """The IF with interference, whose mean power is ``arriving`` of the levels."""
        return samples if self.interference is None else self.interference(samples, start)

    def forward(self, samples: Tensor, levels: Levels, start: int) -> tuple[Tensor, Tensor]:
        """See the class."""
        if self.phase_noise is not None:
            samples = self.phase_noise(samples, start)
        samples = self.arriving(samples, start)
        signal = torch.where(levels.signal > 0, levels.signal, self.noise.empty_power)
        thermal = self.noise.noise_power(levels.signal)
        drawn = torch.zeros_like(levels.signal)
        if not self.noise.noiseless:
            noise = self.noise.draw(samples, broadcast(thermal, samples))
            drawn = energy(noise).reshape(signal.shape[0], -1).mean(-1).to(drawn)
            samples = samples + noise
        else:
            thermal = torch.zeros_like(thermal)
        if self.imbalance is not None:
            samples = self.imbalance(samples)
        offset = signal * self.offset_ratio
        if self.offset_ratio > 0:
            samples = samples + broadcast(offset.sqrt(), samples)[..., None, None].to(samples.dtype)
        if self.bits > 0:
            full_scale = safe_sqrt((levels.arriving + thermal + offset) * self.headroom)
            samples = quantise(samples, broadcast(full_scale, samples), self.bits)
        if self.real is not None:  # last: a missing channel is 0, which no converter level is
            samples = self.real(samples)
        return samples, drawn


def broadcast(per_clip: Tensor, samples: Tensor) -> Tensor:
    """(B,) values for samples (B, M, N), or (B, 1) for samples (B, V, M, N)."""
    return per_clip if samples.dim() == 3 else per_clip.unsqueeze(-1)

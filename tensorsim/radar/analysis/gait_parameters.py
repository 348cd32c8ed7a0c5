"""Torso speed, limb speed and step rate of a person on foot, read from a Doppler-time map.

Percentiles of the amplitude over speed follow van Dorp and Groen, *Feature-based human motion parameter
estimation with radar*, IET Radar, Sonar & Navigation 2 (2008): half of the amplitude of a frame lies below the
speed of the torso, 95 % of it below the speed of the fastest limb. The sign of the speed is ignored, so that
maps of a real signal, which show every motion on both sides, are read like those of a complex one.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    check_positive,
    check_size,
)

#: Cells this far below the strongest of their frame do not count.
DYNAMIC_RANGE_DB = 25.0

#: Nor do those that stand out of the noise, the median of the fastest quarter of the axis, by less than this.
ABOVE_NOISE_DB = 10.0

#: Slower cells are floor, furniture and mains hum.
SLOWEST_M_S = 0.4

#: Power above these multiples of the torso's speed is that of a swinging leg. Which multiple separates them best
#: depends on the gait, so the rhythms above all of them vote.
SWING = (1.25, 1.5, 1.75)

#: A frame belongs to steady gait when the torso is faster than this part of its 90th percentile.
STEADY = 0.6

#: Slower modulation of the swing than this is a change of speed, not a step.
SLOWEST_STEP_HZ = 1.2
FASTEST_STEP_HZ = 4.5


class GaitParameters(NamedTuple):
    """What a Doppler-time map says of a gait.

    Attributes:
        torso_m_s: (...) median over steady frames of the torso's radial speed; 0 without any.
        limb_m_s: (...) 90th percentile over steady frames of the limbs' radial speed: the peaks of the swings;
            likewise.
        step_hz: (...) steps per second, two to a stride; likewise.
        torso_track_m_s: (..., K) per frame; 0 where nothing stands out of the noise.
        limb_track_m_s: (..., K) likewise.
    """

    torso_m_s: Tensor
    limb_m_s: Tensor
    step_hz: Tensor
    torso_track_m_s: Tensor
    limb_track_m_s: Tensor


class GaitEstimator(nn.Module):
    """Reads :class:`GaitParameters` from the map of one person who walks or runs.

    The step rate is the strongest modulation, with its first harmonic, between 1.2 and 4.5 Hz of the shares of
    power faster than 1.25, 1.5 and 1.75 times the torso: a swinging leg puts it there once a step. Not
    differentiable.

    Args:
        speed_m_s: (F,) radial speed of each Doppler bin of the maps, one- or two-sided, in any order.
        frame_rate_hz: frames of the map per second.

    Shapes: magnitude (..., F, K) -> :class:`GaitParameters`.

    Raises:
        TensorsimError: a map that does not fit the axis, lasts less than a second, is empty or has NaN; rates that
            are not positive or too low to see steps.
    """

    speed_m_s: Tensor
    order: Tensor

    def __init__(self, speed_m_s: Tensor, frame_rate_hz: float) -> None:
        super().__init__()
        check_positive(frame_rate_hz, "GaitEstimator.frame_rate_hz")
        if frame_rate_hz < 5 * FASTEST_STEP_HZ:
            raise TensorsimError(
                f"frame_rate_hz: got {frame_rate_hz}, expected at least {5 * FASTEST_STEP_HZ} to see steps and "
                "their first harmonic"
            )
        if speed_m_s.dim() != 1 or not bool((speed_m_s.abs() > SLOWEST_M_S).any()):
            raise TensorsimError(
                f"speed_m_s: got shape {list(speed_m_s.shape)}, expected (F,) with speeds above {SLOWEST_M_S} m/s"
            )
        speed, order = speed_m_s.detach().double().abs().sort()
        first = int((speed <= SLOWEST_M_S).sum())
        self.bins = speed_m_s.shape[0]
        self.frame_rate_hz = float(frame_rate_hz)
        self.second = math.ceil(frame_rate_hz)
        self.quietest = 10 ** (-DYNAMIC_RANGE_DB / 10)
        self.above_noise = 10 ** (ABOVE_NOISE_DB / 10)
        self.swing, self.steady = SWING, STEADY
        self.band = (SLOWEST_STEP_HZ, FASTEST_STEP_HZ)
        self.register_buffer("speed_m_s", speed[first:], persistent=False)
        self.register_buffer("order", order[first:], persistent=False)

    def forward(self, doppler_time: Tensor) -> GaitParameters:
        """Magnitude (..., F, K) to torso, limbs and steps."""
        layout = f"(..., {self.bins} Doppler bins, at least {self.second} frames)"
        check_floating(doppler_time, "doppler_time")
        check_min_rank(doppler_time, 2, "doppler_time", layout)
        check_size(doppler_time, -2, self.bins, "doppler_time", layout)
        if doppler_time.shape[-1] < self.second:
            raise TensorsimError(f"doppler_time: got shape {list(doppler_time.shape)}, expected {layout}")
        check_not_empty(doppler_time, "doppler_time")
        check_finite(doppler_time, "doppler_time")
        power = doppler_time.double().index_select(-2, self.order).square()
        noise = power[..., -(power.shape[-2] // 4) :, :].flatten(-2).median(-1)[0]
        least = torch.maximum(self.quietest * power.amax(-2), self.above_noise * noise.unsqueeze(-1))
        power = torch.where(power < least.unsqueeze(-2), 0.0, power)
        share = power.sqrt().cumsum(-2)
        something = share[..., -1, :] > 0
        share = share / share[..., -1:, :].clamp_min(1e-300)
        fastest = self.speed_m_s.shape[0] - 1
        torso = torch.where(something, self.speed_m_s[(share < 0.5).sum(-2).clamp(max=fastest)], 0.0)
        limb = torch.where(something, self.speed_m_s[(share < 0.95).sum(-2).clamp(max=fastest)], 0.0)
        steady = torso > self.steady * torso.quantile(0.9, -1, keepdim=True)
        walks = steady.any(-1)

        whole = power.sum(-2).clamp_min(1e-300)
        swings: list[Tensor] = []
        for multiple in self.swing:
            fast = self.speed_m_s.unsqueeze(-1) > multiple * torso.unsqueeze(-2)
            swings.append(torch.where(fast, power, 0.0).sum(-2) / whole)
        dtype = doppler_time.dtype
        return GaitParameters(
            torch.where(walks, torch.where(steady, torso, math.nan).nanmedian(-1)[0], 0.0).to(dtype),
            torch.where(walks, torch.where(steady, limb, math.nan).nanquantile(0.9, -1), 0.0).to(dtype),
            torch.where(walks, self._step_rate(torch.stack(swings), steady), 0.0).to(dtype),
            torso.to(dtype),
            limb.to(dtype),
        )

    def _step_rate(self, swing: Tensor, steady: Tensor) -> Tensor:
        """Strongest frequency in the band of steps of ``swing`` (W, ..., K), whose trend over 1.2 s is removed.

        Periodograms of ``log(swing)`` over 4 s, half overlapping, are averaged (Welch): the phase of the steps
        does not outlast a turn. Those of all W are scaled to the same power and added. ``steady`` (..., K).
        """
        shares, frames = swing.shape[0], swing.shape[-1]
        signal = (swing + self.quietest).log().reshape(-1, 1, frames)
        half = int(0.6 * self.frame_rate_hz)
        signal = signal - F.avg_pool1d(signal, 2 * half + 1, 1, half, count_include_pad=False)
        weight = steady.to(signal.dtype).expand(swing.shape).reshape(-1, 1, frames)
        signal = signal * F.avg_pool1d(weight, 9, 1, 4)
        span = min(frames, 4 * self.second)
        window = torch.hann_window(span, periodic=False, dtype=signal.dtype, device=signal.device)
        # Zeros to 0.01 Hz between the samples of the spectrum: the clip may hold a few steps only.
        length = 100 * self.second
        pieces = signal.squeeze(1).unfold(-1, span, max(1, span // 2)) * window
        spectrum = torch.fft.rfft(pieces, length).abs().square().mean(1)
        spectrum = spectrum / spectrum.sum(-1, keepdim=True).clamp_min(1e-300)
        spectrum = spectrum.unflatten(0, (shares, spectrum.shape[0] // shares)).sum(0)
        step = self.frame_rate_hz / length
        low, high = math.ceil(self.band[0] / step), math.floor(self.band[1] / step) + 1
        # A harmonic supports its fundamental, so that two bumps a step do not pass for two steps.
        harmonic = spectrum[:, 2 * low : 2 * high : 2]
        peak = (spectrum[:, low:high] + 0.5 * harmonic).argmax(-1) + low
        return (peak * step).reshape(swing.shape[1:-1])

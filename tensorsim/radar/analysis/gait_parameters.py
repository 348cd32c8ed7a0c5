"""Torso speed, limb speed and step rate of a walking or running person, estimated from a Doppler-time map.

Percentiles of the amplitude over speed follow van Dorp and Groen, *Feature-based human motion parameter
estimation with radar*, IET Radar, Sonar & Navigation 2 (2008): half of the amplitude of a frame lies below the
speed of the torso, 95 % of it below the speed of the fastest limb. The sign of the speed is ignored, so that the
symmetric maps of a real signal give the same result as those of a complex one.

Noise would add amplitude at high speeds. Power is therefore averaged over neighbouring cells, the noise floor of each
frame is subtracted, and cells that do not exceed a threshold above the floor in any of several averages are set to 0:
large averages find weak limbs in noise, small ones keep the edges of strong ones.
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

#: Cells this far below the strongest of their frame are set to 0.
DYNAMIC_RANGE_DB = 25.0

#: Power is averaged over these ranges of speed in m/s and time in s.
AVERAGES = ((0.2, 0.08), (0.4, 0.16), (0.8, 0.16), (0.8, 0.32))

#: The noise floor is the median of the fastest quarter of the axis. The threshold is the floor plus this multiple of
#: the distance from the median to the upper quartile: a false alarm rate of about 1e-4 for white noise in one range
#: bin without averaging, and less with averaging.
THRESHOLD = 10.0

#: Slower cells are static echoes, furniture and mains hum.
SLOWEST_M_S = 0.4

#: Power above these multiples of the torso speed is that of the swinging leg. The best multiple depends on the gait,
#: so the modulation spectra for all of them are added.
SWING = (1.25, 1.5, 1.75)

#: A frame belongs to steady gait if the torso speed is above this fraction of its 90th percentile.
STEADY = 0.6

#: Range of step rates. Slower modulation is a change of speed.
SLOWEST_STEP_HZ = 1.2
FASTEST_STEP_HZ = 4.5


class GaitParameters(NamedTuple):
    """Gait parameters of a Doppler-time map; 0 for a map without motion.

    Attributes:
        torso_m_s: (...) median over steady frames of the radial speed of the torso.
        limb_m_s: (...) 90th percentile over steady frames of the radial speed of the limbs, the peaks of the swings.
        step_hz: (...) steps per second, two per stride.
        torso_track_m_s: (..., K) radial speed of the torso per frame; 0 in frames without motion above the noise.
        limb_track_m_s: (..., K) the same for the limbs.
    """

    torso_m_s: Tensor
    limb_m_s: Tensor
    step_hz: Tensor
    torso_track_m_s: Tensor
    limb_track_m_s: Tensor


class GaitEstimator(nn.Module):
    """Estimates :class:`GaitParameters` from the map of one walking or running person.

    The step rate is the strongest modulation between 1.2 and 4.5 Hz, together with its first harmonic, of the
    fractions of power above 1.25, 1.5 and 1.75 times the torso speed: a leg swings once per step. Not differentiable.

    Args:
        speed_m_s: (F,) radial speed of each Doppler bin of the maps, one- or two-sided, in any order.
        frame_rate_hz: frames of the map per second.

    Shapes: magnitude (..., F, K) -> :class:`GaitParameters`.

    Raises:
        TensorsimError: a map that does not fit the axis, lasts less than a second, is empty or has NaN; a frame rate
            that is not positive or too low for steps.
    """

    speed_m_s: Tensor
    ascending: Tensor
    order: Tensor

    def __init__(self, speed_m_s: Tensor, frame_rate_hz: float) -> None:
        super().__init__()
        check_positive(frame_rate_hz, "GaitEstimator.frame_rate_hz")
        if frame_rate_hz < 5 * FASTEST_STEP_HZ:
            raise TensorsimError(
                f"frame_rate_hz: got {frame_rate_hz}, expected at least {5 * FASTEST_STEP_HZ} for steps and "
                "their first harmonic"
            )
        if speed_m_s.dim() != 1 or not bool((speed_m_s.abs() > SLOWEST_M_S).any()):
            raise TensorsimError(
                f"speed_m_s: got shape {list(speed_m_s.shape)}, expected (F,) with speeds above {SLOWEST_M_S} m/s"
            )
        signed, ascending = speed_m_s.detach().double().sort()
        speed, order = signed.abs().sort()
        first = int((speed <= SLOWEST_M_S).sum())
        step_m_s = max(float(signed.diff().median()), 1e-9) if len(signed) > 1 else math.inf
        self.averages = [
            (2 * min(round(m_s / step_m_s) // 2, len(signed)) + 1, 2 * round(s * frame_rate_hz / 2) + 1)
            for m_s, s in AVERAGES
        ]
        self.bins = speed_m_s.shape[0]
        self.frame_rate_hz = float(frame_rate_hz)
        self.second = math.ceil(frame_rate_hz)
        self.quietest = 10 ** (-DYNAMIC_RANGE_DB / 10)
        self.threshold = THRESHOLD
        self.swing, self.steady = SWING, STEADY
        self.band = (SLOWEST_STEP_HZ, FASTEST_STEP_HZ)
        self.register_buffer("speed_m_s", speed[first:], persistent=False)
        self.register_buffer("ascending", ascending, persistent=False)
        self.register_buffer("order", order[first:], persistent=False)

    def forward(self, doppler_time: Tensor) -> GaitParameters:
        """Magnitude (..., F, K) to torso speed, limb speed and step rate."""
        layout = f"(..., {self.bins} Doppler bins, at least {self.second} frames)"
        check_floating(doppler_time, "doppler_time")
        check_min_rank(doppler_time, 2, "doppler_time", layout)
        check_size(doppler_time, -2, self.bins, "doppler_time", layout)
        if doppler_time.shape[-1] < self.second:
            raise TensorsimError(f"doppler_time: got shape {list(doppler_time.shape)}, expected {layout}")
        check_not_empty(doppler_time, "doppler_time")
        check_finite(doppler_time, "doppler_time")
        power = self._power_above_noise(doppler_time.double())
        share = power.sqrt().cumsum(-2)
        moving = share[..., -1, :] > 0
        share = share / share[..., -1:, :].clamp_min(1e-300)
        fastest = self.speed_m_s.shape[0] - 1
        torso = torch.where(moving, self.speed_m_s[(share < 0.5).sum(-2).clamp(max=fastest)], 0.0)
        limb = torch.where(moving, self.speed_m_s[(share < 0.95).sum(-2).clamp(max=fastest)], 0.0)
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

    def _power_above_noise(self, doppler_time: Tensor) -> Tensor:
        """Power by ascending speed minus the noise floor, 0 where there is no echo: (..., F, K) -> (..., F', K).

        The threshold applies to averages over neighbouring cells. The power itself keeps its resolution.
        """
        power = doppler_time.index_select(-2, self.ascending).square()
        maps = power.reshape(-1, 1, power.shape[-2], power.shape[-1])
        power = power.index_select(-2, self.order)
        found = torch.zeros_like(power, dtype=torch.bool)
        floors: list[Tensor] = []
        for size in self.averages:
            margin = (size[0] // 2, size[1] // 2)
            average = F.avg_pool2d(maps, size, 1, margin, count_include_pad=False).view_as(doppler_time)
            average = average.index_select(-2, self.order)
            fastest = average[..., -(average.shape[-2] // 4) :, :]
            floor, quartile = fastest.median(-2)[0], fastest.quantile(0.75, -2)
            # How much noise varies around its floor is the same in all frames of a clip.
            spread = torch.where(floor > 0, quartile / floor - 1, math.nan)
            spread = spread.nanmedian(-1, keepdim=True)[0].nan_to_num()
            found = found | (average >= (floor * (1 + self.threshold * spread)).unsqueeze(-2))
            floors.append(floor)
        echo = found & (power >= self.quietest * power.amax(-2, keepdim=True))
        floor = floors[0]
        return torch.where(echo, (power - floor.unsqueeze(-2)).clamp_min(0.0), 0.0)

    def _step_rate(self, swing: Tensor, steady: Tensor) -> Tensor:
        """Strongest frequency in the band of steps of ``swing`` (W, ..., K), after removal of its trend over 1.2 s.

        The trend is computed from steady frames only: between two walks there is none.

        Periodograms of ``log(swing)`` over 4 s, half overlapping, are averaged (Welch), since the phase of the steps
        changes when the person turns. Those of all W are scaled to the same power and added. ``steady`` (..., K).
        """
        shares, frames = swing.shape[0], swing.shape[-1]
        signal = (swing + self.quietest).log().reshape(-1, 1, frames)
        half = int(0.6 * self.frame_rate_hz)
        weight = steady.to(signal.dtype).expand(swing.shape).reshape(-1, 1, frames)
        near = F.avg_pool1d(weight, 2 * half + 1, 1, half).clamp_min(1e-9)
        signal = signal - F.avg_pool1d(signal * weight, 2 * half + 1, 1, half) / near
        signal = signal * F.avg_pool1d(weight, 9, 1, 4)
        span = min(frames, 4 * self.second)
        window = torch.hann_window(span, periodic=False, dtype=signal.dtype, device=signal.device)
        # Zero padding for a spectrum in steps of 0.01 Hz: the clip may contain only a few steps.
        length = 100 * self.second
        pieces = signal.squeeze(1).unfold(-1, span, max(1, span // 2)) * window
        spectrum = torch.fft.rfft(pieces, length).abs().square().mean(1)
        spectrum = spectrum / spectrum.sum(-1, keepdim=True).clamp_min(1e-300)
        spectrum = spectrum.unflatten(0, (shares, spectrum.shape[0] // shares)).sum(0)
        step = self.frame_rate_hz / length
        low, high = math.ceil(self.band[0] / step), math.floor(self.band[1] / step) + 1
        # The harmonic counts for its fundamental, so that two maxima per step are not taken for two steps.
        harmonic = spectrum[:, 2 * low : 2 * high : 2]
        peak = (spectrum[:, low:high] + 0.5 * harmonic).argmax(-1) + low
        return (peak * step).reshape(swing.shape[1:-1])

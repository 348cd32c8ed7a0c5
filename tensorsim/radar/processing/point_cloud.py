"""Points from range-Doppler maps of an antenna array: range, speed and direction of each detection."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.errors import check_count, check_mask, check_not_empty, check_positive, check_tensor
from tensorsim.ops import flatten_batch


class Points(NamedTuple):
    """The strongest detections of each frame, strongest first.

    Attributes:
        range_m, speed_m_s: (..., K); positive speed is approaching.
        sine: (..., K) sine of the angle from broadside, positive to the right (+x).
        power: (..., K) mean over antennas, 0 where there is no point.
        valid: (..., K) bool, whether there is a point.
    """

    range_m: Tensor
    speed_m_s: Tensor
    sine: Tensor
    power: Tensor
    valid: Tensor


def local_maxima(power: Tensor) -> Tensor:
    """Cells (..., range, Doppler) that are not below any of their eight neighbours, bool; Doppler is periodic."""
    flat = flatten_batch(power, 2).unsqueeze(1)
    around = F.pad(flat, [1, 1, 0, 0], mode="circular")
    return (flat >= F.max_pool2d(around, 3, 1, [1, 0])).reshape(power.shape)


def beam_sines(signals: Tensor, spacing_wavelengths: float, beams: int) -> Tensor:
    """Sine of the angle from which a line of antennas receives most: (..., A) complex -> (...).

    Antenna a at ``a d`` along +x receives a plane wave from angle theta with the phase factor
    ``exp(+j 2 pi a (d / lambda) sin theta)`` relative to the first one; the beams are the bins of a transform of
    ``beams`` points, and the strongest is refined by the parabola through it and its neighbours.
    """
    spectrum = torch.fft.fft(signals, n=beams, dim=-1).abs()
    best = spectrum.argmax(-1, keepdim=True)
    before = spectrum.gather(-1, (best + beams - 1) % beams)
    here = spectrum.gather(-1, best)
    after = spectrum.gather(-1, (best + 1) % beams)
    bend = (2 * here - before - after).clamp(min=1e-30)
    cycles = ((best + 0.5 * (after - before) / bend) / beams).squeeze(-1)
    cycles = cycles - (cycles + 0.5).floor()
    return (cycles / spacing_wavelengths).clamp(-1.0, 1.0)


class PointCloud(nn.Module):
    """Converts detections in a range-Doppler map to points.

    Args:
        range_step_m: range of bin r is ``r range_step_m``.
        speed_step_m_s: speed of Doppler bin f of F is ``(f - F // 2) speed_step_m_s``.
        points: K, the largest number of points per frame.
        spacing_wavelengths: spacing of neighbouring antennas of the virtual array; 0.5 is unambiguous over the half
            circle in front of it.
        beams: points of the transform over antennas.
        peaks_only: leave out detections that have a stronger neighbour in range or Doppler.

    Shapes: cube (..., A, R, F) complex, detected (..., R, F) bool -> :class:`Points` (..., K). Powers and sines of the
    chosen cells are differentiable; the choice of cells, and so their ranges and speeds, is not.

    Raises:
        TensorsimError: steps that are not positive, fewer than one point or two beams, shapes that do not match.
    """

    def __init__(
        self,
        range_step_m: float,
        speed_step_m_s: float,
        points: int = 64,
        spacing_wavelengths: float = 0.5,
        beams: int = 64,
        peaks_only: bool = True,
    ) -> None:
        super().__init__()
        check_positive(range_step_m, "range_step_m")
        check_positive(speed_step_m_s, "speed_step_m_s")
        check_positive(spacing_wavelengths, "spacing_wavelengths")
        check_count(points, "points")
        check_count(beams, "beams", 2)
        self.range_step_m, self.speed_step_m_s = float(range_step_m), float(speed_step_m_s)
        self.points, self.beams, self.peaks_only = points, beams, peaks_only
        self.spacing_wavelengths = float(spacing_wavelengths)

    def forward(self, cube: Tensor, detected: Tensor) -> Points:
        """Cube (..., A, R, F) complex and detections (..., R, F) to points (..., K)."""
        check_tensor(cube, "cube", "(..., antennas, range, Doppler)", "complex", finite=False)
        check_not_empty(cube, "cube")
        lead = list(cube.shape[:-3])
        check_mask(detected, lead + list(cube.shape[-2:]), "detected")
        power = cube.abs().square().mean(-3)
        chosen = detected & local_maxima(power.detach()) if self.peaks_only else detected
        cells, doppler_bins = power.shape[-2] * power.shape[-1], power.shape[-1]
        count = min(self.points, cells)
        strength = torch.where(chosen, power, -torch.ones_like(power)).flatten(-2)
        top, place = torch.topk(strength, count, dim=-1)
        signals = cube.flatten(-2).transpose(-2, -1)  # (..., cells, A)
        index = place.unsqueeze(-1).expand(lead + [count, cube.shape[-3]])  # noqa: RUF005 (TorchScript)
        sine = beam_sines(signals.gather(-2, index), self.spacing_wavelengths, self.beams)
        valid = top >= 0
        row = torch.div(place, doppler_bins, rounding_mode="floor")
        speed = (place - row * doppler_bins - doppler_bins // 2).to(power.dtype) * self.speed_step_m_s
        zero = torch.zeros_like(top)
        points = [row.to(power.dtype) * self.range_step_m, speed, sine, top]
        missing = self.points - count
        kept = [F.pad(torch.where(valid, x, zero), [0, missing]) for x in points]
        return Points(kept[0], kept[1], kept[2], kept[3], F.pad(valid, [0, missing]))

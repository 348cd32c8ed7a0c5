"""Stationary random motion as a function of time: a sum of sinusoids with the power of a given spectrum.

The value at a time does not depend on earlier queries, so a long clip can be generated in pieces.
Shinozuka and Deodatis, *Simulation of stochastic processes by spectral representation*, Appl. Mech. Rev. 44, 1991.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_floating, check_not_negative, check_positive


def sinusoids(time_s: Tensor, frequency_hz: Tensor, amplitude: Tensor, phase: Tensor) -> Tensor:
    """Sum over k of ``amplitude_k cos(2 pi f_k t + phase_k)``.

    Args:
        time_s: (...) seconds.
        frequency_hz: (C, K) Hz.
        amplitude: (K,), shared by the C processes.
        phase: (C, K) radians.

    Returns:
        (..., C) in the unit of the amplitude and the dtype of the time.
    """
    # Whole turns are removed in float64: after hours a float32 phase would be noise.
    turns = time_s.double()[..., None, None] * frequency_hz
    angle = 2 * math.pi * (turns - turns.detach().floor()) + phase
    return (amplitude * torch.cos(angle)).sum(-1).to(time_s.dtype)


def times_and_processes(joints: Tensor, rate_hz: float, start: int, people: int) -> tuple[Tensor, Tensor]:
    """Frame times of joints (..., P, T, 14, 3), and which of ``people`` processes each person uses.

    Args:
        joints: their first frame is number ``start`` of a clip.
        rate_hz: frames per second.
        start: number of the first frame.
        people: number of processes; person p uses number ``p % people``.

    Returns:
        (T,) float64 seconds and (P,) indices.
    """
    persons, frames = joints.shape[-4], joints.shape[-3]
    time_s = (start + torch.arange(frames, dtype=torch.float64, device=joints.device)) / rate_hz
    return time_s, torch.arange(persons, device=joints.device) % people


class RandomProcess(nn.Module):
    """Independent Gaussian processes with one power spectrum.

    Args:
        spectrum: one-sided power density over frequency in Hz, in any unit: only its shape matters.
        band_hz: lowest and highest frequency; the band is cut into cells of equal ratio, and each process has
            one sinusoid at a random place in every cell.
        rms: root mean square of each process.
        copies: number of processes.
        seed: for frequencies and phases.
        count: sinusoids per process.

    Shapes: seconds (...) and the number of copies (default all) -> (..., copies). Differentiable.

    Raises:
        TensorsimError: a band that is not ascending and positive, an rms below 0, counts below 1, a time that is
            not floating point, more copies than there are.
    """

    frequency_hz: Tensor
    amplitude: Tensor
    phase: Tensor

    def __init__(
        self,
        spectrum: Callable[[Tensor], Tensor],
        band_hz: tuple[float, float],
        rms: float,
        copies: int,
        seed: int,
        count: int = 48,
    ) -> None:
        super().__init__()
        check_positive(band_hz[0], "band_hz")
        if not band_hz[0] < band_hz[1] < math.inf:
            raise TensorsimError(f"band_hz: got {band_hz}, expected ascending positive frequencies")
        check_not_negative(rms, "rms")
        if copies < 1 or count < 1:
            raise TensorsimError(f"copies, count: got {copies} and {count}, expected at least 1")
        generator = torch.Generator().manual_seed(seed)
        edge = torch.logspace(math.log10(band_hz[0]), math.log10(band_hz[1]), count + 1, dtype=torch.float64)
        width = edge.diff()
        place = torch.rand(copies, count, generator=generator, dtype=torch.float64)
        power = spectrum((edge[1:] * edge[:-1]).sqrt()) * width
        phase = 2 * math.pi * torch.rand(copies, count, generator=generator, dtype=torch.float64)
        self.register_buffer("frequency_hz", edge[:-1] + place * width, persistent=False)
        self.register_buffer("amplitude", rms * (2 * power / power.sum()).sqrt(), persistent=False)
        self.register_buffer("phase", phase, persistent=False)

    def forward(self, time_s: Tensor, copies: int | None = None) -> Tensor:
        """Seconds (...) to values (..., copies) of the first ``copies`` processes."""
        check_floating(time_s, "time_s")
        if copies is not None and not 0 <= copies <= self.phase.shape[0]:
            raise TensorsimError(f"copies: got {copies}, expected 0 to {self.phase.shape[0]}")
        frequency_hz, phase = self.frequency_hz.double()[:copies], self.phase.double()[:copies]
        return sinusoids(time_s, frequency_hz, self.amplitude.double(), phase)

"""Range profiles: pulse compression of the dechirped signal by a Fourier transform over fast time.

The beat frequency of a target is proportional to its range. The magnitude of the profiles is the range-time map (RTM).
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_complex_map, check_floating, check_min_rank, check_positive
from tensorsim.protocols import check_instance

_WINDOWS = {
    "hamming": torch.hamming_window,
    "hann": torch.hann_window,
    "blackman": torch.blackman_window,
}


def range_profile(
    intermediate: Tensor, window: Tensor, first_bin: int = 0, last_bin: int | None = None
) -> Tensor:
    r"""Pulse compression: bins of the Fourier transform over fast time, not normalised.

    $$ X_m[k] = \sum_{n=0}^{N-1} w[n] \, \mathrm{IF}_m[n] \, e^{-j 2 \pi k n / N} $$

    Args:
        intermediate: (..., M, N) complex IF samples of M pulses.
        window: (N,) real.
        first_bin, last_bin: the bins to keep; ``last_bin`` None is the last of the first N // 2.

    Returns:
        (..., M, last_bin + 1 - first_bin) complex; bin $k$ is at range $k c / (2 B)$.

    Inputs are not checked; torch raises RuntimeError for shapes that do not fit.
    """
    stop = intermediate.shape[-1] // 2 if last_bin is None else last_bin + 1
    return torch.fft.fft(intermediate * window)[..., first_bin:stop]


def gate_bins(gate_m: tuple[float, float], spacing_m: float, bins: int) -> tuple[int, int]:
    """First and last of ``bins`` range bins, ``spacing_m`` apart, that lie within (nearest, farthest) metres.

    Raises:
        TensorsimError: no bin lies within the gate.
    """
    if isinstance(gate_m, tuple | list) and len(gate_m) == 2 and all(map(is_finite, gate_m)):
        near, far = gate_m
        first = max(0, math.ceil(near / spacing_m - 1e-9))
        last = min(bins - 1, math.floor(far / spacing_m + 1e-9))
        if first <= last:
            return first, last
    raise TensorsimError(
        f"gate_m: got {gate_m}, expected (nearest, farthest) metres with one of the range bins between, which go "
        f"from 0 to {(bins - 1) * spacing_m:.4g} m in steps of {spacing_m:.4g} m"
    )


class RangeProfile(nn.Module):
    """Complex range profiles of IF samples; their magnitude is the range-time map (RTM).

    Args:
        radar: the radar.
        window: over fast time, ``"hamming"``, ``"hann"`` or ``"blackman"`` in their symmetric forms
            (``numpy.hamming``, ...), or None for none, as in the paper.
        gate_m: keep only bins within (nearest, farthest) metres; None keeps the first N // 2.

    Shapes: IF (..., M, N) complex -> (..., M, R) complex of the same precision. The FFT is not normalised: a
    path of amplitude a peaks at ``a * window.sum()``.

    Attributes:
        range_m: (R,) range of each bin, ``k c / (2B)``.
        first_bin, last_bin: k of the first and the last bin.
        window: (N,).

    Raises:
        TensorsimError: an unknown window or one that is all zeros (for two samples), a gate without bins, a real IF,
            N other than the radar's.
    """

    window: Tensor
    range_m: Tensor

    def __init__(
        self,
        radar: RadarConfig,
        window: str | None = "hamming",
        gate_m: tuple[float, float] | None = None,
    ) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        samples = radar.samples_per_chirp
        values = torch.ones(samples, dtype=torch.float64)
        if window is not None:
            if window not in _WINDOWS:
                raise TensorsimError(f"window: got {window!r}, expected one of {sorted(_WINDOWS)} or None")
            values = _WINDOWS[window](samples, periodic=False, dtype=torch.float64)
            if values.max() < 1e-9:
                raise TensorsimError(
                    f"window: got {window!r}, which is 0 at both of the {samples} samples of a pulse, expected "
                    "'hamming' or None"
                )
        self.samples = samples
        first, last = 0, samples // 2 - 1
        if gate_m is not None:
            first, last = gate_bins(gate_m, radar.range_resolution_m, samples // 2)
        self.first_bin, self.last_bin = first, last
        bins = torch.arange(first, last + 1, dtype=torch.float64)
        self.register_buffer("window", values, persistent=False)
        self.register_buffer("range_m", bins * radar.range_resolution_m, persistent=False)

    def forward(self, intermediate: Tensor) -> Tensor:
        """IF (..., M, N) to profiles (..., M, R)."""
        check_complex_map(intermediate, "IF", f"(..., pulses, {self.samples} samples)")
        window = self.window.to(torch.view_as_real(intermediate).dtype)
        return range_profile(intermediate, window, self.first_bin, self.last_bin)


class FollowingGate(nn.Module):
    """Range gate that follows the targets: bins outside it are set to zero, pulse by pulse.

    The gate is centred on the RCS-weighted mean of the targets' geometric range ``(|P - Ptx| + |P - Prx|) / 2``. The
    additional delay of a wall is not included, so the width must allow for it. Pulses without any RCS are not gated.
    Use it after moving target indication: the moving gate would modulate a static echo.

    Args:
        radar: positions of the antennas; the range is the mean over several.
        range_m: (R,) range of each bin.
        width_m: bins are kept up to half this distance from the mean range of the targets.

    Shapes: profiles (..., M, R) complex, positions (..., M, S, 3) m, rcs (..., M, S) m^2 -> (..., M, R).
    Differentiable with respect to the profiles; the choice of bins is not.

    Raises:
        TensorsimError: a width that is not positive; real profiles, shapes that do not match.
    """

    range_m: Tensor
    tx_m: Tensor
    rx_m: Tensor

    def __init__(self, radar: RadarConfig, range_m: Tensor, width_m: float) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        check_positive(width_m, "width_m")
        self.half_width_m = width_m / 2
        self.register_buffer("range_m", range_m.double(), persistent=False)
        for name, antennas in (("tx_m", radar.tx_m), ("rx_m", radar.rx_m)):
            positions = torch.tensor(antennas, dtype=torch.float64).reshape(-1, 3)
            self.register_buffer(name, positions, persistent=False)

    def forward(self, profiles: Tensor, positions: Tensor, rcs: Tensor) -> Tensor:
        """Profiles (..., M, R) of positions (..., M, S, 3) and RCS (..., M, S)."""
        check_complex_map(profiles, "profiles", f"(..., pulses, {self.range_m.shape[0]} range bins)")
        check_min_rank(positions, 3, "positions", "(..., pulses, scatterers, 3) metres")
        if positions.shape[:-2] != profiles.shape[:-1] or positions.shape[-1] != 3:
            raise TensorsimError(
                f"positions: got shape {list(positions.shape)}, expected {list(profiles.shape[:-1])} and scatterers, 3"
            )
        check_floating(rcs, "rcs")
        if rcs.shape != positions.shape[:-1]:
            raise TensorsimError(
                f"rcs: got shape {list(rcs.shape)}, expected {list(positions.shape[:-1])} (per pulse) m^2"
            )
        points = positions.detach().double().unsqueeze(-2)
        range_m = torch.linalg.vector_norm(points - self.tx_m, dim=-1).mean(-1)
        range_m = 0.5 * (range_m + torch.linalg.vector_norm(points - self.rx_m, dim=-1).mean(-1))
        weight = rcs.detach().double()
        total = weight.sum(-1, keepdim=True)
        center = (weight * range_m).sum(-1, keepdim=True) / torch.where(total > 0, total, 1.0)
        keep = ((self.range_m - center).abs() <= self.half_width_m) | (total == 0)
        return torch.where(keep, profiles, torch.zeros_like(profiles))

"""Range profiles: the Fourier transform over fast time turns beat frequency into range."""

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, check_min_rank

_WINDOWS = {
    "hamming": torch.hamming_window,
    "hann": torch.hann_window,
    "blackman": torch.blackman_window,
}


def check_complex_map(x: Tensor, name: str, layout: str) -> None:
    """Refuse anything but complex (..., M, columns) with at least one column."""
    check_min_rank(x, 2, name, layout)
    if not x.is_complex():
        raise TensorsimError(f"{name}: got dtype {x.dtype}, expected a complex tensor")
    if x.shape[-1] == 0:
        raise TensorsimError(f"{name}: got shape {list(x.shape)}, expected {layout} without empty dimensions")


def flatten_batch(x: Tensor, rank: int) -> Tensor:
    """All dimensions before the last ``rank`` as one: (..., *) -> (B, *)."""
    return x.flatten(0, -rank - 1) if x.dim() > rank else x.unsqueeze(0)


def unflatten_batch(x: Tensor, lead: list[int]) -> Tensor:
    """The inverse: (B, *) -> (*lead, *)."""
    return x.reshape(lead + list(x.shape[1:]))


def range_profile(intermediate: Tensor, window: Tensor) -> Tensor:
    """The first N // 2 bins of ``FFT(IF * window)``, not normalised: (..., M, N) complex -> (..., M, N //
    2)."""
    return torch.fft.fft(intermediate * window)[..., : intermediate.shape[-1] // 2]


class RangeProfile(nn.Module):
    """Complex range profiles of IF samples; their magnitude is the range-time map.

    Args:
        radar: the radar.
        window: over fast time, ``"hamming"``, ``"hann"`` or ``"blackman"`` in their symmetric forms
            (``numpy.hamming``, ...), or None for the paper's rectangle.

    Shapes: IF (..., M, N) complex -> (..., M, N // 2) complex of the same precision. The FFT is not
        normalised: a
    path of amplitude a peaks at ``a * window.sum()``.

    Attributes:
        range_m: (N // 2,) range of each bin, ``k c / (2B)``.
        window: (N,).

    Raises:
        TensorsimError: unknown window, a real IF, N other than the radar's.
    """

    window: Tensor
    range_m: Tensor

    def __init__(self, radar: RadarConfig, window: str | None = "hamming") -> None:
        super().__init__()
        samples = radar.samples_per_chirp
        values = torch.ones(samples, dtype=torch.float64)
        if window is not None:
            if window not in _WINDOWS:
                raise TensorsimError(f"window: got {window!r}, expected one of {sorted(_WINDOWS)} or None")
            values = _WINDOWS[window](samples, periodic=False, dtype=torch.float64)
        self.samples = samples
        bins = torch.arange(samples // 2, dtype=torch.float64)
        self.register_buffer("window", values, persistent=False)
        self.register_buffer("range_m", bins * radar.range_resolution_m, persistent=False)

    def forward(self, intermediate: Tensor) -> Tensor:
        """IF (..., M, N) to profiles (..., M, N // 2)."""
        check_complex_map(intermediate, "IF", "(..., pulses, samples)")
        if intermediate.shape[-1] != self.samples:
            raise TensorsimError(
                f"IF: got shape {list(intermediate.shape)}, expected (..., pulses, {self.samples} samples)"
            )
        return range_profile(intermediate, self.window.to(torch.view_as_real(intermediate).dtype))

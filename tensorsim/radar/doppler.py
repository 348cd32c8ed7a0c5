"""Doppler-time maps: a short-time Fourier transform over pulses of every range bin, summed over range."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError
from tensorsim.radar.paths import safe_sqrt
from tensorsim.radar.range_profile import check_complex_map, flatten_batch, unflatten_batch


class DopplerTimeMap(nn.Module):
    """Doppler-time map ``sqrt(sum over range bins of |STFT of that bin|^2)`` of complex profiles.

    The window is a periodic Hann of ``L = round(window_s * PRF)`` pulses, the hop ``L - floor(overlap * L)``,
    the FFT length the next power of two >= max(L, 256); frames lie wholly inside the signal; nothing is
    normalised. Input is conjugated, so that **positive Doppler is approaching**.

    Args:
        radar: the radar (its PRF).
        window_s: window length in seconds.
        overlap: part of the window that neighbouring frames share, in [0, 1).
        integration: ``"noncoherent"``, or ``"paper"`` for the printed formula, the STFT of the sum of
            magnitudes over range, which is real and so shows every motion on both sides.

    Shapes: (..., M, R) complex -> (..., F, K) magnitude, Doppler ascending. Differentiable, with gradient
    0 where the map is 0.

    Attributes:
        doppler_hz: (F,) ascending, ``fftshift(fftfreq(F, 1 / PRF))``.
        length, hop, bins: L, the hop in pulses, and F.

    Raises:
        TensorsimError: a window shorter than 2 pulses, an overlap outside [0, 1), real profiles, fewer than L
            pulses.
    """

    window: Tensor
    doppler_hz: Tensor

    def __init__(
        self,
        radar: RadarConfig,
        window_s: float = 0.1,
        overlap: float = 0.9,
        integration: str = "noncoherent",
    ) -> None:
        super().__init__()
        if integration not in ("noncoherent", "paper"):
            raise TensorsimError(f"integration: got {integration!r}, expected 'noncoherent' or 'paper'")
        if not 0 <= overlap < 1:
            raise TensorsimError(f"overlap: got {overlap}, expected a number in [0, 1)")
        if not (math.isfinite(window_s) and round(window_s * radar.prf_hz) >= 2):
            raise TensorsimError(
                f"window_s: got {window_s} s, expected at least two pulses at a PRF of {radar.prf_hz} Hz"
            )
        self.integration = integration
        self.prf_hz = float(radar.prf_hz)
        self.length = round(window_s * radar.prf_hz)
        self.hop = self.length - math.floor(overlap * self.length)
        self.bins = 1 << (max(self.length, 256) - 1).bit_length()
        # Spectra are worked on in blocks of about 2 MB (complex64), which stay in the cache.
        self.block_frames, self.block_size = 64, 2**18
        window = torch.hann_window(self.length, periodic=True, dtype=torch.float64)
        frequency = torch.fft.fftfreq(self.bins, 1 / radar.prf_hz, dtype=torch.float64)
        self.register_buffer("window", window, persistent=False)
        self.register_buffer("doppler_hz", torch.fft.fftshift(frequency), persistent=False)

    @torch.jit.export
    def frames(self, pulses: int) -> int:
        """How many frames lie wholly inside this many pulses."""
        return max(0, (pulses - self.length) // self.hop + 1)

    @torch.jit.unused
    def frame_times_s(self, pulses: int) -> Tensor:
        """Centre (K,) of each frame in seconds after the first of ``pulses`` pulses."""
        return (torch.arange(self.frames(pulses)) * self.hop + self.length / 2).double() / self.prf_hz

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R) complex to the map (..., F, K)."""
        check_complex_map(profiles, "profiles", "(..., pulses, range bins)")
        shape = list(profiles.shape)
        if shape[-2] < self.length:
            raise TensorsimError(
                f"profiles: got {shape[-2]} pulses in shape {shape}, expected at least the "
                f"{self.length} of one Doppler window"
            )
        series = flatten_batch(profiles, 2).transpose(1, 2)  # (B, R, M)
        if self.integration == "paper":
            series = series.abs().sum(1, keepdim=True)
        window = self.window.to(torch.view_as_real(profiles).dtype)
        frames = series.unfold(-1, self.length, self.hop)  # (B, R, K, L), a view
        step = max(1, self.block_size // (frames.shape[0] * self.block_frames * self.bins))
        blocks: list[Tensor] = []
        for first in range(0, frames.shape[2], self.block_frames):
            block = frames[:, :, first : first + self.block_frames]
            power = torch.zeros(
                [block.shape[0], block.shape[2], self.bins, 2], dtype=window.dtype, device=window.device
            )
            for near in range(0, block.shape[1], step):
                spectrum = torch.fft.fft(block[:, near : near + step] * window, self.bins)
                power = power + torch.view_as_real(spectrum).square().sum(1)
            blocks.append(power.sum(-1))
        spectra = safe_sqrt(torch.cat(blocks, 1))
        # |FFT(conj x)[f]| = |FFT(x)[-f]|, so the conjugate costs a flip of the result only.
        spectra = torch.fft.fftshift(spectra.flip(-1).roll(1, -1), -1)
        return unflatten_batch(spectra.transpose(1, 2), shape[:-2])

"""Fourier synchrosqueezed transform (FSST): a short-time spectrum sharpened along frequency that can be inverted."""

import math

import torch
from torch import Tensor

from tensorsim.config import RadarConfig
from tensorsim.errors import check_count, check_min_rank, check_positive
from tensorsim.ops import safe_sqrt, unflatten_batch
from tensorsim.radar.processing.doppler import DopplerFrames


def reassigned_bins(spectrum: Tensor, derivative: Tensor, threshold: Tensor) -> Tensor:
    """Bins (..., F) int64 to which the values of an STFT are reassigned.

    For a tone at w0, the STFT is ``G(w - w0)`` and the STFT with the derivative of the window is
    ``j (w - w0) G(w - w0)``, so ``w0 = w - Im(derivative / spectrum)``.

    Args:
        spectrum: (..., F) complex, the STFT.
        derivative: (..., F) complex, the STFT with the derivative of the window per sample.
        threshold: (..., 1) values of at most this magnitude are not moved.
    """
    bins = spectrum.shape[-1]
    spectrum, derivative = spectrum.detach(), derivative.detach()
    power = torch.view_as_real(spectrum).square().sum(-1)
    above = power > threshold.square()
    offset = (derivative * spectrum.conj()).imag / torch.where(above, power, 1.0) * (bins / (2 * math.pi))
    offset = torch.where(above, offset.round(), 0.0).long()
    return torch.remainder(torch.arange(bins, device=spectrum.device) - offset, bins)


class SynchrosqueezedMap(DopplerFrames):
    """Doppler-time map by the Fourier synchrosqueezed transform, with the interface of
    :class:`~tensorsim.radar.DopplerTimeMap`.

    Every STFT value is moved along frequency to its local frequency, the time derivative of its phase (Oberlin,
    Meignen and Perrier, ICASSP 2014; Thakur and Wu, SIAM J. Math. Anal. 2011); values in the same bin are added as
    complex numbers. Values stay in their frame, so the sum of a frame, the signal at its centre, does not change:
    :meth:`inverse`. Frames, window, FFT length and axes are those of the Doppler-time map, except that phase is
    referred to the centre of the frame, its pulse ``L // 2``.

    Args:
        radar: the radar (its PRF).
        window_s: length of the window in seconds.
        overlap: overlap of neighbouring windows as a fraction of their length, in [0, 1).
        hop: pulses from frame to frame instead of ``overlap``, at most the length of a window; 1 for a transform that
            can be inverted at every pulse.
        threshold_db: values this far below the strongest of their frame and range bin are not moved.

    Shapes: (..., M, R) complex -> (..., F, K) magnitude, ``sqrt(sum over range bins of |T|^2)``; for one
    coherent series pass it as R = 1 (see :func:`~tensorsim.radar.processing.doppler.coherent_sum`). Differentiable
    with respect to the values, not to their bins.

    Attributes:
        doppler_hz: (F,) Doppler axis in Hz, ascending, positive = approaching.
        length: L, pulses of a window.
        hop: pulses from one window to the next.
        frame_rate_hz: columns per second, PRF / hop; :meth:`frame_times_s` gives their (K,) times in seconds.

    Raises:
        TensorsimError: as :class:`~tensorsim.radar.processing.doppler.DopplerFrames`; a hop below 1 or above L, real
            profiles, fewer than L pulses.
    """

    slope: Tensor

    def __init__(
        self,
        radar: RadarConfig,
        window_s: float = 0.1,
        overlap: float = 0.9,
        hop: int | None = None,
        threshold_db: float = 120.0,
    ) -> None:
        super().__init__(radar, window_s, overlap)
        check_positive(threshold_db, "threshold_db")
        if hop is not None:
            self.hop = check_count(hop, "hop", 1, self.length)
            self.frame_rate_hz = self.prf_hz / self.hop
        self.threshold = 10 ** (-threshold_db / 20)
        angle = 2 * math.pi / self.length * torch.arange(self.length, dtype=torch.float64)
        self.register_buffer("slope", math.pi / self.length * angle.sin(), persistent=False)

    def squeeze(self, frames: Tensor) -> Tensor:
        """Frames (..., L) complex of the raw signal to the transform (..., F), Doppler ascending."""
        real = torch.view_as_real(frames).dtype
        centre = self.length // 2
        frames = frames.conj()
        spectrum = torch.fft.fft(frames * self.window.to(real), self.bins)
        derivative = torch.fft.fft(frames * self.slope.to(real), self.bins)
        threshold = self.threshold * spectrum.detach().abs().amax(-1, keepdim=True)
        index = reassigned_bins(spectrum, derivative, threshold)
        # Phase referred to the centre: exp(+j 2 pi f centre / F), computed modulo F for accuracy.
        turns = torch.remainder(torch.arange(self.bins, device=frames.device) * centre, self.bins)
        angle = turns.to(torch.float64) * (2 * math.pi / self.bins)
        centred = spectrum * torch.polar(torch.ones_like(angle), angle).to(spectrum.dtype)
        parts = torch.view_as_real(centred)
        where = index.unsqueeze(-1).expand(parts.shape)
        return torch.fft.fftshift(
            torch.view_as_complex(torch.zeros_like(parts).scatter_add(-2, where, parts)), -1
        )

    @torch.jit.export
    def transform(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R) to the complex transform (..., R, F, K) of each range bin, not normalised."""
        frames = self.series(profiles).unfold(-1, self.length, self.hop)  # (B, R, K, L), a view
        return unflatten_batch(self.squeeze(frames).transpose(2, 3), list(profiles.shape[:-2]))

    @torch.jit.export
    def inverse(self, transform: Tensor) -> Tensor:
        """Transform (..., R, F, K) to the profiles (..., K, R) at pulses ``L // 2 + hop * k`` of the clip.

        ``x = sum over f of T / (F g(0))``, the conjugate of which is the raw profile; g is 1 at its centre. To
        extract one component of a signal, set the transform to 0 outside its band.
        """
        check_min_rank(transform, 3, "transform", "(..., range bins, Doppler bins, frames)")
        centre = self.window[self.length // 2].to(torch.view_as_real(transform).dtype)
        return (transform.sum(-2) / (self.bins * centre)).conj().resolve_conj().transpose(-1, -2)

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R) complex to the map (..., F, K)."""
        frames = self.series(profiles).unfold(-1, self.length, self.hop)
        columns = max(1, self.block_size // (4 * frames.shape[0] * self.bins))
        blocks: list[Tensor] = []
        for first in range(0, frames.shape[2], columns):
            block = frames[:, :, first : first + columns]
            power = torch.zeros(
                [block.shape[0], block.shape[2], self.bins],
                dtype=torch.view_as_real(profiles).dtype,
                device=profiles.device,
            )
            for bin in range(block.shape[1]):
                power = power + torch.view_as_real(self.squeeze(block[:, bin])).square().sum(-1)
            blocks.append(power)
        spectra = safe_sqrt(torch.cat(blocks, 1))
        return unflatten_batch(spectra.transpose(1, 2), list(profiles.shape[:-2]))

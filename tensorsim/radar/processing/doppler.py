"""Doppler-time maps (DTM): a short-time Fourier transform (STFT) over the pulses of every range bin, summed over range.

:func:`doppler_time_map` is the formula, by ``torch.stft``. :class:`DopplerTimeMap` computes the same in blocks that fit
in the cache, and has options for the integration over range.
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_choice, check_complex_map, check_tensor, is_writing_onnx
from tensorsim.ops import flatten_batch, safe_sqrt, unflatten_batch
from tensorsim.protocols import check_instance
from tensorsim.radar.processing.range_profile import gate_bins


def doppler_time_map(profiles: Tensor, window: Tensor, hop: int, fft_length: int) -> Tensor:
    r"""Doppler-time map: short-time Fourier transform of each range bin, summed over range in power.

    $$ D[f, k] = \sqrt{\sum_r \left| \sum_{m=0}^{L-1} w[m] \, x_r^*[m + k h] \, e^{-j 2 \pi f m / F} \right|^2} $$

    Profiles are conjugated, so that positive Doppler is approaching. Frames lie wholly inside the signal.

    Args:
        profiles: (..., M, R) complex, M pulses of R range bins.
        window: (L,) real, over the pulses of a frame, L <= M.
        hop: $h$, pulses from frame to frame.
        fft_length: F >= L, length of the zero-padded transform.

    Returns:
        (..., F, K) magnitude, K = ``(M - L) // hop + 1`` frames, Doppler ascending as in
        ``fftshift(fftfreq(F, 1 / PRF))``. Differentiable, with gradient 0 where the map is 0.

    Inputs are not checked; torch raises RuntimeError for shapes that do not fit.

    >>> approaching = torch.polar(torch.ones(64), -2 * math.pi * torch.arange(64) / 4)  # phase decreases
    >>> doppler_time_map(approaching[:, None], torch.hann_window(16), hop=8, fft_length=16).argmax(0)
    tensor([12, 12, 12, 12, 12, 12, 12])
    """
    series = profiles.conj().transpose(-1, -2)  # (..., R, M)
    # torch.stft centres the window in frames of fft_length samples; the signal is padded by as much.
    margin = fft_length - window.shape[0]
    padded = torch.nn.functional.pad(series.flatten(0, -2), [margin // 2, margin - margin // 2])
    stft = torch.stft(
        padded,
        n_fft=fft_length,
        hop_length=hop,
        win_length=window.shape[0],
        window=window,
        center=False,
        onesided=False,
        return_complex=True,
    )
    power = torch.view_as_real(stft).square().sum(-1).unflatten(0, series.shape[:-1])  # (..., R, F, K)
    return torch.fft.fftshift(safe_sqrt(power.sum(-3)), -2)


def coherent_sum(profiles: Tensor, samples: int) -> Tensor:
    """Coherent sum over range bins, with phases referred to mid-chirp: (..., M, R) complex -> (..., M, 1).

    Bin k of a profile is ``X[k] = sum over n of w[n] x[n] exp(-j 2 pi k n / N)``, its phase referred to the first
    of N = ``samples`` samples. The plain sum over all k is therefore ``N w[0] x[0]``: one sample, at which every
    window has its minimum (0 for Hann). Referred to mid-chirp, ``c = (N - 1) / 2``, the bins::

        Y[k] = X[k] exp(+j 2 pi k c / N) = sum over n of w[n] x[n] exp(-j 2 pi k (n - c) / N)

    of one target at beat bin b are ``a exp(j 2 pi b c / N) W(b - k)`` with a W that is real for a symmetric window:
    its main lobe adds up in phase, and the sum over all bins is ``N w x`` at mid-chirp, where a window has its
    maximum. A first bin other than 0 adds the same phase to all pulses.
    """
    bins = torch.arange(profiles.shape[-1], dtype=torch.float64, device=profiles.device)
    cycles = torch.remainder(bins * ((samples - 1) / (2 * samples)), 1.0)
    phase = torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles).to(profiles.dtype)
    return torch.matmul(profiles, phase.unsqueeze(-1))


class DopplerFrames(nn.Module):
    """Window, frames and axes of a short-time Fourier transform over pulses; base class of the Doppler maps.

    The window is a periodic Hann of ``L = round(window_s * PRF)`` pulses, the hop ``L - floor(overlap * L)``,
    the FFT length the next power of two >= max(L, 256). Frames lie wholly inside the signal. The transform is not
    normalised. Input is conjugated, so that **positive Doppler is approaching**.

    Args:
        radar: the radar (its PRF).
        window_s: window length in seconds.
        overlap: overlap of neighbouring frames as a fraction of the window, in [0, 1).

    Attributes:
        doppler_hz: (F,) ascending, ``fftshift(fftfreq(F, 1 / PRF))``.
        length, hop, bins: L, the hop in pulses, and F.
        frame_rate_hz: frames per second, PRF / hop.

    Raises:
        TensorsimError: a window shorter than 2 pulses, an overlap outside [0, 1).
    """

    window: Tensor
    shifting_window: Tensor
    doppler_hz: Tensor

    def __init__(self, radar: RadarConfig, window_s: float = 0.1, overlap: float = 0.9) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        if not (is_finite(overlap) and 0 <= overlap < 1):
            raise TensorsimError(f"overlap: got {overlap}, expected a number in [0, 1)")
        if not (is_finite(window_s) and round(window_s * radar.prf_hz) >= 2):
            raise TensorsimError(
                f"window_s: got {window_s} s, expected at least two pulses at a PRF of {radar.prf_hz} Hz"
            )
        self.prf_hz = float(radar.prf_hz)
        self.length = round(window_s * radar.prf_hz)
        # 0.7 of 90 pulses are 63, in floating point 62.99...
        self.hop = max(1, self.length - math.floor(overlap * self.length + 1e-9))
        self.frame_rate_hz = self.prf_hz / self.hop
        self.bins = 1 << (max(self.length, 256) - 1).bit_length()
        # Block size: spectra of about 1 MB (complex64) stay in the cache.
        self.block_size = 2**17
        window = torch.hann_window(self.length, periodic=True, dtype=torch.float64)
        # A factor (-1)^n shifts the spectrum by PRF / 2, so that bins ascend from -PRF / 2 without an fftshift.
        alternating = 1.0 - 2.0 * (torch.arange(self.length, dtype=torch.float64) % 2)
        frequency = torch.fft.fftfreq(self.bins, 1 / radar.prf_hz, dtype=torch.float64)
        self.register_buffer("window", window, persistent=False)
        self.register_buffer("shifting_window", window * alternating, persistent=False)
        self.register_buffer("doppler_hz", torch.fft.fftshift(frequency), persistent=False)

    @torch.jit.export
    def frames(self, pulses: int) -> int:
        """Number of frames that lie wholly inside this many pulses."""
        return max(0, (pulses - self.length) // self.hop + 1)

    @torch.jit.unused
    def frame_times_s(self, pulses: int) -> Tensor:
        """Centre (K,) of each frame in seconds after the first of ``pulses`` pulses."""
        return (torch.arange(self.frames(pulses)) * self.hop + self.length / 2).double() / self.prf_hz

    def series(self, profiles: Tensor) -> Tensor:
        """Check profiles (..., M, R) and arrange them as one series per range bin: (B, R, M)."""
        check_complex_map(profiles, "profiles", "(..., pulses, range bins)")
        shape = list(profiles.shape)
        if shape[-2] < self.length:
            raise TensorsimError(
                f"profiles: got {shape[-2]} pulses in shape {shape}, expected at least the "
                f"{self.length} of one Doppler window"
            )
        return flatten_batch(profiles, 2).transpose(1, 2)

    def spectrum(self, frames: Tensor, padded: Tensor | None = None) -> Tensor:
        """Real and imaginary part (..., F, 2) of the transform of frames (..., L), Doppler ascending.

        ``padded`` (..., F), which is zero beyond L, receives the windowed frames; only for blocks without gradients.
        """
        window = self.shifting_window.to(frames.dtype)
        if padded is None:
            windowed = frames * window
        else:
            windowed = padded
            torch.mul(frames, window, out=padded[..., : self.length])
        # |FFT(conj x)[f]| = |FFT(x)[-f]|, which the inverse transform has at f.
        spectrum = torch.fft.ifft(windowed, self.bins, norm="forward")
        return torch.view_as_real(spectrum.resolve_conj())


class DopplerTimeMap(DopplerFrames):
    """Doppler-time map (DTM) of complex range profiles.

    Args:
        radar: the radar (its PRF and range bins).
        window_s: length of the window in seconds.
        overlap: overlap of neighbouring windows as a fraction of their length, in [0, 1).
        integration: over range bins. ``"noncoherent"``: :func:`doppler_time_map`. ``"coherent"``: |STFT| of
            :func:`coherent_sum`, which adds the bins of one target in phase, but not those of several: use it with a
            gate around one target. ``"paper"``: the paper's formula, the STFT of the sum of magnitudes over range.
            That sum is real, so the map is symmetric and has lost the sign of Doppler.
        gate_m: (nearest, farthest) range in metres of the bins to use, for profiles that start at range 0; None
            uses all bins.

    Shapes: (..., M, R) complex -> (..., F, K) magnitude, Doppler ascending. Differentiable, with gradient
    0 where the map is 0.

    Attributes:
        doppler_hz: (F,) Doppler axis in Hz, ascending, positive = approaching.
        length: L, pulses of a window.
        hop: pulses from one window to the next.
        frame_rate_hz: columns per second, PRF / hop; :meth:`frame_times_s` gives their (K,) times in seconds.

    Raises:
        TensorsimError: as :class:`DopplerFrames`; unknown integration, a gate without bins, real profiles, fewer
            than L pulses.
    """

    def __init__(
        self,
        radar: RadarConfig,
        window_s: float = 0.1,
        overlap: float = 0.9,
        integration: str = "noncoherent",
        gate_m: tuple[float, float] | None = None,
    ) -> None:
        super().__init__(radar, window_s, overlap)
        check_choice(integration, ("noncoherent", "coherent", "paper"), "integration")
        self.integration = integration
        self.samples = radar.samples_per_chirp
        self.gated = gate_m is not None
        self.first_bin, self.last_bin = 0, self.samples - 1
        if gate_m is not None:
            self.first_bin, self.last_bin = gate_bins(gate_m, radar.range_resolution_m, self.samples)

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R) complex to the map (..., F, K)."""
        check_tensor(profiles, "profiles", "(..., pulses, range bins)", "complex", finite=False)
        if 0 < profiles.shape[-1] <= self.first_bin:
            raise TensorsimError(
                f"profiles: got shape {list(profiles.shape)}, expected more than the {self.first_bin} range bins "
                f"before the gate"
            )
        if self.gated:
            profiles = profiles[..., self.first_bin : self.last_bin + 1]
        series = self.series(profiles)  # (B, R, M)
        if self.integration == "paper":
            series = series.abs().sum(1, keepdim=True)
        elif self.integration == "coherent":
            series = coherent_sum(series.transpose(1, 2), self.samples).transpose(1, 2)
        if is_writing_onnx():
            return unflatten_batch(self._of_real_numbers(series), list(profiles.shape[:-2]))
        frames = series.unfold(-1, self.length, self.hop)  # (B, R, K, L), a view
        batch, bins, count = frames.shape[0], frames.shape[1], frames.shape[2]
        # Neighbouring frames share most of their pulses, so a block is filled with frames first, then with clips,
        # then with range bins.
        columns = max(1, min(count, self.block_size // self.bins))
        clips = max(1, self.block_size // (columns * self.bins)) if columns == count else 1
        step = max(1, self.block_size // (min(clips, batch) * columns * self.bins))
        # With autograd the blocks are joined at the end; without, each is written to its place while in the cache.
        joined = series.requires_grad
        rows: list[Tensor] = []
        doppler_time = torch.real(series).new_empty([0 if joined else batch * count, self.bins])
        shape = [min(clips, batch), min(step, bins), min(columns, count), self.bins]
        padded = series.new_zeros([0] if joined else shape)
        for clip in range(0, batch, clips):
            for first in range(0, count, columns):
                block = frames[clip : clip + clips, :, first : first + columns]
                power = torch.real(series).new_zeros([])
                for near in range(0, bins, step):
                    part = block[:, near : near + step]
                    room = None if joined else padded[: part.shape[0], : part.shape[1], : part.shape[2]]
                    for spectrum in self.spectrum(part, room).unbind(1):
                        if power.dim() == 0:
                            power = spectrum.square()
                        else:
                            power.addcmul_(spectrum, spectrum)
                power = power.flatten(0, 1)
                if joined:
                    rows.append(safe_sqrt(power[..., 0] + power[..., 1]))
                else:
                    place = clip * count + first
                    row = doppler_time[place : place + power.shape[0]]
                    torch.add(power[..., 0], power[..., 1], out=row)
                    row.sqrt_()
        if joined:
            doppler_time = torch.cat(rows)
        return unflatten_batch(
            doppler_time.unflatten(0, [batch, count]).transpose(1, 2), list(profiles.shape[:-2])
        )

    def _of_real_numbers(self, series: Tensor) -> Tensor:
        """The map (B, F, K) of series (B, R, M) by products with cosines and sines, for ONNX."""
        cycles = torch.arange(self.length)[:, None] * torch.arange(self.bins) % self.bins / self.bins
        angle = 2 * math.pi * cycles.double()
        paper = not series.is_complex()
        parts = torch.stack([series, torch.zeros_like(series)], -1) if paper else torch.view_as_real(series)
        frames = parts.unfold(2, self.length, self.hop)  # (B, R, K, 2, L)
        window = self.shifting_window.to(frames)
        real, imaginary = (frames * window).unbind(3)
        cos, sin = angle.cos().to(frames), angle.sin().to(frames)
        power = (real @ cos - imaginary @ sin).square() + (real @ sin + imaginary @ cos).square()
        return safe_sqrt(power.sum(1)).transpose(1, 2)


class RangeDopplerVideo(DopplerFrames):
    """Range-Doppler power of each frame: the Doppler-time map before its sum over range.

    Args:
        radar: the radar (its PRF).
        window_s: length of the window in seconds.
        overlap: overlap of neighbouring windows as a fraction of their length, in [0, 1).

    Shapes: (..., M, R) complex -> (..., K, R, F) power ``|STFT|^2``; the sum over R is the square of the noncoherent
    Doppler-time map. Differentiable.

    Attributes:
        doppler_hz: (F,) Doppler axis in Hz, ascending, positive = approaching.
        length: L, pulses of a window.
        hop: pulses from one window to the next.
        frame_rate_hz: columns per second, PRF / hop; :meth:`frame_times_s` gives their (K,) times in seconds.

    Raises:
        TensorsimError: as :class:`DopplerFrames`; real profiles, fewer than L pulses.
    """

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R) complex to power (..., K, R, F)."""
        frames = (
            self.series(profiles).unfold(-1, self.length, self.hop).transpose(1, 2)
        )  # (B, K, R, L), a view
        step = max(1, self.block_size // (frames.shape[0] * frames.shape[2] * self.bins))
        blocks: list[Tensor] = []
        for first in range(0, frames.shape[1], step):
            blocks.append(self.spectrum(frames[:, first : first + step]).square().sum(-1))
        return unflatten_batch(torch.cat(blocks, 1), list(profiles.shape[:-2]))

"""Doppler-time maps: a short-time Fourier transform over pulses of every range bin, summed over range."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import TensorsimError, check_complex_map
from tensorsim.ops import flatten_batch, safe_sqrt, unflatten_batch
from tensorsim.radar.processing.range_profile import gate_bins


def coherent_sum(profiles: Tensor, samples: int) -> Tensor:
    """Sum range bins as the beat signal at mid-chirp: (..., M, R) complex -> (..., M, 1).

    Bin k of a profile is ``X[k] = sum over n of w[n] x[n] exp(-j 2 pi k n / N)``, its phase counted from the first
    of N = ``samples`` samples. The plain sum over all k is therefore ``N w[0] x[0]``: one sample, where every window
    is weakest (0 for Hann). Counted from mid-chirp, ``c = (N - 1) / 2``, the bins

        Y[k] = X[k] exp(+j 2 pi k c / N) = sum over n of w[n] x[n] exp(-j 2 pi k (n - c) / N)

    of one target at beat bin b are ``a exp(j 2 pi b c / N) W(b - k)`` with a W that is real for a symmetric window:
    its whole main lobe adds up in phase, and all bins give ``N w x`` at mid-chirp, where a window is strongest.
    A first bin other than 0 turns the phase of all alike.
    """
    bins = torch.arange(profiles.shape[-1], dtype=torch.float64, device=profiles.device)
    cycles = torch.remainder(bins * ((samples - 1) / (2 * samples)), 1.0)
    phase = torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles).to(profiles.dtype)
    return torch.matmul(profiles, phase.unsqueeze(-1))


class DopplerFrames(nn.Module):
    """The short-time Fourier transform that the maps over Doppler and time share: window, frames and axes.

    The window is a periodic Hann of ``L = round(window_s * PRF)`` pulses, the hop ``L - floor(overlap * L)``,
    the FFT length the next power of two >= max(L, 256); frames lie wholly inside the signal; nothing is
    normalised. Input is conjugated, so that **positive Doppler is approaching**.

    Args:
        radar: the radar (its PRF).
        window_s: window length in seconds.
        overlap: part of the window that neighbouring frames share, in [0, 1).

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
        if not 0 <= overlap < 1:
            raise TensorsimError(f"overlap: got {overlap}, expected a number in [0, 1)")
        if not (math.isfinite(window_s) and round(window_s * radar.prf_hz) >= 2):
            raise TensorsimError(
                f"window_s: got {window_s} s, expected at least two pulses at a PRF of {radar.prf_hz} Hz"
            )
        self.prf_hz = float(radar.prf_hz)
        self.length = round(window_s * radar.prf_hz)
        self.hop = self.length - math.floor(overlap * self.length)
        self.frame_rate_hz = self.prf_hz / self.hop
        self.bins = 1 << (max(self.length, 256) - 1).bit_length()
        # Spectra are worked on in blocks of about 512 kB (complex64), which stay in the cache.
        self.block_size = 2**16
        window = torch.hann_window(self.length, periodic=True, dtype=torch.float64)
        # Every other sample with the other sign turns the spectrum by half a circle: bins ascend from -PRF / 2.
        alternating = 1.0 - 2.0 * (torch.arange(self.length, dtype=torch.float64) % 2)
        frequency = torch.fft.fftfreq(self.bins, 1 / radar.prf_hz, dtype=torch.float64)
        self.register_buffer("window", window, persistent=False)
        self.register_buffer("shifting_window", window * alternating, persistent=False)
        self.register_buffer("doppler_hz", torch.fft.fftshift(frequency), persistent=False)

    @torch.jit.export
    def frames(self, pulses: int) -> int:
        """How many frames lie wholly inside this many pulses."""
        return max(0, (pulses - self.length) // self.hop + 1)

    @torch.jit.unused
    def frame_times_s(self, pulses: int) -> Tensor:
        """Centre (K,) of each frame in seconds after the first of ``pulses`` pulses."""
        return (torch.arange(self.frames(pulses)) * self.hop + self.length / 2).double() / self.prf_hz

    def series(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R), checked, as one series per range bin: (B, R, M)."""
        check_complex_map(profiles, "profiles", "(..., pulses, range bins)")
        shape = list(profiles.shape)
        if shape[-2] < self.length:
            raise TensorsimError(
                f"profiles: got {shape[-2]} pulses in shape {shape}, expected at least the "
                f"{self.length} of one Doppler window"
            )
        return flatten_batch(profiles, 2).transpose(1, 2)

    def spectrum(self, frames: Tensor) -> Tensor:
        """Real and imaginary part (..., F, 2) of the transform of frames (..., L), Doppler ascending."""
        window = self.shifting_window.to(torch.real(frames).dtype)
        # |FFT(conj x)[f]| = |FFT(x)[-f]|, and a transform with the other sign puts -f at f.
        spectrum = torch.fft.ifft(frames * window, self.bins, norm="forward")
        return torch.view_as_real(spectrum.resolve_conj())


class DopplerTimeMap(DopplerFrames):
    """Doppler-time map of complex profiles.

    Args:
        radar, window_s, overlap: see :class:`DopplerFrames`.
        integration: over range bins. ``"noncoherent"``: ``sqrt(sum over range bins of |STFT of that bin|^2)``.
            ``"coherent"``: |STFT| of :func:`coherent_sum`, which adds the bins of a target in phase and those of
            others with whatever phase they have: for a gate around one target. ``"paper"``: the printed formula,
            the STFT of the sum of magnitudes over range, which is real and so shows every motion on both sides.
        gate_m: (nearest, farthest) range in metres whose bins are used, of profiles that start at range 0; None
            takes all of them.

    Shapes: (..., M, R) complex -> (..., F, K) magnitude, Doppler ascending. Differentiable, with gradient
    0 where the map is 0.

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
        if integration not in ("noncoherent", "coherent", "paper"):
            raise TensorsimError(
                f"integration: got {integration!r}, expected 'noncoherent', 'coherent' or 'paper'"
            )
        self.integration = integration
        self.samples = radar.samples_per_chirp
        self.first_bin, self.last_bin = 0, self.samples - 1
        if gate_m is not None:
            self.first_bin, self.last_bin = gate_bins(gate_m, radar.range_resolution_m, self.samples)

    def forward(self, profiles: Tensor) -> Tensor:
        """Profiles (..., M, R) complex to the map (..., F, K)."""
        if profiles.dim() > 1 and profiles.shape[-1] <= self.first_bin and profiles.shape[-1] > 0:
            raise TensorsimError(
                f"profiles: got shape {list(profiles.shape)}, expected more than the {self.first_bin} range bins "
                f"before the gate"
            )
        series = self.series(profiles[..., self.first_bin : self.last_bin + 1])  # (B, R, M)
        if self.integration == "paper":
            series = series.abs().sum(1, keepdim=True)
        elif self.integration == "coherent":
            series = coherent_sum(series.transpose(1, 2), self.samples).transpose(1, 2)
        frames = series.unfold(-1, self.length, self.hop)  # (B, R, K, L), a view
        batch, bins, count = frames.shape[0], frames.shape[1], frames.shape[2]
        # Neighbouring frames share most of their pulses: blocks take frames first, then clips, then range bins.
        columns = max(1, min(count, self.block_size // self.bins))
        clips = max(1, self.block_size // (columns * self.bins)) if columns == count else 1
        step = max(1, self.block_size // (min(clips, batch) * columns * self.bins))
        # Autograd wants the blocks joined; without it each is written where it belongs, while it is in the cache.
        joined = series.requires_grad
        rows: list[Tensor] = []
        doppler_time = torch.real(series).new_empty([0 if joined else batch * count, self.bins])
        for clip in range(0, batch, clips):
            for first in range(0, count, columns):
                block = frames[clip : clip + clips, :, first : first + columns]
                power = torch.real(series).new_zeros([])
                for near in range(0, bins, step):
                    for part in self.spectrum(block[:, near : near + step]).unbind(1):
                        power = torch.addcmul(power, part, part)
                row = safe_sqrt(power[..., 0] + power[..., 1]).flatten(0, 1)
                if joined:
                    rows.append(row)
                else:
                    place = clip * count + first
                    doppler_time[place : place + row.shape[0]] = row
        if joined:
            doppler_time = torch.cat(rows)
        return unflatten_batch(
            doppler_time.unflatten(0, [batch, count]).transpose(1, 2), list(profiles.shape[:-2])
        )


class RangeDopplerVideo(DopplerFrames):
    """Range-Doppler power frame by frame: the Doppler-time map before its sum over range.

    Args:
        radar, window_s, overlap: see :class:`DopplerFrames`.

    Shapes: (..., M, R) complex -> (..., K, R, F) power ``|STFT|^2``; the sum over R is the square of the noncoherent
    Doppler-time map. Differentiable.

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

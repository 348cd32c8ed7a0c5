"""Range bins in closed form: what the Fourier transform over fast time makes of each path, without its IF.

A path of delay tau and gain g is a tone at the beat bin ``b = mu tau N / fs``, so bin k of its range profile is

    X[k] = g exp(j 2 pi (fc tau - mu tau^2 / 2)) W(k - b),    W(x) = sum over n of w[n] exp(-j 2 pi x n / N)

W is the transform of the window: one Dirichlet kernel ``sin(pi x) / sin(pi x / N)`` for the rectangle, three for
Hamming and Hann, five for Blackman (Harris, *On the use of windows for harmonic analysis with the DFT*, 1978).
Evaluated as printed it is 0 / 0 at the peak of every target. But with ``b = n + f``, n whole and ``|f| <= 1/2``,
and the phase counted from mid-chirp, W is so smooth in f that a Chebyshev series of few terms is exact to the last
digit (its coefficients fall like the Bessel functions ``J_j(pi / 2)``): a small table, for any window.
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError
from tensorsim.radar.echo import EchoSynthesizer, check_scene, phasor
from tensorsim.radar.range_profile import RangeProfile

#: Terms of the Chebyshev series: J_11(pi / 2) = 2e-9 and J_17(pi / 2) = 4e-17.
TERMS_FLOAT32, TERMS_FLOAT64 = 11, 17


def kernel_table(window: Tensor, offsets: Tensor, terms: int) -> Tensor:
    """Chebyshev coefficients (terms, D) complex128 of ``W(m - f) exp(-j 2 pi f (N - 1) / (2 N))`` in ``2 f``.

    Args:
        window: (N,) float64.
        offsets: (D,) whole bins m.
        terms: length of the series.
    """
    samples = window.shape[0]
    centred = torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2
    angle = math.pi * (torch.arange(terms, dtype=torch.float64) + 0.5) / terms
    fraction = 0.5 * angle.cos()  # Chebyshev nodes
    # exp(-j 2 pi m n / N): the product is reduced in whole numbers before it becomes a phase.
    turns = torch.remainder(torch.outer(offsets.long(), torch.arange(samples)), samples).double() / samples
    whole = torch.polar(window.expand_as(turns), -2 * math.pi * turns)
    tones = torch.polar(
        torch.ones(terms, samples).double(), 2 * math.pi / samples * torch.outer(fraction, centred)
    )
    values = torch.matmul(tones, whole.transpose(0, 1))
    transform = (2 / terms) * torch.cos(torch.outer(torch.arange(terms, dtype=torch.float64), angle))
    transform[0] *= 0.5
    return torch.matmul(transform.to(values.dtype), values)


def chebyshev(x: Tensor, terms: int) -> Tensor:
    """T_0(x), T_1(x), ... as a last dimension: (...) -> (..., terms)."""
    series = [torch.ones_like(x), x]
    for _ in range(terms - 2):
        series.append(2 * x * series[-1] - series[-2])
    return torch.stack(series, -1)


def bin_sum(
    delay_s: Tensor,
    gain: Tensor,
    carrier_hz: float,
    slope_hz_per_s: float,
    sample_rate_hz: float,
    samples: int,
    table: Tensor,
) -> Tensor:
    """All N bins of the spectrum of windowed beat tones.

    Args:
        delay_s: (L, P) float64.
        gain: (L, P) complex128.
        carrier_hz, slope_hz_per_s, sample_rate_hz: fc, mu, fs.
        samples: N.
        table: (J, D) from :func:`kernel_table` for the D bins around a path, the middle one (D // 2) at it;
            complex in the precision of the result.

    Returns:
        (L, N) complex. The bins form a circle, as those of any discrete transform.
    """
    beat = slope_hz_per_s * samples / sample_rate_hz * delay_s
    whole = beat.detach().round()
    fraction = beat - whole
    phase = carrier_hz * delay_s - 0.5 * slope_hz_per_s * delay_s.square()
    phase = phase + fraction * ((samples - 1) / (2 * samples))
    real = torch.float32 if table.dtype == torch.complex64 else torch.float64
    strength = phasor((phase - phase.round()).to(real)) * gain.to(table.dtype)
    series = chebyshev((2 * fraction).to(real), table.shape[0]) * strength.unsqueeze(-1)  # (L, P, J)
    spread = torch.matmul(series, table).flatten(1)  # (L, P * D)
    width = table.shape[1]
    offsets = torch.arange(width, device=delay_s.device)
    place = (torch.remainder(whole, samples).long().unsqueeze(-1) + offsets).flatten(1)
    ring = torch.zeros([spread.shape[0], samples + width], dtype=table.dtype, device=delay_s.device)
    ring = ring.scatter_add(1, place, spread)
    # Place p of the ring is bin p - width // 2: bring its two ends, if used, round to the other side.
    before = width // 2
    low, middle, high = ring[:, :before], ring[:, before : before + samples], ring[:, before + samples :]
    low = torch.nn.functional.pad(low, [samples - before, 0])
    high = torch.nn.functional.pad(high, [0, samples - high.shape[1]])
    return middle + low + high


class RangeBinSynthesizer(nn.Module):
    """Range profiles of a scene directly from its propagation paths; no IF is made.

    Equals :class:`~tensorsim.radar.range_profile.RangeProfile` of
    :class:`~tensorsim.radar.echo.EchoSynthesizer` to 1e-6 of the norm in float32 and 1e-12 in float64 with all
    bins, and to ``truncation`` of it when only bins near a path are kept.

    Args:
        echo: the scene's paths and its static echo.
        profile: the window, and the gate if it has one.
        near_bins: keep the bins within this many of the nearest to each path; None keeps all. All bins cost
            more than the time-domain way; a few cost several times less.

    Shapes: positions (..., M, S, 3) m, rcs (..., S), (..., M, S) or (S,) m^2 -> (..., M, R) complex, free of
    noise; complex64, and complex128 after ``.double()``. Differentiable by both.

    Attributes:
        truncation: expected error of the norm that ``near_bins`` causes for one path, relative: the square root
            of the part of the window's energy in bins further out, its mean over fractions of a bin. 0 with all.

    Raises:
        TensorsimError: ``near_bins`` below 1, an echo with several antennas or a closed Airy slab; see
            :class:`~tensorsim.radar.echo.EchoSynthesizer`.
    """

    table: Tensor
    noise_factor: Tensor

    def __init__(self, echo: EchoSynthesizer, profile: RangeProfile, near_bins: int | None = None) -> None:
        super().__init__()
        if near_bins is not None and near_bins < 1:
            raise TensorsimError(f"near_bins: got {near_bins}, expected at least 1 or None for all")
        if echo.paths.airy or echo.paths.has_array:
            raise TensorsimError(
                "echo: got a wall with incidence 'airy' or several antennas, expected one antenna of each kind and "
                "paths that are pure tones: the time-domain way has the others"
            )
        self.echo, self.profile = echo, profile
        self.terms_float32, self.terms_float64 = TERMS_FLOAT32, TERMS_FLOAT64
        samples = profile.samples
        everything = torch.arange(samples) - samples // 2
        offsets = everything
        if near_bins is not None and 2 * near_bins + 1 < samples:
            offsets = torch.arange(-near_bins, near_bins + 1)
        table = kernel_table(profile.window.double(), offsets, TERMS_FLOAT64)
        self.truncation = math.sqrt(max(0.0, 1 - self._energy(table) / self._total(profile.window)))
        if len(offsets) == samples:
            self.truncation = 0.0
        self.register_buffer("table", torch.view_as_real(table).clone(), persistent=False)
        # White noise of variance 1 in the IF has the covariance sum w[n]^2 exp(-j 2 pi (k - l) n / N) in the bins.
        # Counted from mid-chirp it is real, and circular noise does not mind the phase of a bin.
        bins = torch.arange(profile.first_bin, profile.last_bin + 1, dtype=torch.float64)
        centred = torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2
        lag = (2 * math.pi / samples) * torch.outer(bins - bins[0], centred)
        row = (lag.cos() * profile.window.double().square()).sum(1)
        difference = (bins[:, None] - bins[None, :]).abs().long()
        value, vector = torch.linalg.eigh(row[difference])
        self.register_buffer("noise_factor", vector * value.clamp_min(0).sqrt(), persistent=False)

    @staticmethod
    @torch.jit.unused
    def _total(window: Tensor) -> float:
        return float(window.shape[0] * window.double().square().sum())

    @staticmethod
    @torch.jit.unused
    def _energy(table: Tensor) -> float:
        """Energy of all columns, the mean over fractions f."""
        fraction = (torch.arange(64, dtype=torch.float64) + 0.5) / 64 - 0.5
        series = chebyshev(2 * fraction, table.shape[0]).to(table.dtype)
        return float(torch.matmul(series, table).abs().square().sum(-1).mean())

    @torch.jit.export
    def target_bins(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """Profiles of the targets alone, unchecked and in one go: (..., S, 3) m and (..., S) m^2 -> (..., R)."""
        paths = self.echo.paths(positions.double(), rcs.double(), None)
        terms = self.terms_float64 if self.echo.fine.dtype == torch.float64 else self.terms_float32
        bins = bin_sum(
            paths.delay_s.flatten(-2).flatten(0, -2),
            paths.gain.flatten(-2).flatten(0, -2),
            self.echo.carrier_hz,
            self.echo.slope_hz_per_s,
            self.echo.sample_rate_hz,
            self.profile.samples,
            torch.view_as_complex(self.table[:terms].to(self.echo.fine.dtype)),
        )
        return bins[:, self.profile.first_bin : self.profile.last_bin + 1].unflatten(
            0, list(positions.shape[:-2])
        )

    @torch.jit.export
    def static_bins(self) -> Tensor:
        """Profile (R,) of what does not move and is switched on: leakage and wall echo."""
        return self.profile(self.echo.static_echo().unsqueeze(0))[0]

    @torch.jit.export
    def color(self, white: Tensor) -> Tensor:
        """White complex noise (..., R) to the noise of the bins when every IF sample has the variance of it."""
        factor = self.noise_factor.to(torch.view_as_real(white).dtype)
        parts = torch.view_as_real(white).transpose(-1, -2)  # (..., 2, R)
        return torch.view_as_complex(torch.matmul(parts, factor.T).transpose(-1, -2).contiguous())

    def forward(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """(..., M, S, 3) metres and (..., S) or (..., M, S) m^2 to profiles (..., M, R)."""
        rcs = check_scene(positions, rcs).flatten(0, -2)
        pulses = positions.flatten(0, -3)
        static = self.static_bins()
        chunks: list[Tensor] = []
        for start in range(0, pulses.shape[0], self.echo.pulse_chunk):
            stop = start + self.echo.pulse_chunk
            chunks.append(self.target_bins(pulses[start:stop], rcs[start:stop]) + static)
        return torch.cat(chunks).unflatten(0, list(positions.shape[:-2]))

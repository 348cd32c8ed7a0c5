"""Range profiles in closed form: the range bins of each path without the IF and its Fourier transform.

The IF of a path is a tone at bin ``b = mu tau N / fs``. With its complex amplitude s and the phase of the bins
referred to mid-chirp, its windowed transform is real except for s::

    X[k] = exp(-j pi k (N - 1) / N) sum over paths of s W(k - b),
    W(x) = sum over n of w[n] cos(2 pi x (n - (N - 1) / 2) / N)

for a symmetric window. W is one Dirichlet kernel ``sin(pi x) / sin(pi x / N)`` without a window, three for Hamming
and Hann, five for Blackman (Harris, *On the use of windows for harmonic analysis with the DFT*, 1978). The Dirichlet
kernel is 0 / 0 at the peak. With ``b = n + f``, n an integer and ``|f| <= 1/2``, W is smooth in f, and a Chebyshev
series of few terms reaches the accuracy of the number format (its coefficients decrease like the Bessel functions
``J_j(pi / 2)``): a small table suffices for any window.
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.errors import TensorsimError, check_count, check_scene
from tensorsim.radar.processing.range_profile import RangeProfile
from tensorsim.radar.synthesis.dechirp import phasor, tone_sum
from tensorsim.radar.synthesis.echo import EchoSynthesizer
from tensorsim.radar.synthesis.noise import energy

#: Terms of the Chebyshev series: J_11(pi / 2) = 2e-9 and J_17(pi / 2) = 4e-17.
TERMS_FLOAT32, TERMS_FLOAT64 = 11, 17


def kernel_table(window: Tensor, offsets: Tensor, terms: int) -> Tensor:
    """Chebyshev coefficients (terms, D) float64 of ``W(m - f)`` in ``2 f``.

    Args:
        window: (N,) float64, symmetric.
        offsets: (D,) integer bins m.
        terms: length of the series.
    """
    samples = window.shape[0]
    centred = torch.arange(samples, dtype=torch.float64) - (samples - 1) / 2
    angle = math.pi * (torch.arange(terms, dtype=torch.float64) + 0.5) / terms
    distance = offsets - 0.5 * angle.cos().unsqueeze(-1)  # at the Chebyshev nodes
    values = torch.matmul((2 * math.pi / samples * distance.unsqueeze(-1) * centred).cos(), window)
    transform = (2 / terms) * torch.cos(torch.outer(torch.arange(terms, dtype=torch.float64), angle))
    transform[0] *= 0.5
    return torch.matmul(transform, values)


def chebyshev(x: Tensor, terms: int) -> Tensor:
    """T_0(x), T_1(x), ... as a last dimension: (...) -> (..., terms)."""
    series = [torch.ones_like(x), x]
    for _ in range(terms - 2):
        series.append(2 * x * series[-1] - series[-2])
    return torch.stack(series, -1)


def mid_chirp_tones(
    delay_s: Tensor,
    gain: Tensor,
    carrier_hz: float,
    slope_hz_per_s: float,
    sample_rate_hz: float,
    samples: int,
    real: torch.dtype,
) -> tuple[Tensor, Tensor]:
    """Beat bins (L, P) float64, in [0, N), and complex amplitudes (L, P) at mid-chirp of paths.

    Args:
        delay_s: (L, P) float64.
        gain: (L, P) complex128.
        carrier_hz, slope_hz_per_s, sample_rate_hz: fc, mu, fs.
        samples: N.
        real: precision of the amplitudes, torch.float32 or float64.
    """
    beat = slope_hz_per_s * samples / sample_rate_hz * delay_s
    beat = beat - samples * (beat.detach() / samples).floor()
    cycles = carrier_hz * delay_s - 0.5 * slope_hz_per_s * delay_s.square()
    cycles = cycles + beat * ((samples - 1) / (2 * samples))
    strength = phasor((cycles - cycles.round()).to(real))
    return beat, strength * gain.to(strength.dtype)


def bin_sum(beat: Tensor, strength: Tensor, samples: int, table: Tensor) -> Tensor:
    """All N bins (L, N) of the spectrum of windowed tones, with phases referred to mid-chirp.

    Args:
        beat: (L, P) float64, in [0, N).
        strength: (L, P) complex, at mid-chirp.
        samples: N.
        table: (J, D) from :func:`kernel_table` for the D bins around a tone, of which D // 2 is the nearest; real,
            in the precision of the result.
    """
    whole = beat.detach().round()
    series = chebyshev((2 * (beat - whole)).to(table.dtype), table.shape[0])  # (L, P, J)
    spread = (torch.matmul(series, table) * strength.unsqueeze(-1)).flatten(1)  # (L, P * D)
    width = table.shape[1]
    place = (whole.long().unsqueeze(-1) + torch.arange(width, device=beat.device)).flatten(1)
    ring = torch.zeros([spread.shape[0], samples + width], dtype=spread.dtype, device=beat.device)
    ring = ring.scatter_add(1, place, spread)
    # Place p of the ring is bin p - width // 2. Bins at both ends are wrapped around modulo N. For even N, mid-chirp is
    # half a sample off, and the wrapped bins change sign.
    before, sign = width // 2, 1 - 2 * ((samples - 1) % 2)
    bins = ring[:, before : before + samples]
    bins[:, samples - before :].add_(ring[:, :before], alpha=sign)
    bins[:, : width - before].add_(ring[:, before + samples :], alpha=sign)
    return bins


def tone_energy(beat: Tensor, strength: Tensor, samples: int) -> Tensor:
    """Sum over N samples of ``|sum of tones|^2``: (..., P) float64 beat bins, (..., P) complex at mid-chirp -> (...).

    Every pair of tones contributes ``2 Re(s_i conj(s_j)) sin(pi d) / sin(pi d / N)``, d the difference of their bins.
    There are P (P - 1) / 2 pairs.
    """
    parts = torch.view_as_real(strength)
    own = samples * parts.square().sum((-2, -1))
    center = (beat - beat.detach().mean(-1, keepdim=True)).to(parts.dtype)
    rows = torch.cat((center.unsqueeze(-1), parts), -1).movedim((-2, -1), (0, 1))  # (P, 3, ...)
    pair = torch.triu_indices(rows.shape[0], rows.shape[0], 1, device=beat.device)
    a, b = rows.index_select(0, pair[0]), rows.index_select(0, pair[1])
    angle = (a[:, 0] - b[:, 0]) * (math.pi / samples)
    half = angle.sin()
    apart = half.abs() > 1e-9
    kernel = torch.where(apart, (samples * angle).sin() / torch.where(apart, half, 1.0), float(samples))
    return own + 2 * ((a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]) * kernel).sum(0)


class RangeBinSynthesizer(nn.Module):
    """Range profiles of a scene directly from its propagation paths, without the IF.

    With all bins, the relative difference to :class:`~tensorsim.radar.RangeProfile` of
    :class:`~tensorsim.radar.EchoSynthesizer` is 1e-6 of the norm in float32 and 1e-12 in float64; with only the bins
    near each path it is ``truncation``.

    Args:
        echo: the scene's paths and its static echo.
        profile: the window, and the gate if it has one.
        near_bins: compute only the bins at most this far from the one nearest to each path; None computes all.
            All bins take longer than the time-domain engine, a few bins several times less.
        energy_stride: :meth:`energy` is computed for every n-th pulse and reused for the pulses up to the next.

    Shapes: positions (..., M, S, 3) m, rcs (..., S), (..., M, S) or (S,) m^2 -> (..., M, R) complex, free of
    noise; complex64, and complex128 after ``.double()``. Differentiable with respect to both.

    Attributes:
        truncation: expected relative error of the norm for one path due to ``near_bins``: the square root of the
            fraction of the window's energy in the other bins, averaged over fractions of a bin. 0 for all bins.

    Raises:
        TensorsimError: ``near_bins`` or ``energy_stride`` below 1, an echo with several antennas or a wall with
            incidence ``"airy"``; see :class:`~tensorsim.radar.EchoSynthesizer`.
    """

    table: Tensor
    bin_cycles: Tensor

    def __init__(
        self,
        echo: EchoSynthesizer,
        profile: RangeProfile,
        near_bins: int | None = None,
        energy_stride: int = 1,
    ) -> None:
        super().__init__()
        self.energy_stride = check_count(energy_stride, "energy_stride")
        if near_bins is not None:
            check_count(near_bins, "near_bins")
        if echo.paths.airy or echo.paths.has_array:
            raise TensorsimError(
                "echo: got a wall with incidence 'airy' or several antennas, expected one antenna of each kind and "
                "paths that are pure tones; engine 'time' supports the others"
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
        self.register_buffer("table", table, persistent=False)
        bins = torch.arange(profile.first_bin, profile.last_bin + 1, dtype=torch.float64)
        cycles = torch.remainder(-bins * ((samples - 1) / (2 * samples)), 1.0)
        self.register_buffer("bin_cycles", cycles, persistent=False)

    @staticmethod
    @torch.jit.unused
    def _total(window: Tensor) -> float:
        return float(window.shape[0] * window.double().square().sum())

    @staticmethod
    @torch.jit.unused
    def _energy(table: Tensor) -> float:
        """Energy of all columns, averaged over fractions f of a bin."""
        fraction = (torch.arange(64, dtype=torch.float64) + 0.5) / 64 - 0.5
        return float(torch.matmul(chebyshev(2 * fraction, table.shape[0]), table).square().sum(-1).mean())

    @torch.jit.export
    def tones(self, positions: Tensor, rcs: Tensor) -> tuple[Tensor, Tensor]:
        """Beat bins and amplitudes of the P paths, without input checks: (..., S, 3) m, (..., S) m^2 -> (..., P)."""
        paths = self.echo.paths(positions.double(), rcs.double(), None)
        return self._tones(paths.delay_s.flatten(-2), paths.gain.flatten(-2))

    def _tones(self, delay_s: Tensor, gain: Tensor) -> tuple[Tensor, Tensor]:
        return mid_chirp_tones(
            delay_s,
            gain,
            self.echo.carrier_hz,
            self.echo.slope_hz_per_s,
            self.echo.sample_rate_hz,
            self.profile.samples,
            self.echo.fine.dtype,
        )

    @torch.jit.export
    def bins(self, beat: Tensor, strength: Tensor) -> Tensor:
        """Profiles (..., R) of :meth:`tones` (..., P)."""
        real = self.echo.fine.dtype
        terms = self.terms_float64 if real == torch.float64 else self.terms_float32
        table = self.table[:terms].to(real)
        ring = bin_sum(beat.flatten(0, -2), strength.flatten(0, -2), self.profile.samples, table)
        bins = ring[:, self.profile.first_bin : self.profile.last_bin + 1] * phasor(self.bin_cycles).to(
            ring.dtype
        )
        return bins.unflatten(0, list(beat.shape[:-1]))

    @torch.jit.export
    def energy(self, beat: Tensor, strength: Tensor, total: bool) -> Tensor:
        """Energy (..., m) over the N samples of :meth:`tones` (..., m, P); ``total`` adds the static paths to them."""
        if self.energy_stride == 1:
            return self._energy_of(beat, strength, total)
        chosen = torch.arange(0, beat.shape[-2], self.energy_stride, device=beat.device)
        some = self._energy_of(beat.index_select(-2, chosen), strength.index_select(-2, chosen), total)
        return some.repeat_interleave(self.energy_stride, -1)[..., : beat.shape[-2]]

    def _energy_of(self, beat: Tensor, strength: Tensor, total: bool) -> Tensor:
        if total:
            static = self.echo.paths.static()
            fixed = self._tones(static.delay_s, static.gain)
            lead = list(beat.shape[:-1]) + [-1]  # noqa: RUF005 (TorchScript)
            beat = torch.cat((beat, fixed[0].expand(lead)), -1)
            strength = torch.cat((strength, fixed[1].expand(lead)), -1)
        samples = self.profile.samples
        if beat.shape[-1] ** 2 <= 16 * samples:
            return tone_energy(beat, strength, samples)
        # For many tones the sum over samples is faster than the sum over pairs.
        start = beat * (-(samples - 1) / (2 * samples))
        first = strength * phasor((start - start.round()).to(self.echo.fine.dtype))
        sums = tone_sum(first, beat / samples, self.echo.coarse, self.echo.fine)[..., :samples]
        return energy(sums.unsqueeze(-2))

    @torch.jit.export
    def static_bins(self) -> Tensor:
        """Profile (R,) of the static paths, leakage and wall echo."""
        return self.profile(self.echo.static_echo().unsqueeze(0))[0]

    def forward(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """(..., M, S, 3) metres and (..., S) or (..., M, S) m^2 to profiles (..., M, R)."""
        rcs = check_scene(positions, rcs).flatten(0, -2)
        pulses = positions.flatten(0, -3)
        static = self.static_bins()
        chunks: list[Tensor] = []
        for start in range(0, pulses.shape[0], self.echo.pulse_chunk):
            stop = start + self.echo.pulse_chunk
            beat, strength = self.tones(pulses[start:stop], rcs[start:stop])
            chunks.append(self.bins(beat, strength) + static)
        return torch.cat(chunks).unflatten(0, list(positions.shape[:-2]))

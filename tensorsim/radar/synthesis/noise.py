"""Receiver noise: complex white Gaussian, set by a signal-to-noise ratio or by the noise temperature."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_choice, check_complex_map, check_positive
from tensorsim.limits import check_range
from tensorsim.ops import safe_sqrt

BOLTZMANN_J_PER_K = 1.380649e-23
REFERENCE_TEMPERATURE_K = 290.0


def energy(signal: Tensor) -> Tensor:
    """Sum of ``|IF|^2`` over pulses and samples: (..., M, N) complex -> (...)."""
    parts = torch.view_as_real(signal).flatten(-3)
    return torch.linalg.vecdot(parts, parts)


def mean_power(signal: Tensor) -> Tensor:
    """Mean of ``|IF|^2`` over pulses and samples: (..., M, N) complex -> (...)."""
    return energy(signal) / (signal.shape[-2] * signal.shape[-1])


def decibels(signal_power: Tensor, noise_power: Tensor) -> Tensor:
    """``10 log10(signal / noise)``; +inf without noise, -inf without signal."""
    ratio = 10.0 * torch.log10(signal_power / noise_power)
    return torch.where(noise_power > 0, ratio, torch.full_like(ratio, float("inf")))


class ProfileNoise(nn.Module):
    """Receiver noise in range profiles, drawn in the range bins: without IF and Fourier transform.

    White noise of variance v in the N samples of a pulse is white noise of variance N v in the N bins. A window w
    convolves it circularly with ``W(m) / N``, where W is the transform of the window. Few values of W matter: three
    for Hamming and Hann, five for Blackman, one without a window. The others, less than 1e-4 of the energy, are left
    out. Phases are referred to sample N / 2.

    Args:
        window: (N,) over fast time, symmetric.

    Shapes: like (B, R, M) complex, noise power per IF sample (B,) -> noise (B, R, M) in R neighbouring bins, and the
        energy (B,) that this realisation would have in N samples. Differentiable with respect to the power.
    """

    taps: list[float]

    def __init__(self, window: Tensor) -> None:
        super().__init__()
        self.samples = window.shape[0]
        lag = torch.arange(self.samples, dtype=torch.float64)
        mid_chirp = torch.polar(torch.ones_like(lag), math.pi * lag * (self.samples - 1) / self.samples)
        taps = (torch.fft.fft(window.double()) * mid_chirp).real * (1 - 2 * torch.remainder(lag, 2))
        share = taps.square() / (window.double().square().sum() * self.samples)
        reach = 0
        while float(share[0] + 2 * share[1 : reach + 1].sum()) < 1 - 1e-4:
            reach += 1
        self.taps = (taps[: reach + 1] / math.sqrt(self.samples)).tolist()

    def forward(self, like: Tensor, power: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        reach = len(self.taps) - 1
        bins = like.shape[1]
        shape = [like.shape[0], bins + 2 * reach, like.shape[2]]
        white = torch.randn(shape, dtype=like.dtype, device=like.device)
        parts = torch.view_as_real(white)
        noise = parts[:, reach : reach + bins]
        for lag in range(1, reach + 1):
            pair = parts[:, reach - lag : reach - lag + bins] + parts[:, reach + lag : reach + lag + bins]
            noise = torch.add(noise, pair, alpha=self.taps[lag] / self.taps[0])
        drawn = energy(white).to(power.dtype) * power * (self.samples / shape[1])
        deviation = self.taps[0] * safe_sqrt(power.to(noise.dtype))[:, None, None, None]
        return torch.view_as_complex(noise * deviation), drawn


class ReceiverNoise(nn.Module):
    r"""Adds complex white Gaussian noise to IF samples.

    Its power per sample is that of the reference, averaged over the clip, divided by the signal-to-noise ratio:

    $$ P_n = P_s \, 10^{-\mathrm{SNR} / 10} $$

    The noise is drawn from PyTorch's global generator; ``torch.manual_seed`` makes it reproducible.

    Args:
        snr_db: signal-to-noise ratio per IF sample, both powers averaged over the clip; None adds no noise.
        reference: the signal in the ratio: ``"echo"``, the echo of the targets; ``"total"``, the whole IF,
            including leakage and wall echo. ``"absolute"`` sets the noise power to $k T_0 B F / P_t$ (IF
            samples are for transmit power 1) and ignores ``snr_db``.
        empty_power: signal power assumed for a clip whose signal is exactly zero, so that an empty scene has a
            noise floor.
        bandwidth_hz: $B$ for ``"absolute"``: the sample rate of the complex IF.
        noise_figure_db: $F$ for ``"absolute"``.
        transmit_power_w: $P_t$ for ``"absolute"``.

    Shapes: IF (..., M, N) complex, optionally the target echo in it, of the same shape -> IF with noise.
        Without the target echo the whole IF is the reference. One noise power per clip. Differentiable: the noise
        scales with its reference.

    Raises:
        TensorsimError: unknown reference, numbers that are not finite or positive, a real IF, shapes that
            differ.
    """

    def __init__(
        self,
        snr_db: float | None = 50.0,
        reference: str = "echo",
        empty_power: float = 0.0,
        bandwidth_hz: float = 10e6,
        noise_figure_db: float = 10.0,
        transmit_power_w: float = 0.01,
    ) -> None:
        super().__init__()
        check_choice(reference, ("echo", "total", "absolute"), "reference")
        if snr_db is not None:
            check_range(snr_db, "ratio of powers", "snr_db")
        check_range(noise_figure_db, "ratio of powers", "noise_figure_db")
        if not (is_finite(empty_power) and empty_power >= 0):
            raise TensorsimError(f"empty_power: got {empty_power}, expected a finite power >= 0")
        check_positive(bandwidth_hz, "bandwidth_hz")
        check_positive(transmit_power_w, "transmit_power_w")
        thermal = BOLTZMANN_J_PER_K * REFERENCE_TEMPERATURE_K * bandwidth_hz * 10 ** (noise_figure_db / 10)
        self.reference = reference
        self.absolute_power = float(thermal / transmit_power_w)
        self.empty_power = float(empty_power)
        self.noiseless = snr_db is None and reference != "absolute"
        self.noise_per_signal = 0.0 if snr_db is None else 10 ** (-snr_db / 10)

    @torch.jit.export
    def noise_power(self, signal_power: Tensor) -> Tensor:
        """Variance of the complex noise for this power of the reference signal, both (...)."""
        if self.reference == "absolute":
            return torch.full_like(signal_power, self.absolute_power)
        return torch.where(signal_power > 0, signal_power, self.empty_power) * self.noise_per_signal

    @torch.jit.export
    def draw(self, like: Tensor, noise_power: Tensor) -> Tensor:
        """Noise in the shape of ``like`` (..., M, N) with this variance (...)."""
        parts = torch.view_as_real(torch.randn_like(like))
        # Without echo there is no noise: the gradients of the other clips stay finite.
        deviation = safe_sqrt(noise_power.to(parts.dtype))[..., None, None, None]
        return torch.view_as_complex(parts * deviation)

    @torch.jit.export
    def realised_snr_db(self, clean: Tensor, noisy: Tensor, target_echo: Tensor | None = None) -> Tensor:
        """Ratio (...) in dB of the reference signal to this realisation of the noise; +inf without noise."""
        signal = clean if target_echo is None or self.reference == "total" else target_echo
        return decibels(mean_power(signal), mean_power(noisy - clean))

    def forward(self, intermediate: Tensor, target_echo: Tensor | None = None) -> Tensor:
        """IF (..., M, N) complex and the target echo in it to IF with noise."""
        check_complex_map(intermediate, "IF", "(..., pulses, samples)")
        signal = intermediate
        if target_echo is not None:
            if target_echo.shape != intermediate.shape or target_echo.dtype != intermediate.dtype:
                raise TensorsimError(
                    f"target_echo: got {list(target_echo.shape)} {target_echo.dtype}, expected "
                    f"{list(intermediate.shape)} {intermediate.dtype} like the IF"
                )
            if self.reference != "total":
                signal = target_echo
        if self.noiseless:
            return intermediate
        return intermediate + self.draw(intermediate, self.noise_power(mean_power(signal)))

"""The dechirped signal: the intermediate frequency (IF) of an FMCW radar as a sum over propagation paths.

:func:`intermediate_frequency` is the formula. The other functions compute the same sum fast: phases are wrapped to
one cycle in float64, and the exponentials of the samples of a pulse are factorised.
"""

import math

import torch
from torch import Tensor

from tensorsim.radar.synthesis.paths import Paths, Resonance


def intermediate_frequency(
    delay_s: Tensor, amplitude: Tensor, carrier_hz: float, slope_hz_per_s: float, time_s: Tensor
) -> Tensor:
    r"""Dechirp: the transmitted chirp times the conjugate of the received sum of its delayed copies.

    With the instantaneous frequency $f(t) = f_c + \mu t$, and delays $\tau_p$ and amplitudes $a_p$ of the paths:

    $$ \mathrm{IF}(t) = \sum_p a_p^* \exp\left(+j 2 \pi \left(f_c \tau_p + \mu \tau_p t - \frac{\mu \tau_p^2}{2}
    \right)\right) $$

    so the beat frequency $\mu \tau$ is positive and the phase of an approaching target decreases. See Jankiraman,
    *FMCW Radar Design*, ch. 2; sign and $\mu \tau^2 / 2$ follow from the mixing product. This evaluates every
    exponential, in float64; :class:`~tensorsim.radar.EchoSynthesizer` computes the same sum faster.

    Args:
        delay_s: (..., P) $\tau$ of P paths, seconds.
        amplitude: (..., P) $a$ of the received wave, real or complex; a phase of a wall or a floor is part of it.
        carrier_hz: $f_c$, the frequency at the start of the sweep.
        slope_hz_per_s: $\mu$, bandwidth over chirp duration.
        time_s: (N,) $t$, seconds after the start of the chirp.

    Returns:
        (..., N) complex128. Differentiable.

    Inputs are not checked; torch raises RuntimeError for shapes that do not fit.
    """
    tau, t = delay_s.double().unsqueeze(-1), time_s.double()
    cycles = carrier_hz * tau + slope_hz_per_s * tau * t - 0.5 * slope_hz_per_s * tau.square()
    conjugate = amplitude.to(torch.complex128).conj().unsqueeze(-1)
    return (conjugate * phasor(cycles)).sum(-2)


def phasor(cycles: Tensor) -> Tensor:
    """``exp(j 2 pi cycles)`` as complex, elementwise."""
    angle = cycles * (2 * math.pi)
    return torch.complex(angle.cos(), angle.sin())


def tones(step: Tensor, count: int, first: Tensor | None = None) -> Tensor:
    """``first exp(j 2 pi step n)`` for n = 0, ..., count - 1: (...) cycles and (...) complex, or 1 -> (count, ...).

    Uses products instead of exponentials: the first Q values times ``exp(j 2 pi step Q)`` are the next Q.
    """
    turn = phasor(step)
    head = torch.ones_like(turn) if first is None else first
    if head.requires_grad or turn.requires_grad:
        table = head.unsqueeze(0)
        while table.shape[0] < count:
            table = torch.cat((table, table[: count - table.shape[0]] * turn))
            turn = turn * turn
        return table
    # Without gradients each product is written to its place.
    table = turn.new_empty([count] + list(turn.shape))  # noqa: RUF005 (TorchScript)
    table[0] = head
    done = 1
    while done < count:
        more = min(done, count - done)
        torch.mul(table[:more], turn, out=table[done : done + more])
        turn = turn * turn
        done += more
    return table


def tone_sum(first: Tensor, step: Tensor, coarse: Tensor, fine: Tensor) -> Tensor:
    """Sum over P tones of ``first exp(j 2 pi step n)`` for n = 0, 1, ..., N1 Q - 1.

    The exponential factors over ``n = Q n1 + n2``, so the sum is a product of two small matrices per pulse
    instead of N exponentials per tone.

    Args:
        first: (L, P) complex, value of each tone at n = 0.
        step: (L, P) float64 cycles per sample; wrapped to one cycle before the cast to the precision of ``fine``.
        coarse: (N1,) 0, 1, ..., N1 - 1 in the real precision of the result.
        fine: (Q,) 0, 1, ..., Q - 1 likewise.

    Returns:
        (L, N1 * Q) complex.
    """
    stride = step * fine.shape[0]
    step = (step - step.round()).to(fine.dtype)
    stride = (stride - stride.round()).to(fine.dtype)
    right = tones(step, fine.shape[0])  # (Q, L, P)
    left = tones(stride, coarse.shape[0], first)  # (N1, L, P)
    return torch.matmul(left.movedim(0, -2), right.movedim(0, -1)).flatten(-2)


def beat_sum(
    delay_s: Tensor,
    gain: Tensor,
    carrier_hz: float,
    slope_hz_per_s: float,
    sample_rate_hz: float,
    coarse: Tensor,
    fine: Tensor,
) -> Tensor:
    """:func:`intermediate_frequency` at the samples ``t = n / fs``, n = 0, 1, ..., in the precision of ``fine``.

    Phases are wrapped to one cycle in float64 before they are cast: a float32 phase at 77 GHz would have an error
    of -60 dB.

    Args:
        delay_s: (L, P) float64.
        gain: (L, P) complex128, conjugate of the amplitude of the received wave.
        carrier_hz: fc, the start of the sweep.
        slope_hz_per_s: mu.
        sample_rate_hz: fs.
        coarse, fine: see :func:`tone_sum`.

    Returns:
        (L, N1 * Q) complex.
    """
    start = carrier_hz * delay_s - 0.5 * slope_hz_per_s * delay_s.square()
    first = phasor((start - start.round()).to(fine.dtype))
    first = first * gain.to(first.dtype)
    return tone_sum(first, slope_hz_per_s / sample_rate_hz * delay_s, coarse, fine)


def dispersed_sum(
    paths: Paths,
    resonance: Resonance,
    carrier_hz: float,
    slope_hz_per_s: float,
    time_s: Tensor,
    attenuates: bool = True,
) -> Tensor:
    """:func:`beat_sum` of paths whose gain depends on the frequency of the sweep: (..., S, P) -> (..., N).

    The wave that arrives at ``t_n`` has the frequency ``f = fc + mu (t_n - tau)``, and each leg multiplies it
    by ``T(f) / T_0(fc) = exp(-alpha d (f / fc - 1)) / (1 - G^2 exp(-2 alpha d f / fc - j 2 pi f t))``: the
    closed sum of all internal bounces over the straight passage, t the delay of a pair. The phase of the straight
    passage is in ``tau`` and not in this factor. The delay ``k t`` of the k-th bounce enters through the frequency
    alone, which leaves out ``mu (k t)^2 / 2`` cycles (2e-4 for the default wall). Where the wall does not attenuate,
    the straight passage loses nothing at any frequency.
    """
    echo = paths.gain.new_zeros(list(paths.gain.shape[:-2]) + list(time_s.shape))
    for s in range(paths.gain.shape[-2]):  # all scatterers at once would need S P N complex numbers per pulse
        delay = paths.delay_s[..., s, :, None]
        cycles = carrier_hz * delay + slope_hz_per_s * delay * (time_s - 0.5 * delay)
        frequency = (carrier_hz + slope_hz_per_s * (time_s - delay)).unsqueeze(-2)  # (..., P, 1, N)
        relative = frequency / carrier_hz
        neper, bounce = resonance.loss_neper[..., s, :, :, None], resonance.bounce_s[..., s, :, :, None]
        turn = torch.polar(torch.exp(-2 * neper * relative), -2 * math.pi * bounce * frequency)
        leg = 1 / (1 - resonance.square[..., s, :, :, None] * turn)
        if attenuates:
            leg = leg * torch.exp(-neper * (relative - 1))
        factor = (leg[..., 0, :] * leg[..., 1, :]).conj() * paths.gain[..., s, :, None]
        echo = echo + (phasor(cycles - cycles.round()) * factor).sum(-2)
    return echo

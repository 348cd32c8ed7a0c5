"""Receiver effects on the IF: I/Q imbalance, DC offset, one channel instead of two, and a converter with few bits.

See Razavi, *RF Microelectronics*, 2nd ed., ch. 4, and Widrow and Kollar, *Quantization Noise*. All act on each sample
separately, so a clip may be processed in pieces.
"""

import cmath
import math

import torch
from torch import Tensor, nn

from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_complex_map, check_count, check_positive


class QuadratureImbalance(nn.Module):
    """Scales Q relative to I and turns it by an angle (I/Q imbalance): an image at the negative frequency.

    ``y = a x + b conj(x)`` with ``a = (1 + g exp(-j phi)) / 2``, ``b = (1 - g exp(j phi)) / 2``. In a continuous-wave
    radar the image is at the opposite Doppler; with a sweep it is at the negative beat. For a target within the range
    profile that is outside the profile; for one whose beat is above half the sample rate it is inside, at the opposite
    Doppler.

    Args:
        gain_db: g, gain of Q over I.
        phase_rad: phi, deviation of I and Q from a phase difference of 90 degrees.

    Shapes: IF (..., M, N) complex -> likewise. Differentiable.

    Attributes:
        image_rejection_db: power of a tone over that of its image,
            ``(1 + 2 g cos phi + g^2) / (1 - 2 g cos phi + g^2)``.

    Raises:
        TensorsimError: numbers that are not finite, an IF that is not complex.
    """

    def __init__(self, gain_db: float = 0.5, phase_rad: float = math.radians(2.0)) -> None:
        super().__init__()
        if not (is_finite(gain_db) and is_finite(phase_rad)):
            raise TensorsimError(
                f"gain_db, phase_rad: got {gain_db} and {phase_rad}, expected finite numbers"
            )
        gain = 10 ** (gain_db / 20)
        self.direct = complex(1 + gain * cmath.exp(-1j * phase_rad)) / 2
        self.image = complex(1 - gain * cmath.exp(1j * phase_rad)) / 2
        self.image_rejection_db = (
            math.inf if self.image == 0 else 20 * math.log10(abs(self.direct) / abs(self.image))
        )

    def forward(self, intermediate: Tensor) -> Tensor:
        """IF to IF with an image."""
        check_complex_map(intermediate, "IF", "(..., pulses, samples)")
        return self.direct * intermediate + self.image * intermediate.conj()


class DcOffset(nn.Module):
    """Adds a constant to the IF, as mixers and amplifiers do: a line at zero beat and zero Doppler.

    Args:
        offset: complex, in the unit of the IF (amplitude for transmit power 1).

    Shapes: IF (..., M, N) complex -> likewise. Differentiable.

    Raises:
        TensorsimError: an offset that is not finite, an IF that is not complex.
    """

    def __init__(self, offset: complex) -> None:
        super().__init__()
        self.offset = complex(offset)
        if not cmath.isfinite(self.offset):
            raise TensorsimError(f"offset: got {offset}, expected a finite complex number")

    def forward(self, intermediate: Tensor) -> Tensor:
        """IF to IF with an offset."""
        check_complex_map(intermediate, "IF", "(..., pulses, samples)")
        return intermediate + self.offset


class RealReceiver(nn.Module):
    """Keeps only I. Spectra are mirror-symmetric: ``(x + conj x) / 2`` has the wave and its image at half amplitude.

    A continuous-wave radar then cannot tell approaching from receding. With a sweep the image is at the negative
    beat, outside the range profile; a target whose beat is above half the sample rate appears only as its image, too
    near and at the opposite Doppler. The signal-to-noise ratio of the samples does not change; in a range bin it falls
    by 3 dB, since the noise of the negative beats is added.

    Shapes: IF (..., M, N) complex -> likewise, with imaginary part 0. Differentiable.

    Raises:
        TensorsimError: an IF that is not complex.
    """

    def forward(self, intermediate: Tensor) -> Tensor:
        """IF to its real part."""
        check_complex_map(intermediate, "IF", "(..., pulses, samples)")
        in_phase = torch.real(intermediate)
        return torch.complex(in_phase, torch.zeros_like(in_phase))


def quantise(intermediate: Tensor, full_scale: Tensor, bits: int) -> Tensor:
    """Mid-rise quantisation and clipping of I and Q.

    Levels are odd multiples of half a step, ``step = 2 full_scale / 2^bits``.

    Args:
        intermediate: (..., M, N) complex.
        full_scale: (...) largest value of I or Q; where it is 0, the result is 0.
        bits: number of bits per channel.

    Returns:
        (..., M, N) complex. The gradient is that of clipping: the steps have none.
    """
    parts = torch.view_as_real(intermediate.resolve_conj())
    step = (2 * full_scale / 2**bits).to(parts.dtype)[..., None, None, None]
    highest = step * (2 ** (bits - 1) - 0.5)
    parts = torch.minimum(torch.maximum(parts, -highest), highest)
    levels = (torch.floor(parts / torch.where(step > 0, step, 1.0)) + 0.5) * step
    rounding = torch.minimum(torch.maximum(levels, -highest), highest) - parts
    return torch.view_as_complex(parts + rounding.detach())


class Converter(nn.Module):
    """Quantises I and Q to a number of bits and clips them (an analogue-to-digital converter for each).

    See :func:`quantise`. For a signal that spans many steps the quantisation noise is ``step^2 / 12`` per channel; a
    full-scale tone has a signal-to-noise ratio of 6.02 bits + 1.76 dB.

    Args:
        bits: 1 to 24.
        full_scale: largest value of I or Q in the unit of the IF (amplitude for transmit power 1); beyond it the
            converter saturates.

    Shapes: IF (..., M, N) complex -> likewise. The gradient is that of clipping: the steps have none.

    Raises:
        TensorsimError: bits out of range, a full scale that is not positive, an IF that is not complex.
    """

    def __init__(self, bits: int, full_scale: float) -> None:
        super().__init__()
        check_count(bits, "bits", 1, 24)
        check_positive(full_scale, "full_scale")
        self.bits, self.full_scale = bits, float(full_scale)

    def forward(self, intermediate: Tensor) -> Tensor:
        """IF to IF on the converter's levels."""
        check_complex_map(intermediate, "IF", "(..., pulses, samples)")
        full_scale = torch.full(
            intermediate.shape[:-2], self.full_scale, dtype=torch.float64, device=intermediate.device
        )
        return quantise(intermediate, full_scale, self.bits)

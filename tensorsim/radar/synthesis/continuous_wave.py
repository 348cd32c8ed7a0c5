"""Echoes received by a continuous-wave radar: no range, one complex number at each instant."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import SPEED_OF_LIGHT_M_S, Vector
from tensorsim.errors import check_positive, check_scene
from tensorsim.limits import check_range
from tensorsim.motion.scatterers import check_antenna
from tensorsim.radar.synthesis.dechirp import phasor
from tensorsim.radar.synthesis.legs import leg_length
from tensorsim.radar.synthesis.paths import radar_equation_amplitude


def continuous_wave(path_m: Tensor, amplitude: Tensor, wavelength_m: float) -> Tensor:
    """``sum over scatterers of a exp(+j 2 pi R / lambda)``, transmitted times conjugate received wave.

    Args:
        path_m: (..., S) float64 R, from the transmitter via the scatterer to the receiver.
        amplitude: (..., S) a.
        wavelength_m: lambda.

    Returns:
        (...) complex in the precision of ``amplitude``; the phase of an approaching target decreases.
    """
    cycles = path_m / wavelength_m
    # Whole cycles are removed in float64: a phase in float32 would leave a floor near -60 dB.
    return (amplitude * phasor((cycles - cycles.round()).to(amplitude.dtype))).sum(-1)


class ContinuousWaveEcho(nn.Module):
    """Noise-free baseband signal of a scene, as a continuous-wave radar receives it.

    Equals the first sample of each pulse of :class:`~tensorsim.radar.EchoSynthesizer` with the same carrier and
    antennas in free space, except for the residual video phase of a sweep, ``mu tau^2 / 2`` cycles. The instants are
    those of the positions and need not be evenly spaced.

    Args:
        carrier_hz: transmitted frequency.
        tx_m, rx_m: positions of transmitter and receiver in metres.
        antenna_gain_dbi: gain of each antenna, the same in all directions.

    Shapes: positions (..., M, S, 3) m and rcs (..., S), (..., M, S) or (S,) m^2 -> (..., M) complex64, or complex128
    after ``.double()``. Differentiable with respect to both.

    Raises:
        TensorsimError: a carrier that is not positive, an antenna without three finite numbers, an implausible
            gain, shapes that do not match.
    """

    tx: Tensor
    rx: Tensor
    precision: Tensor

    def __init__(self, carrier_hz: float, tx_m: Vector, rx_m: Vector, antenna_gain_dbi: float = 0.0) -> None:
        super().__init__()
        check_positive(carrier_hz, "carrier_hz")
        check_antenna("tx_m", tx_m)
        check_antenna("rx_m", rx_m)
        check_range(antenna_gain_dbi, "gain", "antenna_gain_dbi")
        self.wavelength_m = SPEED_OF_LIGHT_M_S / carrier_hz
        self.gain = 10 ** (antenna_gain_dbi / 10)
        self.register_buffer("tx", torch.tensor(tx_m, dtype=torch.float64), persistent=False)
        self.register_buffer("rx", torch.tensor(rx_m, dtype=torch.float64), persistent=False)
        self.register_buffer("precision", torch.zeros(()), persistent=False)

    def forward(self, positions: Tensor, rcs: Tensor) -> Tensor:
        """Scatterers (..., M, S, 3) m with (..., M, S) m^2 to the baseband signal (..., M)."""
        rcs = check_scene(positions, rcs)
        shortest_m = self.wavelength_m / (4 * math.pi)  # as elsewhere: the radar equation does not hold below
        there = leg_length(positions.double(), self.tx.double(), shortest_m)
        back = leg_length(positions.double(), self.rx.double(), shortest_m)
        amplitude = radar_equation_amplitude(
            rcs.double(), there, back, self.wavelength_m, self.gain, self.gain
        )
        return continuous_wave(there + back, amplitude.to(self.precision.dtype), self.wavelength_m)

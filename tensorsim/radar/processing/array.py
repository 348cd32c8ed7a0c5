"""Angle of arrival: range-angle and azimuth-time maps of the channels of an array.

A plane wave from the unit direction u reaches channel v, with transmitter at p and receiver at q, earlier than the
origin by ``u . (p + q) / c``. Its beat signal has the phase ``-2 pi u . (p + q) / lambda``: the virtual element is
at ``p + q``. Maps are those of the conventional (Bartlett) beamformer ``w^H C w`` with the
steering vector w and the covariance C of the channels (Van Trees, *Optimum Array Processing*, ch. 6).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.config.checks import is_finite
from tensorsim.errors import TensorsimError, check_not_empty, check_tensor
from tensorsim.ops import safe_sqrt
from tensorsim.protocols import check_instance
from tensorsim.radar.synthesis.dechirp import phasor


class AngleMaps(NamedTuple):
    """Magnitude over azimuth; for a single plane wave, that of one channel.

    Attributes:
        range_angle: (..., R, D) for D azimuths, root mean square over pulses.
        azimuth_time: (..., D, M), root of the sum of squares over range bins.
    """

    range_angle: Tensor
    azimuth_time: Tensor


def virtual_elements(radar: RadarConfig) -> Tensor:
    """Positions ``p + q`` (V, 3) in metres, float64, of the channels ``v = k A + a`` of an array."""
    tx = torch.tensor(radar.tx_positions_m, dtype=torch.float64)
    rx = torch.tensor(radar.rx_positions_m, dtype=torch.float64)
    return (tx[:, None] + rx).flatten(0, 1)


def row_spacing_m(radar: RadarConfig) -> float:
    """Spacing of the virtual elements of a uniform row along x; half a wavelength for a single element.

    Raises:
        TensorsimError: an array that is not a uniform row along x, from left to right.
    """
    elements = virtual_elements(radar)
    if len(elements) == 1:
        return radar.doppler_wavelength_m / 2
    steps = elements.diff(dim=0)
    step_m = float(steps[0, 0])
    if step_m <= 0 or bool((steps - steps.new_tensor([step_m, 0.0, 0.0])).abs().max() > 1e-6):
        raise TensorsimError(
            f"radar: got virtual elements at {[[round(v, 5) for v in place] for place in elements.tolist()]} m, "
            "expected an evenly spaced row along x, from left to right"
        )
    return step_m


def steering_vectors(
    channels_m: Tensor, azimuth_rad: Tensor, elevation_rad: float, wavelength_m: float
) -> Tensor:
    """Phase in cycles (D, V) of the beat signal of virtual elements (V, 3) for plane waves from D azimuths."""
    level = math.cos(elevation_rad)
    height = torch.full_like(azimuth_rad, math.sin(elevation_rad))
    direction = torch.stack((azimuth_rad.sin() * level, azimuth_rad.cos() * level, height), -1)
    return -(direction @ channels_m.T) / wavelength_m


def array_steering(radar: RadarConfig, azimuth_rad: Tensor, elevation_rad: float) -> Tensor:
    """:func:`steering_vectors` (D, V) of the channels of a radar, minus whole cycles.

    Raises:
        TensorsimError: azimuths that are not a finite vector, an elevation that is not finite.
    """
    azimuth = torch.as_tensor(azimuth_rad).double()
    if azimuth.dim() != 1 or azimuth.numel() == 0 or not bool(torch.isfinite(azimuth).all()):
        raise TensorsimError(f"azimuth_rad: got shape {list(azimuth.shape)}, expected (D,) finite angles")
    if not is_finite(elevation_rad):
        raise TensorsimError(f"elevation_rad: got {elevation_rad}, expected a finite angle")
    cycles = steering_vectors(virtual_elements(radar), azimuth, elevation_rad, radar.doppler_wavelength_m)
    return cycles - cycles.round()


def beam_weights(cycles: Tensor, dtype: torch.dtype) -> Tensor:
    """Complex weights (D, V) of the conventional beamformer, from steering phases (D, V)."""
    return phasor(cycles).to(dtype) / cycles.shape[1]


def beam_power(profiles: Tensor, cycles: Tensor) -> Tensor:
    """``w^H C w`` of channels (..., V, X, Y) with steering phases (D, V): mean over Y -> (..., D, X)."""
    weights = beam_weights(cycles, profiles.dtype)
    series = profiles.movedim(-3, -2)  # (..., X, V, Y)
    covariance = torch.matmul(series, series.mH) / series.shape[-1]
    power = (torch.matmul(weights.conj(), covariance) * weights).sum(-1).real  # (..., X, D)
    return power.clamp_min(0.0).transpose(-1, -2)


def align_transmitters(profiles: Tensor, transmitters: int) -> Tensor:
    """Time alignment of profiles (..., V, M, R) of K transmitters that fire in turn (TDM).

    Transmitter k samples the motion k / K of a pulse interval later than the first; an angle estimator would mistake
    the phase of this motion for a direction. A linear phase over Doppler, ``exp(-j 2 pi f k / K)`` for f in [-1/2, 1/2)
    cycles per interval, shifts its pulses to the start of the interval, for Doppler up to PRF / 2. About six pulses at
    either end stay wrong, because the transform is periodic; range migration within an interval is not corrected.
    Differentiable.

    Raises:
        TensorsimError: empty or real profiles, or a number of channels that is not a multiple of the transmitters.
    """
    check_tensor(profiles, "profiles", "(..., channels, pulses, range bins)", "complex", finite=False)
    check_not_empty(profiles, "profiles")
    channels = profiles.shape[-3]
    if transmitters < 1 or channels % transmitters != 0:
        raise TensorsimError(
            f"profiles: got {channels} channels for {transmitters} transmitters, expected a multiple of them"
        )
    doppler = torch.fft.fftfreq(profiles.shape[-2], dtype=torch.float64, device=profiles.device)
    turn = torch.arange(channels, device=profiles.device) // (channels // transmitters)
    angle = (-2 * math.pi / transmitters) * turn.unsqueeze(-1) * doppler
    shift = torch.polar(torch.ones_like(angle), angle).to(profiles.dtype).unsqueeze(-1)
    return torch.fft.ifft(torch.fft.fft(profiles, dim=-2) * shift, dim=-2)


class AngleMapper(nn.Module):
    """Range-angle and azimuth-time maps of range profiles.

    Args:
        radar: the array; its channels in the order of the echo, ``v = k A + a``.
        azimuth_rad: (D,) directions; 0 is +y, positive is to the right (+x).
        elevation_rad: elevation of all of them.

    Shapes: profiles (..., V, M, R) complex -> :class:`AngleMaps`. Differentiable.

    The wavelength is that of the centre of the sweep, to which the phase of a range profile belongs. Waves are assumed
    plane: ranges must be much larger than ``aperture^2 / lambda``. For transmitters that fire in turn (TDM), motion at
    v m/s changes the phase between neighbours by ``4 pi v / (lambda K PRF)``, which is not corrected here: see
    :func:`align_transmitters`.

    Attributes:
        azimuth_rad: (D,).

    Raises:
        TensorsimError: a radar without an array; azimuths that are not a finite vector; profiles with another
            number of channels, empty or real ones.
    """

    azimuth_rad: Tensor
    cycles: Tensor

    def __init__(self, radar: RadarConfig, azimuth_rad: Tensor, elevation_rad: float = 0.0) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        if not radar.has_array:
            raise TensorsimError("radar: got one transmitter and one receiver, expected several: rx_m (A, 3)")
        self.register_buffer("cycles", array_steering(radar, azimuth_rad, elevation_rad), persistent=False)
        self.register_buffer("azimuth_rad", torch.as_tensor(azimuth_rad).double(), persistent=False)
        self.channels = self.cycles.shape[1]

    def forward(self, profiles: Tensor) -> AngleMaps:
        """(..., V, M, R) to range-angle (..., R, D) and azimuth-time (..., D, M)."""
        layout = f"(..., {self.channels} channels, pulses, range bins)"
        check_tensor(profiles, "profiles", layout, "complex")
        check_not_empty(profiles, "profiles")
        cycles = self.cycles.double()
        by_range = beam_power(profiles.transpose(-1, -2), cycles).transpose(-1, -2)
        by_pulse = beam_power(profiles, cycles) * profiles.shape[-1]
        return AngleMaps(safe_sqrt(by_range), safe_sqrt(by_pulse))

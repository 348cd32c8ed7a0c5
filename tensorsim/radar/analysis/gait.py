"""Tools for gait analysis: bulk Doppler compensation, and the cadence-velocity diagram."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import RadarConfig
from tensorsim.errors import (
    TensorsimError,
    check_complex_map,
    check_finite,
    check_floating,
    check_min_rank,
    check_not_empty,
    check_positive,
)
from tensorsim.protocols import check_instance


def path_of_speed(speed_m_s: Tensor, prf_hz: float) -> Tensor:
    """Change of range (..., M) m since the first pulse, from radial speeds (..., M) m/s, positive = approaching.

    Integrates by the trapezoidal rule in float64.
    """
    speed = speed_m_s.double()
    steps = (speed[..., 1:] + speed[..., :-1]) / (2 * prf_hz)
    return torch.nn.functional.pad(-steps.cumsum(-1), [1, 0])


class BulkDopplerCompensation(nn.Module):
    """Removes the motion of one point of the body, usually the torso, from range profiles.

    The phase of a target at range r is ``2 pi (fc + B/2) 2 r / c`` at mid-chirp (the centre of the sweep, as on the
    Doppler axis). Multiplication with its conjugate along the given path shifts that point to 0 Hz; limbs appear at
    their speed relative to it. With ``migration`` the range bins are shifted too, so that the point stays in the bin
    of the first pulse.

    Args:
        radar: the radar.
        migration: also shift the range bins: an inverse transform to N fast-time samples, a linear phase about
            mid-chirp, and a transform. Profiles do not contain negative ranges; these are taken as 0, which causes
            an error of about the sidelobe level of the range window for targets near range 0.

    Shapes: profiles (..., M, R) complex, range of the point (..., M) m, half the bistatic path; see
    :func:`path_of_speed` for a track of speeds -> (..., M, R) complex. Only changes of range matter. Differentiable
    with respect to both.

    Raises:
        TensorsimError: real profiles, a path of another length than the pulses, NaN.
    """

    def __init__(self, radar: RadarConfig, migration: bool = False) -> None:
        super().__init__()
        check_instance(radar, RadarConfig, "radar")
        self.migration = migration
        self.doppler_wavelength_m = radar.doppler_wavelength_m
        self.range_resolution_m = radar.range_resolution_m
        self.samples = radar.samples_per_chirp

    def forward(self, profiles: Tensor, range_m: Tensor) -> Tensor:
        """Profiles (..., M, R) and range (..., M) m to profiles (..., M, R)."""
        check_complex_map(profiles, "profiles", "(..., pulses, range bins)")
        check_floating(range_m, "range")
        check_finite(range_m, "range")
        if range_m.dim() < 1 or range_m.shape[-1] != profiles.shape[-2] or profiles.shape[-2] == 0:
            raise TensorsimError(
                f"range: got shape {list(range_m.shape)}, expected (..., {profiles.shape[-2]} pulses), at least one"
            )
        moved = range_m.double() - range_m.double()[..., :1]
        if self.migration:
            if profiles.shape[-1] > self.samples:
                raise TensorsimError(
                    f"profiles: got {profiles.shape[-1]} range bins, expected at most {self.samples}"
                )
            fast_time = torch.arange(self.samples, dtype=torch.float64, device=profiles.device)
            cycles = (fast_time - (self.samples - 1) / 2) * (
                moved.unsqueeze(-1) / (self.range_resolution_m * self.samples)
            )
            beat = torch.fft.ifft(profiles, self.samples) * self._unwind(cycles, profiles)
            profiles = torch.fft.fft(beat)[..., : profiles.shape[-1]]
        return profiles * self._unwind(2 * moved / self.doppler_wavelength_m, profiles).unsqueeze(-1)

    def _unwind(self, cycles: Tensor, like: Tensor) -> Tensor:
        """``exp(-j 2 pi cycles)``, wrapped to one cycle in float64."""
        angle = -2 * math.pi * (cycles - cycles.detach().round())
        return torch.polar(torch.ones_like(angle), angle).to(like.dtype)


class CadenceVelocityDiagram(nn.Module):
    """Cadence-velocity diagram ``|FFT over time of the map|``: modulation of each Doppler bin at each cadence.

    The mean over time of every Doppler bin is removed, so that constant components do not mask the modulation, and
    a periodic Hann window is applied to the clip (Bjorklund, Johansson and Petersson, IEEE RadarCon 2012).

    Args:
        frame_rate_hz: frames per second of the map, ``DopplerTimeMap.frame_rate_hz``.

    Shapes: map (..., F, K) -> (..., F, K // 2 + 1) magnitude; a bin modulated by ``a cos`` peaks at ``a K / 4``.
    Differentiable where it is not 0.

    Raises:
        TensorsimError: a frame rate that is not positive, an empty map, fewer than 2 frames, NaN.
    """

    def __init__(self, frame_rate_hz: float) -> None:
        super().__init__()
        check_positive(frame_rate_hz, "frame_rate_hz")
        self.frame_rate_hz = float(frame_rate_hz)

    @torch.jit.unused
    def cadence_hz(self, frames: int) -> Tensor:
        """Cadence (frames // 2 + 1,) of the columns in Hz, from 0."""
        return torch.fft.rfftfreq(frames, 1 / self.frame_rate_hz, dtype=torch.float64)

    def forward(self, doppler_time: Tensor) -> Tensor:
        """Map (..., F, K) to (..., F, K // 2 + 1)."""
        check_floating(doppler_time, "map")
        check_min_rank(doppler_time, 2, "map", "(..., Doppler bins, frames)")
        frames = doppler_time.shape[-1]
        if frames < 2:
            raise TensorsimError(f"map: got shape {list(doppler_time.shape)}, expected at least 2 frames")
        check_not_empty(doppler_time, "map")
        check_finite(doppler_time, "map")
        window = torch.hann_window(
            frames, periodic=True, dtype=doppler_time.dtype, device=doppler_time.device
        )
        return torch.fft.rfft((doppler_time - doppler_time.mean(-1, keepdim=True)) * window).abs()

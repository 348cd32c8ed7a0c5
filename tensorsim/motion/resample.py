"""From joints at video rate to joints at pulse rate.

Linear interpolation has a piecewise constant velocity, which gives spectral lines at the frame rate in the
radar data. A C2 cubic spline has continuous velocity and acceleration; it is the default.

Source: C. de Boor, "A Practical Guide to Splines" (1978), ch. IV, in terms of second derivatives.
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    check_size,
)


def natural_spline_curvature(y: Tensor, interval: float) -> Tensor:
    """Second derivatives at the knots of the natural cubic spline through equidistant knots.

    They solve ``m[k-1] + 4 m[k] + m[k+1] = 6 (y[k-1] - 2 y[k] + y[k+1]) / interval^2`` with ``m = 0`` at both
    ends. Extended as an odd function beyond the ends the system is circulant: the FFT solves it without a
    loop over knots.

    Args:
        y: (..., T, J, 3) values at the knots, T >= 2.
        interval: distance between knots.

    Returns:
        Tensor of the same shape as ``y``.
    """
    if y.numel() == 0:
        return torch.zeros_like(y)
    count = y.shape[-3] - 1
    right = (y[..., :-2, :, :] - 2 * y[..., 1:-1, :, :] + y[..., 2:, :, :]) * (6 / interval**2)
    end = torch.zeros_like(y[..., :1, :, :])
    odd = torch.cat([end, right, end, -right.flip(-3)], dim=-3)
    angle = torch.arange(count + 1, dtype=y.dtype, device=y.device) * (math.pi / count)
    spectrum = torch.fft.rfft(odd, dim=-3) / (4 + 2 * torch.cos(angle)).view(-1, 1, 1)
    curvature: Tensor = torch.fft.irfft(spectrum, n=2 * count, dim=-3)
    return curvature[..., : count + 1, :, :]


def evaluate_cubic(y: Tensor, curvature: Tensor, interval: float, times: Tensor) -> Tensor:
    """Piecewise cubic with values ``y`` and second derivatives ``curvature`` at equidistant knots.

    Beyond the last knot it continues linearly with the velocity there (for a natural spline with continuous
    acceleration). Without curvature it is the piecewise linear interpolant.

    Args:
        y, curvature: (..., T, J, 3), T >= 2.
        interval: distance between knots.
        times: (M,) >= 0, in intervals: knot k is at time k.

    Returns:
        (..., M, J, 3).
    """
    knot = torch.floor(times).long().clamp(max=y.shape[-3] - 2)
    b = (times - knot).clamp(max=1.0)
    a = 1 - b
    beyond = times - knot - b
    bend = interval**2 / 6

    at_knot = (a - beyond).view(-1, 1, 1), (bend * (a**3 - a + beyond)).view(-1, 1, 1)
    at_next = (b + beyond).view(-1, 1, 1), (bend * (b**3 - b + 2 * beyond)).view(-1, 1, 1)
    position = y.index_select(-3, knot) * at_knot[0]
    position = torch.addcmul(position, y.index_select(-3, knot + 1), at_next[0])
    position = torch.addcmul(position, curvature.index_select(-3, knot), at_knot[1])
    return torch.addcmul(position, curvature.index_select(-3, knot + 1), at_next[1])


class PoseResampler(nn.Module):
    """Joints at video rate -> joints at the pulse rate of the radar.

    Frame k is at ``k / fps``, pulse m at ``m / prf_hz``. T frames last ``T / fps``, so a clip has
    ``M = round(T / fps * prf_hz)`` pulses; those after the last frame continue linearly with its velocity.

    The result is always float64: float32 metres are too coarse for the phase of a carrier of
    77 GHz (a floor near -60 dB).

    Args:
        prf_hz: pulse repetition frequency.
        method: ``"spline"``, the natural cubic spline (``scipy.interpolate.CubicSpline(bc_type="natural")``),
            or ``"linear"`` as in the paper (``numpy.interp``).

    Example:
        >>> joints = torch.randn(2, 30, 14, 3)  # 1 s at 30 frames per second
        >>> resampler = PoseResampler(prf_hz=8192.0)
        >>> whole = resampler(joints, 30.0)
        >>> whole.shape
        torch.Size([2, 8192, 14, 3])

        The same in pieces, for clips whose pulses do not fit in memory:

        >>> coefficients = resampler.coefficients(joints, 30.0)
        >>> piece = resampler.evaluate(coefficients, 30.0, 1000, 1100)
        >>> torch.allclose(piece, whole[:, 1000:1100])
        True

    Raises:
        TensorsimError: a PRF that is not positive, or an unknown method.
    """

    def __init__(self, prf_hz: float, method: str = "spline") -> None:
        super().__init__()
        check_positive(prf_hz, "PoseResampler.prf_hz")
        check_choice(method, ("spline", "linear"), "PoseResampler.method")
        self.prf_hz = float(prf_hz)
        self.method = method

    def forward(self, joints: Tensor, fps: float) -> Tensor:
        """Resample joints (..., T, J, 3) at ``fps`` frames per second to (..., M, J, 3) float64.

        Raises:
            TensorsimError: wrong shape, fewer than 2 frames, NaN, fps not positive, or a clip shorter than a
                pulse.
        """
        coefficients = self.coefficients(joints, fps)
        return self.evaluate(coefficients, fps, 0, self.pulses(joints.shape[-3], fps))

    @torch.jit.export
    def pulses(self, frames: int, fps: float) -> int:
        """M, the number of pulses in a clip of this many frames."""
        check_positive(fps, "PoseResampler: fps")
        count = math.floor(frames / fps * self.prf_hz + 0.5)
        if count < 1:
            raise TensorsimError(
                f"PoseResampler: got {frames} frames at {fps} fps, expected a clip that holds a pulse at "
                f"{self.prf_hz} Hz"
            )
        return count

    @torch.jit.export
    def coefficients(self, joints: Tensor, fps: float) -> Tensor:
        """The curve through joints (..., T, J, 3): positions in m and accelerations in m/s^2 at the frames.

        Returns:
            (..., 2, T, J, 3) float64. For ``"linear"`` the accelerations are zero.

        Raises:
            TensorsimError: see :meth:`forward`.
        """
        check_floating(joints, "joints")
        check_min_rank(joints, 3, "joints", "(..., T, J, 3)")
        check_size(joints, -1, 3, "joints", "(..., T, J, 3)")
        check_positive(fps, "PoseResampler: fps")
        if joints.shape[-3] < 2:
            raise TensorsimError(
                f"joints: got shape {list(joints.shape)} with {joints.shape[-3]} frames, expected "
                f"(..., T, J, 3) with at least 2: motion needs two moments"
            )
        check_finite(joints, "joints")
        positions = joints.to(torch.float64)
        if self.method == "spline":
            accelerations = natural_spline_curvature(positions, 1 / fps)
        else:
            accelerations = torch.zeros_like(positions)
        return torch.stack([positions, accelerations], dim=-4)

    @torch.jit.export
    def evaluate(self, coefficients: Tensor, fps: float, start: int, stop: int) -> Tensor:
        """Joints (..., stop - start, J, 3) float64 at pulses ``start`` to ``stop`` (excluded).

        Args:
            coefficients: (..., 2, T, J, 3), see :meth:`coefficients`.
            fps: the frame rate that the coefficients were made with.
            start, stop: pulses, ``0 <= start <= stop <= M``.

        Raises:
            TensorsimError: not coefficients, or pulses that the clip does not have.
        """
        check_min_rank(coefficients, 4, "coefficients", "(..., 2, T, J, 3)")
        check_size(coefficients, -4, 2, "coefficients", "(..., 2, T, J, 3)")
        pulses = self.pulses(coefficients.shape[-3], fps)
        if not 0 <= start <= stop <= pulses:
            raise TensorsimError(
                f"PoseResampler: got pulses {start} to {stop}, expected a range within 0 to {pulses}"
            )
        times = torch.arange(start, stop, dtype=torch.float64, device=coefficients.device) * fps / self.prf_hz
        positions, accelerations = coefficients.unbind(-4)
        # In pieces that fit into the processor's cache: several times faster than all pulses at once.
        per_pulse = max(1, positions.numel() // positions.shape[-3])
        pieces = times.split(max(1, 131072 // per_pulse))
        return torch.cat(
            [evaluate_cubic(positions, accelerations, 1 / fps, piece) for piece in pieces], dim=-3
        )

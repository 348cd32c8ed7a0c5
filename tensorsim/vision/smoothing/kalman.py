"""Kalman filtering and Rauch-Tung-Striebel smoothing of joints with the constant-velocity model.

Every coordinate is a position and a velocity driven by white acceleration noise of density ``q``
(Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 6.2.2):

    x(t+1) = [1 dt; 0 1] x(t) + w,   E[w w'] = q [dt^3/3 dt^2/2; dt^2/2 dt],   z = [1 0] x + n,   E[n^2] = r

The covariance does not depend on what was measured, only on which frames were, so all coordinates of a point
share one 2 x 2 covariance: three numbers, and every inverse is a division.
"""

import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    check_size,
)

#: The frame rate at which ``process_noise`` is stated.
REFERENCE_FPS = 30.0


def smooth_constant_velocity(
    measured: Tensor,
    valid: Tensor,
    process_noise: float,
    measurement_noise: float,
    initial_speed: float,
    dt: float,
    backward: bool = True,
) -> Tensor:
    """Positions estimated from measured ones under the constant-velocity model.

    In the first frame the position is expected at the first valid measurement (with a wide variance) and the
    velocity at zero within ``initial_speed``. Only ratios of the noises count: a common factor on
    ``process_noise``, ``measurement_noise`` and ``initial_speed**2`` changes nothing.

    Args:
        measured: (..., T, D) positions, D coordinates measured together; ignored where not valid.
        valid: (..., T) bool, the measured frames. Others are predicted; a point never measured is zeros.
        process_noise: density q of the acceleration noise, unit^2 / time^3.
        measurement_noise: variance r of a measured coordinate, unit^2.
        initial_speed: prior standard deviation of the velocity, unit / time.
        dt: time between frames.
        backward: smooth with the Rauch-Tung-Striebel backward pass, else the forward filter alone, which
            lags.

    Returns:
        (..., T, D) in the dtype of ``measured``; computed in float64.
    """
    frames = measured.shape[-2]
    z = torch.where(valid.unsqueeze(-1), measured, 0.0).to(torch.float64)
    seen = valid.to(torch.float64).unsqueeze(-1)
    first = valid.to(torch.uint8).argmax(-1, keepdim=True).unsqueeze(-1)
    x = z.take_along_dim(first, dim=-2).squeeze(-2)
    v = torch.zeros_like(x)

    r = measurement_noise
    q00, q01, q11 = process_noise * dt**3 / 3.0, process_noise * dt**2 / 2.0, process_noise * dt
    p00 = torch.full_like(x[..., :1], 1e4 * r)  # wide enough to leave the first measurement alone
    p01 = torch.zeros_like(p00)
    p11 = torch.full_like(p00, initial_speed**2)

    predicted: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
    filtered: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
    for t in range(frames):
        if t > 0:
            x = x + dt * v
            p00 = p00 + dt * (2.0 * p01 + dt * p11) + q00
            p01 = p01 + dt * p11 + q01
            p11 = p11 + q11
        predicted.append((x, v, p00, p01, p11))
        gain = seen[..., t, :] / (p00 + r)  # zero in a missing frame: the state coasts
        k0, k1 = gain * p00, gain * p01
        innovation = z[..., t, :] - x
        x, v = x + k0 * innovation, v + k1 * innovation
        p11 = p11 - k1 * p01
        p00, p01 = (1.0 - k0) * p00, (1.0 - k0) * p01
        filtered.append((x, v, p00, p01, p11))

    estimates = [x]
    if backward:
        for t in range(frames - 2, -1, -1):
            x_next, v_next, s00, s01, s11 = predicted[t + 1]
            x_here, v_here, p00, p01, p11 = filtered[t]
            # C = P F' S^-1, the smoother gain, S the covariance predicted for the next frame.
            a0, a1 = p00 + dt * p01, p01 + dt * p11
            det = s00 * s11 - s01 * s01
            dx, dv = x - x_next, v - v_next
            x = x_here + ((a0 * s11 - p01 * s01) * dx + (p01 * s00 - a0 * s01) * dv) / det
            v = v_here + ((a1 * s11 - p11 * s01) * dx + (p11 * s00 - a1 * s01) * dv) / det
            estimates.append(x)
        estimates.reverse()
    else:
        estimates = [state[0] for state in filtered]
    return torch.stack(estimates, dim=-2).to(measured.dtype)


class KalmanSmoother(nn.Module):
    """Smooths joints along time, each on its own, with the constant-velocity model; missing joints coast.

    Input ``joints`` (..., T, J, 3) in metres, ``valid`` (..., T, J) bool (None: all measured) and ``fps``;
    output (..., T, J, 3) in the dtype of the input, finite everywhere. Differentiable by ``joints`` (with
    zero gradient where not valid); float32 input is computed in float64 and cast back.

    Missing frames between measured ones are bridged. Frames before the first are extrapolated backwards by
    "rts", the speed fading into its prior, and hold the first measurement under "forward"; frames after the
    last continue at the last velocity. A joint never measured is zeros.

    The noise is stated per frame at 30 fps, so that the bandwidth in Hz hardly depends on the frame rate: the
    acceleration density is ``q = process_noise * 30**3`` m^2/s^3, and ``dt = 1 / fps``. Away from the ends
    "rts" is a zero-phase low-pass, close to ``q / (q + r dt w^4)`` in amplitude: with the defaults -3 dB at
    2.15 Hz and -6 dB at 2.7 Hz at 30 fps (-3 dB at 1.8 Hz at 15 fps, 2.6 Hz at 60 fps). The bandwidth grows
    with the fourth root of ``process_noise / measurement_noise``: ten times as much gives 3.8 Hz.

    Args:
        process_noise: m^2 per frame^3 at 30 fps.
        measurement_noise: variance of a measured coordinate, m^2.
        mode: "rts", the Rauch-Tung-Striebel smoother, or "forward", the causal filter alone.
        initial_speed: prior standard deviation of a joint's velocity at the first frame, m/s.

    Raises:
        TensorsimError: noise that is not positive, an unknown mode, wrong shapes, T = 0, fps not positive, or
            a NaN or infinite coordinate where ``valid``.
    """

    def __init__(
        self,
        process_noise: float = 0.001,
        measurement_noise: float = 0.01,
        mode: str = "rts",
        initial_speed: float = 3.0,
    ) -> None:
        super().__init__()
        check_positive(process_noise, "KalmanSmoother.process_noise")
        check_positive(measurement_noise, "KalmanSmoother.measurement_noise")
        check_positive(initial_speed, "KalmanSmoother.initial_speed")
        if mode not in ("rts", "forward"):
            raise TensorsimError(f"KalmanSmoother.mode: got {mode!r}, expected 'rts' or 'forward'")
        self.process_density = process_noise * REFERENCE_FPS**3
        self.measurement_noise = float(measurement_noise)
        self.initial_speed = float(initial_speed)
        self.mode = mode

    def forward(self, joints: Tensor, valid: Tensor | None, fps: float) -> Tensor:
        """Smoothed joints (..., T, J, 3): see the class."""
        check_floating(joints, "joints")
        check_min_rank(joints, 3, "joints", "(..., T, J, 3)")
        check_size(joints, -1, 3, "joints", "(..., T, J, 3)")
        check_positive(fps, "fps")
        if joints.shape[-3] == 0:
            raise TensorsimError(f"joints: got shape {list(joints.shape)}, expected at least one frame")
        if valid is None:
            valid = torch.ones(joints.shape[:-1], dtype=torch.bool, device=joints.device)
        if valid.dtype != torch.bool or valid.shape != joints.shape[:-1]:
            raise TensorsimError(
                f"valid: got {valid.dtype} of {list(valid.shape)}, expected bool of {list(joints.shape[:-1])}"
            )
        check_finite(torch.where(valid.unsqueeze(-1), joints, 0.0), "joints where valid")
        smooth = smooth_constant_velocity(
            joints.transpose(-2, -3),
            valid.transpose(-1, -2),
            self.process_density,
            self.measurement_noise,
            self.initial_speed,
            1.0 / fps,
            self.mode == "rts",
        )
        return smooth.transpose(-2, -3)

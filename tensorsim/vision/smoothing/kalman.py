"""Kalman filtering and Rauch-Tung-Striebel smoothing of joints with the constant-velocity model.

Every coordinate is a position and a velocity driven by white acceleration noise of density ``q``
(Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", section 6.2.2):

    x(t+1) = [1 dt; 0 1] x(t) + w,   E[w w'] = q [dt^3/3 dt^2/2; dt^2/2 dt],   z = [1 0] x + n,   E[n^2] = r

Coordinates are independent, so a covariance is three numbers, and every inverse is a division.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from tensorsim.errors import (
    TensorsimError,
    check_choice,
    check_finite,
    check_floating,
    check_mask,
    check_min_rank,
    check_positive,
    check_size,
)
from tensorsim.vision.smoothing.noise import acceleration_density, jitter

#: The frame rate at which ``process_noise`` is stated.
REFERENCE_FPS = 30.0
#: Noises of the original's control panel.
PANEL_PROCESS_NOISE, PANEL_MEASUREMENT_NOISE = 0.001, 0.01


class KalmanState(NamedTuple):
    """Estimates of independent coordinates and their covariances; the latter broadcast against the former.

    Attributes:
        position: (..., D).
        velocity: (..., D).
        p00: variance of the position.
        p01: covariance of position and velocity.
        p11: variance of the velocity.
    """

    position: Tensor
    velocity: Tensor
    p00: Tensor
    p01: Tensor
    p11: Tensor


def constant_velocity_predict(state: KalmanState, process_noise: Tensor, dt: float) -> KalmanState:
    r"""The state one frame later.

    $$ x \leftarrow F x, \quad P \leftarrow F P F^T + Q $$

    Args:
        state: filtered estimates of the frame before.
        process_noise: density q of the acceleration noise, unit^2 / time^3.
        dt: time between frames.
    """
    x, v, p00, p01, p11 = state
    q = process_noise
    return KalmanState(
        x + dt * v,
        v,
        p00 + dt * (2.0 * p01 + dt * p11) + q * (dt**3 / 3.0),
        p01 + dt * p11 + q * (dt**2 / 2.0),
        p11 + q * dt,
    )


def kalman_update(
    state: KalmanState, measured: Tensor, measurement_noise: Tensor, valid: Tensor
) -> KalmanState:
    r"""The state after a measurement, with the gain K.

    $$ K = \frac{P H^T}{H P H^T + r}, \quad x \leftarrow x + K (z - H x), \quad P \leftarrow (1 - K H) P $$

    Args:
        state: predicted estimates.
        measured: (..., D) positions z, finite.
        measurement_noise: variance r of a measured coordinate, unit^2.
        valid: 1 where there is a measurement, 0 where there is none: there the gain is zero and the state stays.
    """
    x, v, p00, p01, p11 = state
    gain = valid / (p00 + measurement_noise)
    k0, k1 = gain * p00, gain * p01
    innovation = measured - x
    return KalmanState(
        x + k0 * innovation, v + k1 * innovation, (1.0 - k0) * p00, (1.0 - k0) * p01, p11 - k1 * p01
    )


def rts_step(filtered: KalmanState, predicted: KalmanState, x: Tensor, v: Tensor, dt: float) -> list[Tensor]:
    """One backward step of the Rauch-Tung-Striebel smoother: ``x + C (x_next - F x)``, ``C = P F' S^-1``.

    Args:
        filtered: estimates of a frame, with covariance P.
        predicted: what was predicted from it for the next frame, with covariance S.
        x: smoothed positions of the next frame.
        v: smoothed velocities of the next frame.
        dt: time between frames.

    Returns:
        Smoothed positions and velocities of the frame.
    """
    p00, p01, p11 = filtered.p00, filtered.p01, filtered.p11
    s00, s01, s11 = predicted.p00, predicted.p01, predicted.p11
    a0, a1 = p00 + dt * p01, p01 + dt * p11
    det = s00 * s11 - s01 * s01
    dx, dv = x - predicted.position, v - predicted.velocity
    return [
        filtered.position + ((a0 * s11 - p01 * s01) * dx + (p01 * s00 - a0 * s01) * dv) / det,
        filtered.velocity + ((a1 * s11 - p11 * s01) * dx + (p11 * s00 - a1 * s01) * dv) / det,
    ]


def smooth_constant_velocity(
    measured: Tensor,
    valid: Tensor,
    process_noise: Tensor,
    measurement_noise: Tensor,
    initial_speed: float,
    dt: float,
    backward: bool = True,
) -> Tensor:
    """Positions estimated from measured ones under the constant-velocity model.

    In the first frame the position is expected at the first valid measurement (with a wide variance) and the
    velocity at zero within ``initial_speed``. Only ratios of the noises count: a common factor on
    ``process_noise``, ``measurement_noise`` and ``initial_speed**2`` changes nothing.

    Args:
        measured: (..., T, D) positions; ignored where not valid.
        valid: (..., T) bool, the measured frames. Others are predicted; a point never measured is all zeros.
        process_noise: density q of the acceleration noise, unit^2 / time^3, that leads up to a frame; like
            ``measurement_noise``, it broadcasts to (..., T, D) or (..., T, 1).
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
    # One covariance serves all coordinates that have the same noise.
    q = process_noise.to(torch.float64) * torch.ones_like(seen)
    r = measurement_noise.to(torch.float64) * torch.ones_like(seen)
    first = valid.to(torch.uint8).argmax(-1, keepdim=True).unsqueeze(-1)
    x = z.take_along_dim(first, dim=-2).squeeze(-2)
    p00 = 1e4 * r[..., 0, :] + torch.zeros_like(q[..., 0, :])  # wide: the first measurement dominates
    state = KalmanState(
        x, torch.zeros_like(x), p00, torch.zeros_like(p00), torch.full_like(p00, initial_speed**2)
    )
    predicted: list[KalmanState] = []
    filtered: list[KalmanState] = []
    measurements, noises, there = z.unbind(-2), r.unbind(-2), seen.unbind(-2)
    densities = q.unbind(-2)
    for t in range(frames):
        if t > 0:
            state = constant_velocity_predict(state, densities[t], dt)
        predicted.append(state)
        state = kalman_update(state, measurements[t], noises[t], there[t])
        filtered.append(state)

    estimates = [state.position for state in filtered]
    if backward:
        x, v = state.position, state.velocity
        for t in range(frames - 2, -1, -1):
            x, v = rts_step(filtered[t], predicted[t + 1], x, v, dt)
            estimates[t] = x
    return torch.stack(estimates, dim=-2).to(measured.dtype)


class KalmanSmoother(nn.Module):
    """Smooths joints along time, each on its own, with the constant-velocity model; missing joints are predicted.

    Input ``joints`` (..., T, J, 3) in metres, ``valid`` (..., T, J) bool (None: all measured), ``fps`` and, if the
    size of the errors is known, ``noise_std_m``, their standard deviation in metres, (..., T, J, 3) or (..., T, J, 1);
    output (..., T, J, 3) in the dtype of the input, finite everywhere. Differentiable with respect to ``joints`` (with
    zero gradient where not valid); float32 input is computed in float64 and cast back.

    By default both noises are estimated from the joints, so that exact joints pass through and noisy ones are smoothed:

    - measurement noise, per joint and coordinate, from its sixth differences
      (:func:`~tensorsim.vision.smoothing.noise.jitter`, whose variance counts 1.5 times, as errors are rarely white),
      but at least 0.5 mm and at least ``noise_std_m``. Use that for slow errors, which look like motion, and for those
      of depths, see :func:`~tensorsim.vision.smoothing.noise.noise_with_depth`;
    - process noise, per joint and frame, from its second differences over 0.13 s
      (:func:`~tensorsim.vision.smoothing.noise.acceleration_density`), at least 0.3 m^2/s^3: a body that stands
      still has about that, a wrist that punches a thousand times as much.

    With exact joints the gain is above 0.9 up to 5 Hz at 30 fps. Noises that are given apply to all joints and frames;
    then "rts" is a zero-phase low-pass away from the ends, with the gain ``q / (q + r dt w^4)`` to first order. They
    are stated per frame at 30 fps, as in the original's panel, so that the bandwidth in Hz hardly depends on the frame
    rate: the acceleration density is ``q = process_noise * 30**3`` m^2/s^3, and ``dt = 1 / fps``. The panel's 0.001
    and 0.01 have -3 dB at 2.15 Hz and -6 dB at 2.7 Hz at 30 fps.

    Missing frames between measured ones are bridged. Frames before the first are extrapolated backwards by
    "rts", the speed fading into its prior, and hold the first measurement with "forward"; frames after the
    last continue at the last velocity. A joint never measured is all zeros.

    Args:
        process_noise: m^2 per frame^3 at 30 fps; None estimates it.
        measurement_noise: variance of a measured coordinate, m^2; it replaces ``noise_std_m`` too. None estimates it.
        mode: "rts", the Rauch-Tung-Striebel smoother, or "forward", the causal filter alone: it cannot look at
            the whole clip, and takes the panel's 0.001 and 0.01 where none are given.
        initial_speed: prior standard deviation of a joint's velocity at the first frame, m/s.

    Raises:
        TensorsimError: noise that is not positive, an unknown mode, wrong shapes, T = 0, fps not positive, a NaN or
            infinite coordinate where ``valid``.
    """

    process_density: float | None
    measurement_noise: float | None

    def __init__(
        self,
        process_noise: float | None = None,
        measurement_noise: float | None = None,
        mode: str = "rts",
        initial_speed: float = 3.0,
    ) -> None:
        super().__init__()
        check_choice(mode, ("rts", "forward"), "KalmanSmoother.mode")
        if mode == "forward":
            process_noise = PANEL_PROCESS_NOISE if process_noise is None else process_noise
            measurement_noise = PANEL_MEASUREMENT_NOISE if measurement_noise is None else measurement_noise
        if process_noise is not None:
            check_positive(process_noise, "KalmanSmoother.process_noise")
        if measurement_noise is not None:
            check_positive(measurement_noise, "KalmanSmoother.measurement_noise")
        check_positive(initial_speed, "KalmanSmoother.initial_speed")
        self.process_density = None if process_noise is None else process_noise * REFERENCE_FPS**3
        self.measurement_noise = None if measurement_noise is None else float(measurement_noise)
        self.initial_speed = float(initial_speed)
        self.mode = mode
        # Constants of the estimates, see the class.
        self.jitter_factor, self.least_noise_m2 = 1.5, 0.0005**2
        self.least_density, self.span_s, self.window_s = 0.3, 0.13, 0.15

    def forward(
        self, joints: Tensor, valid: Tensor | None, fps: float, noise_std_m: Tensor | None = None
    ) -> Tensor:
        """Smoothed joints (..., T, J, 3): see the class."""
        check_floating(joints, "joints")
        check_min_rank(joints, 3, "joints", "(..., T, J, 3)")
        check_size(joints, -1, 3, "joints", "(..., T, J, 3)")
        check_positive(fps, "fps")
        if joints.shape[-3] == 0:
            raise TensorsimError(f"joints: got shape {list(joints.shape)}, expected at least one frame")
        if valid is None:
            valid = torch.ones(joints.shape[:-1], dtype=torch.bool, device=joints.device)
        check_mask(valid, list(joints.shape[:-1]), "valid")
        check_finite(torch.where(valid.unsqueeze(-1), joints, 0.0), "joints where valid")
        tracks, seen = joints.transpose(-2, -3), valid.transpose(-1, -2)
        r = self._measurement_noise(tracks, seen, noise_std_m)
        smooth = smooth_constant_velocity(
            tracks,
            seen,
            self._process_noise(tracks, seen, r, fps),
            r,
            self.initial_speed,
            1.0 / fps,
            self.mode == "rts",
        )
        return smooth.transpose(-2, -3)

    def _measurement_noise(self, tracks: Tensor, valid: Tensor, noise_std_m: Tensor | None) -> Tensor:
        """Variance of measured coordinates in m^2, broadcast to tracks (..., J, T, 3)."""
        given = self.measurement_noise
        if noise_std_m is not None:
            check_floating(noise_std_m, "noise_std_m")
            sizes = list(valid.transpose(-1, -2).shape)
            coordinates = noise_std_m.shape[-1]
            if list(noise_std_m.shape[:-1]) != sizes or (coordinates != 1 and coordinates != 3):
                raise TensorsimError(
                    f"noise_std_m: got shape {list(noise_std_m.shape)}, expected {sizes} and 1 or 3 coordinates"
                )
            check_finite(noise_std_m, "noise_std_m")
        if given is not None:
            return torch.full([1], given, dtype=torch.float64, device=tracks.device)
        points = torch.where(valid.unsqueeze(-1), tracks, 0.0).to(torch.float64)
        deviation = jitter(points, valid)
        # A joint that is never seen for long enough is taken to be as noisy as the noisiest one of the body.
        deviation = torch.where(deviation > 0, deviation, deviation.amax(dim=-2, keepdim=True))
        r = self.jitter_factor * deviation.square().unsqueeze(-2) + self.least_noise_m2
        if noise_std_m is not None:
            r = torch.maximum(r, noise_std_m.transpose(-2, -3).to(torch.float64).square())
        return r

    def _process_noise(self, tracks: Tensor, valid: Tensor, r: Tensor, fps: float) -> Tensor:
        """Acceleration density in m^2/s^3, broadcast to tracks (..., J, T, 3)."""
        given = self.process_density
        if given is not None:
            return torch.full([1], given, dtype=torch.float64, device=tracks.device)
        points = torch.where(valid.unsqueeze(-1), tracks, 0.0).to(torch.float64)
        noise = r.expand_as(points)
        return acceleration_density(points, valid, noise, fps, self.span_s, self.window_s, self.least_density)

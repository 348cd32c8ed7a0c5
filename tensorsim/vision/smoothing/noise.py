"""Noise of tracks, estimated from the tracks themselves: of the measurement and of the motion.

The estimates use differences along time over a short and a long span: measurement noise is the same in both, while
motion grows with the span.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.vision.smoothing.along_time import masked_median

#: Share of the spread of depths that the smoother treats as noise. All of it would lower peaks of punches by a fifth.
DEPTH_NOISE = 0.25


def jitter(x: Tensor, valid: Tensor, order: int = 6) -> Tensor:
    """Standard deviation of the white noise of tracks, from differences of high order along time.

    The n-th difference of white noise of variance s^2 has the variance s^2 binomial(2n, n), while that of motion is
    small: a sinusoid of frequency f is scaled by (2 sin(pi f / fps))^n, 1 at a sixth of the frame rate. The median of
    the magnitudes is taken (times 1.4826, as for a normal distribution), so that short fast motion does not count.

    Args:
        x: (..., T, D).
        valid: (..., T) bool.
        order: n.

    Returns:
        (..., D); 0 where there are no n + 1 valid frames in a row. Differentiable.
    """
    if x.shape[-2] <= order:
        return x.new_zeros(x.shape[:-2] + x.shape[-1:])
    difference = torch.diff(x, n=order, dim=-2).abs().transpose(-1, -2)
    whole = valid.unfold(-1, order + 1, 1).all(dim=-1).unsqueeze(-2).expand_as(difference)
    gain = math.exp(math.lgamma(2.0 * order + 1.0) - 2.0 * math.lgamma(order + 1.0))  # binomial(2n, n)
    return 1.4826 / math.sqrt(gain) * masked_median(difference, whole)[..., 0]


def acceleration_density(
    x: Tensor, valid: Tensor, noise: Tensor, fps: float, span_s: float, window_s: float, least: float
) -> Tensor:
    """Density of the white acceleration noise that moves a track, over time.

    Under the constant-velocity model with acceleration noise of density q, second differences over m frames,
    x(t + m) - 2 x(t) + x(t - m), have the variance 2/3 q (m dt)^3 + 6 r with measurement noise of variance r. Solved
    for q with a local mean of the squared differences, over coordinates and a Gaussian window of time.

    Args:
        x: (..., T, D) positions in m.
        valid: (..., T) bool.
        noise: (..., T, D) variance of a measured coordinate, m^2.
        fps: frames per second.
        span_s: m in seconds. Long spans resolve slow motion in noise; motion that repeats after a span is missed.
        window_s: standard deviation of the window.
        least: smallest result; it also counts as one more frame of every window, so a long gap has this density.

    Returns:
        (..., T, 1) m^2/s^3. Differentiable.
    """
    frames, m = x.shape[-2], max(int(span_s * fps + 0.5), 1)
    if frames <= 2 * m:
        return torch.full_like(x[..., :1], least)
    second = x[..., 2 * m :, :] - 2.0 * x[..., m:-m, :] + x[..., : -2 * m, :]
    expected = noise[..., 2 * m :, :] + 4.0 * noise[..., m:-m, :] + noise[..., : -2 * m, :]
    density = (second.square() - expected).mean(dim=-1) / (2.0 / 3.0 * (m / fps) ** 3)
    whole = (valid[..., 2 * m :] & valid[..., m:-m] & valid[..., : -2 * m]).to(x.dtype)

    radius = int(3.0 * window_s * fps) + 1
    offset = torch.arange(-radius, radius + 1, dtype=x.dtype, device=x.device)
    kernel = torch.exp(-0.5 * (offset / (window_s * fps)).square())[None, None]
    rows = torch.stack([density * whole, whole]).reshape(-1, 1, frames - 2 * m)
    sums = F.conv1d(F.pad(rows, [m, m]), kernel, padding=radius).reshape(2, -1)
    motion, weight = sums[0].reshape(valid.shape), sums[1].reshape(valid.shape)
    return ((motion + least) / (weight + 1.0)).clamp(min=least).unsqueeze(-1)


def keypoint_noise(scores: Tensor, height_px: Tensor, height_m: float = 1.75) -> Tensor:
    """Standard deviation of joints that come from the heat maps of a network.

    Errors of networks last for several frames, so that jitter does not show them. They are half a cell of the heat
    map, of which 64 cover 1.25 heights of the body, or half a pixel of the film where that is larger, divided by
    the score: 1.7 cm at a score of 1. Found with the shipped networks on rendered films.

    Args:
        scores: (..., J); below 0.2 they count as 0.2.
        height_px: (...) height of the standing body in pixels of the film, ``Lifted.scale``.
        height_m: the same in metres.

    Returns:
        (..., J, 1) metres.
    """
    cell = (1.0 / height_px.clamp(min=1.0)).clamp(min=1.25 / 64.0)
    return (0.5 * height_m * cell.unsqueeze(-1) / scores.clamp(min=0.2, max=1.0)).unsqueeze(-1)


def noise_with_depth(
    noise: Tensor,
    deviation: Tensor,
    joints: Tensor,
    camera_m: Tensor,
    height_m: float = 1.75,
    share: float = DEPTH_NOISE,
) -> Tensor:
    """Standard deviation of joints along world axes whose depth is less certain than their place in the picture.

    Errors of depth move a joint along its line of sight. They are similar in neighbouring frames, so no filter
    removes them, and only a ``share`` of the spread counts as noise. Only the diagonal of the covariance is
    kept, as the smoother treats coordinates as independent.

    Args:
        noise: (..., J, 1) metres, across the line of sight, of :func:`keypoint_noise`.
        deviation: (..., J) of depths in body heights, ``Lifted.deviation``.
        joints: (..., J, 3) metres.
        camera_m: (3,) position of the camera.
        height_m: of the body.
        share: of the spread of depths that changes from frame to frame.

    Returns:
        (..., J, 3) metres.
    """
    sight = F.normalize(joints.detach() - camera_m, dim=-1)
    return (noise.square() + (share * height_m * deviation.unsqueeze(-1) * sight).square()).sqrt()

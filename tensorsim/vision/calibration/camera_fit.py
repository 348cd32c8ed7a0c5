"""A still pinhole camera from upright bodies on a level floor: maximum a posteriori by Gauss-Newton.

An upright body is modelled as a few points above each other at known heights (Lv, Zhao, Nevatia, "Camera calibration
from video of a walking human", 2006, use feet and head). For a camera of given tilt, roll, height and field of view,
the spot on the floor that best fits them to the image is a linear least-squares solution. The residuals determine the
camera: sizes at several places give the horizon, the lean of bodies away from the middle the nadir, both together the
focal length. The apparent width of trunks is not used: people who walk past a camera turn their trunks towards it, by
up to 40 degrees.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor


def camera_axes(pitch: Tensor, roll: Tensor) -> Tensor:
    """Axes right, down, forward of cameras in the world, rows of (..., 3, 3).

    Args:
        pitch: (...) radians, upward tilt of the optical axis.
        roll: (...) radians about that axis, positive = clockwise as the camera sees it (people lean to its left).
    """
    zero, one = torch.zeros_like(pitch), torch.ones_like(pitch)
    forward = torch.stack([zero, torch.cos(pitch), torch.sin(pitch)], dim=-1)
    level = torch.stack([one, zero, zero], dim=-1)
    down = torch.linalg.cross(forward, level)
    cos, sin = torch.cos(roll).unsqueeze(-1), torch.sin(roll).unsqueeze(-1)
    return torch.stack([cos * level + sin * down, cos * down - sin * level, forward], dim=-2)


def place_upright(
    axes: Tensor, height: Tensor, focal: Tensor, image: Tensor, above_floor: Tensor, beside: Tensor
) -> tuple[Tensor, Tensor]:
    """Spots on the floor where upright bodies stand, and how they would look there.

    Args:
        axes: (..., 3, 3) of :func:`camera_axes`.
        height: (...) of the camera above the floor.
        focal: (...) in the unit of ``image``.
        image: (..., P, T, K, 2) points of bodies, from the principal point, v down.
        above_floor: (..., P, T, K) heights of the points above the floor, in the unit of ``height``.
        beside: (..., P, T, K, 2) offsets of the points from the spot, to its right and ahead of it.

    Returns:
        spots (..., P, T, 2) right of and in front of the camera, and the points there (..., P, T, K, 2).
    """
    f = focal[..., None, None, None, None]
    turned = axes[..., None, None, None, :, :]
    # Each point gives two equations that are linear in the spot: (f a_i - u_i a_3) . X = 0.
    rows = f[..., None] * turned[..., :2, :] - image[..., None] * turned[..., 2:, :]
    z = above_floor - height[..., None, None, None]
    a = rows[..., :2]
    b = -rows[..., 2] * z[..., None] - (a * beside[..., None, :]).sum(dim=-1)
    normal = (a[..., :, :, None] * a[..., :, None, :]).sum(dim=(-4, -3))
    right = (a * b[..., None]).sum(dim=(-3, -2))
    det = normal[..., 0, 0] * normal[..., 1, 1] - normal[..., 0, 1] * normal[..., 1, 0]
    det = det.clamp(min=1e-12)
    x = (normal[..., 1, 1] * right[..., 0] - normal[..., 0, 1] * right[..., 1]) / det
    y = (normal[..., 0, 0] * right[..., 1] - normal[..., 1, 0] * right[..., 0]) / det
    spot = torch.stack([x, y], dim=-1)
    points = torch.cat([spot[..., None, :] + beside, z[..., None]], dim=-1)
    local = torch.matmul(points, axes[..., None, None, :, :].transpose(-1, -2))
    return spot, f * local[..., :2] / local[..., 2:].clamp(min=0.1)


class Bodies(NamedTuple):
    """Upright bodies of P people in T frames, as a camera sees them.

    Attributes:
        image: (P, T, 2, 2) ankles and shoulders in half widths of the picture, from its middle.
        upright: (P, T) bool, the frames that count.
        above_floor: (P, T, 2) metres.
        walking: (P, T) from 0, standing, to 1, walking.
        noise: (P, T) standard deviation of a point in half widths.
    """

    image: Tensor
    upright: Tensor
    above_floor: Tensor
    walking: Tensor
    noise: Tensor


def misfit(parameters: Tensor, bodies: Bodies, fps: float) -> tuple[Tensor, Tensor]:
    """Residuals of upright bodies and of their walking speeds, in standard deviations.

    Args:
        parameters: (..., 4 + 3 P): pitch, roll, logarithm of the height of the camera in m, horizontal field of view,
            then, each for all people, the logarithm of the factor on the body height, that of the walking speed in
            m/s, and by how many metres the shoulders are ahead of the ankles in a walk.
        bodies: what is seen.
        fps: frames per second.

    Returns:
        (..., P, T, 4) of ankles and shoulders, (..., P, T) of the speeds; zeros where nothing is known.
    """
    people, frames = bodies.upright.shape[0], bodies.upright.shape[1]
    axes = camera_axes(parameters[..., 0], parameters[..., 1])
    focal = 1.0 / torch.tan(parameters[..., 3] / 2)
    height = parameters[..., 2].exp()
    own = parameters[..., 4:].unflatten(-1, [3, people])
    factor, pace, lean = own[..., 0, :].exp(), own[..., 1, :].exp(), own[..., 2, :]
    above_floor = bodies.above_floor * factor[..., None, None]
    nowhere = torch.zeros_like(bodies.image)
    spot, _ = place_upright(axes, height, focal, bodies.image, above_floor, nowhere)

    # Displacement over a window of one second; the first and last half second use the first and last window.
    span = max(min(int(fps + 0.5), frames - 1), 1)
    time = torch.arange(frames, device=spot.device)
    before = (time - span // 2).clamp(min=0, max=max(frames - 1 - span, 0))
    after = (before + span).clamp(max=frames - 1)
    start, end = spot.index_select(-2, before), spot.index_select(-2, after)
    between = spot.index_select(-2, (before + after) // 2)
    way = end - start
    distance = torch.linalg.vector_norm(way, dim=-1)
    # In two parts: the path of a person who turns is longer than the straight line.
    path = torch.linalg.vector_norm(between - start, dim=-1) + torch.linalg.vector_norm(end - between, dim=-1)
    known = bodies.upright.index_select(-1, after) & bodies.upright.index_select(-1, before) & bodies.upright
    moves = bodies.walking * known.to(spot.dtype)
    ahead = way / distance.clamp(min=0.3)[..., None] * (moves * lean[..., None])[..., None]
    beside = torch.stack([torch.zeros_like(ahead), ahead], dim=-2)
    _, seen = place_upright(axes, height, focal, bodies.image, above_floor, beside)

    # A person walking in an unknown direction also leans in an unknown direction: up to twice the noise.
    lost = 1.0 + bodies.walking * (~known).to(spot.dtype)
    away = (seen - bodies.image) / (lost * bodies.noise)[..., None, None]
    away = torch.where(bodies.upright[..., None, None], away, 0.0).flatten(-2)
    speed = path / (span / fps)
    return away, moves * (speed / pace[..., None] - 1.0) / 0.1


def residuals(parameters: Tensor, bodies: Bodies, fps: float) -> Tensor:
    """Both kinds of :func:`misfit` together, (..., P, T, 5)."""
    away, speed = misfit(parameters, bodies, fps)
    return torch.cat([away, speed[..., None]], dim=-1)


def jacobian(parameters: Tensor, bodies: Bodies, fps: float) -> Tensor:
    """Jacobian (..., P, T, 5, 4 + 3 P) of :func:`residuals` for the parameters, by central differences."""
    people, step = bodies.upright.shape[0], 1e-5
    # One camera parameter, or one of all people at once: a body depends only on those of its own person.
    moved = torch.eye(4 + 3, dtype=parameters.dtype, device=parameters.device) * step
    moved = torch.cat([moved[:, :4], moved[:, 4:].repeat_interleave(people, dim=1)], dim=1)
    at = parameters.unsqueeze(-2)
    slopes = residuals(at + moved, bodies, fps) - residuals(at - moved, bodies, fps)
    slopes = slopes.movedim(-4, -1) / (2 * step)  # (..., P, T, 5, 7)
    each = torch.eye(people, dtype=parameters.dtype, device=parameters.device)[:, None, None, None, :]
    return torch.cat([slopes[..., :4], (slopes[..., 4:, None] * each).flatten(-2)], dim=-1)


def robust(residual: Tensor, outlier: float) -> tuple[Tensor, Tensor]:
    """Cauchy loss (..., P, T, 2) of bodies and of speeds, from residuals (..., P, T, 5), and its weights."""
    squared = (
        torch.stack([residual[..., :4].square().sum(dim=-1), residual[..., 4].square()], dim=-1) / outlier**2
    )
    return 0.5 * outlier**2 * torch.log1p(squared), 1.0 / (1.0 + squared)


def fit_camera(
    start: Tensor,
    mean: Tensor,
    deviation: Tensor,
    bodies: Bodies,
    fps: float,
    share: Tensor,
    rounds: int = 25,
    first_rounds: int = 8,
    kept: int = 3,
    outlier: float = 2.5,
) -> tuple[Tensor, Tensor, Tensor]:
    """Levenberg-Marquardt from several starts at once, with Cauchy's robust loss and normal priors.

    Most starts converge to the same solution, so after a few steps only the best continue, until they hardly move.

    Args:
        start: (S, 4 + 3 P) parameters, see :func:`misfit`.
        mean, deviation: (4 + 3 P,) of the priors.
        bodies, fps: see :func:`misfit`.
        share: (P, 1, 1) how much each frame of a person counts; successive frames are not independent.
        rounds: largest number of steps.
        first_rounds: steps taken from all starts.
        kept: K, how many starts continue after those.
        outlier: residual in standard deviations beyond which a body or a speed is doubted.

    Returns:
        Parameters (K, 4 + 3 P), their covariance (K, 4 + 3 P, 4 + 3 P) and cost (K,).
    """
    at, residual = start, residuals(start, bodies, fps)
    cost = _cost(at, residual, mean, deviation, share, outlier)
    damping = torch.full_like(cost, 1e-2)
    precision = torch.diag(deviation.pow(-2))
    hessian = precision.expand(at.shape[0], -1, -1)
    for i in range(rounds):
        if i == first_rounds:
            best = cost.argsort()[:kept]
            at, residual, cost, damping = at[best], residual[best], cost[best], damping[best]
        trust = share * robust(residual, outlier)[1]
        trust = torch.cat([trust[..., :1].expand(-1, -1, -1, 4), trust[..., 1:]], dim=-1)
        slope = jacobian(at, bodies, fps)
        weighted = (slope * trust[..., None]).flatten(1, 3)
        hessian = torch.matmul(weighted.transpose(-1, -2), slope.flatten(1, 3)) + precision
        gradient = torch.matmul(weighted.transpose(-1, -2), residual.flatten(1, 3)[..., None])[..., 0]
        gradient = gradient + (at - mean) / deviation.square()
        ridge = torch.diag_embed(damping[:, None] * torch.diagonal(hessian, dim1=-2, dim2=-1))
        step = torch.linalg.solve(hessian + ridge, gradient.unsqueeze(-1)).squeeze(-1)
        tried = _feasible(at - step)
        new_residual = residuals(tried, bodies, fps)
        new_cost = _cost(tried, new_residual, mean, deviation, share, outlier)
        better = new_cost < cost
        at = torch.where(better[:, None], tried, at)
        residual = torch.where(better[:, None, None, None], new_residual, residual)
        cost = torch.where(better, new_cost, cost)
        damping = torch.where(better, damping / 4, damping * 6).clamp(1e-9, 1e9)
        if i >= first_rounds and bool((step / deviation).abs().amax() < 1e-5):
            break
    return at, torch.linalg.inv(hessian), cost


def _cost(
    at: Tensor, residual: Tensor, mean: Tensor, deviation: Tensor, share: Tensor, outlier: float
) -> Tensor:
    """Negative log posterior (S,) up to a constant."""
    loss = (share * robust(residual, outlier)[0]).flatten(1).sum(dim=-1)
    return loss + 0.5 * ((at - mean) / deviation).square().sum(dim=-1)


def _feasible(parameters: Tensor) -> Tensor:
    """Cameras clamped to 0.3 to 10 m above the floor, fields of view of 15 to 150 degrees, pitch within 80."""
    low = [-1.4, -0.8, math.log(0.3), 0.26]
    high = [1.4, 0.8, math.log(10.0), 2.6]
    columns = [parameters[..., i : i + 1].clamp(low[i], high[i]) for i in range(4)]
    columns.append(parameters[..., 4:])
    return torch.cat(columns, dim=-1)

"""Ray casting of rounded volumes: tapered capsules, made elliptical by squashing, with a depth buffer.

A tapered capsule is the union of spheres whose centre runs from a to b while the radius changes linearly from
ra to rb. Intersections with rays have a closed form; for a squashed capsule, space is stretched so that it becomes
round, which preserves the ray parameter.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.config import CameraConfig
from tensorsim.geometry.camera import NEAR_M, camera_to_world, focal_length, principal_point, project


class Volumes(NamedTuple):
    """S tapered capsules of one or more people.

    Attributes:
        start: (..., S, 3) world metres, centre of the first sphere.
        end: (..., S, 3) centre of the last sphere.
        start_radius: (..., S) metres.
        end_radius: (..., S) metres.
        axes: (..., S, 3, 3) rows right, front, up of the body part, in the world.
        origin: (..., S, 3) origin of the part's own coordinates (right, front, up).
        depth: (..., S) ratio of the extent along front to that along right, 1 for a round one.
        length: (..., S) length in metres of the whole limb or trunk that the part belongs to.
    """

    start: Tensor
    end: Tensor
    start_radius: Tensor
    end_radius: Tensor
    axes: Tensor
    origin: Tensor
    depth: Tensor
    length: Tensor

    @property
    def radius(self) -> Tensor:
        """(..., S) metres: radius of spheres at both ends that enclose the squashed ones."""
        return torch.maximum(self.start_radius, self.end_radius) * self.depth.clamp(min=1.0)


class Hits(NamedTuple):
    """First intersections of the rays of an image.

    Attributes:
        depth: (H * W,) ray parameter; infinite without an intersection.
        volume: (H * W,) int64 index of the volume; -1 without one.
        normal: (H * W, 3) unit vectors pointing out of the body, smooth across the volumes of a person.
    """

    depth: Tensor
    volume: Tensor
    normal: Tensor


class View(NamedTuple):
    """The rays of an image and the projection of points into it: a pinhole camera, or parallel rays for a light.

    Attributes:
        origins: (H * W, 3) world metres where rays start (or (1, 3), one point for all).
        directions: (H * W, 3) vectors of one unit of depth along each ray (or (1, 3)).
        axes: (3, 3) rows right, down, forward.
        position: (3,) the camera; for parallel rays the world point at the centre of the image.
        scale: focal length in pixels; for parallel rays pixels per metre.
        center: (u, v) principal point.
        size: (height, width).
        pinhole: whether rays meet in the camera.
    """

    origins: Tensor
    directions: Tensor
    axes: Tensor
    position: Tensor
    scale: float
    center: tuple[float, float]
    size: tuple[int, int]
    pinhole: bool

    @classmethod
    def of_camera(cls, camera: CameraConfig, height: int, width: int, like: Tensor) -> "View":
        """The rays through the pixel centres of a pinhole camera; the ray parameter is depth in metres."""
        focal, center = focal_length(camera, width), principal_point(camera, height, width)
        axes, position = camera_to_world(camera)[:, :3].T.to(like), like.new_tensor(camera.position_m)
        across = _grid(height, width, center, like) / focal
        directions = across @ axes[:2] + axes[2]
        return cls(position[None], directions, axes, position, focal, center, (height, width), True)

    @classmethod
    def of_light(cls, towards: Tensor, middle: Tensor, side_m: float, pixels: int) -> "View":
        """Parallel rays from a distant light in the direction ``towards`` (3,), in a square around ``middle`` (3,)."""
        forward = -towards
        right = torch.linalg.cross(forward, forward.new_tensor([0.0, 0.0, 1.0]))
        right = right / right.norm()
        axes = torch.stack([right, torch.linalg.cross(forward, right), forward])
        scale, center = pixels / side_m, ((pixels - 1) / 2, (pixels - 1) / 2)
        origins = middle + _grid(pixels, pixels, center, middle) / scale @ axes[:2]
        return cls(origins, forward[None], axes, middle, scale, center, (pixels, pixels), False)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) -> pixels (..., 2) and depth (...)."""
        if self.pinhole:
            pose = torch.cat([self.axes.mT, self.position[:, None]], dim=-1)
            return project(points, self.scale, self.center, pose)
        local = (points - self.position) @ self.axes.mT
        return local[..., :2] * self.scale + local.new_tensor(self.center), local[..., 2]

    def windows(self, volumes: Volumes) -> Tensor:
        """Pixels that may see each of the S volumes: (S, 4) int64 left, top, right, bottom, the last two
        exclusive. Empty for volumes that reach behind the camera."""
        height, width = self.size
        lows, highs, front = [], [], torch.ones_like(volumes.start_radius, dtype=torch.bool)
        radius = volumes.radius
        for point in (volumes.start, volumes.end):
            pixel, depth = self.project(point)
            extent = self.scale * radius
            if self.pinhole:
                # Off the axis the image of a sphere is longer than f r / z, by the secant of its angle; this bounds it.
                slant = (pixel - pixel.new_tensor(self.center)).abs().amax(dim=-1) / self.scale
                extent = extent / (depth - radius).clamp(min=NEAR_M) * (1 + slant)
                front = front & (depth - radius > NEAR_M)
            lows.append(pixel - extent[..., None])
            highs.append(pixel + extent[..., None])
        limit = radius.new_tensor([width, height])
        low = torch.minimum(*lows).floor().clamp(min=0).minimum(limit)
        high = (torch.maximum(*highs).ceil() + 1).clamp(min=0).minimum(limit)
        return (torch.cat([low, high], dim=-1) * front[:, None]).long()


def _grid(height: int, width: int, center: tuple[float, float], like: Tensor) -> Tensor:
    """Pixel coordinates relative to the principal point, (H * W, 2)."""
    u = torch.arange(width, dtype=like.dtype, device=like.device) - center[0]
    v = torch.arange(height, dtype=like.dtype, device=like.device) - center[1]
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1).reshape(-1, 2)


def cast(volumes: Volumes, owner: Tensor, view: View, blend_m: float = 0.015) -> Hits:
    """First hits of the rays of an image with S volumes.

    Where volumes of one person meet, their normals are averaged with weights ``exp(-depth / blend_m)``, with depth
    behind the nearest one, so that the transition is shaded smoothly.

    Args:
        volumes: (S, ...) at one instant.
        owner: (S,) int64, the person each volume belongs to.
        view: the rays.
        blend_m: length over which volumes blend.
    """
    windows = view.windows(volumes)
    width = windows[:, 2] - windows[:, 0]
    count = width * (windows[:, 3] - windows[:, 1])
    volume = torch.repeat_interleave(count)
    place = torch.arange(volume.numel(), device=volume.device) - (count.cumsum(0) - count)[volume]
    row, column = place // width[volume], place % width[volume]
    pixel = (windows[volume, 1] + row) * view.size[1] + windows[volume, 0] + column

    depth, normal = _enter(volumes, volume, view, pixel)
    met = torch.isfinite(depth)
    volume, pixel, depth, normal = volume[met], pixel[met], depth[met], normal[met]

    pixels = view.size[0] * view.size[1]
    first = depth.new_full((pixels,), math.inf).scatter_reduce_(0, pixel, depth, "amin")
    beyond = depth - first[pixel]
    nearest = torch.full((pixels,), -1, dtype=torch.int64, device=depth.device)
    nearest[pixel[beyond == 0]] = volume[beyond == 0]
    same = owner[volume] == owner[nearest[pixel]]
    weight = torch.exp(-beyond / blend_m) * same
    shared = torch.zeros(pixels, 3, dtype=depth.dtype, device=depth.device)
    shared.index_add_(0, pixel, normal * weight[:, None])
    return Hits(first, nearest, torch.nn.functional.normalize(shared, dim=-1))


def _enter(volumes: Volumes, volume: Tensor, view: View, pixel: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter volumes, for K pairs: ray parameter (K,), infinite for a miss, and normals (K, 3).

    With b - a = h, a ray q(t) = o + t d relative to a, and r = ra - rb, the mantle is
    ``(|h|^2 - r^2) |q|^2 = (h.q)^2 - 2 ra r (h.q) + |h|^2 ra^2``, valid where the tangent sphere lies between
    the ends, ``0 < h.q - ra r < |h|^2 - r^2``.
    """
    front, stretch = volumes.axes[:, 1], 1 / volumes.depth - 1

    def squash(vectors: Tensor, of: Tensor) -> Tensor:
        """Stretch along the part's front axis so that the volume becomes round."""
        return vectors + front[of] * (stretch[of] * (vectors * front[of]).sum(-1))[:, None]

    everyone = torch.arange(volumes.start.shape[0], device=volume.device)
    length = squash(volumes.end - volumes.start, everyone)
    ra, rb = volumes.start_radius, volumes.end_radius
    r, hh = ra - rb, length.square().sum(-1)
    mantle = hh - r * r
    directions = view.directions if view.directions.shape[0] == 1 else view.directions[pixel]
    origins = view.origins if view.origins.shape[0] == 1 else view.origins[pixel]
    d = squash(directions.expand(volume.numel(), 3), volume)
    o = squash(origins - volumes.start[volume], volume)
    h = length[volume]
    hd, ho, dd = (h * d).sum(-1), (h * o).sum(-1), (d * d).sum(-1)
    od, oo = (o * d).sum(-1), (o * o).sum(-1)
    ra, rb, r, hh, mantle = ra[volume], rb[volume], r[volume], hh[volume], mantle[volume]

    def root(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        """Smaller solution of ``a t^2 + 2 b t + c = 0``; infinite without one."""
        inner = b * b - a * c
        t = (-b - inner.clamp(min=0).sqrt()) / a
        return torch.where((inner >= 0) & (t > 0), t, math.inf)

    t_side = root(
        mantle * dd - hd * hd,
        mantle * od - hd * (ho - ra * r),
        mantle * oo - ho * ho + 2 * ra * r * ho - hh * ra * ra,
    )
    along = ho + t_side * hd - ra * r
    t_side = torch.where((along > 0) & (along < mantle), t_side, math.inf)
    t_start = root(dd, od, oo - ra * ra)
    # o - h starts at b
    t_end = root(dd, od - hd, oo - 2 * ho + hh - rb * rb)
    t = torch.minimum(torch.minimum(t_side, t_start), t_end)
    t = torch.where(mantle > 0, t, torch.where(ra >= rb, t_start, t_end))  # one sphere contains the other
    # The normal points away from the centre of the tangent sphere.
    share = torch.where(t == t_side, along / mantle, (t == t_end).to(t.dtype))
    outward = o + torch.where(torch.isfinite(t), t, 0.0)[:, None] * d - h * share.nan_to_num()[:, None]
    return t, torch.nn.functional.normalize(squash(outward, volume), dim=-1)

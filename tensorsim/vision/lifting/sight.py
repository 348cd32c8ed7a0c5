"""Keypoints as a level camera would see them: the camera's tilt, turn and focal length taken out.

Lines of sight are turned into a frame whose z axis is vertical and whose y axis points horizontally towards the
person. A point at (x, y, z) is then seen at ``a = x / y`` and ``e = z / y``: upright bodies stay upright whatever the
tilt. Positions are relative to the direction of the person and divided by the angular size of the body, both averaged
over a few frames, so that the same pose looks the same wherever it is in the picture.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

#: Numbers per frame in :attr:`Sight.features`.
FEATURES = 67
#: Frames to each side over which direction and size are averaged.
RADIUS = 10


class Sight(NamedTuple):
    """People as a level camera sees them; S tracks of T frames.

    Attributes:
        features: (S, T, FEATURES) for the network.
        joints: (S, T, 14, 2) of the joints, in units of ``size`` from the direction of the person; 0 if not seen.
        elevation: (S, T) ``e`` of the direction of the person.
        size: (S, T) angular size: root mean square of the visible keypoints' ``a`` and ``e`` about their mean.
        azimuth: (S, T, 2) cosine and sine of the angle from world +y to the person, towards +x.
    """

    features: Tensor
    joints: Tensor
    elevation: Tensor
    size: Tensor
    azimuth: Tensor


def mirror_image(sight: Sight, other_keypoint: Tensor, other_joint: Tensor) -> Sight:
    """The same people with left and right exchanged, each in the same place.

    Args:
        sight: of the people.
        other_keypoint: (17,) int64, for each keypoint the one that takes its place in a mirror image.
        other_joint: (14,) int64, the same for joints.
    """
    turn = torch.tensor([-1.0, 1.0], dtype=sight.joints.dtype, device=sight.joints.device)
    spot, scores, edges, room, rest = sight.features.split([34, 17, 4, 4, 8], dim=-1)
    spot = spot.unflatten(-1, [17, 2]).index_select(-2, other_keypoint) * turn
    left, right = edges[..., :1], edges[..., 1:2]
    features = torch.cat(
        [
            spot.flatten(-2), scores.index_select(-1, other_keypoint), -right, -left, edges[..., 2:],
            room[..., 1:2], room[..., :1], room[..., 2:], rest,
        ], dim=-1,
    )  # fmt: skip
    joints = sight.joints.index_select(-2, other_joint) * turn
    return Sight(features, joints, sight.elevation, sight.size, sight.azimuth)


def windowed_mean(x: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean of x (S, T, D) over ``2 RADIUS + 1`` frames about each; weight (S, T) not negative."""
    radius = 10  # RADIUS: TorchScript cannot read module constants
    rows = torch.cat([x * weight[..., None], weight[..., None]], dim=-1).transpose(1, 2)
    sums = F.avg_pool1d(rows, 2 * radius + 1, 1, radius).transpose(1, 2)
    return sums[..., :-1] / sums[..., -1:].clamp(min=1e-6)


def world_rays(image: Tensor, focal: Tensor, center: Tensor, rotation: Tensor) -> Tensor:
    """Directions in world axes of pixels.

    Args:
        image: (S, T, N, 2) pixels.
        focal: (S,) pixels.
        center: (S, 2) principal point.
        rotation: (S, 3, 3) from camera axes (right, down, forward) to the world's.

    Returns:
        (S, T, N, 3), not of unit length: 1 along the optical axis.
    """
    across = (image - center[:, None, None]) / focal[:, None, None, None]
    rays = torch.cat([across, torch.ones_like(across[..., :1])], dim=-1)
    return torch.matmul(rays, rotation[:, None].transpose(-1, -2))


def plane(rays: Tensor, azimuth: Tensor) -> Tensor:
    """Where rays (S, T, N, 3) meet the vertical plane one metre away towards the person: ``a`` and ``e``."""
    cos, sin = azimuth[..., None, 0], azimuth[..., None, 1]
    away = (rays[..., 0] * sin + rays[..., 1] * cos).clamp(min=0.05)
    a = (rays[..., 0] * cos - rays[..., 1] * sin) / away
    return torch.stack([a, rays[..., 2] / away], dim=-1).clamp(-4.0, 4.0)


def turned(vectors: Tensor, azimuth: Tensor) -> Tensor:
    """World vectors (..., 3) along axes to the right of a horizontal direction, along it, and up.

    Args:
        vectors: (..., 3).
        azimuth: (..., 2) cosine and sine of the angle of the direction from +y towards +x.
    """
    cos, sin = azimuth[..., 0], azimuth[..., 1]
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return torch.stack([x * cos - y * sin, x * sin + y * cos, z], dim=-1)


def turned_back(points: Tensor, azimuth: Tensor) -> Tensor:
    """Points (S, T, N, 3) from the frame that faces the person to world axes."""
    cos, sin = azimuth[..., None, 0], azimuth[..., None, 1]
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return torch.stack([x * cos + y * sin, y * cos - x * sin, z], dim=-1)


def level_sight(
    keypoints: Tensor,
    scores: Tensor,
    joints: Tensor,
    joint_scores: Tensor,
    boxes: Tensor,
    valid: Tensor,
    focal: Tensor,
    center: Tensor,
    rotation: Tensor,
    extent: Tensor,
    fps: Tensor,
    camera_height: Tensor,
    threshold: float = 0.3,
) -> Sight:
    """What the network needs to know about S tracks.

    Args:
        keypoints: (S, T, 17, 2) COCO keypoints in pixels.
        scores: (S, T, 17); below ``threshold`` they count as not seen.
        joints: (S, T, 14, 2) joints in pixels, see :func:`tensorsim.body.skeleton.coco_to_body`.
        joint_scores: (S, T, 14).
        boxes: (S, T, 4) ``xyxy`` pixels.
        valid: (S, T) bool, frames in which the person is tracked.
        focal: (S,) pixels.
        center: (S, 2) principal point in pixels.
        rotation: (S, 3, 3) from camera axes to world axes.
        extent: (S, 2) width and height of the picture in pixels.
        fps: (S,) frames per second.
        camera_height: (S,) of the camera above the floor, in heights of the person.
        threshold: of scores.
    """
    there = valid.to(keypoints.dtype)
    seen = (scores >= threshold).to(keypoints.dtype) * there[..., None]
    joints_seen = (joint_scores >= threshold).to(keypoints.dtype) * there[..., None]
    left, top, right, bottom = boxes.unbind(-1)
    middle_x, middle_y = (left + right) / 2, (top + bottom) / 2
    sides = torch.stack(
        [
            torch.stack([left, middle_y], dim=-1), torch.stack([right, middle_y], dim=-1),
            torch.stack([middle_x, top], dim=-1), torch.stack([middle_x, bottom], dim=-1),
        ], dim=-2,
    )  # fmt: skip
    image = torch.cat([keypoints, joints, sides], dim=-2)
    rays = world_rays(image, focal, center, rotation)

    count = seen.sum(dim=-1)
    unit = F.normalize(rays[..., :17, :], dim=-1)
    mean = (unit * seen[..., None]).sum(dim=-2) / count.clamp(min=1.0)[..., None]
    ahead = rotation[:, None, :, 2]  # used where nobody is seen for a long time
    direction = windowed_mean(mean, (count >= 3).to(there.dtype)) + 1e-6 * ahead
    flat = direction[..., :2].square().sum(dim=-1).clamp(min=1e-18).sqrt()  # well below 1e-6 squared
    azimuth = torch.stack([direction[..., 1] / flat, direction[..., 0] / flat], dim=-1)
    elevation = (direction[..., 2] / flat).clamp(-4.0, 4.0)

    points = plane(rays, azimuth)
    body = points[..., :17, :]
    centre = (body * seen[..., None]).sum(dim=-2, keepdim=True) / count.clamp(min=1.0)[..., None, None]
    square = ((body - centre).square().sum(dim=-1) * seen).sum(dim=-1) / count.clamp(min=1.0)
    enough = (count >= 5).to(there.dtype)
    size = windowed_mean(0.5 * square.clamp(min=1e-8).log()[..., None], enough)[..., 0].exp()
    known = windowed_mean(enough[..., None], torch.ones_like(enough))[..., 0] > 0
    size = torch.where(known, size, torch.full_like(size, 0.08)).clamp(min=1e-3)

    zero = torch.zeros_like(elevation)
    offset = torch.stack([zero, elevation], dim=-1)[..., None, :]
    local = (points - offset) / size[..., None, None]
    spot = local[..., :17, :].clamp(-8.0, 8.0) * seen[..., None]
    spots = local[..., 17:31, :].clamp(-8.0, 8.0) * joints_seen[..., None]
    edges = torch.stack(
        [local[..., 31, 0], local[..., 32, 0], local[..., 33, 1], local[..., 34, 1]], dim=-1
    ).clamp(-8.0, 8.0) * there[..., None]  # fmt: skip
    wide, tall = (right - left).clamp(min=1.0), (bottom - top).clamp(min=1.0)
    room = torch.stack(
        [left / wide, (extent[:, None, 0] - right) / wide, top / tall, (extent[:, None, 1] - bottom) / tall],
        dim=-1,
    ).clamp(0.0, 1.0) * there[..., None]  # fmt: skip
    rate = (30.0 / fps)[:, None].expand_as(elevation)
    # The lowest point of a person who stands, sits or lies touches the floor, and a floor point at distance d is seen
    # at e = -h / d. So -e / (h size) is one over the angular size that the body has at a distance of one body height.
    above = camera_height[:, None].clamp(0.1, 10.0)
    lowest = torch.where(seen > 0, spot[..., 1], torch.full_like(seen, 8.0)).amin(dim=-1)
    under = torch.stack([lowest, edges[..., 3]], dim=-1) + (elevation / size)[..., None]
    on_floor = (-under / above[..., None]).clamp(-4.0, 8.0) * enough[..., None]
    features = torch.cat(
        [
            spot.flatten(-2), (scores.clamp(0.0, 1.0) * seen), edges, room,
            torch.stack([elevation, 1.0 + 0.5 * size.log(), there, rate, enough], dim=-1),
            0.25 * on_floor, above[..., None].log().expand_as(enough[..., None]),
        ], dim=-1,
    )  # fmt: skip
    return Sight(features, spots, elevation, size, azimuth)

"""Keypoints of a film whose camera turns and zooms, as a still camera would have seen them.

A camera that turns about its optical centre, and zooms, maps the pixels of one picture to those of another by a
homography ``K' R K^-1`` (Hartley and Zisserman, Multiple View Geometry, 8.4), whatever the depth of what it sees. A
camera that changes its place is treated as one that turns by as much as its background shifts.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tensorsim.types import Tracks
from tensorsim.vision.smoothing.even_time import even_count

#: A camera that turns by more than this from its mean direction is not stabilised: its pictures share no image plane.
MOST_TURN_RAD = math.radians(45)
#: Nor is one if a corner's depth along the mean direction is a smaller share than this of its depth in its own picture:
#: it would land far outside.
LEAST_DEPTH = 0.2
#: Share of the picture's width and height at its left, right and lower edges where keypoints count as cut off.
_BESIDE, _BELOW = 0.01, 0.03


class StillPicture(NamedTuple):
    """People in one picture that has room for all pictures of a film.

    Attributes:
        tracks: of one clip (B = 1), boxes in pixels of this picture.
        keypoints: (1, P, T, 17, 2) pixels.
        scores: (1, P, T, 17); 0 where the film's own picture cuts a keypoint off.
        size: its height and width; its middle is where the middle of the film's picture is on average.
        margin: (2,) pixels added to a picture of the film at the left and at the top (as many right and below).
        from_film: (T, 3, 3) homographies from homogeneous pixels of each frame to a still picture of the film's size.
    """

    tracks: Tracks
    keypoints: Tensor
    scores: Tensor
    size: tuple[int, int]
    margin: Tensor
    from_film: Tensor


def camera_path(steps: Tensor, focal: float) -> tuple[Tensor, Tensor]:
    """Where a camera looks in each frame.

    Args:
        steps: (T, 4) how the background moves from the previous frame to each one: right and down in pixels at the
            middle of the picture, turn in radians (clockwise), logarithm of the zoom. The first row is not used.
        focal: focal length of the first frame in pixels.

    Returns:
        Rotations (T, 3, 3) from the camera axes (right, down, forward) of the first frame to those of each, and focal
        lengths (T,) in pixels.
    """
    steps = steps.double().clone()
    steps[0] = 0.0
    focals = focal * steps[:, 3].cumsum(dim=0).exp()
    # What was straight ahead is now to the right and below: the camera turned left and up.
    about = torch.stack(
        [-torch.atan(steps[:, 1] / focals), torch.atan(steps[:, 0] / focals), steps[:, 2]], dim=-1
    )
    x, y, z = about.unbind(-1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    at, rotations = torch.eye(3, dtype=torch.float64), []
    for step in torch.linalg.matrix_exp(skew):
        at = step @ at
        rotations.append(at)
    return torch.stack(rotations), focals


def homographies(steps: Tensor, focal: float, size: tuple[int, int]) -> Tensor | None:
    """Homographies (T, 3, 3) of :attr:`StillPicture.from_film`; None if the camera turns too far for its view.

    Args:
        steps: see :func:`camera_path`.
        focal: geometric mean of the focal lengths in pixels.
        size: height and width of the pictures.
    """
    zoomed = steps[1:, 3].double().cumsum(dim=0)
    mean = float(torch.cat([zoomed.new_zeros(1), zoomed]).mean())
    rotations, focals = camera_path(steps, focal * math.exp(-mean))
    left, _, right = torch.linalg.svd(rotations.mean(dim=0))
    sign = torch.linalg.det(left @ right)
    middle = left @ torch.diag(torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign])) @ right
    turns = middle @ rotations.mT
    trace = turns.diagonal(dim1=-2, dim2=-1).sum(dim=-1)
    if float(torch.acos(((trace - 1) / 2).clamp(-1, 1)).max()) > MOST_TURN_RAD:
        return None
    through = _intrinsics(torch.full_like(focals, focal), size) @ turns @ _intrinsics(focals, size).inverse()
    if float(_projected(_corners(size), through)[..., 2].min()) < LEAST_DEPTH:
        return None
    return through


def _corners(size: tuple[int, int]) -> Tensor:
    """The corners (4, 2) of a picture of this height and width."""
    return torch.tensor([(u, v) for u in (-0.5, size[1] - 0.5) for v in (-0.5, size[0] - 0.5)])


def _projected(points: Tensor, through: Tensor) -> Tensor:
    """Map points (..., T, N, 2) in pixels by homographies (T, 3, 3) to homogeneous ones (..., T, N, 3)."""
    whole = torch.cat([points.double(), torch.ones_like(points[..., :1]).double()], dim=-1)
    return whole @ through.to(points.device).mT


def _intrinsics(focals: Tensor, size: tuple[int, int]) -> Tensor:
    """Camera matrices (T, 3, 3) of focal lengths (T,) in pixels."""
    matrices = torch.diag_embed(torch.stack([focals, focals, torch.ones_like(focals)], dim=-1))
    matrices[:, 0, 2], matrices[:, 1, 2] = (size[1] - 1) / 2, (size[0] - 1) / 2
    return matrices


def at_even_times(steps: Tensor, times_s: Tensor, fps: float) -> Tensor:
    """Steps (T, 4) of frames at times (T,), see :func:`camera_path`, resampled to times ``k / fps``."""
    since = (times_s - times_s[0]).double().numpy()
    even = np.arange(int(even_count(times_s[-1] - times_s[0], fps))) / fps
    way = steps.double().cumsum(dim=0).numpy()
    between = np.stack([np.interp(even, since, column) for column in way.T], axis=-1)
    return torch.from_numpy(np.diff(between, axis=0, prepend=between[:1]))


def mapped(points: Tensor, through: Tensor) -> Tensor:
    """Map points (..., T, N, 2) in pixels by homographies (T, 3, 3), in float64 on the device of the points."""
    whole = _projected(points, through)
    return whole[..., :2] / whole[..., 2:]


def _margin(size: tuple[int, int], through: Tensor) -> tuple[int, int]:
    """Pixels to add at the left and top, and as many at the right and bottom, to hold all pictures of a film."""
    corners = mapped(_corners(size), through)
    outside = torch.cat([corners.amax(dim=(0, 1)), -corners.amin(dim=(0, 1))])
    beyond = outside - torch.tensor([size[1] - 0.5, size[0] - 0.5, 0.5, 0.5])
    left, above = beyond.clamp(min=0).unflatten(0, (2, 2)).amax(dim=0).ceil().tolist()
    return int(left), int(above)


def still_picture(
    tracks: Tracks, keypoints: Tensor, scores: Tensor, size: tuple[int, int], steps: Tensor, focal: float
) -> StillPicture | None:
    """People of a film in the picture of a still camera that looks where the film's does on average.

    What a picture of the film cuts off stays cut off: boxes that reach its edge reach that of the still picture, and
    keypoints at its edge are not seen.

    Args:
        tracks: of one clip (B = 1).
        keypoints: (1, P, T, 17, 2) pixels.
        scores: (1, P, T, 17).
        size: height and width of the film's pictures.
        steps: (T, 4) of the camera, see :func:`camera_path`.
        focal: mean focal length in pixels.

    Returns:
        None if the camera turns by more than :data:`MOST_TURN_RAD` from its mean direction, or so far that a corner
        of a picture has a depth below :data:`LEAST_DEPTH`.
    """
    through = homographies(steps, focal, size)
    if through is None:
        return None
    height, width = size
    beside = _margin(size, through)
    large = (height + 2 * beside[1], width + 2 * beside[0])
    margin = torch.tensor(beside, dtype=torch.float64, device=keypoints.device)

    cut_off = (keypoints[..., 0] < _BESIDE * width) | (keypoints[..., 0] > (1 - _BESIDE) * width)
    cut_off = cut_off | (keypoints[..., 1] > (1 - _BELOW) * height)
    boxes = tracks.boxes
    # A box of the same shape about its mapped middle.
    middle = (boxes[..., :2] + boxes[..., 2:])[..., None, :] / 2
    ends = torch.cat([middle, middle + torch.tensor([1.0, 0.0]).to(middle)], dim=-2)
    at, by_one = mapped(ends, through).unbind(-2)
    half = (boxes[..., 2:] - boxes[..., :2]).double() / 2 * (by_one - at).norm(dim=-1, keepdim=True)
    moved = torch.cat([at - half, at + half], dim=-1) + margin.repeat(2)
    edge = torch.tensor([0.0, 0.0, large[1] - 1.0, large[0] - 1.0]).to(moved)
    reaches = torch.cat(
        [boxes[..., :2] <= 1, boxes[..., 2:] >= torch.tensor([width - 2, height - 2]).to(boxes)], dim=-1
    )
    moved = torch.where(reaches, edge, moved)
    return StillPicture(
        tracks._replace(boxes=torch.where(tracks.valid[..., None], moved.to(boxes.dtype), boxes)),
        (mapped(keypoints, through) + margin).to(keypoints.dtype),
        scores * ~cut_off,
        large,
        margin,
        through,
    )

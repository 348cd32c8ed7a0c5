"""The floor as a camera is assumed to see it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tensorsim.config import CameraConfig

_COLOUR = (90, 200, 250)
#: The grid reaches from the radar this far ahead, and half as far to both sides, in metres.
FLOOR_M = 8


def floor_lines(camera: CameraConfig, height: int, width: int) -> np.ndarray:
    """Lines 1 m apart on the floor, y from 0 to 8 m and x from -4 to 4 m, in the picture of a camera.

    Args:
        camera: a focal length in pixels refers to this picture.
        height, width: of the picture in pixels.

    Returns:
        (n, 2, 2) float64 ``uv`` pixels of both ends of the parts of lines that are in front of the camera; they may
        lie outside the picture.
    """
    import torch

    from tensorsim.geometry.camera import NEAR_M, camera_to_world, focal_length, principal_point, project

    half = FLOOR_M / 2
    ahead = [((x, 0.0, 0.0), (x, FLOOR_M, 0.0)) for x in np.arange(-half, half + 1)]
    across = [((-half, y, 0.0), (half, y, 0.0)) for y in range(FLOOR_M + 1)]
    ends = torch.tensor(ahead + across, dtype=torch.float64)
    focal, center, pose = (
        focal_length(camera, width), principal_point(camera, height, width), camera_to_world(camera),
    )  # fmt: skip
    depth = project(ends, focal, center, pose)[1]
    ends, depth = ends[(depth > NEAR_M).any(dim=1)], depth[(depth > NEAR_M).any(dim=1)]
    # Lines are cut where they pass behind the camera.
    hidden = depth < NEAR_M
    share = ((NEAR_M - depth) / (depth.flip(1) - depth)).where(hidden, torch.zeros(()).double())
    ends = ends + share[..., None] * (ends.flip(1) - ends)
    return project(ends, focal, center, pose)[0].numpy()


def through(lines: np.ndarray, homography: np.ndarray) -> np.ndarray:
    """Map lines of :func:`floor_lines` by a homography (3, 3), leaving out those that end up behind the camera."""
    whole = np.concatenate([lines, np.ones_like(lines[..., :1])], axis=-1) @ homography.T
    whole = whole[(whole[..., 2] > 1e-3).all(axis=-1)]
    return np.asarray(whole[..., :2] / whole[..., 2:])


def draw_lines(image: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Draw lines of :func:`floor_lines` on a copy of an image (H, W, 3) uint8 RGB."""
    import cv2

    image = np.ascontiguousarray(image).copy()
    for start, stop in lines.round().astype(int).tolist():
        cv2.line(image, start, stop, _COLOUR, 1, cv2.LINE_AA)
    return image


def draw_floor(image: np.ndarray, camera: CameraConfig, to_image: np.ndarray | None = None) -> np.ndarray:
    """Draw on an image the floor that a camera sees, see :func:`floor_lines`.

    Args:
        image: (H, W, 3) uint8 RGB; not changed.
        camera: a focal length in pixels refers to this image.
        to_image: (3, 3) homography from pixels of the camera to those of the image; None if they are the same.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    lines = floor_lines(camera, *image.shape[:2])
    return draw_lines(image, lines if to_image is None else through(lines, to_image))

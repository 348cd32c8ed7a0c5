"""The floor that a camera is believed to see."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tensorsim.config import CameraConfig

_COLOUR = (90, 200, 250)


def draw_floor(image: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """Draw a grid of 1 m on the floor, 5 m to both sides of the camera and from 0.5 to 10 m ahead of it in y.

    Args:
        image: (H, W, 3) uint8 RGB; not changed.
        camera: a focal length in pixels is one of this image.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    import cv2
    import torch

    from tensorsim.geometry.camera import camera_to_world, focal_length, principal_point, project

    height, width = image.shape[:2]
    focal, center, pose = (
        focal_length(camera, width), principal_point(camera, height, width), camera_to_world(camera),
    )  # fmt: skip
    x, y = camera.position_m[:2]
    ends = [((x + k, y + 0.5), (x + k, y + 10.0)) for k in range(-5, 6)]
    ends += [((x - 5.0, y + k), (x + 5.0, y + k)) for k in range(1, 11)]
    image = np.ascontiguousarray(image).copy()
    for start, stop in ends:
        line = np.zeros((40, 3))
        line[:, :2] = np.linspace(start, stop, 40)
        pixels, depth = project(torch.from_numpy(line), focal, center, pose)
        drawable = ((pixels.abs() < 1e4).all(dim=-1) & (depth > 0.2)).numpy()
        points = pixels.round().int().tolist()
        for k in np.flatnonzero(drawable[1:] & drawable[:-1]):
            cv2.line(image, points[k], points[k + 1], _COLOUR, 1, cv2.LINE_AA)
    return image

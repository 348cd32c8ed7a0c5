"""The pinhole camera: where it stands, what a pixel sees, where a point lands."""

import math

import torch
from torch import Tensor

from tensorsim.config import CameraConfig


def camera_to_world(camera: CameraConfig) -> Tensor:
    """Pose (3, 4) float64 of a camera: ``world = pose[:, :3] @ x + pose[:, 3]``, x right, down, forward."""
    cos_yaw, sin_yaw = math.cos(camera.yaw_rad), math.sin(camera.yaw_rad)
    cos_pitch, sin_pitch = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    right = torch.tensor([cos_yaw, -sin_yaw, 0.0], dtype=torch.float64)
    forward = torch.tensor([sin_yaw * cos_pitch, cos_yaw * cos_pitch, sin_pitch], dtype=torch.float64)
    position = torch.tensor(camera.position_m, dtype=torch.float64)
    return torch.stack([right, torch.linalg.cross(forward, right), forward, position], dim=1)


def back_project(image: Tensor, reach: Tensor, focal: Tensor, center: Tensor, pose: Tensor) -> Tensor:
    """World points on lines of sight of a pinhole camera.

    Args:
        image: (..., J, 2) pixels.
        reach: (..., J) metres along the optical axis.
        focal: (...) pixels.
        center: (2,) pixels, the principal point.
        pose: (..., 3, 4) world from camera (right, down, forward).

    Returns:
        (..., J, 3) metres.
    """
    across = (image - center) * (reach / focal[..., None])[..., None]
    points = torch.cat([across, reach[..., None]], dim=-1)
    return torch.matmul(points, pose[..., :3].transpose(-1, -2)) + pose[..., None, :, 3]

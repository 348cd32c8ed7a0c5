"""The pinhole camera: its pose, projection of points to pixels, and back-projection of pixels to points."""

import math

import torch
from torch import Tensor, nn

from tensorsim.config import CameraConfig

#: Points nearer to the camera than this are not projected, nor drawn.
NEAR_M = 0.1


class Pinhole(nn.Module):
    """A camera for use inside stages that are scripted.

    Args:
        camera: its configuration.

    Attributes:
        pose: (3, 4) float64, see :func:`camera_to_world`.
    """

    pose: Tensor
    focal_px: float | None
    center_px: tuple[float, float] | None

    def __init__(self, camera: CameraConfig) -> None:
        super().__init__()
        self.focal_px, self.center_px = camera.focal_px, camera.center_px
        self.half_width = math.tan(camera.horizontal_fov_rad / 2)  # of the image, in focal lengths
        self.register_buffer("pose", camera_to_world(camera), persistent=False)

    def focal_length(self, width: int) -> float:
        """Focal length in pixels for images of ``width`` pixels, from the field of view unless it is given."""
        focal = self.focal_px
        return width / 2 / self.half_width if focal is None else focal

    def principal_point(self, height: int, width: int) -> tuple[float, float]:
        """Principal point (u, v) in pixels: the centre of the image unless it is given. Pixel centres are integers."""
        center = self.center_px
        return ((width - 1) / 2, (height - 1) / 2) if center is None else center


def focal_length(camera: CameraConfig, width: int) -> float:
    """See :meth:`Pinhole.focal_length`."""
    return Pinhole(camera).focal_length(width)


def principal_point(camera: CameraConfig, height: int, width: int) -> tuple[float, float]:
    """See :meth:`Pinhole.principal_point`."""
    return Pinhole(camera).principal_point(height, width)


def camera_to_world(camera: CameraConfig) -> Tensor:
    """Pose (3, 4) float64 of a camera: ``world = pose[:, :3] @ x + pose[:, 3]``, x right, down, forward."""
    cos_yaw, sin_yaw = math.cos(camera.yaw_rad), math.sin(camera.yaw_rad)
    cos_pitch, sin_pitch = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    right = torch.tensor([cos_yaw, -sin_yaw, 0.0], dtype=torch.float64)
    forward = torch.tensor([sin_yaw * cos_pitch, cos_yaw * cos_pitch, sin_pitch], dtype=torch.float64)
    down = torch.linalg.cross(forward, right)
    cos_roll, sin_roll = math.cos(camera.roll_rad), math.sin(camera.roll_rad)
    right, down = cos_roll * right + sin_roll * down, cos_roll * down - sin_roll * right
    position = torch.tensor(camera.position_m, dtype=torch.float64)
    return torch.stack([right, down, forward, position], dim=1)


def project(points: Tensor, focal: float, center: tuple[float, float], pose: Tensor) -> tuple[Tensor, Tensor]:
    """Projection of a pinhole camera: ``u = cu + f x / z``, ``v = cv + f y / z`` with (x, y, z) right, down, forward.

    Args:
        points: (..., 3) world metres.
        focal: f, focal length in pixels.
        center: (cu, cv), principal point in pixels.
        pose: (3, 4) world from camera, see :func:`camera_to_world`.

    Returns:
        (..., 2) pixels and (...) depth z in metres. Pixels are meaningless where the depth is below ``NEAR_M``, to
        which it is clamped.
    """
    # Equal to kornia.geometry.project_points after transform_points, which take more than twice as long.
    local = torch.matmul(points - pose[:, 3], pose[:, :3])
    depth = local[..., 2]
    scale = focal / depth.clamp(min=0.1)  # NEAR_M: TorchScript cannot read module constants
    return local[..., :2] * scale[..., None] + torch.tensor(center).to(local), depth


def back_project(image: Tensor, depth: Tensor, focal: Tensor, center: Tensor, pose: Tensor) -> Tensor:
    """The inverse of :func:`project`: world points on the lines of sight of pixels.

    Args:
        image: (..., J, 2) pixels.
        depth: (..., J) metres along the optical axis.
        focal: (...) pixels.
        center: (2,) pixels, the principal point.
        pose: (..., 3, 4) world from camera (right, down, forward).

    Returns:
        (..., J, 3) metres.
    """
    across = (image - center) * (depth / focal[..., None])[..., None]
    points = torch.cat([across, depth[..., None]], dim=-1)
    return torch.matmul(points, pose[..., :3].transpose(-1, -2)) + pose[..., None, :, 3]

"""Projection and back-projection against kornia, and as inverses of each other."""

import math

import kornia.geometry
import pytest
import torch

from tensorsim.config import CameraConfig
from tensorsim.geometry.camera import (
    NEAR_M,
    back_project,
    camera_to_world,
    focal_length,
    principal_point,
    project,
)

CAMERA = CameraConfig(position_m=(0.3, -1.0, 1.2), pitch_rad=-0.2, yaw_rad=0.4, roll_rad=0.1)
HEIGHT, WIDTH = 360, 640


def points_ahead() -> torch.Tensor:
    """(4, 5, 3) world points in front of the camera."""
    generator = torch.Generator().manual_seed(0)
    local = torch.rand(4, 5, 3, generator=generator, dtype=torch.float64) * 4 - 2
    local[..., 2] += 5
    pose = camera_to_world(CAMERA)
    return local @ pose[:, :3].T + pose[:, 3]


def test_projection_equals_kornia() -> None:
    focal, center = focal_length(CAMERA, WIDTH), principal_point(CAMERA, HEIGHT, WIDTH)
    assert focal == pytest.approx(320 / math.tan(CAMERA.horizontal_fov_rad / 2))
    assert center == (319.5, 179.5)
    pose, points = camera_to_world(CAMERA), points_ahead()
    matrix = torch.tensor([[focal, 0, center[0]], [0, focal, center[1]], [0, 0, 1]], dtype=torch.float64)
    world_to_camera = torch.linalg.inv(torch.cat([pose, torch.tensor([[0.0, 0, 0, 1]]).double()]))
    local = kornia.geometry.transform_points(world_to_camera[None], points.reshape(1, -1, 3)).reshape(4, 5, 3)
    expected = kornia.geometry.project_points(local, matrix.expand(4, 5, 3, 3))
    pixels, depth = project(points, focal, center, pose)
    torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(depth, local[..., 2])


def test_a_camera_rolled_clockwise_sees_upright_bodies_lean_to_the_left() -> None:
    camera = CameraConfig(position_m=(0.0, 0.0, 1.0), roll_rad=0.2)
    body = torch.tensor([[0.0, 5.0, 0.0], [0.0, 5.0, 2.0]], dtype=torch.float64)
    (feet, head), _ = project(body, 500.0, (320.0, 180.0), camera_to_world(camera))
    # 100 px below and above the middle, turned by 0.2 rad.
    assert head.tolist() == pytest.approx([320 - 100 * math.sin(0.2), 180 - 100 * math.cos(0.2)])
    assert feet.tolist() == pytest.approx([320 + 100 * math.sin(0.2), 180 + 100 * math.cos(0.2)])


def test_back_projection_is_the_inverse() -> None:
    focal, center = focal_length(CAMERA, WIDTH), principal_point(CAMERA, HEIGHT, WIDTH)
    pose, points = camera_to_world(CAMERA), points_ahead()
    pixels, depth = project(points, focal, center, pose)
    again = back_project(pixels, depth, torch.full((4,), focal).double(), torch.tensor(center).double(), pose)
    torch.testing.assert_close(again, points)


def test_points_behind_the_camera_stay_finite() -> None:
    pixels, depth = project(
        torch.tensor([[0.0, -5.0, 0.0]]), 500.0, (0.0, 0.0), camera_to_world(CAMERA).float()
    )
    assert float(depth) < NEAR_M
    assert bool(pixels.isfinite().all())

"""The floor drawn on a picture lies where the camera sees it."""

import math

import numpy as np
import pytest
import torch

from tensorsim.config import CameraConfig
from tensorsim.geometry.camera import camera_to_world, focal_length, principal_point, project
from tensorsim.plot import draw_floor, floor_lines

HEIGHT, WIDTH = 480, 640
CAMERAS = [
    CameraConfig(position_m=(0.0, 0.0, 1.5)),
    CameraConfig(position_m=(0.5, -1.0, 2.4), pitch_rad=-0.4, roll_rad=0.1, horizontal_fov_rad=1.2),
    CameraConfig(position_m=(-2.0, 3.0, 3.0), pitch_rad=-0.8, yaw_rad=0.6),  # lines begin behind it
]


@pytest.mark.parametrize("camera", CAMERAS)
def test_lines_are_where_points_of_the_floor_are_seen(camera: CameraConfig) -> None:
    """Every point of the grid that is seen is drawn, and no point in the middle of a cell."""
    drawn = draw_floor(np.zeros((HEIGHT, WIDTH, 3), np.uint8), camera).any(axis=2)
    how = focal_length(camera, WIDTH), principal_point(camera, HEIGHT, WIDTH), camera_to_world(camera)
    along = torch.linspace(0, 8, 401, dtype=torch.float64)
    seen = 0
    for whole in range(9):
        constant = torch.full_like(along, float(whole))
        for x, y in ((constant - 4, along), (along - 4, constant)):
            at, depth = project(torch.stack([x, y, 0 * x], dim=-1), *how)
            seen += assert_drawn(drawn, at.numpy(), depth.numpy() > 0.1)
    assert seen > 500
    middles = torch.cartesian_prod(torch.arange(-3.5, 4), torch.arange(0.5, 8), torch.zeros(1)).double()
    at, depth = project(middles, *how)
    # Cells that are smaller than some pixels have no dark middle.
    near = (depth > 0.5) & (depth < 4.0)
    columns, rows = at[near].round().long().T.numpy()
    inside = (columns >= 0) & (columns < WIDTH) & (rows >= 0) & (rows < HEIGHT)
    assert inside.sum() > 3
    assert not drawn[rows[inside], columns[inside]].any()


def assert_drawn(drawn: np.ndarray, at: np.ndarray, before: np.ndarray) -> int:
    """Pixels of points inside the picture are drawn, within one pixel of rounding; how many there are."""
    columns, rows = at[before].round().astype(int).T
    inside = (columns >= 1) & (columns < WIDTH - 1) & (rows >= 1) & (rows < HEIGHT - 1)
    for row, column in zip(rows[inside], columns[inside], strict=True):
        assert drawn[row - 1 : row + 2, column - 1 : column + 2].any(), (row, column)
    return int(inside.sum())


def test_the_floor_ends_below_the_horizon() -> None:
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    level = draw_floor(picture, CAMERAS[0])
    assert not picture.any()
    # 8 m away and 1.5 m down: f 1.5 / 8 below the middle.
    first = np.flatnonzero(level.any(axis=(1, 2)))[0]
    assert first == pytest.approx((HEIGHT - 1) / 2 + WIDTH / 2 / math.tan(math.pi / 6) * 1.5 / 8, abs=1.5)
    up = CameraConfig(position_m=(0.0, 0.0, 1.5), pitch_rad=1.2)
    assert not draw_floor(picture, up).any()
    away = CameraConfig(position_m=(0.0, 20.0, 1.5))
    assert len(floor_lines(away, HEIGHT, WIDTH)) == 0

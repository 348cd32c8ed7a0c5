"""The floor drawn on a picture lies where the camera sees it."""

import numpy as np
import pytest

from tensorsim.config import CameraConfig
from tensorsim.plot import draw_floor


def test_the_floor_ends_below_the_horizon() -> None:
    picture = np.zeros((240, 320, 3), np.uint8)
    level = draw_floor(picture, CameraConfig(position_m=(0.0, 0.0, 1.5)))
    assert not picture.any()
    rows = np.flatnonzero(level.any(axis=(1, 2)))
    # 10 m away and 1.5 m down: f 1.5 / 10 below the middle.
    assert rows[0] == pytest.approx(119.5 + 160 / np.tan(np.pi / 6) * 0.15, abs=1.5)
    tilted = draw_floor(picture, CameraConfig(position_m=(0.0, 0.0, 1.5), pitch_rad=-0.5))
    assert np.flatnonzero(tilted.any(axis=(1, 2)))[0] < rows[0]
    up = draw_floor(picture, CameraConfig(position_m=(0.0, 0.0, 1.5), pitch_rad=1.2))
    assert not up.any()

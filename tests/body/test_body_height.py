"""Standing height from legs and trunk, in any pose."""

import pytest
import torch

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.skeleton import body_height
from tensorsim.config import JOINTS


def test_height_is_that_of_published_segments() -> None:
    """Thigh 0.245, shank 0.246 and trunk 0.288 of the height: one leg straight, the other stretched to the side."""
    places = {
        "neck": (0.0, 0.0, 0.288),
        "right_hip": (0.1, 0.0, 0.0),
        "left_hip": (-0.1, 0.0, 0.0),
        "right_knee": (0.1, 0.0, -0.245),
        "right_ankle": (0.1, 0.0, -0.491),
        "left_knee": (-0.345, 0.0, 0.0),
        "left_ankle": (-0.345, 0.246, 0.0),
    }
    joints = torch.zeros(14, 3, dtype=torch.float64)
    for name, place in places.items():
        joints[JOINTS.index(name)] = torch.tensor(place)
    assert float(body_height(1.8 * joints)) == pytest.approx(1.8)
    assert body_height(joints.expand(2, 3, 14, 3)).shape == (2, 3)


def test_height_of_a_standing_body_is_its_height() -> None:
    joints = forward_kinematics(BodyPose.standing(), 1.65)
    assert float(body_height(joints)) == pytest.approx(1.65)

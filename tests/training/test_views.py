"""Pictures of a camera that is turned, and boxes in them, against cameras and outlines worked out by hand."""

import math

import numpy as np
import pytest

from tensorsim.training.views import random_turn, turned_camera, warp_boxes, warp_points

SIZE = (300, 400)


def pixels(points: np.ndarray) -> np.ndarray:
    """Where a camera of SIZE and the focal length 400 sees points (n, 3): x right, y down, z forward."""
    return 400 * points[:, :2] / points[:, 2:] + [200, 150]


def test_a_camera_tilted_down_sees_what_was_ahead_higher_up() -> None:
    scene = np.array([[0, 0, 5.0], [1, 0.5, 4], [-0.7, 1, 6]])
    angle = math.radians(20)
    # The axes of the tilted camera, written down one by one.
    forward = np.array([0, math.sin(angle), math.cos(angle)])
    below = np.array([0, math.cos(angle), -math.sin(angle)])
    tilted = np.stack([scene[:, 0], scene @ below, scene @ forward], axis=1)
    found = warp_points(pixels(scene), turned_camera(*SIZE, down_deg=20))
    np.testing.assert_allclose(found, pixels(tilted), atol=1e-9)
    assert found[0, 1] < 150


def test_panned_right_things_move_left_and_rolled_they_turn_clockwise() -> None:
    centre = np.array([[200.0, 150]])
    assert warp_points(centre, turned_camera(*SIZE, right_deg=10))[0, 0] == pytest.approx(
        200 - 400 * math.tan(math.radians(10))
    )
    right_of_it = warp_points(np.array([[260.0, 150]]), turned_camera(*SIZE, roll_deg=90))
    np.testing.assert_allclose(right_of_it, [[200, 210]], atol=1e-9)


def test_without_a_turn_all_stays() -> None:
    boxes = np.array([[10, 20, 60, 120]], np.float32)
    np.testing.assert_allclose(turned_camera(*SIZE), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(warp_boxes(boxes, np.zeros((1, 19, 3)), np.eye(3)), boxes, atol=1e-9)
    assert warp_boxes(np.zeros((0, 4)), np.zeros((0, 19, 3)), np.eye(3)).shape == (0, 4)


@pytest.mark.parametrize("seed", range(20))
def test_boxes_are_around_the_warped_outline(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = random_turn(SIZE, rng)
    low = rng.uniform(0, 200, (3, 2))
    boxes = np.concatenate([low, low + rng.uniform(20, 100, (3, 2))], axis=1)
    angle = np.linspace(0, 2 * np.pi, 4001)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for box, found in zip(boxes, warp_boxes(boxes, np.zeros((3, 19, 3)), turn), strict=True):
        outline = warp_points((box[:2] + box[2:]) / 2 + circle * (box[2:] - box[:2]) / 2, turn)
        np.testing.assert_allclose(found, [*outline.min(0), *outline.max(0)], atol=1e-2)


def test_labelled_keypoints_are_inside() -> None:
    box = np.array([[100, 50, 160, 250]], np.float32)
    keypoints = np.zeros((1, 19, 3))
    keypoints[0, :3] = [[159, 51, 2], [101, 249, 1], [300, 300, 0]]
    turn = turned_camera(*SIZE, roll_deg=45)
    found = warp_boxes(box, keypoints, turn)[0]
    points = warp_points(keypoints[0, :2, :2], turn)
    assert (points >= found[:2] - 1e-9).all()
    assert (points <= found[2:] + 1e-9).all()
    corners = warp_points(np.array([[100, 50], [160, 50], [100, 250], [160, 250.0]]), turn)
    assert (found[2:] - found[:2] < np.ptp(corners, axis=0)).all()
    # A quarter turn needs no keypoints: the box is turned as it is.
    quarter = turned_camera(*SIZE, roll_deg=90)
    corners = warp_points(np.array([[100, 50], [160, 250.0]]), quarter)
    np.testing.assert_allclose(
        warp_boxes(box, np.zeros((1, 19, 3)), quarter)[0], [*corners.min(0), *corners.max(0)], atol=1e-6
    )

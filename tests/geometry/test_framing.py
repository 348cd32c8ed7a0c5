"""The camera that has all people in its picture, against OpenCV's projection."""

import math

import cv2
import numpy as np
import pytest
import torch

from tensorsim.body.kinematics import BodyPose, forward_kinematics
from tensorsim.body.skeleton import body_to_coco
from tensorsim.config import JOINTS, CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.framing import BOX_MARGINS, camera_on, keypoint_boxes, seen_keypoints

HEIGHT, WIDTH = 360, 640


def bodies(*places: tuple[float, float]) -> torch.Tensor:
    """(P, 2, 14, 3): people who stand at (x, y) and take a step of 0.5 m away."""
    body = forward_kinematics(BodyPose.standing((2,)), 1.75) + torch.tensor([0.0, 0.0, 0.93])
    step = torch.tensor([0.0, 0.5])[:, None, None] * torch.tensor([0.0, 1.0, 0.0])
    return torch.stack([body + step + torch.tensor([x, y, 0.0]) for x, y in places]).double()


def by_opencv(points: torch.Tensor, camera: CameraConfig) -> np.ndarray:
    """Pixels of world points: first the turn about the vertical, then the tilt, of a camera that looks along +y."""
    yaw = cv2.Rodrigues(np.array([0.0, 0.0, -camera.yaw_rad]))[0]
    tilt = cv2.Rodrigues(np.array([camera.pitch_rad, 0.0, 0.0]))[0]
    world_to_level = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    rotation = world_to_level @ tilt.T @ yaw.T
    focal = WIDTH / 2 / math.tan(camera.horizontal_fov_rad / 2)
    matrix = np.array([[focal, 0, (WIDTH - 1) / 2], [0, focal, (HEIGHT - 1) / 2], [0, 0, 1]])
    shift = -rotation @ np.array(camera.position_m)
    pixels = cv2.projectPoints(
        points.reshape(-1, 1, 3).numpy(), cv2.Rodrigues(rotation)[0], shift, matrix, None
    )[0]
    return pixels.reshape(*points.shape[:-1], 2)


@pytest.mark.parametrize("places", [[(0.0, 2.5)], [(-1.0, 3.0), (2.0, 6.0)], [(1.5, 2.0)], [(0.0, 30.0)]])
def test_whole_bodies_are_in_the_picture_and_fill_it(places: list[tuple[float, float]]) -> None:
    joints = bodies(*places)
    valid = torch.ones(joints.shape[:2], dtype=torch.bool)
    camera = camera_on(joints, valid, HEIGHT, WIDTH)
    keypoints, scores = seen_keypoints(joints, valid, camera, HEIGHT, WIDTH)
    assert scores.min() == 1.0
    np.testing.assert_allclose(keypoints.numpy(), by_opencv(body_to_coco(joints), camera), atol=1e-6)
    crown = by_opencv(joints[..., 0, :] + torch.tensor([0.0, 0.0, 0.25]), camera)
    sole = by_opencv(joints[..., 10, :] - torch.tensor([0.0, 0.0, 0.10]), camera)
    reach = max(
        np.abs(np.stack([crown, sole])[..., 1] - (HEIGHT - 1) / 2).max() / (HEIGHT / 2),
        np.abs(by_opencv(joints, camera)[..., 0] - (WIDTH - 1) / 2).max() / (WIDTH / 2),
    )
    narrowest = camera.horizontal_fov_rad == pytest.approx(math.radians(40))
    assert reach <= 0.89
    assert narrowest == (places[0][1] > 10)
    assert narrowest or reach > 0.86


def test_turns_and_tilts_towards_people() -> None:
    valid = torch.ones(1, 2, dtype=torch.bool)
    right = camera_on(bodies((2.0, 4.0)), valid, HEIGHT, WIDTH)
    left = camera_on(bodies((-2.0, 4.0)), valid, HEIGHT, WIDTH)
    assert right.yaw_rad == pytest.approx(-left.yaw_rad, abs=0.02)
    assert right.yaw_rad > 0.4
    assert right.pitch_rad < 0, "most of a body is below 1.5 m"


def test_who_is_not_there_does_not_count() -> None:
    joints = bodies((0.0, 3.0), (9.0, 2.0))
    valid = torch.tensor([[True, True], [False, False]])
    camera = camera_on(joints, valid, HEIGHT, WIDTH)
    assert abs(camera.yaw_rad) < 0.05
    joints[1] = 0.0
    keypoints, scores = seen_keypoints(joints, valid, camera, HEIGHT, WIDTH)
    assert keypoints.isfinite().all()
    assert (scores.amax(dim=-1) == valid).all()
    assert (keypoints[1] == 0).all()


def test_nobody_in_front_is_refused() -> None:
    valid = torch.ones(1, 2, dtype=torch.bool)
    with pytest.raises(TensorsimError, match="no people in front"):
        camera_on(bodies((0.0, -3.0)), valid, HEIGHT, WIDTH)
    with pytest.raises(TensorsimError, match="no people in front"):
        camera_on(bodies((0.0, 3.0)), ~valid, HEIGHT, WIDTH)


def test_keypoints_outside_or_behind_have_no_score() -> None:
    joints = bodies((0.0, 3.0), (0.0, -3.0), (8.0, 3.0))
    valid = torch.ones(3, 2, dtype=torch.bool)
    scores = seen_keypoints(joints, valid, CameraConfig(), HEIGHT, WIDTH)[1]
    assert scores[1:].max() == 0
    assert scores[0, :, 0].min() == 1
    assert scores[0, 0, 15:].max() == 0, "feet 3 m from a level camera at 1.5 m are below its picture"


def test_boxes_surround_the_keypoints_that_have_a_score() -> None:
    keypoints = torch.rand(2, 17, 2) * 100 + 50
    scores = torch.ones(2, 17)
    keypoints[0, 3], scores[0, 3] = torch.tensor([900.0, 900.0]), 0.0
    scores[1] = 0.0
    boxes = keypoint_boxes(keypoints, scores)
    told = keypoints[0, scores[0] > 0].numpy()
    low, high = told.min(axis=0), told.max(axis=0)
    left, top, right, bottom = (high - low).max() * np.array(BOX_MARGINS)
    expected = [low[0] - left, low[1] - top, high[0] + right, high[1] + bottom]
    np.testing.assert_allclose(boxes[0].numpy(), expected, rtol=1e-5)
    assert (boxes[1] == 0).all()


@pytest.mark.parametrize(
    ("u", "v"), [(-0.5, 100.0), (WIDTH - 0.5, 100.0), (100.0, -0.5), (100.0, HEIGHT - 0.5)]
)
def test_the_picture_reaches_half_a_pixel_beyond_the_centres_of_its_edges(u: float, v: float) -> None:
    camera, wrist = CameraConfig(), JOINTS.index("right_wrist")
    focal = WIDTH / 2 / math.tan(camera.horizontal_fov_rad / 2)
    middle = torch.tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    for pixels, inside in ((0.1, 1.0), (-0.1, 0.0)):
        pixel = torch.tensor([u, v])
        pixel = pixel + pixels * (middle - pixel).sign() * (torch.tensor([u, v]) != 100.0)
        across = (pixel - middle) / focal * 3.0
        joints = bodies((0.0, 3.0))[:, :1].clone()
        joints[0, 0, wrist] = torch.stack([across[0], torch.tensor(3.0), 1.5 - across[1]])
        keypoints, scores = seen_keypoints(joints, torch.ones(1, 1, dtype=torch.bool), camera, HEIGHT, WIDTH)
        torch.testing.assert_close(keypoints[0, 0, 10], pixel.double(), atol=1e-4, rtol=0)
        assert float(scores[0, 0, 10]) == inside

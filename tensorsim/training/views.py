"""Pictures as taken by a rotated camera, with boxes of people that stay tight.

Pixel coordinates have (0, 0) at the outer corner of the first pixel.
"""

import math

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]


def turned_camera(
    height: float, width: float, down_deg: float = 0.0, right_deg: float = 0.0, roll_deg: float = 0.0
) -> Doubles:
    """Homography (3, 3) from a picture to that of the same camera rotated about its centre.

    ``K R K^-1`` with the longer side of the picture as focal length (a field of view of 53 degrees).

    Args:
        height: height of the picture, pixels.
        width: width of the picture, pixels.
        down_deg: downward tilt of the camera; the content of the picture moves up.
        right_deg: pan of the camera to the right.
        roll_deg: rotation of the picture after that, clockwise as seen.

    Reference:
        Hartley and Zisserman, "Multiple View Geometry in Computer Vision", section 8.4.2.
    """
    focal = max(height, width)
    intrinsic = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    (cx, sx), (cy, sy), (cz, sz) = (
        (math.cos(a), math.sin(a)) for a in np.radians([down_deg, right_deg, roll_deg])
    )
    # Axes: x right, y down, z forward. The previous view direction of a camera tilted down is above its centre.
    down = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    right = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    roll = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    turned: Doubles = intrinsic @ roll @ down @ right @ np.linalg.inv(intrinsic)
    return turned


def warp_points(points: npt.NDArray[np.floating], homography: Doubles) -> Doubles:
    """Points (..., 2) under a homography."""
    warped = points @ homography[:, :2].T + homography[:, 2]
    places: Doubles = warped[..., :2] / warped[..., 2:]
    return places


def warp_boxes(
    boxes: npt.NDArray[np.floating], keypoints: npt.NDArray[np.floating], homography: Doubles
) -> Doubles:
    """Boxes of people in a warped picture: around the ellipses inscribed in the old ones, and the keypoints.

    The corners of a box are usually empty: a box around the warped corners would be too large.

    Args:
        boxes: (n, 4) ``xyxy``.
        keypoints: (n, K, 3) x, y and v; those with v > 0 are inside the new boxes.
        homography: (3, 3); the boxes must be in front of the rotated camera.

    Returns:
        (n, 4) ``xyxy``.

    Reference:
        Hartley and Zisserman, section 2.2.3: a dual conic C* becomes H C* H^T; lines that touch it have l^T C* l = 0.
    """
    if len(boxes) == 0:
        return np.zeros((0, 4))
    middle, half = (boxes[:, :2] + boxes[:, 2:]) / 2, (boxes[:, 2:] - boxes[:, :2]) / 2
    place = np.tile(np.eye(3), (len(boxes), 1, 1))
    place[:, :2, 2] = middle
    place = homography @ place
    radii = np.concatenate([half**2, -np.ones((len(boxes), 1))], axis=1)
    conic = (place * radii[:, None]) @ place.transpose(0, 2, 1)
    last = conic[:, 2, 2, None]
    centre = conic[:, :2, 2] / last
    extent = np.sqrt(np.maximum(centre**2 - conic[:, [0, 1], [0, 1]] / last, 0))
    points = warp_points(keypoints[..., :2], homography)
    known = keypoints[..., 2:] > 0
    low = np.minimum(centre - extent, np.where(known, points, np.inf).min(axis=1))
    high = np.maximum(centre + extent, np.where(known, points, -np.inf).max(axis=1))
    return np.concatenate([low, high], axis=1)


def random_turn(size: tuple[int, int], rng: np.random.Generator) -> Doubles:
    """Homography (3, 3) of a picture (height, width) for a camera that is tilted, panned or held askew.

    Most rotations are of a few degrees; a fifth turn the picture on its side or to any angle, as if people lay.
    """
    roll = rng.normal(0, 6)
    kind = rng.random()
    if kind < 0.12:
        roll += 90 * rng.choice([-1, 1])
    elif kind < 0.2:
        roll = rng.uniform(-180, 180)
    down, right = np.clip(rng.normal(0, 1, 2), -2, 2) * [14, 10]
    return turned_camera(*size, down, right, roll)

"""A camera that keeps everybody in its picture, and the keypoints it would see without occlusion."""

import math

import torch
from torch import Tensor

from tensorsim.body.skeleton import body_to_coco
from tensorsim.config import CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.camera import NEAR_M, camera_to_world, focal_length, principal_point, project

#: Extent of a body beyond its joints: above the nose and below the ankles.
_ABOVE_M, _BELOW_M = 0.25, 0.10
#: Margins from the outermost keypoints of an upright person to the left, top, right and bottom of the box that the
#: detector finds, as shares of the longer side of the keypoints' extent; measured on rendered films.
BOX_MARGINS = (0.045, 0.07, 0.045, 0.09)
#: Smallest field of view, also for small motion.
_NARROWEST_RAD = math.radians(40.0)


def camera_on(
    joints: Tensor,
    valid: Tensor,
    height: int,
    width: int,
    margin: float = 0.12,
    position_m: tuple[float, float, float] = CameraConfig.position_m,
) -> CameraConfig:
    """A static camera with yaw, pitch and field of view such that whole bodies stay in its picture.

    Args:
        joints: (P, T, 14, 3) world metres.
        valid: (P, T) bool, who is present. Points beside or behind the camera are left out.
        height, width: of the picture in pixels.
        margin: free share of each half of the picture.
        position_m: where it stands, by default at the radar.

    Raises:
        TensorsimError: nobody is ever in front of the camera.
    """
    bodies = joints[valid].double()
    reach = bodies.new_tensor([[0.0, 0.0, _ABOVE_M], [0.0, 0.0, -_BELOW_M]])
    points = torch.cat([bodies + reach[0], bodies + reach[1]]).flatten(0, -2) - bodies.new_tensor(position_m)
    points = points[points[:, 1] > NEAR_M]
    if points.numel() == 0:
        raise TensorsimError(f"camera: got no people in front of {position_m}, expected some at larger y")
    yaw = _middle(torch.atan2(points[:, 0], points[:, 1]))
    pitch = _middle(torch.atan2(points[:, 2], points[:, :2].norm(dim=-1)))
    pose = camera_to_world(CameraConfig(position_m=(0.0, 0.0, 0.0), pitch_rad=pitch, yaw_rad=yaw))
    tangents, depth = project(points, 1.0, (0.0, 0.0), pose.to(points))
    u, v = tangents[depth > NEAR_M].abs().amax(dim=0).tolist()
    half_width = max(u, v * width / height) / (1 - margin)
    fov = max(2 * math.atan(half_width), _NARROWEST_RAD)
    return CameraConfig(None, fov, None, position_m, pitch, yaw)


def _middle(angle: Tensor) -> float:
    return float(angle.amin() + angle.amax()) / 2


def seen_keypoints(
    joints: Tensor, valid: Tensor, camera: CameraConfig, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """COCO keypoints of bodies without occlusion.

    Args:
        joints: (..., 14, 3) world metres.
        valid: (...) bool.
        camera: the camera.
        height, width: of the picture in pixels.

    Returns:
        (..., 17, 2) pixels and scores (..., 17): 1 in the picture, else 0. Absent people are at 0 with score 0.
    """
    points = torch.where(valid[..., None, None], body_to_coco(joints), 0.0)
    focal, center = focal_length(camera, width), principal_point(camera, height, width)
    pixels, depth = project(points, focal, center, camera_to_world(camera).to(points))
    inside = (pixels >= -0.5).all(dim=-1) & (pixels[..., 0] < width - 0.5) & (pixels[..., 1] < height - 0.5)
    there = valid[..., None] & (depth > NEAR_M)
    return torch.where(there[..., None], pixels, 0.0), (there & inside).to(joints.dtype)


def keypoint_boxes(keypoints: Tensor, scores: Tensor) -> Tensor:
    """Boxes (..., 4) ``xyxy`` about keypoints (..., 17, 2) with a score; zeros without any.

    Keypoints lie inside bodies, so boxes are enlarged by :data:`BOX_MARGINS` of their longer side, to be like those of
    the detector.
    """
    visible = (scores > 0)[..., None]
    low = torch.where(visible, keypoints, math.inf).amin(dim=-2)
    high = torch.where(visible, keypoints, -math.inf).amax(dim=-2)
    extra = keypoints.new_tensor(BOX_MARGINS) * (high - low).amax(dim=-1, keepdim=True)
    boxes = torch.cat([low - extra[..., :2], high + extra[..., 2:]], dim=-1)
    return torch.where(visible.any(dim=-2), boxes, 0.0)

"""How well a camera is estimated from people: generated walks in front of known cameras."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.body.kinematics import rotation
from tensorsim.body.skeleton import body_to_coco, mid_hips
from tensorsim.config import CameraConfig
from tensorsim.errors import TensorsimError
from tensorsim.geometry.camera import camera_to_world
from tensorsim.motion.activities import ActivityGenerator
from tensorsim.vision.calibration.calibrator import CameraCalibrator, CameraEstimate, with_reserve
from tensorsim.vision.calibration.camera_fit import camera_axes, place_upright
from tensorsim.vision.calibration.upright import STANDING, WALKING, ends_of_body, is_upright, walking_share

FPS = 30.0
HEIGHT, WIDTH = 480, 640
#: Walks with all keypoints in the picture in less than this share of the frames are skipped.
LEAST_SEEN = 0.5


class Walk(NamedTuple):
    """A person walking in front of a camera.

    Attributes:
        joints: (T, 14, 3) metres, the camera above the origin.
        height_m: height of the body.
        keypoints: (T, 17, 2) pixels.
        scores: (T, 17), 1 in the picture, else 0.
    """

    joints: Tensor
    height_m: float
    keypoints: Tensor
    scores: Tensor

    @property
    def seen(self) -> float:
        """Share of the frames with all keypoints in the picture."""
        return float(self.scores.all(dim=-1).double().mean())


class CameraErrors(NamedTuple):
    """Errors of one estimate.

    Attributes:
        pitch_deg: estimate minus truth.
        range: relative error, median over the frames with an upright body.
        fov_deg, height_m: estimate minus truth.
        fov_sd_deg: standard deviation of the field of view as stated by the estimate.
    """

    pitch_deg: float
    range: float
    fov_deg: float
    height_m: float
    fov_sd_deg: float


def known_camera(tilt_deg: float, height_m: float, fov_deg: float) -> CameraConfig:
    """A camera above the origin, tilted down by ``tilt_deg``."""
    return CameraConfig(
        horizontal_fov_rad=math.radians(fov_deg),
        position_m=(0.0, 0.0, height_m),
        pitch_rad=-math.radians(tilt_deg),
    )


def walk_before(camera: CameraConfig, seed: int, turn_deg: float = 80.0, seconds: float = 8.0) -> Walk:
    """A generated walk with one turn, placed at the range where most of it is in the picture.

    Args:
        camera: a camera above the origin.
        seed: seed of the person, the heading and the side of the turn.
        turn_deg: angle of the turn at half time; 0 is a straight walk.
        seconds: length.
    """
    generator = torch.Generator().manual_seed(seed)
    motion = ActivityGenerator().generate("walking", seed=generator, duration_s=seconds, rate_hz=FPS)
    joints = motion.joints[0].clone()
    angles = torch.rand(2, generator=generator, dtype=torch.float64)
    half = joints.shape[0] // 2
    pivot = mid_hips(joints[half]) * joints.new_tensor([1.0, 1.0, 0.0])
    turn = rotation(2, torch.deg2rad(turn_deg * (angles[0] - 0.5).sign()))
    joints[half:] = (joints[half:] - pivot) @ turn.mT + pivot
    joints = joints @ rotation(2, 2 * math.pi * angles[1]).mT
    hips = mid_hips(joints)[:, :2]
    middle = (hips.amin(dim=0) + hips.amax(dim=0)) / 2
    joints = joints - torch.cat([middle, middle.new_zeros(1)])
    walks = []
    for range_m in torch.arange(1.5, 15.0, 0.25).tolist():
        moved = joints + joints.new_tensor([0.0, range_m, 0.0])
        walks.append(Walk(moved, float(motion.people.height_m[0]), *_seen_by(camera, moved)))
    return max(walks, key=lambda walk: walk.seen)


def _seen_by(camera: CameraConfig, joints: Tensor) -> tuple[Tensor, Tensor]:
    """COCO keypoints of joints (T, 14, 3): pixels (T, 17, 2), and 1.0 for those in the picture (T, 17)."""
    pose = camera_to_world(camera)
    local = (body_to_coco(joints) - pose[:, 3]) @ pose[:, :3]
    focal = WIDTH / 2 / math.tan(camera.horizontal_fov_rad / 2)
    middle = local.new_tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    pixels = focal * local[..., :2] / local[..., 2:].clamp(min=0.1) + middle
    inside = ((pixels >= 0) & (pixels < local.new_tensor([WIDTH, HEIGHT]))).all(dim=-1) & (
        local[..., 2] > 0.3
    )
    return pixels, inside.to(joints.dtype)


def estimate(walk: Walk, noise_px: float, known_height: bool, seed: int = 0) -> CameraEstimate:
    """The camera estimated from keypoints of a walk with Gaussian errors of ``noise_px``, before :func:`used`."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(walk.keypoints.shape, generator=generator, dtype=torch.float64)
    keypoints = walk.keypoints + noise_px * noise
    calibrator = CameraCalibrator((walk.height_m,), 0.02) if known_height else CameraCalibrator()
    valid = walk.scores.any(dim=-1)
    return calibrator(keypoints[None], walk.scores[None], valid[None], HEIGHT, WIDTH, FPS)


def used(told: CameraEstimate) -> CameraEstimate:
    """The estimate as used by the pipeline: drawn towards a usual camera where its tilt is uncertain."""
    return with_reserve(told, HEIGHT, WIDTH)


def errors_of(found: CameraEstimate, camera: CameraConfig, walk: Walk) -> CameraErrors:
    """Errors of an estimate; ranges follow from the true keypoints and the estimated camera.

    Raises:
        TensorsimError: no frame of the walk shows an upright body.
    """
    upright = is_upright(walk.keypoints, walk.scores, 0.5)
    if not bool(upright.any()):
        raise TensorsimError("walk: got no frame with an upright body, expected at least one")
    walking = walking_share(walk.keypoints[None], upright[None], FPS)[0, :, None]
    standing, walked = (torch.tensor(points, dtype=torch.float64) for points in (STANDING, WALKING))
    above_floor = walk.height_m * (standing + walking * (walked - standing))
    middle = torch.tensor([(WIDTH - 1) / 2, (HEIGHT - 1) / 2], dtype=torch.float64)
    image = (ends_of_body(walk.keypoints) - middle) / (WIDTH / 2)
    focal = 1 / torch.tan(found.horizontal_fov_rad / 2)
    axes = camera_axes(found.pitch_rad, found.roll_rad)
    spot, _ = place_upright(
        axes, found.height_m, focal, image[None], above_floor[None], torch.zeros_like(image[None])
    )
    truth = mid_hips(walk.joints)[:, :2].norm(dim=-1)
    ratio = spot[0].norm(dim=-1) / truth
    return CameraErrors(
        math.degrees(float(found.pitch_rad) - camera.pitch_rad),
        float(ratio[upright].median()) - 1.0,
        math.degrees(float(found.horizontal_fov_rad) - camera.horizontal_fov_rad),
        float(found.height_m) - camera.position_m[2],
        math.degrees(float(found.horizontal_fov_sd_rad)),
    )

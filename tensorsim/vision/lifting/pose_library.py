"""Pools of 3D poses for nearest-match lifting: loading, scaling to body heights, turning to every heading."""

import math
from pathlib import Path

import torch
from torch import Tensor

from tensorsim.body.skeleton import body_height, mid_hips
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError, check_finite, check_floating, check_min_rank, check_size
from tensorsim.model_files import model_path

SHIPPED_LIBRARY = "pose_library_small.safetensors"


def standardise_poses(joints: Tensor) -> Tensor:
    """Poses relative to the middle of the hips, in standing body heights.

    Args:
        joints: (..., 14, 3) in any unit of length, PHYSICS axes (x right, y away, z up).

    Returns:
        (L, 14, 3): leading dimensions flattened.

    Raises:
        TensorsimError: another shape, NaN, no pose, or a pose without legs and trunk.
    """
    layout = "(..., 14, 3) joints x right, y away, z up"
    check_floating(joints, "pose library")
    check_min_rank(joints, 2, "pose library", layout)
    check_size(joints, -2, len(JOINTS), "pose library", layout)
    check_size(joints, -1, 3, "pose library", layout)
    joints = joints.reshape(-1, len(JOINTS), 3)
    if joints.shape[0] == 0:
        raise TensorsimError("pose library: got no poses, expected at least one")
    check_finite(joints, "pose library")
    height = body_height(joints)
    if bool((height <= 0).any()):
        raise TensorsimError("pose library: got a pose whose legs and trunk have no length, expected a body")
    return (joints - mid_hips(joints)[:, None]) / height[:, None, None]


def turn(joints: Tensor, angle: Tensor) -> Tensor:
    """Joints (..., J, 3) turned about the vertical by ``angle`` (...), counter-clockwise seen from above."""
    c, s = torch.cos(angle)[..., None], torch.sin(angle)[..., None]
    x, y, z = joints[..., 0], joints[..., 1], joints[..., 2]
    return torch.stack([c * x - s * y, s * x + c * y, z.expand_as(c * x)], dim=-1)


def seen_from(joints: Tensor, pitch_rad: float) -> Tensor:
    """Joints (..., J, 3) in the axes right, forward, up of a camera tilted upwards by ``pitch_rad``."""
    c, s = math.cos(pitch_rad), math.sin(pitch_rad)
    x, y, z = joints[..., 0], joints[..., 1], joints[..., 2]
    return torch.stack([x, c * y + s * z, c * z - s * y], dim=-1)


def all_headings(poses: Tensor, yaws: int) -> Tensor:
    """Every pose (L, 14, 3) at ``yaws`` evenly spaced headings: (L * yaws, 14, 3).

    Row ``l * yaws + h`` is pose l turned by 2 pi h / yaws, counter-clockwise seen from above.
    """
    angle = torch.arange(yaws, dtype=poses.dtype, device=poses.device) * (2 * math.pi / yaws)
    return turn(poses[:, None], angle).flatten(0, 1)


def load_pose_library(path: str | Path | None = None) -> Tensor:
    """Read a pool of poses.

    Args:
        path: ``.safetensors`` with a tensor ``poses`` (L, 14, 3); None reads the shipped pool.

    Returns:
        (L, 14, 3) float32, standardised: see :func:`standardise_poses`.

    Raises:
        TensorsimError: no such file, not a safetensors file, or without usable ``poses``.
    """
    from safetensors import SafetensorError, safe_open

    file = model_path(SHIPPED_LIBRARY) if path is None else Path(path)
    if not file.is_file():
        raise TensorsimError(f"pose library: no file {str(file)!r}")
    try:
        with safe_open(file, framework="pt") as stored:
            if "poses" not in stored.keys():  # noqa: SIM118 (not a dictionary)
                raise TensorsimError(
                    f"pose library: {str(file)!r} has no tensor 'poses', only {list(stored.keys())}"
                )
            poses = stored.get_tensor("poses")
    except SafetensorError as error:
        raise TensorsimError(f"pose library: {str(file)!r} is not a safetensors file ({error})") from error
    return standardise_poses(poses.float())

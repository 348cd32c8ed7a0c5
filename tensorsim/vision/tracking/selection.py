"""Which of the people in a scene count: all, those who move, the nearest one, or one by number."""

import torch
from torch import Tensor

from tensorsim.body.skeleton import mid_hips
from tensorsim.errors import TensorsimError
from tensorsim.types import Pose

#: Hips, a head or hands that get further than this from their median position count as motion.
MOVING_M = 0.25


def select_people(pose: Pose, mode: str, fps: float) -> Pose:
    """Select the people of one clip that count; the others become invalid, and numbers stay the same.

    Args:
        pose: of one clip (B = 1).
        mode: ``"all"``; ``"moving"``, those whose hips, head or hands get more than :data:`MOVING_M` away from where
            they mostly are (bystanders who sit or stand are left out); ``"nearest"``, the one with the smallest mean
            range; or the number of a person, from ``"1"``.
        fps: frames per second; somebody present for less than a quarter of a second does not count as the nearest,
            unless everybody is.

    Raises:
        TensorsimError: another mode, no such person, or several clips.
    """
    if pose.valid.shape[0] != 1:
        raise TensorsimError(f"select_people: got {pose.valid.shape[0]} clips, expected one")
    valid, joints = pose.valid[0], pose.joints[0]
    people = valid.shape[0]
    if mode == "all" or people == 0:
        return pose
    if mode == "moving":
        chosen = torch.stack([moves(joints[person][valid[person]]) for person in range(people)])
    elif mode == "nearest":
        steady = valid.sum(dim=-1) >= min(0.25 * fps, int(valid.sum(dim=-1).max()))
        range_m = torch.linalg.vector_norm(mid_hips(joints)[..., :2], dim=-1)
        mean = (range_m * valid).sum(dim=-1) / valid.sum(dim=-1).clamp(min=1)
        mean = torch.where(steady & valid.any(dim=-1), mean, torch.full_like(mean, float("inf")))
        chosen = torch.arange(people, device=valid.device) == mean.argmin()
    elif isinstance(mode, str) and mode.isdecimal() and 1 <= int(mode) <= people:
        chosen = torch.arange(people, device=valid.device) == int(mode) - 1
    else:
        raise TensorsimError(
            f"people: got {mode!r}, expected 'all', 'moving', 'nearest' or the number of one of the "
            f"{people} found"
        )
    return pose._replace(valid=pose.valid & chosen[None, :, None])


def moves(joints: Tensor) -> Tensor:
    """Whether a person with joints (T, 14, 3) m moves: () bool, false without frames."""
    if joints.shape[0] == 0:
        return torch.zeros((), dtype=torch.bool, device=joints.device)
    points = torch.cat([mid_hips(joints)[:, None], joints[:, (0, 4, 7)]], dim=1)
    away = torch.linalg.vector_norm(points - points.median(dim=0).values, dim=-1)
    # A twentieth of the frames may be wrong.
    return (away.quantile(0.95, dim=0) > MOVING_M).any()

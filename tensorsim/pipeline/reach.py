"""Where to put a radar so that it sees the people of a video, whose camera may be beyond the radar's reach."""

import torch
from torch import Tensor

from tensorsim.config import RadarConfig
from tensorsim.errors import check_points

#: When the position of a radar is chosen, nobody comes nearer to it than this.
NEAREST_M = 1.5
#: Margin before the end of the range axis, for limbs.
_ROOM_M = 0.4


def radar_ahead_m(joints: Tensor, valid: Tensor, radar: RadarConfig) -> float:
    """How far in front of the camera a radar must stand so that people are within its range axis.

    People beyond the axis do not appear in maps. The result is the smallest distance that brings in everyone possible:
    nobody may come nearer than :data:`NEAREST_M`, so distant bystanders stay out of range if somebody is nearby. If
    everybody is within the axis already, or nobody can be brought in, the radar stays beside the camera.

    Args:
        joints: (P, T, 14, 3) metres in the world of a radar at the camera, looking along y.
        valid: (P, T) bool.
        radar: the radar.

    Returns:
        Metres along y, 0 or more.

    Raises:
        TensorsimError: joints of another shape.
    """
    check_points(joints, 4, 14, 3, "joints", "(P, T, 14, 3) joints in metres")
    if not bool(valid.any()):
        return 0.0
    x, y, z = (joints - joints.new_tensor(radar.middle_m)).unbind(-1)
    # The end of the axis is a sphere: a joint off the line of sight reaches it at a smaller y.
    end = ((radar.reach_m - _ROOM_M) ** 2 - x.square() - z.square()).clamp(min=0.0).sqrt()
    there = valid[..., None]
    needed = torch.where(there, y - end, 0.0).amax(dim=(-2, -1)).clamp(min=0.0)
    allowed = torch.where(there, y - NEAREST_M, torch.inf).amin()
    return float(torch.where(needed <= allowed, needed, 0.0).amax())

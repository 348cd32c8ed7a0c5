"""Where to put a radar so that it sees the people of a film, whose camera may be farther away than it reaches."""

import torch
from torch import Tensor

from tensorsim.config import RadarConfig
from tensorsim.errors import check_points

#: Nobody comes nearer to a radar than this where its place is chosen.
NEAREST_M = 1.5
#: Room left before the end of the range axis, for limbs.
_ROOM_M = 0.4


def radar_ahead_m(joints: Tensor, valid: Tensor, radar: RadarConfig) -> float:
    """How far in front of the camera a radar has to stand so that people are within its range axis.

    People beyond the axis do not appear in maps. As few metres as bring in all who can be: nobody may come nearer than
    :data:`NEAREST_M`, so that far away bystanders of somebody nearby stay beyond. Where everybody is within the axis,
    or nobody can be brought in, the radar stays beside the camera.

    Args:
        joints: (P, T, 14, 3) m in the world of the radar at the camera, looking along y.
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
    # On the end of the axis a joint beside the line of sight is less far ahead.
    end = ((radar.reach_m - _ROOM_M) ** 2 - x.square() - z.square()).clamp(min=0.0).sqrt()
    there = valid[..., None]
    needed = torch.where(there, y - end, 0.0).amax(dim=(-2, -1)).clamp(min=0.0)
    allowed = torch.where(there, y - NEAREST_M, torch.inf).amin()
    return float(torch.where(needed <= allowed, needed, 0.0).amax())

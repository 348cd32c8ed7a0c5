"""Steps taken during a movement on the spot: a lunge into a punch, a step back after a kick."""

import torch
from torch import Tensor

from tensorsim.motion.feet import LEFT_LEG, RIGHT_LEG, place_ankles
from tensorsim.motion.timing import bell, segment

#: Fraction of a step in which each foot moves: the first foot at its beginning, the second at its end.
_ONE_FOOT = 0.65
#: How far a foot is lifted and the hips sink in the middle of a step, as fractions of its length.
_LIFT, _SINK = 0.15, 0.12


def step_about(joints: Tensor, time: Tensor, start_s: Tensor, lasts_s: Tensor, way_m: Tensor) -> Tensor:
    """Add steps to the motion of bodies: the hips move along, one foot first and then the other.

    Bones keep their lengths; the legs bend to reach the feet (:func:`~tensorsim.motion.feet.place_ankles`).

    Args:
        joints: (N, K, 14, 3) m, z up from the floor.
        time: (N, K) times of the frames in s.
        start_s, lasts_s: (N, S) start and duration of each step in s.
        way_m: (N, S, 2) displacement of each step, x and y in m.

    Returns:
        (N, K, 14, 3) m.
    """
    body = torch.zeros_like(joints[..., 0, :])
    feet = torch.zeros_like(joints[..., :2, :])  # right, left
    for s in range(way_m.shape[1]):
        start, end = start_s[:, s, None], (start_s + lasts_s)[:, s, None]
        one_foot = _ONE_FOOT * lasts_s[:, s, None]
        way = torch.nn.functional.pad(way_m[:, s], (0, 1))
        length = way.norm(dim=-1)[:, None]
        down = _SINK * length * bell(time, start, end)
        body = body + segment(time, start, end)[..., None] * way[:, None]
        body = torch.cat([body[..., :2], body[..., 2:] - down[..., None]], dim=-1)
        for foot in (0, 1):
            # Every other step begins with the other foot.
            first = start if (s + foot) % 2 == 0 else end - one_foot
            moved = segment(time, first, first + one_foot)[..., None] * way[:, None]
            up = _LIFT * length * bell(time, first, first + one_foot)
            moved = torch.cat([moved[..., :2], up[..., None]], dim=-1)
            feet[..., foot, :] = feet[..., foot, :] + moved
    moved = joints + body[..., None, :]
    ankles = joints[..., (RIGHT_LEG + 2, LEFT_LEG + 2), :] + feet
    across = joints[..., RIGHT_LEG, :] - joints[..., LEFT_LEG, :]
    forward = torch.stack([-across[..., 1], across[..., 0], torch.zeros_like(across[..., 0])], dim=-1)
    forward = forward / forward.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    thigh = (joints[..., RIGHT_LEG, :] - joints[..., RIGHT_LEG + 1, :]).norm(dim=-1)
    shank = (joints[..., RIGHT_LEG + 1, :] - joints[..., RIGHT_LEG + 2, :]).norm(dim=-1)
    return place_ankles(moved, ankles, forward, thigh, shank)

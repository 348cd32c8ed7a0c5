"""Motion of people while they are absent from the scene."""

import torch
from torch import Tensor

from tensorsim.errors import check_mask, check_min_rank
from tensorsim.vision.smoothing.along_time import seen_beside


def continued(joints: Tensor, valid: Tensor) -> Tensor:
    """Replace the joints in frames in which a person is absent by motion without jumps.

    A spline is affected by neighbouring frames: a jump where somebody leaves would show in the echo while that person
    is still there. Here motion continues with the velocity of the last two frames, slowing down, and within a gap it
    blends into the motion that leads into the next run in the same way.

    Args:
        joints: (..., T, J, 3); values in frames that are not valid do not matter.
        valid: (..., T) bool.

    Returns:
        (..., T, J, 3), equal to ``joints`` where valid; zeros for people who are never there.

    Raises:
        TensorsimError: wrong shapes, or valid not boolean.
    """
    check_min_rank(joints, 3, "joints", "(..., T, J, 3)")
    check_mask(valid, list(joints.shape[:-2]), "valid")
    if bool(valid.all()):
        return joints
    frames = joints.shape[-3]
    present = torch.where(valid[..., None, None], joints, torch.zeros_like(joints))
    frame = torch.arange(frames, device=valid.device)
    before, after = seen_beside(valid)
    ahead = _beyond(present, valid, before, 1)
    back = _beyond(present, valid, after, -1)
    since, until = (frame - before).to(joints.dtype), (after - frame).to(joints.dtype)
    share = since / (since + until).clamp(min=1.0)
    share = torch.where(before < 0, 1.0, torch.where(after >= frames, 0.0, share**2 * (3 - 2 * share)))
    moved = ahead + share[..., None, None] * (back - ahead)
    return torch.where(valid[..., None, None], joints, moved)


def _beyond(joints: Tensor, valid: Tensor, edge: Tensor, sense: int) -> Tensor:
    """Motion extrapolated beyond the frames ``edge`` (..., T), forwards (``sense`` 1) or backwards (-1) in time."""
    frames = valid.shape[-1]
    last = edge.clamp(0, frames - 1)
    previous = (last - sense).clamp(0, frames - 1)
    shape = joints.shape
    at_last = joints.gather(-3, last[..., None, None].expand(shape))
    step = at_last - joints.gather(-3, previous[..., None, None].expand(shape))
    known = valid.gather(-1, previous) & (previous != last)
    since = (torch.arange(frames, device=valid.device) - edge).abs().to(joints.dtype)
    slowing = 6.0  # frames after which the speed has fallen to a third
    way = slowing * (1 - torch.exp(-since / slowing)) * known
    return at_last + way[..., None, None] * step

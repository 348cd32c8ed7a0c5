"""Joints that jump: positions that no body can reach are removed before smoothing, and speeds limited after it."""

import torch
from torch import Tensor


def reachable_chain(
    positions: Tensor, valid: Tensor, fps: float, top_speed: float, reach_s: float = 0.5
) -> Tensor:
    """The largest set of frames among which a point never moves faster than ``top_speed``.

    Dynamic programming over chains of frames, as for the longest increasing subsequence; after a gap of more than
    ``reach_s`` the point may be anywhere.

    Args:
        positions: (N, T, 3) metres; ignored in frames that are not valid.
        valid: (N, T) bool.
        fps: frames per second.
        top_speed: m/s.
        reach_s: seconds that a chain looks back.

    Returns:
        (N, T) bool, true in frames of the chain, a subset of ``valid``. Of equally long chains the one that ends first.
    """
    points, frames = positions.shape[0], positions.shape[1]
    window = max(int(reach_s * fps), 1)
    count = torch.zeros(
        points, frames + 1, device=positions.device
    )  # links of the best chain that ends at a frame
    before = torch.full((points, frames + 1), frames, dtype=torch.int64, device=positions.device)
    # The best chain that ended too long ago for its position to matter; the last column stands for no chain at all.
    old_count = torch.zeros(points, device=positions.device)
    old = torch.full((points,), frames, dtype=torch.int64, device=positions.device)
    for t in range(frames):
        if t > window:
            newer = count[:, t - window - 1] > old_count
            old = torch.where(newer, torch.full_like(old, t - window - 1), old)
            old_count = torch.where(newer, count[:, t - window - 1], old_count)
        best, link = old_count, old
        first = max(t - window, 0)
        if first < t:
            step = torch.linalg.vector_norm(positions[:, t : t + 1] - positions[:, first:t], dim=-1)
            frames_apart = torch.arange(t - first, 0, -1, device=positions.device)
            near = valid[:, first:t] & (step <= frames_apart * (top_speed / fps))
            chains = torch.where(near, count[:, first:t], torch.zeros_like(step[:1, :1], dtype=count.dtype))
            longest, index = chains.max(dim=-1)
            better = longest > best
            best, link = torch.where(better, longest, best), torch.where(better, index + first, link)
        count[:, t] = torch.where(valid[:, t], best + 1.0, torch.zeros_like(best))
        before[:, t] = link
    kept = torch.zeros(points, frames + 1, dtype=torch.bool, device=positions.device)
    at = count[:, :frames].argmax(dim=-1)
    at = torch.where(valid.any(dim=-1), at, torch.full_like(at, frames))
    for _ in range(frames):
        kept = kept.scatter(1, at.unsqueeze(-1), torch.ones_like(kept[:, :1]))
        at = before.gather(1, at.unsqueeze(-1)).squeeze(-1)
    return kept[:, :frames] & valid


def without_jumps(joints: Tensor, valid: Tensor, fps: float, top_speed: float) -> Tensor:
    """Which joints to trust, (..., T, J) bool: :func:`reachable_chain` for each joint.

    Args:
        joints: (..., T, J, 3) metres.
        valid: (..., T, J) bool.
        fps: frames per second.
        top_speed: m/s that no joint exceeds.
    """
    if joints.numel() == 0:
        return valid
    shape = valid.transpose(-1, -2).shape
    positions = joints.detach().transpose(-2, -3).reshape(-1, shape[-1], 3)
    chain = reachable_chain(positions, valid.transpose(-1, -2).reshape(-1, shape[-1]), fps, top_speed)
    return chain.reshape(shape).transpose(-1, -2)


def limit_speed(joints: Tensor, fps: float, top_speed: float) -> Tensor:
    """Joints (..., T, J, 3) that follow the given ones at ``top_speed`` (m/s) at most; slower ones are unchanged."""
    frames = joints.shape[-3]
    if frames == 0:
        return joints
    limit = top_speed / fps
    followed = [joints[..., 0, :, :]]
    for t in range(1, frames):
        step = joints[..., t, :, :] - followed[-1]
        length = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
        followed.append(followed[-1] + step * (limit / length.clamp(min=1e-9)).clamp(max=1.0))
    return torch.stack(followed, dim=-3)

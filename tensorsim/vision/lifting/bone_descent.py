"""Levenberg-Marquardt on :class:`~tensorsim.vision.lifting.bone_cost.BoneCost`.

The normal equations couple a frame to the two before it and are solved in pairs of frames, so the work grows linearly
with the length of the clip. The lengths of bones, which all frames share, are eliminated by a Schur complement.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tensorsim.vision.lifting.block_tridiagonal import solve_block_tridiagonal
from tensorsim.vision.lifting.bone_cost import BoneClip, BoneCost


def second_difference_hessian(stiffness: Tensor, frames: int) -> tuple[Tensor, Tensor, Tensor]:
    """Hessian of squared second differences along T frames, in pairs of frames; the last pair may be half empty.

    Args:
        stiffness: (S, T + 2, J) weights, 0 at both ends.
        frames: T.

    Returns:
        Diagonal (S, 2 K, J) of K pairs, coupling (S, K, J, J) of the two frames of a pair, and of each pair to the
        one before it (S, K - 1, 2 J, 2 J).
    """
    pairs = (frames + 1) // 2
    stiffness = F.pad(stiffness, [0, 0, 0, 2 * pairs - frames])
    diagonal = (stiffness[:, :-2] + 4 * stiffness[:, 1:-1] + stiffness[:, 2:])[:, : 2 * pairs]
    next_two = stiffness[:, 2:]
    next_one = -2 * (stiffness[:, 1:-1] + next_two)
    within = torch.diag_embed(next_one[:, 0::2])
    corner = torch.diag_embed(next_two[:, 0 : 2 * pairs - 2 : 2])
    beside = torch.diag_embed(next_one[:, 1 : 2 * pairs - 2 : 2])
    other = torch.diag_embed(next_two[:, 1 : 2 * pairs - 2 : 2])
    upper = torch.cat([corner, beside], dim=-1)
    return diagonal, within, torch.cat([upper, torch.cat([torch.zeros_like(corner), other], dim=-1)], dim=-2)


class BoneDescent(nn.Module):
    """Steps of Levenberg-Marquardt.

    Args:
        cost: the sum to minimise.

    Shapes:
        clip, distances (S, T, 13), logarithms of relative lengths (S, 8), deviation of bones (S), number of steps ->
        distances and logarithms after these steps, of no higher cost. Differentiable.
    """

    def __init__(self, cost: BoneCost) -> None:
        super().__init__()
        self.cost = cost

    def forward(
        self, clip: BoneClip, r: Tensor, stretch: Tensor, bone_m: Tensor, steps: int
    ) -> tuple[Tensor, Tensor]:
        """Distances and logarithms after ``steps`` steps."""
        diagonal, within, below = second_difference_hessian(clip.stiffness, r.shape[1])
        damping = torch.ones(r.shape[0], dtype=r.dtype, device=r.device)
        cost = self.cost(clip, r, stretch, bone_m)
        for _ in range(steps):
            step, stretch_step = self._step(clip, r, stretch, bone_m, damping, diagonal, within, below)
            next_r, next_stretch = r + step, stretch + stretch_step
            next_cost = self.cost(clip, next_r, next_stretch, bone_m)
            better = next_cost < cost
            r = torch.where(better[:, None, None], next_r, r)
            stretch = torch.where(better[:, None], next_stretch, stretch)
            cost = torch.where(better, next_cost, cost)
            damping = torch.where(better, (damping / 6).clamp(min=1e-6), damping * 5)
        return r, stretch

    def _step(
        self,
        clip: BoneClip,
        r: Tensor,
        stretch: Tensor,
        bone_m: Tensor,
        damping: Tensor,
        diagonal: Tensor,
        within: Tensor,
        below: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """One damped Gauss-Newton step of the distances (S, T, 13) and the logarithms of lengths (S, 8)."""
        tracks, frames = r.shape[0], r.shape[1]
        pairs = (frames + 1) // 2
        eye = torch.eye(13, dtype=r.dtype, device=r.device)
        gradient, hessian, jacobian, error = self._distance_terms(clip, r, stretch, bone_m)
        cross = torch.matmul(jacobian[..., :13].transpose(-1, -2), jacobian[..., 13:])
        right = torch.cat([-gradient[..., None], -cross], dim=-1)
        if frames % 2 == 1:  # an empty frame fills the last pair
            hessian = torch.cat([hessian, eye.expand(tracks, 1, 13, 13)], dim=1)
            right = torch.cat([right, torch.zeros_like(right[:, :1])], dim=1)
        hessian = hessian + torch.diag_embed(diagonal) + 250.0 * damping[:, None, None, None] * eye
        blocks = torch.cat(
            [torch.cat([hessian[:, 0::2], within], dim=-1), torch.cat([within, hessian[:, 1::2]], dim=-1)],
            dim=-2,
        )
        solved = solve_block_tridiagonal(blocks, below, right.reshape(tracks, pairs, 26, 9))
        solved = solved.reshape(tracks, 2 * pairs, 13, 9)[:, :frames]

        # The lengths by the Schur complement, then the distances given the lengths.
        by_length = jacobian[..., 13:]
        length_share = self.cost.length_share
        length_gradient = torch.matmul(by_length.transpose(-1, -2), error[..., None])[..., 0].sum(dim=1)
        length_gradient = length_gradient + stretch / length_share**2
        length_hessian = torch.matmul(by_length.transpose(-1, -2), by_length).sum(dim=1)
        length_hessian = length_hessian + (1 / length_share**2 + 1e3 * damping[:, None, None]) * torch.eye(
            8, dtype=r.dtype, device=r.device
        )
        cross = cross.flatten(1, 2).transpose(-1, -2)
        flat = solved.flatten(1, 2)
        schur = length_hessian + torch.matmul(cross, flat[..., 1:])
        right_side = length_gradient + torch.matmul(cross, flat[..., :1])[..., 0]
        stretch_step = torch.linalg.solve(schur, -right_side)
        step = solved[..., 0] + torch.matmul(flat[..., 1:], stretch_step[..., None])[..., 0].reshape(r.shape)
        return step, stretch_step

    def _distance_terms(
        self, clip: BoneClip, r: Tensor, stretch: Tensor, bone_m: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Half the gradient (S, T, 13) and Hessian (S, T, 13, 13) in the distances, without second differences in the
        latter, and the Jacobian (S, T, 12, 13 + 8) of bone errors in distances and lengths, and these (S, T, 12)."""
        directions, expected, error, deviation = self.cost.bone_errors(clip, r, stretch, bone_m)
        along = torch.matmul(directions, clip.lines.transpose(-1, -2))
        by_distance = along * self.cost.bones / deviation[..., None]
        owner = F.one_hot(self.cost.length_of_bone, 8).to(r.dtype)
        by_length = -(expected[:, None] / deviation)[..., None] * owner

        bend = (r[:, 2:] - 2 * r[:, 1:-1] + r[:, :-2]) * clip.stiffness[:, 2:-2]
        gradient = F.pad(bend, [0, 0, 2, 0]) - 2 * F.pad(bend, [0, 0, 1, 1]) + F.pad(bend, [0, 0, 0, 2])
        gradient = gradient + torch.matmul(by_distance.transpose(-1, -2), error[..., None])[..., 0]
        given_gradient, hessian, _ = self.cost.given(clip, r)
        gradient = gradient + given_gradient
        hessian = hessian + torch.matmul(by_distance.transpose(-1, -2), by_distance)
        if self.cost.has_floor:
            floor_gradient, floor_hessian, _ = self.cost.floor(clip, r)
            gradient, hessian = gradient + floor_gradient, hessian + torch.diag_embed(floor_hessian)
        return gradient, hessian, torch.cat([by_distance, by_length], dim=-1), error

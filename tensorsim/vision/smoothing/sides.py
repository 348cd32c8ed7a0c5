"""Left and right of people over time: limbs that a network exchanges for some frames are exchanged back.

Networks confuse the sides of people seen from behind or from the side, for single frames or for longer. Exchanged
limbs jump: the vector from the right to the left ankle turns round from one frame to the next.
"""

import torch
from torch import Tensor, nn

from tensorsim.errors import check_keypoints, check_positive, check_score


def viterbi_two_states(stay: Tensor, change: Tensor, second: float) -> Tensor:
    """The cheapest path of a chain with two states, the first of which is the usual one.

    Args:
        stay: (N, T - 1) cost of both frames of a pair being in the same state.
        change: (N, T - 1) cost of their being in different states.
        second: cost of a frame in the second state.

    Returns:
        (N, T) bool, true where the path is in the second state.
    """
    steps = stay.shape[1]
    usual = stay.new_zeros(stay.shape[0], 1)
    other = usual + second
    from_usual: list[Tensor] = []
    from_other: list[Tensor] = []
    for t in range(steps):
        same, different = stay[:, t : t + 1], change[:, t : t + 1]
        a, b = usual + same, other + different
        c, d = usual + different, other + same
        from_usual.append(b < a)  # whether the cheapest path to the usual state comes from the other one
        from_other.append(d <= c)
        usual, other = torch.minimum(a, b), torch.minimum(c, d) + second
    at = other < usual
    path = [at]
    for t in range(steps - 1, -1, -1):
        at = torch.where(at, from_other[t], from_usual[t])
        path.append(at)
    path.reverse()
    return torch.cat(path, dim=1)


class SteadySides(nn.Module):
    """Exchanges left and right keypoints where that makes limbs move steadily.

    Arms (with the shoulders) and legs (with the hips) are two chains of two states, as found or exchanged. From one
    frame to the next each pair of points, left and right, costs the squared change of the vector between them, in
    sizes of the person, times the lowest of its scores. A change of state costs ``change``: the ankles of a walk seen
    from the side, which pass each other in a few frames, cost less. The path of least cost is taken (Viterbi, IEEE
    Trans. Inf. Theory 13, 1967). Each exchanged frame costs a little, so the sides found most of the time are kept.

    Args:
        change: squared sizes of the person at 30 frames per second; twice that at 15 and below.
        exchanged: cost of an exchanged frame at up to 30 frames per second; above, the cost per second is constant.
        threshold: score from which a point counts.

    Shapes:
        COCO keypoints (..., T, 17, 2) pixels, scores (..., T, 17), valid (..., T) bool, frames per second ->
        keypoints and scores. Differentiable, except for the choice of those to exchange.

    Raises:
        TensorsimError: costs that are not positive, wrong shapes, NaN.
    """

    def __init__(self, change: float = 0.06, exchanged: float = 0.02, threshold: float = 0.3) -> None:
        super().__init__()
        check_positive(change, "SteadySides.change")
        check_positive(exchanged, "SteadySides.exchanged")
        check_score(threshold, "SteadySides.threshold")
        self.change, self.exchanged, self.threshold = change, exchanged, threshold

    def forward(self, keypoints: Tensor, scores: Tensor, valid: Tensor, fps: float) -> tuple[Tensor, Tensor]:
        """Keypoints, scores, valid, frame rate -> keypoints and scores of steady sides."""
        check_keypoints(keypoints, scores, valid, 3, "(..., T, 17, 2) keypoints in pixels")
        check_positive(fps, "fps")
        if valid.numel() == 0:
            return keypoints, scores
        shape, frames = keypoints.shape, keypoints.shape[-3]
        points, weights = keypoints.reshape(-1, frames, 17, 2), scores.reshape(-1, frames, 17)
        weights = torch.where(valid.reshape(-1, frames, 1) & (weights >= self.threshold), weights, 0.0)
        arms = self._exchanged(points.detach(), weights.detach(), 5, fps)[..., None]
        legs = self._exchanged(points.detach(), weights.detach(), 11, fps)[..., None]
        arms, legs = arms.expand(-1, -1, 6), legs.expand(-1, -1, 6)
        swap = torch.cat([torch.zeros_like(arms[..., :5]), arms, legs], dim=-1).reshape(scores.shape)
        # COCO alternates left and right from the shoulders on.
        opposite = torch.tensor(
            [0, 1, 2, 3, 4, 6, 5, 8, 7, 10, 9, 12, 11, 14, 13, 16, 15], device=keypoints.device
        )
        other = keypoints.index_select(-2, opposite)
        keypoints = torch.where(swap[..., None], other, keypoints).reshape(shape)
        return keypoints, torch.where(swap, scores.index_select(-1, opposite), scores)

    def _exchanged(self, points: Tensor, weights: Tensor, first: int, fps: float) -> Tensor:
        """Frames (N, T) in which the three pairs from keypoint ``first`` on are exchanged."""
        pairs, both = points[:, :, first : first + 6], weights[:, :, first : first + 6]
        between = pairs[:, :, 0::2] - pairs[:, :, 1::2]
        trust = torch.minimum(both[:, :, 0::2], both[:, :, 1::2])
        seen = (weights > 0)[..., None]
        high = torch.where(seen, points, float("-inf")).amax(dim=2)
        low = torch.where(seen, points, float("inf")).amin(dim=2)
        size = (high - low).amax(dim=-1).clamp(min=1.0, max=1e6)
        size = torch.maximum(size[:, 1:], size[:, :-1])[..., None, None]
        before, after = between[:, :-1] / size, between[:, 1:] / size
        trust = torch.minimum(trust[:, 1:], trust[:, :-1])
        stay = (trust * (after - before).square().sum(dim=-1)).sum(dim=-1)
        change = (trust * (after + before).square().sum(dim=-1)).sum(dim=-1)
        penalty = self.change * min(max(30.0 / fps, 1.0), 2.0)
        return viterbi_two_states(stay, change + penalty, self.exchanged * min(30.0 / fps, 1.0))

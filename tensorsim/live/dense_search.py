"""Nearest poses, frame by frame: each frame is compared with the whole pool at once, by a precomputed table."""

import torch
from torch import Tensor, nn

from tensorsim.vision.lifting.pose_library import all_headings, seen_from
from tensorsim.vision.lifting.pose_search import PoseSearch, normalise_weights, seen_along_depth


class DenseSearch(nn.Module):
    """The result of :class:`~tensorsim.vision.lifting.pose_search.PoseSearch`, in float32, for few frames at a time.

    That class saves comparisons when many frames share the work; for a single frame its preparation costs more than
    one pass over all poses, which takes ten milliseconds for 300 000.

    Args:
        search: the pool, its headings and the number of neighbours.

    Shapes:
        keypoints (N, 14, 2) and weights (N, 14) >= 0 -> (N, neighbours) int64, best first.
    """

    table: Tensor

    def __init__(self, search: PoseSearch) -> None:
        super().__init__()
        self.search, self.neighbours = search, search.neighbours
        seen = torch.cat(
            [
                seen_along_depth(seen_from(all_headings(part, search.yaws), search.pitch_rad)).float()
                for part in search.library.split(8192)
            ]
        )
        power = seen[:, :14].square() + seen[:, 14:].square()
        self.register_buffer("table", torch.cat([seen, power], dim=-1).t().contiguous(), persistent=False)

    def forward(self, keypoints: Tensor, weights: Tensor) -> Tensor:
        """The indices of the poses with the largest weighted cosines."""
        w = normalise_weights(weights)
        k = keypoints - (w[..., None] * keypoints).sum(dim=-2, keepdim=True)
        moment = torch.cat([w * k[..., 0], w * k[..., 1]], dim=-1).to(self.table.dtype)
        w = w.to(self.table.dtype)
        power = w @ self.table[28:]
        spread = power - (w @ self.table[:14]).square() - (w @ self.table[14:28]).square()
        norm = (spread - 1e-6 * power).clamp(min=1e-9).sqrt()
        return (moment @ self.table[:28] / norm).topk(self.neighbours, dim=-1)[1]

    def poses(self, index: Tensor) -> Tensor:
        """Poses (..., 14, 3) of indices (...)."""
        return self.search.poses(index)

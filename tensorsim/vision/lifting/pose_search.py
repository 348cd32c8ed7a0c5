"""Exact search of a large pool of poses for those whose projections fit keypoints best.

The pool is sorted once into blocks of similar poses. A frame is compared only with blocks that the triangle inequality
does not rule out, by matrix products in bfloat16 (float32 for unequal weights) whose rounding error is bounded. What
the bound does not exclude is computed in float64: the result equals that of a full search.
"""

import math

import torch
from torch import Tensor, nn

from tensorsim.errors import is_exporting
from tensorsim.vision.lifting.pose_library import all_headings, seen_from, turn

#: Largest number of poses in a block; in a pool that needs more than one, about half as many is the smallest.
BLOCK = 8192
#: Poses that an exported graph compares at once.
EXPORTED = 2**17
#: Cosines in float32 may be this much too low.
ROUNDING = 1e-5
#: All blocks but the last hold a multiple of this many poses.
_STRIDE = 64


def normalise_weights(weights: Tensor) -> Tensor:
    """Weights (..., J) summing to one over the joints; all zero stays all zero."""
    return weights / weights.sum(dim=-1, keepdim=True).clamp(min=1e-12)


def seen_along_depth(poses: Tensor) -> Tensor:
    """Poses (..., 14, 3) projected along depth, centred, at unit norm: (..., 28), x of all joints, then v."""
    flat = torch.stack([poses[..., 0], -poses[..., 2]], dim=-2)
    flat = flat - flat.mean(dim=-1, keepdim=True)
    flat = flat.flatten(-2)
    return flat / torch.linalg.vector_norm(flat, dim=-1, keepdim=True).clamp(min=1e-12)


def weighted_cosine(keypoints: Tensor, weights: Tensor, poses: Tensor) -> Tensor:
    """Agreement of poses with keypoints: the cosine between both, weighted and each about its weighted mean.

    The best scale a > 0 and shift b leave ``sum_j w_j |k_j - a p_j - b|^2 = (1 - cos^2) sum_j w_j |k_j - k|^2``;
    a pose that fits only upside down has a cosine below zero.

    Args:
        keypoints: (..., 14, 2) pixels, v down.
        weights: (..., 14), not negative, summing to one.
        poses: (..., 14, 3).

    Returns:
        (...), computed in float64.
    """
    w = weights.double()[..., None]
    k = keypoints.double()
    p = torch.stack([poses[..., 0], -poses[..., 2]], dim=-1).double()
    k, p = k - (w * k).sum(dim=-2, keepdim=True), p - (w * p).sum(dim=-2, keepdim=True)
    product = (w * k * p).sum(dim=(-2, -1))
    size = (w * k.square()).sum(dim=(-2, -1)) * (w * p.square()).sum(dim=(-2, -1))
    return product / size.clamp(min=1e-24).sqrt()


def cosine_table(moment: Tensor, weights: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`weighted_cosine` of every frame with every pose by matrix products, and the poses' weighted norms.

    Args:
        moment: (N, 28) weighted keypoints about their weighted mean, at unit weighted norm.
        weights: (N, 14) summing to one.
        seen: (L, 28) from :func:`seen_along_depth`.

    Returns:
        cosines (N, L), rounded up by what float32 may lose where the seen joints lie close together, and the
        norms (N, L).
    """
    x, v = seen[:, :14].t(), seen[:, 14:].t()
    x_mean, v_mean = torch.mm(weights, x), torch.mm(weights, v)
    spread = torch.mm((1.0 - 1e-6) * weights, x.square() + v.square())
    norm = (
        spread.addcmul_(x_mean, x_mean, value=-1.0)
        .addcmul_(v_mean, v_mean, value=-1.0)
        .clamp_(min=1e-9)
        .sqrt_()
    )
    return torch.mm(moment, seen.t()).div_(norm).add_(1e-6), norm


def reach_table(moment: Tensor, weights: Tensor, seen: Tensor, least: Tensor, slack: float) -> Tensor:
    """Not negative where the :func:`cosine_table` of a frame and a pose may reach ``least`` (N,) >= 0 of the frame.

    A cosine is a product over a norm, whose square is ``power - x^2 - v^2``. Both sides of
    ``product >= least norm`` are squared, which takes neither root nor quotient::

        max(product, 0)^2 + (least x)^2 + (least v)^2 - (least^2 - slack) power >= 0

    Rounding in float32 changes that by less than ``slack``, 1e-5, of the power.
    """
    x, v = seen[:, :14].t(), seen[:, 14:].t()
    least = least.to(seen.dtype)[:, None]
    score = torch.mm((slack - least.square()) * weights, x.square() + v.square())
    product = torch.mm(moment, seen.t()).clamp_(min=0.0)
    score.addcmul_(product, product)
    for axis in [x, v]:
        mean = torch.mm(least * weights, axis)
        score.addcmul_(mean, mean)
    return score


def blocks_of_similar(points: Tensor, block: int) -> tuple[Tensor, list[int]]:
    """Sort points into blocks by halving at the median of the principal axis until they are small enough.

    Args:
        points: (L, D).
        block: points of a block at most.

    Returns:
        (L,) int64 the order of the points, and where in it the blocks start, with L at the end.
    """
    waiting, done, starts = [torch.arange(points.shape[0], device=points.device)], [], [0]
    while waiting:
        rows = waiting.pop()
        if rows.shape[0] <= block:
            done.append(rows)
            starts.append(starts[-1] + rows.shape[0])
            continue
        sample = points[rows[:: max(rows.shape[0] // 4096, 1)]]
        axis = torch.linalg.eigh(sample.t().cov())[1][:, -1]
        rows = rows[torch.mv(points[rows], axis).argsort()]
        half = (rows.shape[0] // 2 + _STRIDE - 1) // _STRIDE * _STRIDE
        waiting += [rows[half:], rows[:half]]
    return torch.cat(done), starts


def groups_of(score: Tensor) -> Tensor:
    """Scores (N, L) in groups of 64 neighbours, or of a smaller power of two that L has: (N, G, every)."""
    every = 64
    while score.shape[1] % every != 0:
        every = every // 2
    return score.reshape(score.shape[0], -1, every)


def at_least(score: Tensor, threshold: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (P,) and columns (P,) of the scores (N, L) that reach the threshold (N,) of their row."""
    # Few do: the largest of every group rule the others out, faster than a comparison of all would.
    groups = groups_of(score)
    place = torch.nonzero(groups.amax(dim=-1) >= threshold[:, None])
    row, group = place[:, 0], place[:, 1]
    hit = torch.nonzero(groups[row, group] >= threshold[row][:, None])
    found = hit[:, 0]
    return row[found], group[found] * groups.shape[2] + hit[:, 1]


def columns_of_largest(score: Tensor, count: int) -> Tensor:
    """Columns (N, count) of the largest scores (N, L) of each row, in any order."""
    groups = groups_of(score)
    if groups.shape[1] < 2 * count:
        return score.topk(count, dim=-1, sorted=False)[1]
    # They lie in the groups with the largest maxima.
    group = groups.amax(dim=-1).topk(count, dim=-1, sorted=False)[1]
    every = groups.shape[2]
    column = (group[..., None] * every + torch.arange(every, device=score.device)).flatten(1)
    return column.gather(1, score.gather(1, column).topk(count, dim=-1, sorted=False)[1])


def best_per_frame(frame: Tensor, pose: Tensor, cosine: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The ``count`` pairs of frame and pose, out of (P,), with the largest cosines per frame, best first.

    Of equal cosines, the one with the lower pose number comes first.
    """
    order = pose.argsort()
    order = order[torch.sort(cosine[order], stable=True, descending=True)[1]]
    order = order[torch.sort(frame[order], stable=True)[1]]
    frame, pose, cosine = frame[order], pose[order], cosine[order]
    place = torch.arange(frame.shape[0], device=frame.device) - torch.searchsorted(frame, frame)
    keep = place < count
    return frame[keep], pose[keep], cosine[keep]


class PoseSearch(nn.Module):
    """The poses of a pool, at every heading, whose projections along depth fit keypoints best.

    A pose p fits keypoints k with scale a > 0 and shift b by ``min sum_j w_j |k_j - a p_j - b|^2``: the largest
    :func:`weighted_cosine` is the nearest pose. With equal weights that is the Euclidean distance between centred
    projections of unit norm, which the paper compares.

    1. The angle between a frame and any pose of a block is at least that to the centre of the block less
       ``asin(sqrt(max w) r / |centre|)``, r the largest distance of the block's poses from it (any angle where
       the argument exceeds 1): centring shortens, and a weighted norm is at most ``sqrt(max w)`` times
       the plain one. The best poses of the block with the nearest centre bound the angle; blocks beyond it
       are skipped.
    2. In the others cosines come from matrix products. With equal weights these are in bfloat16, about the
       centre of the block: the effect of rounding is a product of small numbers, bounded by the
       norms of the rounding errors (Cauchy-Schwarz). With other weights they are in float32.
    3. Poses whose upper bound reaches the least of the best are compared in float64.

    Args:
        library: (L, 14, 3) standardised poses, see :func:`tensorsim.vision.lifting.pose_library.standardise_poses`.
        yaws: headings at which each is tried.
        neighbours: how many to return.
        chunk: frame-pose pairs compared at once, which bounds the memory: up to 24 bytes a pair; at least one frame
            with one block of 8192 poses.
        pitch_rad: upward tilt of the camera; poses are compared, and given, in its axes right, forward, up.
        blocks: order and starts of another search of the same poses, whose blocks are nearly as good for another
            tilt; None sorts anew.

    Shapes:
        keypoints (N, 14, 2) and weights (N, 14) >= 0 -> (N, neighbours) int64, ``pose * yaws + heading``, best
        first; the lower index first where two fit equally well. A frame without weights gets the first poses.
        Not differentiable.
    """

    library: Tensor
    order: Tensor
    seen: Tensor
    centres: Tensor
    radius: Tensor
    rounding: Tensor
    coarse: Tensor

    def __init__(
        self,
        library: Tensor,
        yaws: int,
        neighbours: int,
        chunk: int,
        pitch_rad: float = 0.0,
        blocks: tuple[Tensor, list[int]] | None = None,
    ) -> None:
        super().__init__()
        self.yaws, self.neighbours, self.chunk = yaws, neighbours, chunk
        self.exported = EXPORTED
        self.pitch_rad = float(pitch_rad)
        self.margin = ROUNDING
        seen = torch.cat(
            [
                seen_along_depth(seen_from(all_headings(part, yaws), pitch_rad)).float()
                for part in library.split(8192)
            ]
        )
        self.block = max(BLOCK, 3 * neighbours)
        order, self.starts = blocks_of_similar(seen, self.block) if blocks is None else blocks
        centres, radius, rounding = [], [], []
        seen = seen[order]
        coarse = torch.empty(len(seen), 32, dtype=torch.bfloat16)
        for start, stop in zip(self.starts[:-1], self.starts[1:], strict=True):
            points = seen[start:stop]
            centre = points.mean(dim=0)
            offset = points - centre
            aside = offset @ centre
            high = aside.bfloat16()
            one = torch.ones_like(high)
            coarse[start:stop] = torch.cat(
                [offset.bfloat16(), torch.stack([high, (aside - high).bfloat16(), one, one], dim=-1)], dim=-1
            )
            centres.append(centre)
            radius.append(offset.norm(dim=-1).max())
            rounding.append((offset - offset.bfloat16()).norm(dim=-1).max())
        self.register_buffer("library", library, persistent=False)
        self.register_buffer("order", order, persistent=False)
        self.register_buffer("seen", seen, persistent=False)
        self.register_buffer("centres", torch.stack(centres), persistent=False)
        self.register_buffer("radius", torch.stack(radius), persistent=False)
        self.register_buffer("rounding", torch.stack(rounding), persistent=False)
        self.register_buffer("coarse", coarse, persistent=False)

    @torch.jit.unused
    def tilted(self, pitch_rad: float) -> "PoseSearch":
        """A copy for a camera with another tilt."""
        blocks = self.order, self.starts
        other = PoseSearch(self.library, self.yaws, self.neighbours, self.chunk, pitch_rad, blocks)
        return other.to(self.library.device)

    def poses(self, index: Tensor) -> Tensor:
        """Poses (..., 14, 3) of indices (...)."""
        base = self.library[torch.div(index, self.yaws, rounding_mode="floor")]
        turned = turn(base, (index % self.yaws).to(base.dtype) * (2 * math.pi / self.yaws))
        return seen_from(turned, self.pitch_rad)

    def forward(self, keypoints: Tensor, weights: Tensor) -> Tensor:
        """Keypoints (N, 14, 2) and weights (N, 14) -> indices (N, neighbours)."""
        w = normalise_weights(weights)
        k = keypoints - (w[..., None] * keypoints).sum(dim=-2, keepdim=True)
        size = (w[..., None] * k.square()).sum(dim=(-2, -1)).sqrt()[:, None]
        moment = torch.cat([w * k[..., 0], w * k[..., 1]], dim=-1) / size.clamp(min=1e-12)
        moment, w = moment.to(self.centres.dtype), w.to(self.centres.dtype)
        if is_exporting():
            return self._scan(moment, w)
        index = torch.arange(self.neighbours, device=keypoints.device).repeat(keypoints.shape[0], 1)
        informative = (moment != 0).any(dim=-1)
        equal = (w == w[:, :1]).all(dim=-1)
        tile = min(max(self.chunk // self.block, 1), 512)
        for uniform in (True, False):
            for rows in torch.nonzero(informative & (equal == uniform))[:, 0].split(tile):
                if rows.shape[0] > 0:
                    index[rows] = self._search(keypoints[rows], moment[rows], w[rows], uniform)
        return index

    def _search(self, keypoints: Tensor, moment: Tensor, weights: Tensor, uniform: bool) -> Tensor:
        """Forward for frames that all have equal weights (``uniform``), or all do not."""
        frames = keypoints.shape[0]
        cosine, norm = cosine_table(moment, weights, self.centres)
        reach = weights.amax(dim=-1).sqrt()[:, None] * self.radius / norm
        slip = torch.where(reach < 1.0, torch.asin(reach.clamp(max=1.0)), math.pi)
        bound = torch.cos((torch.acos(cosine.clamp(-1.0, 1.0)) - slip).clamp(min=0.0))

        # Any poses give a lower bound of the best; those of the nearest block give a tight one.
        home = cosine.argmax(dim=-1)
        guess = torch.zeros((frames, self.neighbours), dtype=torch.int64, device=keypoints.device)
        homes: list[int] = torch.nonzero(torch.bincount(home))[:, 0].tolist()
        for block in homes:
            rows = torch.nonzero(home == block)[:, 0]
            if uniform:
                score, _ = self._coarse_scores(block, moment[rows])
            else:
                score, _ = cosine_table(moment[rows], weights[rows], self._seen(block))
            guess[rows] = self.order[self.starts[block] + columns_of_largest(score, self.neighbours)]
        first_fit = weighted_cosine(keypoints[:, None], weights[:, None], self.poses(guess))
        least = first_fit.amin(dim=-1)

        # Every frame begins with these, so that it has enough poses however its scores are rounded.
        every = torch.arange(frames, device=keypoints.device).repeat_interleave(self.neighbours)
        frame, pose, fit = best_per_frame(every, guess.flatten(), first_fit.flatten(), self.neighbours)
        new_frames, new_poses, waiting = [frame[:0]], [pose[:0]], 0
        alive = bound >= least[:, None] - self.margin
        blocks: list[int] = torch.nonzero(alive.any(dim=0))[:, 0].tolist()
        for i in range(len(blocks)):
            block = blocks[i]
            rows = torch.nonzero(alive[:, block])[:, 0]
            if uniform:
                score, slack = self._coarse_scores(block, moment[rows])
                # Scores are cosines minus one; they and the threshold are rounded by 2^-8 of themselves at most.
                threshold = ((least[rows] - 1.0 - slack) * (1.0 + 2.0**-6)).to(score.dtype)
            else:
                floor = least[rows].clamp(min=0.0)
                score = reach_table(moment[rows], weights[rows], self._seen(block), floor, self.margin)
                threshold = torch.zeros_like(score[:, 0])
            row, column = at_least(score, threshold)
            found, candidate = rows[row], self.order[self.starts[block] + column]
            fresh = (guess[found] != candidate[:, None]).all(dim=-1)
            new_frames.append(found[fresh])
            new_poses.append(candidate[fresh])
            waiting += new_frames[-1].shape[0]
            if waiting > 4096 or i == len(blocks) - 1:
                joined, candidates = torch.cat(new_frames), torch.cat(new_poses)
                for at in range(0, waiting, 16384):
                    some, candidate = joined[at : at + 16384], candidates[at : at + 16384]
                    agree = weighted_cosine(keypoints[some], weights[some], self.poses(candidate))
                    frame, pose, fit = best_per_frame(
                        torch.cat([frame, some]),
                        torch.cat([pose, candidate]),
                        torch.cat([fit, agree]),
                        self.neighbours,
                    )
                worst = torch.full_like(least, -1.0)
                full = frame[self.neighbours - 1 :] == frame[: frame.shape[0] - self.neighbours + 1]
                first = torch.nonzero(full)[:, 0]
                worst[frame[first]] = fit[first + self.neighbours - 1]
                least = torch.maximum(least, worst)
                new_frames, new_poses, waiting = [frame[:0]], [pose[:0]], 0
        return pose.reshape(frames, self.neighbours)

    def _seen(self, block: int) -> Tensor:
        """The poses of a block along depth: (L, 28)."""
        return self.seen[self.starts[block] : self.starts[block + 1]]

    def _coarse_scores(self, block: int, moment: Tensor) -> tuple[Tensor, Tensor]:
        """Cosines minus one of frames of equal weights with a block's poses, and how much too low they may be."""
        rows = slice(self.starts[block], self.starts[block + 1])
        centre = self.centres[block]
        point = math.sqrt(14.0) * moment
        offset = point - centre
        # (q' + c) (x' + c) - 1 = q' x' + c x' + (q c - 1): numbers that are not small come in two parts.
        aside = torch.mv(point, centre) - 1.0
        short, high = offset.to(torch.bfloat16), aside.to(torch.bfloat16)
        one = torch.ones_like(high)
        parts = torch.stack([one, one, high, (aside - high).to(torch.bfloat16)], dim=-1)
        # A module cast to another precision has cast what is stored too; the numbers are the same.
        rounded = torch.cat([short, parts], dim=-1).to(self.coarse.dtype)
        score = torch.mm(rounded, self.coarse[rows].t()).to(moment.dtype)
        slack = torch.linalg.vector_norm(offset - short, dim=-1) * self.radius[block]
        slack = slack + torch.linalg.vector_norm(short.to(offset.dtype), dim=-1) * self.rounding[block]
        # For the residue of numbers split into two parts, and for float32 sums.
        slack = slack + 6e-5
        return score, slack

    def _scan(self, moment: Tensor, weights: Tensor) -> Tensor:
        """Full search without data-dependent control flow, for exported graphs: every frame with every pose."""
        best = torch.full((moment.shape[0], self.neighbours), -2.0, dtype=moment.dtype, device=moment.device)
        index = torch.zeros((moment.shape[0], self.neighbours), dtype=torch.int64, device=moment.device)
        # Few and large parts, since each becomes operations of the graph.
        for pose in self.order.split(self.exported):
            seen = seen_along_depth(self.poses(pose)).to(moment.dtype)
            best, at = torch.cat([best, cosine_table(moment, weights, seen)[0]], dim=-1).topk(self.neighbours)
            index = torch.cat([index, pose.expand(moment.shape[0], -1)], dim=-1).gather(-1, at)
        return index

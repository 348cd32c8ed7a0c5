"""Which end of each bone is nearer to the camera.

If one joint of a bone of known length is known, a single view leaves two positions for the other: in front of the
plane parallel to the image and behind it (C. J. Taylor, "Reconstruction of articulated objects from point
correspondences in a single uncalibrated image", 2000). A body of twelve bones has 4096 poses in every frame with the
same projection. Over time most sequences of them have large accelerations: where a bone is parallel to the image both
positions coincide, and the smoothest sequence continues on the other side. Sequences are found by exact dynamic
programming over pairs of frames, first for the four signs of the trunk (hips, spine, shoulders, head) and then, given
the trunk, for the two of each arm and leg.
"""

import torch
from torch import Tensor


def smoothest_sequence(places: Tensor, cost: Tensor, weight: float) -> Tensor:
    """The candidates, one per frame, with the least cost and acceleration (Viterbi, 1967, over pairs of frames).

    Args:
        places: (N, T, K, J) coordinates of J joints under each of K candidates, T >= 2.
        cost: (N, T, K) of each candidate by itself.
        weight: of squared second differences; their cost is ``4 log(1 + weight d^2 / 4)`` (Cauchy's), so that a few
            may be large.

    Returns:
        (N, T) int64 candidates that minimise the sum.
    """
    tracks, frames, count, _ = places.shape
    best = cost[:, 0, :, None] + cost[:, 1, None, :]
    back: list[Tensor] = []
    for t in range(2, frames):
        here = places[:, t, None, None, :]
        bend = here - 2 * places[:, t - 1, None, :, None] + places[:, t - 2, :, None, None]
        jerky = 4 * torch.log1p(weight / 4 * bend.square()).sum(dim=-1)
        best, before = (best[..., None] + jerky + cost[:, t, None, None, :]).min(dim=1)
        back.append(before)
    last = best.flatten(1).argmin(dim=1)
    sequence = [last % count, torch.div(last, count, rounding_mode="floor")]
    track = torch.arange(tracks, device=places.device)
    for i in range(frames - 2):
        sequence.append(back[frames - 3 - i][track, sequence[-1], sequence[-2]])
    sequence.reverse()
    return torch.stack(sequence, dim=1)


def reach(line: Tensor, start: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
    """Where a line of sight is at a given distance from a point: at ``middle - half`` and ``middle + half``.

    If the line stays further away than that, both are its nearest point.

    Args:
        line: (..., 3) direction, not necessarily of unit length.
        start: (..., 3) the point, seen from the camera.
        length: (...) the distance.

    Returns:
        middle and half (...), in units of ``line``.
    """
    square = line.square().sum(dim=-1)
    middle = (line * start).sum(dim=-1) / square
    rest = (length.square() - start.square().sum(dim=-1)) / square + middle.square()
    return middle, rest.clamp(min=1e-12).sqrt()


def half_spread(first: Tensor, second: Tensor, middle: Tensor, length: Tensor) -> Tensor:
    """Half the difference of the distances of two joints that are ``length`` apart, the first being further away.

    Args:
        first, second: (..., 3) unit lines of sight.
        middle: (...) mean of the distances of both.
        length: (...).

    Returns:
        (...) at least 0: the sum and the difference of unit vectors are at right angles.
    """
    across = (first - second).square().sum(dim=-1) * middle.square()
    return ((length.square() - across) / (first + second).square().sum(dim=-1)).clamp(min=1e-12).sqrt()


def unlikely(
    places: Tensor, expected: Tensor, trust: float, spread_m: float, height: Tensor, floor_m: float
) -> Tensor:
    """Cost (N, T, K) of candidates (N, T, K, J) that are far from the expected (N, T, J), or below the floor.

    Args:
        places, expected: distances along lines of sight.
        trust, spread_m: weight and deviation of expected ones, under Cauchy's loss.
        height: (N, T, J, 2) of joints above where they rest on the floor: at distance 0, and the increase per metre.
        floor_m: deviation of joints below it.
    """
    cost = trust * torch.log1p(((places - expected[:, :, None]) / spread_m).square())
    over = height[:, :, None, :, 0] + height[:, :, None, :, 1] * places
    return (cost + (over.clamp(max=0.0) / floor_m).square().clamp(max=50.0)).sum(dim=-1)


def choose_branches(
    distance: Tensor,
    lines: Tensor,
    lengths: Tensor,
    given: Tensor,
    trust: float,
    spread_m: float,
    height: Tensor,
    fps: float,
    acceleration_m_s2: float = 20.0,
    floor_m: float = 0.02,
) -> Tensor:
    """Distances with the most likely signs of all bones; the middle of the hips stays.

    The 13 joints are the head and three of each limb: shoulders or hips, elbows or knees, wrists or ankles, of right
    arm, left arm, right leg, left leg.

    Args:
        distance: (S, T, 13) from the camera.
        lines: (S, T, 13, 3) unit lines of sight.
        lengths: (S, 8) in metres, in the order of ``tensorsim.vision.lifting.bone_cost.LENGTH_SHARES``.
        given: (S, T, 13) distances of the lifter.
        trust: weight of these.
        spread_m: their deviation about the hips.
        height: (S, T, 13, 2), see :func:`unlikely`.
        fps: frames per second.
        acceleration_m_s2: typical acceleration along lines of sight.
        floor_m: deviation of joints below the floor.

    Returns:
        (S, T, 13).
    """
    weight = (fps**2 / acceleration_m_s2) ** 2
    hips = (distance[..., 7] + distance[..., 10]) / 2
    expected = given + (hips - (given[..., 7] + given[..., 10]) / 2)[..., None]
    head, limbs = lines[:, :, 0], lines[:, :, 1:].unflatten(2, [4, 3])
    roots = limbs[:, :, :, 0]
    right, left = roots[:, :, None, 0], roots[:, :, None, 1]
    right_hip, left_hip = roots[:, :, None, 2], roots[:, :, None, 3]
    shares = lengths[:, None, None]

    # The trunk: a bit for each of hips, spine, shoulders and head.
    number = torch.arange(16, device=distance.device)
    bits = [(torch.div(number, 2**i, rounding_mode="floor") % 2 * 2 - 1).to(distance.dtype) for i in range(4)]
    middle = hips[..., None].expand(-1, -1, 16)
    half = half_spread(right_hip, left_hip, middle, shares[..., 4]) * bits[0]
    hip_r, hip_l = middle + half, middle - half
    start = (hip_r[..., None] * right_hip + hip_l[..., None] * left_hip) / 2
    middle, half = reach((right + left) / 2, start, shares[..., 7])
    middle = middle + half * bits[1]
    half = half_spread(right, left, middle, shares[..., 1]) * bits[2]
    shoulder_r, shoulder_l = middle + half, middle - half
    start = (shoulder_r[..., None] * right + shoulder_l[..., None] * left) / 2
    middle, half = reach(head[:, :, None], start, shares[..., 0])
    places = torch.stack([middle + half * bits[3], shoulder_r, shoulder_l, hip_r, hip_l], dim=-1)
    trunk = torch.tensor([0, 1, 4, 7, 10], device=distance.device)
    cost = unlikely(places, expected[:, :, trunk], trust, spread_m, height[:, :, trunk], floor_m)
    chosen = smoothest_sequence(places, cost, weight)[..., None, None]
    found = places.gather(2, chosen.expand(-1, -1, 1, 5))[:, :, 0]

    # Arms and legs: two bits each, all four limbs at once.
    start = (found[..., 1:, None] * roots).transpose(1, 2).flatten(0, 1)[:, :, None]
    limbs, limb_height = limbs.transpose(1, 2).flatten(0, 1), height[:, :, 1:].unflatten(2, [4, 3])
    upper, lower = lengths[:, [2, 2, 5, 5]].reshape(-1, 1, 1), lengths[:, [3, 3, 6, 6]].reshape(-1, 1, 1)
    middle, half = reach(limbs[:, :, None, 1], start, upper)
    knee = middle + half * bits[1][:4]
    middle, half = reach(limbs[:, :, None, 2], knee[..., None] * limbs[:, :, None, 1], lower)
    places = torch.stack([knee, middle + half * bits[0][:4]], dim=-1)
    cost = unlikely(
        places,
        expected[..., 1:].unflatten(2, [4, 3])[..., 1:].transpose(1, 2).flatten(0, 1),
        trust,
        spread_m,
        limb_height[..., 1:, :].transpose(1, 2).flatten(0, 1),
        floor_m,
    )
    chosen = smoothest_sequence(places, cost, weight)[..., None, None]
    ends = places.gather(2, chosen.expand(-1, -1, 1, 2))[:, :, 0].unflatten(0, [-1, 4]).transpose(1, 2)
    whole = torch.cat([found[..., 1:, None], ends], dim=-1).flatten(2)
    return torch.cat([found[..., :1], whole], dim=-1)

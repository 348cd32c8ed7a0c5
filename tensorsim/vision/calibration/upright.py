"""Keypoints of people who stand or walk: which frames show them whole and upright, and whether they walk."""

import math

import torch
from torch import Tensor

from tensorsim.body.skeleton import coco_to_body
from tensorsim.vision.smoothing.along_time import fill_gaps, local_linear

#: Heights of the middle of the ankles and of the shoulders, as shares of the standing height: of a standing person, and
#: the mean over a walk, in which a foot is lifted and the knees are bent (generated and captured walks agree within
#: 0.01).
STANDING = (0.039, 0.818)
WALKING = (0.075, 0.798)
#: How far the shoulders are ahead of the ankles in a walk, as a share of the standing height (0.01 to 0.06), and its
#: standard deviation.
LEAN, LEAN_SPREAD = 0.035, 0.02
#: Walking speed in standing heights per second, and the standard deviation of its logarithm.
PACE, PACE_SPREAD = 0.7, 0.2
#: Walking speed in standing heights per second, divided by the square of the cycles per second, and the standard
#: deviation of its logarithm: steps lengthen in proportion to their rate (Sekiya and Nagasaki, "Reproducibility of the
#: walking patterns of normal young adults", 1998, 0.0065 m per step and minute; Boulic's gait 0.89, captured walks 0.82
#: to 0.95; the deviation is wider than theirs, as walking habits vary more than among these few people).
WALK_RATIO, WALK_RATIO_SPREAD = 0.9, 0.08


def ends_of_body(keypoints: Tensor) -> Tensor:
    """Middle of the ankle joints and of the shoulders from COCO keypoints: (..., 17, 2) -> (..., 2, 2)."""
    joints, _ = coco_to_body(keypoints, torch.ones_like(keypoints[..., 0]))
    return torch.stack([(joints[..., 10, :] + joints[..., 13, :]) / 2, joints[..., 1, :]], dim=-2)


def is_upright(keypoints: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Whether ankles, knees, hips and shoulders are seen and lie as in an upright body.

    Trunk and legs point down within 45 degrees and agree within 30, no leg is bent so far that its bones are 35 %
    longer than the line from hip to ankle, and the trunk is 0.4 to 1.1 times as long as the legs (0.6 for a camera at
    the height of the body; it looks longer from above).

    Args:
        keypoints: (..., 17, 2) COCO keypoints, v down.
        scores: (..., 17).
        threshold: score from which a point is seen.

    Returns:
        (...) bool.
    """
    neck = (keypoints[..., 5, :] + keypoints[..., 6, :]) / 2
    hips = (keypoints[..., 11, :] + keypoints[..., 12, :]) / 2
    ankles = (keypoints[..., 15, :] + keypoints[..., 16, :]) / 2
    trunk, legs = hips - neck, ankles - hips
    bones = torch.zeros_like(trunk[..., 0])
    for hip, knee, ankle in ((11, 13, 15), (12, 14, 16)):
        thigh = keypoints[..., knee, :] - keypoints[..., hip, :]
        shank = keypoints[..., ankle, :] - keypoints[..., knee, :]
        stretched = torch.linalg.vector_norm(keypoints[..., ankle, :] - keypoints[..., hip, :], dim=-1)
        length = torch.linalg.vector_norm(thigh, dim=-1) + torch.linalg.vector_norm(shank, dim=-1)
        bones = torch.maximum(bones, length / stretched.clamp(min=1e-3))
    trunk_px, legs_px = torch.linalg.vector_norm(trunk, dim=-1), torch.linalg.vector_norm(legs, dim=-1)
    aligned = (trunk * legs).sum(dim=-1) > 0.866 * trunk_px * legs_px
    ratio = trunk_px / legs_px.clamp(min=1e-3)
    seen = (scores[..., 5:7] >= threshold).all(dim=-1) & (scores[..., 11:17] >= threshold).all(dim=-1)
    down = (trunk[..., 1] > trunk[..., 0].abs()) & (legs[..., 1] > legs[..., 0].abs())
    return seen & down & aligned & (bones < 1.35) & (ratio > 0.4) & (ratio < 1.1) & (legs_px > 10.0)


def steadily(upright: Tensor, valid: Tensor, fps: float, share: float = 0.8) -> Tensor:
    """Frames (..., T) bool in which a body is upright, as in at least ``share`` of the valid ones within 0.4 s.

    A sitting person looks upright in a frame here and there.
    """
    radius = int(0.4 * fps)
    ones = torch.ones(1, 1, 2 * radius + 1, dtype=torch.float64, device=upright.device)
    stacked = torch.stack([upright & valid, valid]).to(torch.float64)
    counts = torch.nn.functional.conv1d(stacked.reshape(-1, 1, upright.shape[-1]), ones, padding=radius)
    counts = counts.reshape(stacked.shape)
    return upright & valid & (counts[0] >= share * counts[1])


def still_beside_others(ends: Tensor, valid: Tensor, least: float = 0.04) -> Tensor:
    """Which people never move while others do: objects, or pictures of people, taken for a person.

    Their ankles and shoulders stay within ``least`` of their size in the image of one place in nine of ten frames.
    If nobody moves more than that, nobody counts as still.

    Args:
        ends: (P, T, 2, 2) pixels, see :func:`ends_of_body`.
        valid: (P, T) bool.

    Returns:
        (P,) bool.
    """
    far = torch.zeros(valid.shape[0], dtype=ends.dtype, device=ends.device)
    for person in range(valid.shape[0]):
        seen = ends[person][valid[person]]
        if seen.shape[0] > 0:
            middle = seen.median(dim=0).values
            size = torch.linalg.vector_norm(middle[0] - middle[1], dim=-1).clamp(min=1.0)
            away = torch.linalg.vector_norm(seen - middle, dim=-1).amax(dim=-1) / size
            far[person] = away.quantile(0.9)
    return (far <= least) & valid.any(dim=-1) & (far > least).any()


def ankles_apart(keypoints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Neck (..., 2) and size (...) of bodies in pixels, and the vector (..., 2) from right to left ankle in sizes."""
    neck = (keypoints[..., 5, :] + keypoints[..., 6, :]) / 2
    ankles = (keypoints[..., 15, :] + keypoints[..., 16, :]) / 2
    size = torch.linalg.vector_norm(neck - ankles, dim=-1).clamp(min=1.0)
    return neck, size, (keypoints[..., 15, :] - keypoints[..., 16, :]) / size.unsqueeze(-1)


def walking_share(keypoints: Tensor, upright: Tensor, fps: float) -> Tensor:
    """How much people walk: 0 standing to 1 walking, from how the ankles move relative to each other in a second.

    A person who stays in place, as in a fight, does not walk: within the second the neck moves by less than 0.2 of the
    body's size in the image, and that size changes by less than 5 %. If somebody walks straight away from the camera,
    or towards it, the ankles hardly move relative to each other, so little more than keypoint errors already counts.

    Args:
        keypoints: (..., T, 17, 2).
        upright: (..., T) bool, the frames that count.
        fps: frames per second.

    Returns:
        (..., T) in [0, 1].
    """
    neck, size, apart = ankles_apart(keypoints)
    weights = upright.to(apart.dtype)
    spread = torch.zeros_like(size)
    for axis in range(2):
        mean = local_linear(apart[..., axis], weights, 0.5 * fps)
        spread = spread + local_linear((apart[..., axis] - mean).square(), weights, 0.5 * fps)
    steady: list[Tensor] = []
    for axis in range(2):
        steady.append(local_linear(neck[..., axis], weights, 0.2 * fps))
    neck, size = torch.stack(steady, dim=-1), local_linear(size, weights, 0.2 * fps).clamp(min=1.0)
    frames = size.shape[-1]
    time = torch.arange(frames, device=size.device)
    half = min(int(0.5 * fps), (frames - 1) // 2)
    inside = (time >= half) & (time < frames - half)
    before = (time - half).clamp(min=0)
    after = (time + half).clamp(max=frames - 1)
    way = neck.index_select(-2, after) - neck.index_select(-2, before)
    growth = (size.index_select(-1, after) / size.index_select(-1, before)).log().abs()
    goes = (torch.linalg.vector_norm(way, dim=-1) > 0.2 * size) | (growth > 0.05)
    # Within half a second of a gap or an end of the film the nearest frame with a full second decides.
    known = inside & upright & upright.index_select(-1, after) & upright.index_select(-1, before)
    goes = fill_gaps(goes.to(size.dtype), known) * (upright & known.any(dim=-1, keepdim=True)).to(size.dtype)
    return ((spread.clamp(min=0.0).sqrt() - 0.03) / 0.02).clamp(0.0, 1.0) * goes


def cadence(
    keypoints: Tensor, walking: Tensor, fps: float, least_hz: float = 0.5, most_hz: float = 1.3
) -> tuple[Tensor, Tensor]:
    """Gait cycles (of two steps each) per second, from how far the ankles are apart in the picture.

    That distance, squared, has two periods per cycle, whichever ankle is ahead: networks confuse left and right, and
    people who turn round swap them. The cadence is the peak of its periodogram.

    Args:
        keypoints: (..., T, 17, 2).
        walking: (..., T) in [0, 1], see :func:`walking_share`.
        fps: frames per second.
        least_hz, most_hz: the band that is searched for the peak.

    Returns:
        Hertz (...), and the share (...) of the power in [0, 1] that a sinusoid of this frequency explains: 0 if the
        person walks for less than a second, or the peak is at an end of the band.
    """
    _, _, apart = ankles_apart(keypoints)
    # Changes over a second or more, such as of the heading, do not come from the steps.
    slow = torch.stack([local_linear(apart[..., axis], walking, 0.5 * fps) for axis in range(2)], dim=-1)
    squared = (apart - slow).square().sum(dim=-1)
    steps = walking * (squared - local_linear(squared, walking, 0.5 * fps))
    frames = steps.shape[-1]
    hertz = torch.linspace(least_hz, most_hz, 161, dtype=steps.dtype, device=steps.device)
    power = torch.zeros_like(steps[..., :1] * hertz)
    total = torch.zeros_like(steps[..., 0])
    # In windows with a standard deviation of one second: after a pause the steps resume with another phase.
    for middle_s in range(math.ceil(frames / fps)):
        first, last = max(int((middle_s - 5) * fps), 0), min(int((middle_s + 5) * fps) + 1, frames)
        time = torch.arange(first, last, dtype=steps.dtype, device=steps.device) / fps - middle_s
        phase = 2 * math.pi * time[:, None] * (2 * hertz)
        window = torch.exp(-0.5 * time.square())
        part = window * steps[..., first:last]
        power = power + torch.matmul(part, phase.cos()).square() + torch.matmul(part, phase.sin()).square()
        # A sinusoid of amplitude A in a window W has the power (A sum(W) / 2)^2 and the energy A^2 sum(W) / 2.
        window = window * walking[..., first:last]
        total = total + (window * steps[..., first:last].square()).sum(dim=-1) * window.sum(dim=-1) / 2
    best = power.argmax(dim=-1)
    share = power.amax(dim=-1) / total.clamp(min=1e-12)
    inside = (best > 0) & (best < hertz.shape[0] - 1) & (walking.sum(dim=-1) >= fps)
    return hertz[best], torch.where(inside, share.clamp(max=1.0), 0.0)

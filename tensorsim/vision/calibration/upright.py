"""Key points of people who stand or walk: which frames show them whole and upright, and whether they walk."""

import torch
from torch import Tensor

from tensorsim.body.skeleton import coco_to_body
from tensorsim.vision.smoothing.along_time import local_linear

#: Heights of the ankles' and the shoulders' middle over the standing height: of somebody who stands, and the mean over
#: a walk, in which a foot is lifted and the knees are bent (generated and captured walks agree within 0.01).
STANDING = (0.039, 0.818)
WALKING = (0.075, 0.798)
#: How far the shoulders are ahead of the ankles in a walk, over the standing height (0.01 to 0.06).
LEAN = 0.03
#: Walking speed in standing heights per second, and the standard deviation of its logarithm.
PACE, PACE_SPREAD = 0.7, 0.2


def ends_of_body(keypoints: Tensor) -> Tensor:
    """Middle of the ankle joints and of the shoulders from COCO key points: (..., 17, 2) -> (..., 2, 2)."""
    joints, _ = coco_to_body(keypoints, torch.ones_like(keypoints[..., 0]))
    return torch.stack([(joints[..., 10, :] + joints[..., 13, :]) / 2, joints[..., 1, :]], dim=-2)


def is_upright(keypoints: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Whether ankles, knees, hips and shoulders are seen and lie as in an upright body.

    Trunk and legs point down within 45 degrees and agree within 30, no leg is bent so far that its bones are 35 %
    longer than from hip to ankle, and the trunk is 0.4 to 1.1 times as long as the legs (0.6 for a camera at the
    height of the body; it looks longer from above).

    Args:
        keypoints: (..., 17, 2) COCO key points, v down.
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
    """Frames (..., T) bool in which a body is upright, as it is in most valid frames within 0.4 s.

    Somebody who sits looks upright in a frame here and there.
    """
    radius = int(0.4 * fps)
    ones = torch.ones(1, 1, 2 * radius + 1, dtype=torch.float64, device=upright.device)
    stacked = torch.stack([upright & valid, valid]).to(torch.float64)
    counts = torch.nn.functional.conv1d(stacked.reshape(-1, 1, upright.shape[-1]), ones, padding=radius)
    counts = counts.reshape(stacked.shape)
    return upright & valid & (counts[0] >= share * counts[1])


def walking_share(keypoints: Tensor, upright: Tensor, fps: float) -> Tensor:
    """How much people walk: 0 standing to 1 walking, from how the ankles move against each other within a second.

    Whoever stays in place, as in a fight, does not walk: within the second the neck moves by less than 0.2 of the
    body's size in the image, and that size changes by less than 8 %.

    Args:
        keypoints: (..., T, 17, 2).
        upright: (..., T) bool, the frames that count.
        fps: frames per second.

    Returns:
        (..., T) in [0, 1].
    """
    neck = (keypoints[..., 5, :] + keypoints[..., 6, :]) / 2
    ankles = (keypoints[..., 15, :] + keypoints[..., 16, :]) / 2
    size = torch.linalg.vector_norm(neck - ankles, dim=-1).clamp(min=1.0)
    apart = (keypoints[..., 15, :] - keypoints[..., 16, :]) / size.unsqueeze(-1)
    weights = upright.to(apart.dtype)
    spread = torch.zeros_like(size)
    for axis in range(2):
        mean = local_linear(apart[..., axis], weights, 0.5 * fps)
        spread = spread + local_linear((apart[..., axis] - mean).square(), weights, 0.5 * fps)
    frames = size.shape[-1]
    time = torch.arange(frames, device=size.device)
    before = (time - int(0.5 * fps)).clamp(min=0)
    after = (time + int(0.5 * fps)).clamp(max=frames - 1)
    way = neck.index_select(-2, after) - neck.index_select(-2, before)
    growth = (size.index_select(-1, after) / size.index_select(-1, before)).log().abs()
    goes = (torch.linalg.vector_norm(way, dim=-1) > 0.2 * size) | (growth > 0.08)
    goes = goes & upright.index_select(-1, after) & upright.index_select(-1, before)
    return ((spread.clamp(min=0.0).sqrt() - 0.05) / 0.05).clamp(0.0, 1.0) * goes.to(size.dtype)

"""COCO-17 key points to the 14 joints of the radar body, in the image."""

import torch
from torch import Tensor

from tensorsim.errors import (
    TensorsimError,
    check_finite,
    check_floating,
    check_min_rank,
    check_positive,
    check_size,
)


def coco_to_body(keypoints: Tensor, scores: Tensor, threshold: float = 0.3) -> tuple[Tensor, Tensor]:
    """The 14 joints of ``tensorsim.JOINTS`` from the 17 key points of COCO.

    The head is the nose. From behind, the nose is hidden and its score low: the head then slides, as the
    score falls below ``threshold``, to the score-weighted mean of eyes and ears, which from there lies where
    the nose would project. The neck is the middle of the shoulders, with the lower of their two scores.

    Args:
        keypoints: (..., 17, 2) pixels, order of ``tensorsim.COCO_KEYPOINTS``.
        scores: (..., 17).
        threshold: score from which the nose counts as seen.

    Returns:
        joints (..., 14, 2) in pixels and scores (..., 14). Differentiable.

    Raises:
        TensorsimError: other shapes, NaN, or a threshold that is not positive.
    """
    layout = "(..., 17, 2) COCO key points in pixels"
    check_floating(keypoints, "keypoints")
    check_min_rank(keypoints, 2, "keypoints", layout)
    check_size(keypoints, -2, 17, "keypoints", layout)
    check_size(keypoints, -1, 2, "keypoints", layout)
    if scores.shape != keypoints.shape[:-1]:
        raise TensorsimError(f"scores: got shape {list(scores.shape)}, expected {list(keypoints.shape[:-1])}")
    check_finite(keypoints, "keypoints")
    check_finite(scores, "scores")
    check_positive(threshold, "threshold")

    nose, nose_score = keypoints[..., :1, :], scores[..., :1]
    face, face_scores = keypoints[..., 1:5, :], scores[..., 1:5].clamp(min=0.0)
    total = face_scores.sum(dim=-1, keepdim=True).clamp(min=1e-6)
    face_middle = (face_scores[..., None] * face).sum(dim=-2, keepdim=True) / total[..., None]
    face_score = face_scores.square().sum(dim=-1, keepdim=True) / total

    trust_nose = (nose_score / threshold).clamp(0.0, 1.0)
    trust_face = (face_score / threshold).clamp(0.0, 1.0) * (1.0 - trust_nose)
    share = trust_face / (trust_nose + trust_face).clamp(min=1e-6)
    head = nose + share[..., None] * (face_middle - nose)
    head_score = nose_score + share * (face_score - nose_score)

    neck = keypoints[..., 5:7, :].mean(dim=-2, keepdim=True)
    neck_score = scores[..., 5:7].amin(dim=-1, keepdim=True)

    # COCO alternates left and right from shoulders (5, 6) to ankles (15, 16); the body goes limb by limb.
    joints = [head, neck, keypoints[..., 6:11:2, :], keypoints[..., 5:10:2, :]]
    joints += [keypoints[..., 12:17:2, :], keypoints[..., 11:16:2, :]]
    joint_scores = [head_score, neck_score, scores[..., 6:11:2], scores[..., 5:10:2]]
    joint_scores += [scores[..., 12:17:2], scores[..., 11:16:2]]
    return torch.cat(joints, dim=-2), torch.cat(joint_scores, dim=-1)

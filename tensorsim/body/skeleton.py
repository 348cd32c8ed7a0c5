"""The 14 joints of the radar body and the 17 key points of COCO: each from the other, roots and mirror images."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.body.proportions import NOSE_FORWARD, NOSE_UP, SHANK, THIGH, TRUNK
from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.errors import TensorsimError, check_finite, check_points, check_positive, check_tensor

#: Arms and legs by the indices of their joints, upper segment first.
LIMBS = ((2, 3), (3, 4), (5, 6), (6, 7), (8, 9), (9, 10), (11, 12), (12, 13))
#: Segments of constant length by their ends; 14 is the middle of the hips. The neck, joint 1, is that of the shoulders.
BONES = ((0, 1), (2, 5), *LIMBS[:4], (8, 11), *LIMBS[4:], (1, 14))


def mid_hips(joints: Tensor) -> Tensor:
    """Middle of the hips, the root of the skeleton: (..., 14, D) -> (..., D)."""
    return 0.5 * (
        joints[..., 8, :] + joints[..., 11, :]
    )  # literals: TorchScript reads no constants of modules


def body_height(joints: Tensor) -> Tensor:
    """Standing height of the body from its legs and trunk, in any pose.

    Args:
        joints: (..., 14, 3) in any unit of length.

    Returns:
        (...) in the same unit.
    """

    def bone(a: str, b: str) -> Tensor:
        return (joints[..., JOINTS.index(a), :] - joints[..., JOINTS.index(b), :]).norm(dim=-1)

    legs = sum(bone(f"{s}_hip", f"{s}_knee") + bone(f"{s}_knee", f"{s}_ankle") for s in ("right", "left"))
    trunk = (joints[..., JOINTS.index("neck"), :] - mid_hips(joints)).norm(dim=-1)
    return (0.5 * legs + trunk) / (SHANK + THIGH + TRUNK)


def mirror(joints: Tensor) -> Tensor:
    """The mirror image of poses (..., 14, 3): x negated, right and left joints exchanged."""
    swapped = [
        JOINTS.index(n.replace("right", "left") if "right" in n else n.replace("left", "right"))
        for n in JOINTS
    ]
    flipped = joints[..., swapped, :]
    return torch.cat([-flipped[..., :1], flipped[..., 1:]], dim=-1)


def coco_to_body(keypoints: Tensor, scores: Tensor, threshold: float = 0.3) -> tuple[Tensor, Tensor]:
    """The 14 joints of ``tensorsim.JOINTS`` from the 17 key points of COCO.

    The head is the nose. From behind, the nose is hidden and its score low: as the score falls below
    ``threshold``, the head moves to the score-weighted mean of eyes and ears, which from behind lies where
    the nose would project. The neck is the middle of the shoulders, with the lower of their two scores.

    Args:
        keypoints: (..., 17, 2) pixels, order of ``tensorsim.COCO_KEYPOINTS``.
        scores: (..., 17).
        threshold: score from which the nose counts as visible.

    Returns:
        joints (..., 14, 2) in pixels and scores (..., 14). Differentiable.

    Raises:
        TensorsimError: other shapes, NaN, or a threshold that is not positive.
    """
    layout = "(..., 17, 2) COCO key points in pixels"
    check_points(keypoints, 2, 17, 2, "keypoints", layout)
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


#: Eyes and ears seen from the nose: sideways, backward and up, in body heights.
_EYE = (0.018, 0.014, 0.019)
_EAR = (0.043, 0.060, 0.010)


def body_to_coco(joints: Tensor) -> Tensor:
    """The 17 key points of COCO from the 14 joints of the radar body.

    Eyes and ears are placed about the nose in a frame that neck and nose (which give its size too) and the
    line of the shoulders span: they follow only a part of a rotation of the head relative to the trunk.

    Args:
        joints: (..., 14, 3) metres, order of ``tensorsim.JOINTS``, any frame with right-handed axes.

    Returns:
        (..., 17, 3) in the order of ``tensorsim.COCO_KEYPOINTS``; body joints and nose are kept as they are. Where nose
        and neck coincide, eyes and ears are at the nose.

    Raises:
        TensorsimError: joints of another shape, or integers.
    """
    check_tensor(joints, "joints", "(..., 14, 3)")
    nose, neck = joints[..., 0, :], joints[..., 1, :]
    reach = nose - neck
    height = reach.norm(dim=-1, keepdim=True) / math.hypot(NOSE_FORWARD, NOSE_UP)
    reach = F.normalize(reach, dim=-1)
    across = joints[..., 2, :] - joints[..., 5, :]
    right = across - (across * reach).sum(dim=-1, keepdim=True) * reach
    right = F.normalize(right, dim=-1)
    beside = torch.linalg.cross(right, reach)  # `reach` turned by 90 degrees, backwards
    angle = math.atan2(NOSE_FORWARD, NOSE_UP)
    up = math.cos(angle) * reach + math.sin(angle) * beside
    forward = math.sin(angle) * reach - math.cos(angle) * beside

    def face(side: float, place: tuple[float, float, float]) -> Tensor:
        sideways, back, above = place
        return nose + height * (side * sideways * right - back * forward + above * up)

    points = [nose, face(-1.0, _EYE), face(1.0, _EYE), face(-1.0, _EAR), face(1.0, _EAR)]
    points += [joints[..., JOINTS.index(name), :] for name in COCO_KEYPOINTS[5:]]
    return torch.stack(points, dim=-2)

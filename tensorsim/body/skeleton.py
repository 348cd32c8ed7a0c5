"""The 14 joints of the radar body and the 17 keypoints of COCO: each from the other, roots and mirror images."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.body.proportions import NOSE_FORWARD, NOSE_UP
from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.config.names import LIMBS
from tensorsim.errors import (
    check_finite,
    check_points,
    check_positive,
    check_shape,
    check_tensor,
)

#: Segments of constant length by their ends; 14 is the middle of the hips. The neck, joint 1, is that of the shoulders.
BONES = ((0, 1), (2, 5), *LIMBS[:4], (8, 11), *LIMBS[4:], (1, 14))


def other_sides(names: Sequence[str]) -> tuple[int, ...]:
    """For each name, the number of the one that takes its place in a mirror image: left for right, right for left."""
    return tuple(
        names.index(name.replace("right", "left") if "right" in name else name.replace("left", "right"))
        for name in names
    )


#: For each joint and each COCO keypoint, the one that takes its place in a mirror image.
MIRRORED_JOINTS, MIRRORED = other_sides(JOINTS), other_sides(COCO_KEYPOINTS)


def mid_hips(joints: Tensor) -> Tensor:
    """Middle of the hips, the root of the skeleton: (..., 14, D) -> (..., D)."""
    return 0.5 * (
        joints[..., 8, :] + joints[..., 11, :]
    )  # literals: TorchScript cannot read module constants


def trunk_uprightness(joints: Tensor) -> Tensor:
    """Cosine of the angle between the trunk and the vertical: (..., 14, 3) -> (...), 1 upright, 0 horizontal."""
    trunk = joints[..., 1, :] - mid_hips(joints)
    return trunk[..., 2] / trunk.square().sum(dim=-1).clamp(min=1e-6).sqrt()


def trunk_lean(joints: Tensor) -> Tensor:
    """How far the trunk leans: (..., 14, 3) -> (...), 0 upright, 1 horizontal or upside down."""
    return 1 - trunk_uprightness(joints).clamp(min=0.0)


def lowest_ankle(joints: Tensor) -> Tensor:
    """Height of the lower ankle: (..., 14, 3) -> (...)."""
    return torch.minimum(joints[..., 10, 2], joints[..., 13, 2])


def bone_lengths(joints: Tensor, ends: Tensor) -> Tensor:
    """Lengths (..., 12) of the bones of bodies (..., 14, 3).

    Args:
        joints: in any unit of length; lengths are at least a thousandth of it.
        ends: (2, 12) int64, ``torch.tensor(BONES).T``, which TorchScript cannot read here.
    """
    points = torch.cat([joints, mid_hips(joints)[..., None, :]], dim=-2)
    along = points.index_select(-2, ends[0]) - points.index_select(-2, ends[1])
    return along.square().sum(dim=-1).clamp(min=1e-6).sqrt()


def body_height(joints: Tensor) -> Tensor:
    """Standing height of the body from its legs and trunk, in any pose.

    Args:
        joints: (..., 14, 3) in any unit of length.

    Returns:
        (...) in the same unit.
    """
    upper = joints[..., 8:13:3, :] - joints[..., 9:14:3, :]  # hips to knees, right and left
    lower = joints[..., 9:14:3, :] - joints[..., 10:14:3, :]
    legs = 0.5 * (torch.linalg.vector_norm(upper, dim=-1) + torch.linalg.vector_norm(lower, dim=-1)).sum(
        dim=-1
    )
    trunk = torch.linalg.vector_norm(joints[..., 1, :] - mid_hips(joints), dim=-1)
    return (legs + trunk) / 0.779  # SHANK + THIGH + TRUNK of the proportions, as a literal for TorchScript


def mirror(joints: Tensor) -> Tensor:
    """The mirror image of poses (..., 14, 3): x negated, right and left joints exchanged."""
    flipped = joints[..., MIRRORED_JOINTS, :]
    return torch.cat([-flipped[..., :1], flipped[..., 1:]], dim=-1)


class Marks(NamedTuple):
    """Where people, and networks trained on their marks, see joints in pictures, relative to the joint centres.

    Hips, knees, ankles and elbows of COCO are not where the bones turn. Offsets are shares of a segment, the means of
    two networks trained on people's marks, to half a percent (``python -m tests.benchmarks.eval_keypoints``).

    Attributes:
        elbow: above the joint, of the upper arm.
        hip: below the joint, of the trunk, from the middle of the shoulders to that of the hips.
        knee: below the joint, of the shank.
        ankle: above the joint, of the shank.
    """

    elbow: float = 0.06
    hip: float = 0.017
    knee: float = 0.038
    ankle: float = 0.048


def coco_to_body(keypoints: Tensor, scores: Tensor, threshold: float = 0.3) -> tuple[Tensor, Tensor]:
    """The 14 joints of ``tensorsim.JOINTS`` from the 17 keypoints of COCO.

    Elbows, hips, knees and ankles move from where COCO marks them to the joints (:class:`Marks`): fully if the other
    keypoints that this needs score ``threshold`` or more, less the lower they score.

    The head is the nose. From behind, the nose is hidden and its score low: as the score falls below
    ``threshold``, the head moves to the score-weighted mean of eyes and ears, which from behind lies where
    the nose would project. The neck is the middle of the shoulders, with the lower of their two scores.

    Args:
        keypoints: (..., 17, 2) pixels, order of ``tensorsim.COCO_KEYPOINTS``.
        scores: (..., 17).
        threshold: score from which the nose, and the keypoints that others are moved by, count as visible.

    Returns:
        joints (..., 14, 2) in pixels and scores (..., 14). Differentiable.

    Raises:
        TensorsimError: other shapes, NaN, or a threshold that is not positive.
    """
    layout = "(..., 17, 2) COCO keypoints in pixels"
    check_points(keypoints, 2, 17, 2, "keypoints", layout)
    check_shape(scores, list(keypoints.shape[:-1]), "scores")
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

    # COCO alternates left and right from shoulders (5, 6) to ankles (15, 16).
    marks = Marks()
    trust = (scores / threshold).clamp(0.0, 1.0)[..., None]
    shoulders, elbows, wrists = keypoints[..., 5:7, :], keypoints[..., 7:9, :], keypoints[..., 9:11, :]
    hips, knees, ankles = keypoints[..., 11:13, :], keypoints[..., 13:15, :], keypoints[..., 15:17, :]
    upper_arms = (elbows - shoulders) / (1.0 - marks.elbow)
    trunk = (hips.mean(dim=-2, keepdim=True) - neck) / (1.0 + marks.hip)
    shanks = (ankles - knees) / (1.0 - marks.knee - marks.ankle)
    trunk_trust = torch.cat([trust[..., 5:7, :], trust[..., 11:13, :]], dim=-2).amin(dim=-2, keepdim=True)
    elbows = elbows + marks.elbow * trust[..., 5:7, :] * upper_arms
    hips = hips - marks.hip * trunk_trust * trunk
    knees = knees - marks.knee * trust[..., 15:17, :] * shanks
    ankles = ankles + marks.ankle * trust[..., 13:15, :] * shanks

    # The body goes limb by limb, right before left.
    arms = torch.stack([shoulders, elbows, wrists], dim=-2)
    legs = torch.stack([hips, knees, ankles], dim=-2)
    joints = [head, neck, arms[..., 1, :, :], arms[..., 0, :, :], legs[..., 1, :, :], legs[..., 0, :, :]]
    joint_scores = [head_score, neck_score, scores[..., 6:11:2], scores[..., 5:10:2]]
    joint_scores += [scores[..., 12:17:2], scores[..., 11:16:2]]
    return torch.cat(joints, dim=-2), torch.cat(joint_scores, dim=-1)


#: Eyes and ears relative to the nose: sideways, backward and up, in body heights.
_EYE = (0.018, 0.014, 0.019)
_EAR = (0.043, 0.060, 0.010)


def body_to_coco(joints: Tensor) -> Tensor:
    """The 17 keypoints of COCO from the 14 joints of the radar body.

    Eyes and ears are placed about the nose in a frame spanned by the line from neck to nose (which also sets its
    size) and that of the shoulders: they follow only part of a rotation of the head relative to the trunk.

    Args:
        joints: (..., 14, 3) metres, order of ``tensorsim.JOINTS``, any frame with right-handed axes.

    Returns:
        (..., 17, 3) in the order of ``tensorsim.COCO_KEYPOINTS``. Shoulders, wrists and nose are kept as they are;
        elbows, hips, knees and ankles are where COCO marks them (:class:`Marks`), which :func:`coco_to_body` undoes.
        Where nose and neck coincide, eyes and ears are at the nose.

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
    marks = Marks()
    trunk = mid_hips(joints) - 0.5 * (joints[..., 2, :] + joints[..., 5, :])
    place = {name: joints[..., JOINTS.index(name), :] for name in COCO_KEYPOINTS[5:]}
    marked = dict(place)
    for side in ("left", "right"):
        shoulder, elbow, hip, knee, ankle = (
            place[f"{side}_{name}"] for name in ("shoulder", "elbow", "hip", "knee", "ankle")
        )
        marked[f"{side}_elbow"] = elbow + marks.elbow * (shoulder - elbow)
        marked[f"{side}_hip"] = hip + marks.hip * trunk
        marked[f"{side}_knee"] = knee + marks.knee * (ankle - knee)
        marked[f"{side}_ankle"] = ankle + marks.ankle * (knee - ankle)
    points += [marked[name] for name in COCO_KEYPOINTS[5:]]
    return torch.stack(points, dim=-2)

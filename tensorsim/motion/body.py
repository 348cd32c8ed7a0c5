"""A 14-joint articulated body: forward kinematics from joint angles, with constant bone lengths.

Lengths are fractions of the body height (Winter, *Biomechanics and Motor Control of Human Movement*, after
Drillis and Contini), except the half widths of shoulders and hips and the place of the nose, which are those
of key points in pictures.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.errors import check_floating, check_min_rank, check_size

ANKLE_HEIGHT = 0.039
SHANK = 0.246
THIGH = 0.245
TRUNK = 0.288
HALF_HIPS = 0.06
HALF_SHOULDERS = 0.105
UPPER_ARM = 0.186
FOREARM = 0.146
#: The nose seen from the middle of the shoulders: forward and up.
NOSE_FORWARD = 0.06
NOSE_UP = 0.11
#: Flesh between a joint and the floor that it rests on; ankles stand at their own height.
FLESH = 0.045


class Proportions(NamedTuple):
    """Lengths of segments as fractions of the body height, each a number or a tensor (...).

    The defaults are the means; head and ankles keep the same fraction in every body.
    """

    shank: Tensor | float = SHANK
    thigh: Tensor | float = THIGH
    trunk: Tensor | float = TRUNK
    half_hips: Tensor | float = HALF_HIPS
    half_shoulders: Tensor | float = HALF_SHOULDERS
    upper_arm: Tensor | float = UPPER_ARM
    forearm: Tensor | float = FOREARM


class BodyPose(NamedTuple):
    """Joint angles in radians. All zero: standing upright, arms hanging, facing +y with the right side at +x.

    Arms follow the twist of the trunk but not its pitch, thighs hang from the pelvis but do not tilt with it:
    flexion is measured from "straight down" of the body, as gait and exercise data are published.

    Attributes:
        heading: (...) turn of the whole body about the vertical, counter-clockwise seen from above.
        lean: (...) tilt of the whole body, forward positive; 90 degrees is lying prone.
        roll: (...) tilt of the whole body to its right.
        trunk: (..., 3) pitch (forward), roll (to the right), twist (counter-clockwise) against the body.
        pelvis: (..., 2) roll (right side down) and yaw (counter-clockwise).
        head: (..., 2) pitch (down) and yaw (counter-clockwise) against the trunk.
        shoulder: (..., 2, 3) right then left: flexion (forward), abduction (sideways), rotation (inwards).
        elbow: (..., 2) flexion.
        hip: (..., 2, 2) right then left: flexion (forward), abduction (sideways).
        knee: (..., 2) flexion.
    """

    heading: Tensor
    lean: Tensor
    roll: Tensor
    trunk: Tensor
    pelvis: Tensor
    head: Tensor
    shoulder: Tensor
    elbow: Tensor
    hip: Tensor
    knee: Tensor

    @classmethod
    def standing(cls, shape: tuple[int, ...] = (), dtype: torch.dtype = torch.float64) -> "BodyPose":
        """All angles zero; change some with ``_replace``."""
        tails: tuple[tuple[int, ...], ...] = ((), (), (), (3,), (2,), (2,), (2, 3), (2,), (2, 2), (2,))
        return cls(*(torch.zeros(shape + tail, dtype=dtype) for tail in tails))


def rotation(axis: int, angle: Tensor) -> Tensor:
    """Right-handed rotation matrices (..., 3, 3) about x (0), y (1) or z (2) by ``angle`` (...) radians."""
    c, s = torch.cos(angle), torch.sin(angle)
    one, zero = torch.ones_like(c), torch.zeros_like(c)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rows = [[zero] * 3 for _ in range(3)]
    rows[axis][axis] = one
    rows[i][i], rows[i][j], rows[j][i], rows[j][j] = c, -s, s, c
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def forward_kinematics(
    pose: BodyPose, height_m: Tensor | float = 1.0, proportions: Proportions | None = None
) -> Tensor:
    """Joints of an articulated body with constant bone lengths.

    Args:
        pose: angles with any leading dimensions.
        height_m: standing body height, a number or (...) metres.
        proportions: lengths of the segments; None is the mean body.

    Returns:
        (..., 14, 3) metres, order of ``tensorsim.JOINTS``, x right, y forward, z up, relative to the middle
        of the hips. Differentiable.
    """
    like = pose.heading
    sizes = Proportions() if proportions is None else proportions
    shank, thigh, trunk, half_hips, half_shoulders, upper_arm, forearm = (
        torch.as_tensor(size, dtype=like.dtype, device=like.device)[..., None] for size in sizes
    )

    def vector(x: float, y: float, z: float) -> Tensor:
        return torch.tensor([x, y, z], dtype=like.dtype, device=like.device)

    down = vector(0.0, 0.0, -1.0)
    body = rotation(2, pose.heading) @ rotation(1, pose.roll) @ rotation(0, -pose.lean)
    twisted = body @ rotation(2, pose.trunk[..., 2])
    chest = twisted @ rotation(1, pose.trunk[..., 1]) @ rotation(0, -pose.trunk[..., 0])
    pelvis = body @ rotation(2, pose.pelvis[..., 1]) @ rotation(1, pose.pelvis[..., 0])
    skull = chest @ rotation(2, pose.head[..., 1]) @ rotation(0, -pose.head[..., 0])

    neck = trunk * (chest @ vector(0.0, 0.0, 1.0))
    joints = [neck + skull @ vector(0.0, NOSE_FORWARD, NOSE_UP), neck]
    for limb, side in ((0, 1.0), (1, -1.0)):  # right arm, left arm
        flexion, abduction, inward = pose.shoulder[..., limb, :].unbind(-1)
        arm = twisted @ rotation(0, flexion) @ rotation(1, -side * abduction) @ rotation(2, side * inward)
        shoulder = neck + half_shoulders * (chest @ vector(side, 0.0, 0.0))
        elbow = shoulder + upper_arm * (arm @ down)
        wrist = elbow + forearm * (arm @ rotation(0, pose.elbow[..., limb]) @ down)
        joints += [shoulder, elbow, wrist]
    for limb, side in ((0, 1.0), (1, -1.0)):  # right leg, left leg
        flexion, abduction = pose.hip[..., limb, :].unbind(-1)
        leg = body @ rotation(0, flexion) @ rotation(1, -side * abduction)
        hip = half_hips * (pelvis @ vector(side, 0.0, 0.0))
        knee = hip + thigh * (leg @ down)
        ankle = knee + shank * (leg @ rotation(0, -pose.knee[..., limb]) @ down)
        joints += [hip, knee, ankle]
    height = torch.as_tensor(height_m, dtype=like.dtype, device=like.device)
    return torch.stack(joints, dim=-2) * height[..., None, None]


def rest_on_floor(joints: Tensor, height_m: Tensor | float = 1.0) -> Tensor:
    """Shift poses (..., 14, 3) vertically so that they rest on z = 0 by whatever is lowest.

    Standing, that is an ankle at its anatomical height; lying or kneeling, a joint with flesh around it.
    """
    clearance = [ANKLE_HEIGHT if name.endswith("ankle") else FLESH for name in JOINTS]
    height = torch.as_tensor(height_m, dtype=joints.dtype, device=joints.device)
    room = torch.tensor(clearance, dtype=joints.dtype, device=joints.device) * height[..., None]
    lift = (room - joints[..., 2]).amax(dim=-1)
    zero = torch.zeros_like(lift)
    return joints + torch.stack([zero, zero, lift], dim=-1)[..., None, :]


def mirror(joints: Tensor) -> Tensor:
    """The mirror image of poses (..., 14, 3): x negated, right and left joints exchanged."""
    swapped = [
        JOINTS.index(n.replace("right", "left") if "right" in n else n.replace("left", "right"))
        for n in JOINTS
    ]
    flipped = joints[..., swapped, :]
    return torch.cat([-flipped[..., :1], flipped[..., 1:]], dim=-1)


#: Eyes and ears seen from the nose: sideways, backward and up, in body heights.
_EYE = (0.018, 0.014, 0.019)
_EAR = (0.043, 0.060, 0.010)


def body_to_coco(joints: Tensor) -> Tensor:
    """The 17 key points of COCO from the 14 joints of the radar body.

    Eyes and ears are placed about the nose in a frame that neck and nose (which give its size too) and the
    line of the shoulders span: a head that turns against the trunk turns them in part only.

    Args:
        joints: (..., 14, 3) metres, order of ``tensorsim.JOINTS``, any frame with right-handed axes.

    Returns:
        (..., 17, 3) in the order of ``tensorsim.COCO_KEYPOINTS``; body joints and nose are kept as they are.

    Raises:
        TensorsimError: joints of another shape, or integers.
    """
    check_floating(joints, "joints")
    check_min_rank(joints, 2, "joints", "(..., 14, 3)")
    check_size(joints, -2, len(JOINTS), "joints", "(..., 14, 3)")
    check_size(joints, -1, 3, "joints", "(..., 14, 3)")
    nose, neck = joints[..., 0, :], joints[..., 1, :]
    reach = nose - neck
    height = reach.norm(dim=-1, keepdim=True) / math.hypot(NOSE_FORWARD, NOSE_UP)
    reach = reach / reach.norm(dim=-1, keepdim=True)
    across = joints[..., 2, :] - joints[..., 5, :]
    right = across - (across * reach).sum(dim=-1, keepdim=True) * reach
    right = right / right.norm(dim=-1, keepdim=True)
    beside = torch.linalg.cross(right, reach)  # a quarter turn from `reach`, back to up as forward to right
    angle = math.atan2(NOSE_FORWARD, NOSE_UP)
    up = math.cos(angle) * reach + math.sin(angle) * beside
    forward = math.sin(angle) * reach - math.cos(angle) * beside

    def face(side: float, place: tuple[float, float, float]) -> Tensor:
        sideways, back, above = place
        return nose + height * (side * sideways * right - back * forward + above * up)

    points = [nose, face(-1.0, _EYE), face(1.0, _EYE), face(-1.0, _EAR), face(1.0, _EAR)]
    points += [joints[..., JOINTS.index(name), :] for name in COCO_KEYPOINTS[5:]]
    return torch.stack(points, dim=-2)

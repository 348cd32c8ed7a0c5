"""A 14-joint articulated body: forward kinematics from joint angles, with constant bone lengths."""

from typing import NamedTuple

import torch
from torch import Tensor

from tensorsim.body.proportions import ANKLE_HEIGHT, FLESH, NOSE_FORWARD, NOSE_UP, Proportions
from tensorsim.config import JOINTS


class BodyPose(NamedTuple):
    """Joint angles in radians. All zero: standing upright, arms hanging, facing +y with the right side at +x.

    Arms follow the twist of the trunk but not its pitch, thighs hang from the pelvis but do not tilt with it:
    flexion is measured from "straight down" of the body, as gait and exercise data are published.

    Attributes:
        heading: (...) turn of the whole body about the vertical, counter-clockwise seen from above.
        lean: (...) tilt of the whole body, forward positive; 90 degrees is lying prone.
        roll: (...) tilt of the whole body to its right.
        trunk: (..., 3) pitch (forward), roll (to the right), twist (counter-clockwise) relative to the body.
        pelvis: (..., 2) roll (right side down) and yaw (counter-clockwise).
        head: (..., 2) pitch (down) and yaw (counter-clockwise) relative to the trunk.
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
    # Equal to kornia.geometry.axis_angle_to_rotation_matrix, which takes six times as long and does not script.
    c, s = torch.cos(angle), torch.sin(angle)
    one, zero = torch.ones_like(c), torch.zeros_like(c)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    entries = [zero] * 9
    entries[4 * axis] = one
    entries[4 * i], entries[3 * i + j], entries[3 * j + i], entries[4 * j] = c, -s, s, c
    return torch.stack(entries, dim=-1).unflatten(-1, [3, 3])


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
    """Shift poses (..., 14, 3) vertically so that their lowest joint rests on z = 0.

    When standing, that is an ankle at its anatomical height; when lying or kneeling, a joint with flesh around it.
    """
    clearance = [ANKLE_HEIGHT if name.endswith("ankle") else FLESH for name in JOINTS]
    height = torch.as_tensor(height_m, dtype=joints.dtype, device=joints.device)
    room = torch.tensor(clearance, dtype=joints.dtype, device=joints.device) * height[..., None]
    lift = (room - joints[..., 2]).amax(dim=-1)
    zero = torch.zeros_like(lift)
    return joints + torch.stack([zero, zero, lift], dim=-1)[..., None, :]

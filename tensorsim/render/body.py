"""A body of rounded volumes around the 14 joints, and its COCO keypoints.

Sizes are in metres for a body 1.75 m tall and scale with the height; they are those of adults (Gordon et al., *ANSUR*,
medians of both sexes), joined so that silhouettes have no gaps.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.body import proportions
from tensorsim.body.skeleton import body_height, body_to_coco, mid_hips
from tensorsim.render.cast import Volumes

REFERENCE_HEIGHT_M = 1.75
#: Position of the nose relative to the centre of the head: forward and up.
NOSE_FORWARD, NOSE_UP = 0.102, -0.005
#: Angle between upright and the direction from mid-shoulders to the nose, for a body that looks straight ahead.
NOSE_TILT = math.atan2(proportions.NOSE_FORWARD, proportions.NOSE_UP)

#: Positions of eyes and ears relative to the centre of the head, (right, front, up), right side.
EYE = (0.032, 0.086, 0.028)
EAR = (0.076, -0.005, 0.012)

#: Body parts, by what covers them; the index is the ``part`` of a volume.
PARTS = ("head", "neck", "trunk", "hips", "upper_arm", "forearm", "hand", "thigh", "shank", "shoe")


class Body(NamedTuple):
    """Volumes of one person over time, and the parts they belong to.

    Attributes:
        volumes: :class:`Volumes` with leading (T, S).
        part: (S,) int64 index into PARTS.
        keypoints: (T, 17, 3) COCO keypoints in the world.
        height_m: standing height, computed from bone lengths, median over time.
    """

    volumes: Volumes
    part: Tensor
    keypoints: Tensor
    height_m: float


def frame(up: Tensor, right: Tensor) -> Tensor:
    """Rows right, front, up (..., 3, 3) of the frame with this up vector and, as nearly as possible, this right."""
    up = F.normalize(up, dim=-1)
    right = F.normalize(right - (right * up).sum(-1, keepdim=True) * up, dim=-1)
    return torch.stack([right, torch.linalg.cross(up, right), up], dim=-2)


class _Builder:
    """Collects volumes, each given in the coordinates (right, front, up) of a part's frame.

    Args:
        girth: factor on all radii.
        scale: height of the body relative to the reference height.
    """

    def __init__(self, girth: float, scale: float) -> None:
        self.girth, self.scale = girth, scale
        self.rows: list[tuple[Tensor, ...]] = []
        self.parts: list[int] = []

    def add(
        self,
        part: str,
        axes: Tensor,
        origin: Tensor,
        start: Tensor | tuple[float, float, float],
        end: Tensor | tuple[float, float, float],
        radii: tuple[float, float],
        depth: float = 1.0,
        length: Tensor | None = None,
    ) -> None:
        """Add a tapered capsule between points in the world (tensors) or in the frame (tuples, reference metres)."""

        def place(point: Tensor | tuple[float, float, float]) -> Tensor:
            if isinstance(point, Tensor):
                return point
            return origin + self.scale * (origin.new_tensor(point) @ axes)

        frames = origin.shape[0]
        ra, rb = (origin.new_full((frames,), radius * self.scale * self.girth) for radius in radii)
        if length is None:
            length = origin.new_ones(frames)
        squash = origin.new_full((frames,), depth)
        self.rows.append((place(start), place(end), ra, rb, axes, origin, squash, length))
        self.parts.append(PARTS.index(part))


def build_body(joints: Tensor, girth: float = 1.0, long_hair: bool = False) -> Body:
    """A body on the joints of one person.

    The head faces the direction of the nose from the shoulders; the trunk twists with shoulders and hips; hands
    continue the forearms, and feet are perpendicular to the shanks but not below the floor.

    Args:
        joints: (T, 14, 3) metres, order of ``tensorsim.JOINTS``.
        girth: thickness of the body, 1 for the median adult.
        long_hair: hair down to the shoulders.
    """
    height = float(body_height(joints).median())
    scale = height / REFERENCE_HEIGHT_M
    build = _Builder(girth, scale)
    head_build = _Builder(1.0, scale)  # head size does not depend on girth
    up = joints[:, 1] - mid_hips(joints)
    chest = frame(up, joints[:, 2] - joints[:, 5])
    _add_trunk(build, joints, chest)
    face = _add_head(build, head_build, joints, chest, long_hair)
    _add_arms(build, joints)
    _add_legs(build, joints)
    rows = build.rows + head_build.rows
    volumes = Volumes(*(torch.stack(column, dim=1) for column in zip(*rows, strict=True)))
    part = torch.tensor(build.parts + head_build.parts, device=joints.device)
    return Body(volumes, part, torch.cat([face, body_to_coco(joints)[:, 5:]], dim=1), height)


def _add_trunk(build: _Builder, joints: Tensor, chest: Tensor) -> None:
    """Hips, waist and chest. Lengths along the trunk follow the skeleton, so they are given in world coordinates."""
    s, neck, hips = build.scale, joints[:, 1], mid_hips(joints)
    shoulder_line, hip_line = joints[:, 2] - joints[:, 5], joints[:, 8] - joints[:, 11]
    pelvis = frame(neck - hips, hip_line)
    waist = frame(neck - hips, F.normalize(shoulder_line, dim=-1) + F.normalize(hip_line, dim=-1))
    tall = (neck - hips).norm(dim=-1)

    def along(share: float, forward: float, axes: Tensor) -> Tensor:
        return hips + share * (neck - hips) + forward * s * axes[:, 1]

    build.add("hips", pelvis, hips, (-0.065, -0.01, -0.01), (0.065, -0.01, -0.01), (0.115, 0.115), 0.92, tall)
    for part, axes, start, end, radii, depth in (
        ("hips", pelvis, (0.0, 0.0), (0.2, 0.005), (0.158, 0.142), 0.70),
        ("trunk", waist, (0.2, 0.005), (0.45, 0.01), (0.140, 0.136), 0.70),
        ("trunk", chest, (0.45, 0.01), (0.75, 0.01), (0.138, 0.156), 0.68),
        ("trunk", chest, (0.75, 0.01), (0.86, 0.0), (0.156, 0.128), 0.66),
    ):
        build.add(part, axes, hips, along(*start, axes), along(*end, axes), radii, depth, tall)
    for joint, side in ((2, 1.0), (5, -1.0)):
        inner = neck + s * (side * 0.05 * chest[:, 0] + 0.035 * chest[:, 2])
        build.add("trunk", chest, hips, inner, joints[:, joint], (0.052, 0.058), 1.0, tall)
        low = hips + 0.70 * (neck - hips) + side * 0.10 * s * chest[:, 0]
        high = joints[:, joint] - 0.02 * s * chest[:, 2]
        build.add("trunk", chest, hips, low, high, (0.07, 0.055), 1.0, tall)


def _head_frame(joints: Tensor, chest: Tensor, scale: float) -> tuple[Tensor, Tensor]:
    """Frame (T, 3, 3) and centre (T, 3) of the head.

    Only the nose indicates the orientation, so half of its pitch is used. The head stays upright while the trunk is
    nearly upright, and over the neck: in some skeletons the joint is the centre of the head.
    """
    neck = joints[:, 1]
    nose = joints[:, 0] - neck
    yaw = torch.asin(((nose * chest[:, 0]).sum(-1) / (0.105 * scale)).clamp(-0.9, 0.9))
    ahead = torch.cos(yaw)[:, None] * chest[:, 1] + torch.sin(yaw)[:, None] * chest[:, 0]
    nod = torch.atan2((nose * ahead).sum(-1), (nose * chest[:, 2]).sum(-1)) - NOSE_TILT
    nod = 0.5 * nod.clamp(0, 1.2)
    upright = 0.7 * ((chest[:, 2:, 2] - 0.6) / 0.3).clamp(0, 1)
    up = (1 - upright) * chest[:, 2] + upright * F.pad(torch.zeros_like(neck[:, :2]), (0, 1), value=1.0)
    up = torch.cos(nod)[:, None] * up + torch.sin(nod)[:, None] * ahead
    head = frame(up, torch.linalg.cross(ahead, chest[:, 2]))
    center = joints[:, 0] - scale * (NOSE_FORWARD * head[:, 1] + NOSE_UP * head[:, 2])
    behind = ((neck - center) * ahead).sum(-1, keepdim=True) - 0.01 * scale
    return head, center + behind.clamp(min=0) * ahead


def _add_head(
    build: _Builder, head_build: _Builder, joints: Tensor, chest: Tensor, long_hair: bool
) -> Tensor:
    """Add head and neck; returns the face keypoints (T, 5, 3): nose, eyes and ears."""
    s = build.scale
    head, center = _head_frame(joints, chest, s)

    def on_head(*point: float) -> Tensor:
        return center + s * (center.new_tensor(point) @ head)

    def add(
        start: tuple[float, float, float],
        end: tuple[float, float, float],
        radii: tuple[float, float],
        depth: float = 1.0,
    ) -> None:
        head_build.add("head", head, center, start, end, radii, depth)

    add((0, -0.012, 0.030), (0, -0.004, 0.014), (0.080, 0.078), 1.20)
    add((0, 0.012, 0.0), (0, 0.035, -0.072), (0.072, 0.040))
    add((0, 0.086, 0.018), (0, NOSE_FORWARD - 0.006, -0.008), (0.008, 0.014))
    for side in (1.0, -1.0):
        add((side * 0.076, -0.008, 0.02), (side * 0.074, -0.004, -0.012), (0.016, 0.011))
    if long_hair:
        add((0, -0.035, 0.03), (0, -0.065, -0.16), (0.082, 0.066), 0.7)
    low = joints[:, 1] - s * (0.01 * chest[:, 2])
    build.add("neck", head, center, low, on_head(0, -0.02, -0.06), (0.060, 0.054))
    face = [on_head(side * place[0], *place[1:]) for place in (EYE, EAR) for side in (-1.0, 1.0)]
    return torch.stack([on_head(0, NOSE_FORWARD, NOSE_UP), *face], dim=1)


def _add_arms(build: _Builder, joints: Tensor) -> None:
    """Upper arms, forearms and hands."""
    line = joints[:, 2] - joints[:, 5]
    for first, side in ((2, 1.0), (5, -1.0)):
        shoulder, elbow, wrist = joints[:, first], joints[:, first + 1], joints[:, first + 2]
        upper, lower = frame(shoulder - elbow, line), frame(elbow - wrist, line)
        arm, fore = (shoulder - elbow).norm(dim=-1), (elbow - wrist).norm(dim=-1)
        bulge = shoulder + 0.35 * (elbow - shoulder)
        build.add("upper_arm", upper, shoulder, shoulder, bulge, (0.056, 0.050), 1.0, arm)
        build.add("upper_arm", upper, shoulder, bulge, elbow, (0.050, 0.041), 1.0, arm)
        bulge = elbow + 0.25 * (wrist - elbow)
        build.add("forearm", lower, elbow, elbow, bulge, (0.041, 0.043), 1.0, fore)
        build.add("forearm", lower, elbow, bulge, wrist, (0.043, 0.027), 1.0, fore)
        build.add("hand", lower, wrist, (0, 0, -0.01), (0, 0.005, -0.085), (0.027, 0.040), 0.6)
        build.add("hand", lower, wrist, (0, 0.005, -0.09), (0, 0.025, -0.165), (0.036, 0.017), 0.55)
        build.add("hand", lower, wrist, (0, 0.01, -0.03), (-side * 0.03, 0.035, -0.095), (0.018, 0.011))


def _add_legs(build: _Builder, joints: Tensor) -> None:
    """Thighs, shanks and shoes."""
    s, line = build.scale, joints[:, 8] - joints[:, 11]
    pelvis = frame(joints[:, 1] - mid_hips(joints), line)
    ground = joints[:, (10, 13), 2].min()  # the floor that these feet stand on
    for first, side in ((8, 1.0), (11, -1.0)):
        hip, knee, ankle = joints[:, first], joints[:, first + 1], joints[:, first + 2]
        upper, lower = frame(hip - knee, line), frame(knee - ankle, line)
        thigh, shank = (hip - knee).norm(dim=-1), (knee - ankle).norm(dim=-1)
        inward = hip - side * 0.020 * s * pelvis[:, 0]
        build.add("thigh", upper, hip, inward, hip + 0.3 * (knee - hip), (0.088, 0.082), 1.0, thigh)
        build.add("thigh", upper, hip, hip + 0.3 * (knee - hip), knee, (0.082, 0.056), 1.0, thigh)
        calf = knee + 0.30 * (ankle - knee) - 0.012 * s * lower[:, 1]
        build.add("shank", lower, knee, knee, calf, (0.054, 0.056), 1.0, shank)
        build.add("shank", lower, knee, calf, ankle, (0.056, 0.037), 1.0, shank)
        foot = _level_foot(lower, ankle, ground, s)
        toes = (side * 0.008, 0.115, -0.042)
        build.add("shoe", foot, ankle, (0, -0.045, -0.035), (0, 0.02, -0.015), (0.034, 0.042))
        build.add("shoe", foot, ankle, (0, 0.01, -0.028), toes, (0.040, 0.040))
        build.add("shoe", foot, ankle, toes, (side * 0.004, 0.165, -0.046), (0.040, 0.027))


def _level_foot(shank: Tensor, ankle: Tensor, ground: Tensor, scale: float) -> Tensor:
    """Frame (T, 3, 3) of a foot perpendicular to the shank, its toes not below the floor."""
    toe = ankle + scale * 0.165 * shank[:, 1]
    clearance = ankle[:, 2] - ground  # 0 on the floor
    lowest = (ground - 0.01 * scale + 0.4 * clearance.clamp(min=0)).minimum(ankle[:, 2])
    short = (lowest - toe[:, 2]).clamp(min=0)
    # Only feet near the floor stand on it; feet in the air or of lying bodies keep their orientation.
    lift = short * (clearance < 0.25 * scale)
    forward = F.normalize(toe + F.pad(lift[:, None], (2, 0)) - ankle, dim=-1)
    up = torch.linalg.cross(shank[:, 0], forward)
    return frame(up, shank[:, 0])

"""The people of a sample on the floor, at one common rate."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.body.skeleton import body_height, mid_hips, mirror
from tensorsim.data.motion_files import place
from tensorsim.data.sets.variations import Variation, VariationConfig
from tensorsim.data.skeletons import Motion
from tensorsim.errors import TensorsimError
from tensorsim.motion.absence import continued
from tensorsim.motion.resample import PoseResampler


class Scene(NamedTuple):
    """People in the world.

    Attributes:
        joints: (P, T, 14, 3) float32 metres.
        valid: (P, T) bool.
        fps: frames per second.
    """

    joints: Tensor
    valid: Tensor
    fps: float


def varied(motion: Motion, variation: Variation) -> Motion:
    """Apply a variation to recorded people: height, mirroring, heading, position and speed.

    Args:
        motion: people; their positions relative to each other scale with their height.
        variation: refers to the first person.

    Raises:
        TensorsimError: nobody in it.
    """
    present = motion.valid.any(dim=1)
    if not bool(present.any()):
        raise TensorsimError("motion: contains no people, expected at least one")
    joints, valid = motion.joints[present].double(), motion.valid[present]
    if variation.height_m is not None:
        joints = joints * (variation.height_m / float(body_height(joints[0, valid[0]]).median()))
    if variation.mirrored:
        joints = mirror(joints)
    turn = math.radians(variation.heading_deg)
    moved = place(Motion(joints, valid, motion.fps), variation.distance_m, turn, variation.side_m)
    return moved._replace(fps=motion.fps * variation.speed)


def part_of(motion: Motion, duration_s: float, rate_hz: float, start: float) -> Scene:
    """``duration_s`` of a motion at ``rate_hz``, beginning at a fraction ``start`` of the possible start times.

    In a shorter motion people are present only for as long as it lasts. Joints of absent people do not matter.

    Raises:
        TensorsimError: fewer than two frames.
    """
    frames = motion.valid.shape[1]
    if frames < 2:
        raise TensorsimError(f"motion: got {frames} frame, expected at least 2")
    count = round(duration_s * rate_hz)
    resampled = PoseResampler(rate_hz)(continued(motion.joints, motion.valid), motion.fps)
    there = resampled.shape[1]
    nearest = (torch.arange(there) * (motion.fps / rate_hz)).round().long().clamp(max=frames - 1)
    valid = motion.valid[:, nearest]
    first = round(start * max(0, there - count))
    joints, valid = resampled[:, first : first + count], valid[:, first : first + count]
    missing = count - joints.shape[1]
    if missing > 0:
        joints = torch.cat([joints, joints[:, -1:].expand(-1, missing, -1, -1)], dim=1)
        valid = torch.cat([valid, valid.new_zeros(valid.shape[0], missing)], dim=1)
    return Scene(joints.float(), valid, rate_hz)


def beside_each_other(scenes: list[Scene], spacing_m: float) -> Scene:
    """Combine several scenes of equal length: the first stays, the others start alternately to its right and left.

    Args:
        scenes: each with its people; the first person of each determines its position.
        spacing_m: distance in x between neighbours at the start.
    """
    joints, valid = [], []
    for k, scene in enumerate(scenes):
        side = (1 if k % 2 else -1) * ((k + 1) // 2) * spacing_m
        beside = _start(scenes[0]) - _start(scene) + scene.joints.new_tensor([side, 0.0, 0.0])
        joints.append(scene.joints + beside)
        valid.append(scene.valid)
    return Scene(torch.cat(joints), torch.cat(valid), scenes[0].fps)


def _start(scene: Scene) -> Tensor:
    """The floor position (3,), with z = 0, of the first person's hips when that person first appears."""
    first = int(scene.valid[0].int().argmax())
    return F.pad(mid_hips(scene.joints[0, first])[:2], (0, 1))


def kept_inside(scene: Scene, config: VariationConfig) -> Scene:
    """Move everybody along y by the smallest amount that keeps hips within ``keep_m``, the near limit first."""
    if not bool(scene.valid.any()):
        return scene
    near, far = config.keep_m
    y = scene.joints[..., (8, 11), 1].mean(-1)[scene.valid]
    closest, farthest = float(y.min()), float(y.max())
    shift = max(0.0, near - closest) - max(0.0, min(farthest - far, closest - near))
    return scene._replace(joints=scene.joints + scene.joints.new_tensor([0.0, shift, 0.0]))


def seen_from(joints: Tensor, x_m: float, y_m: float, yaw_deg: float) -> Tensor:
    """Joints (..., 3) in the axes of a radar at (x, y) that looks along +y rotated by ``yaw_deg``."""
    yaw = math.radians(yaw_deg)
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = joints.new_tensor([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return (joints - joints.new_tensor([x_m, y_m, 0.0])) @ turn.mT

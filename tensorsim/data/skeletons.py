"""Map skeletons from capture files to the 14 joints of ``tensorsim.JOINTS``.

File formats differ in their joints and joint names; joints are found by name.
"""

import math
import re
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from tensorsim.body.skeleton import body_height
from tensorsim.config import JOINTS
from tensorsim.errors import TensorsimError, check_finite, check_positive
from tensorsim.limits import RANGES, check_range

#: Names of each joint in files, without the side, the most specific first. Mixamo and CMU name a bone's start.
_ALIASES = {
    "shoulder": ("arm", "upperarm", "uparm", "shldr", "shoulder"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm"),
    "wrist": ("wrist", "hand"),
    "hip": ("upleg", "upperleg", "thigh", "hip"),
    "knee": ("knee", "lowleg", "lowerleg", "leg", "shin", "calf"),
    "ankle": ("ankle", "foot"),
}
#: Units of capture files in metres: metre, centimetre, inch, millimetre, unit of CMU's ASF files.
_UNITS_M = (1.0, 0.01, 0.0254, 0.001, 0.0254 / 0.45)
_TYPICAL_HEIGHT_M = 1.75


class Motion(NamedTuple):
    """People moving in the world.

    Attributes:
        joints: (P, T, 14, 3) float32 metres, order of ``tensorsim.JOINTS``, x right, y away, z up.
        valid: (P, T) bool, whether the person is in the scene.
        fps: frames per second.
    """

    joints: Tensor
    valid: Tensor
    fps: float


def body_joints(positions: Tensor, names: tuple[str, ...], top: Tensor | None = None) -> Tensor:
    """The 14 joints from a skeleton with named joints.

    The neck is the midpoint of the shoulders. A missing nose is placed in front of the head joint: half way up to the
    top of the head and as far forward, or by the size of a typical head if ``top`` is unknown.

    Args:
        positions: (..., J, 3) world metres.
        names: J names, with "right", "r", "left" or "l" before or after, in any case, with any prefix.
        top: (..., 3) top of the head.
    """
    index = {plain_name(name): i for i, name in reversed(list(enumerate(names)))}

    def find(joint: str) -> Tensor | None:
        side, _, kind = joint.partition("_")
        candidates = [joint]
        if kind:
            candidates = [
                form
                for alias in _ALIASES[kind]
                for form in (side + alias, side[0] + alias, alias + side, alias + side[0], side + kind)
            ]
        for candidate in candidates:
            if candidate in index:
                return positions[..., index[candidate], :]
        return None

    found = {joint: find(joint) for joint in JOINTS[2:]}
    head, nose = find("head"), find("nose")
    missing = [joint for joint, position in found.items() if position is None]
    if head is None and nose is None:
        missing.insert(0, "head")
    if missing:
        raise TensorsimError(
            f"joint names: got {', '.join(names)}; expected names for {', '.join(missing)} as well"
        )
    limbs = torch.stack([position for position in found.values() if position is not None], dim=-2)
    right, left = limbs[..., 0, :], limbs[..., 3, :]
    neck = (right + left) / 2
    if nose is None:
        assert head is not None
        hips = (limbs[..., 6, :] + limbs[..., 9, :]) / 2
        up = F.normalize(neck - hips if top is None else top - head, dim=-1)
        front = F.normalize(torch.linalg.cross(up, right - left), dim=-1)
        size = 0.2 if top is None else (top - head).norm(dim=-1, keepdim=True)
        nose = head + 0.5 * size * (up * (0.4 if top is None else 1.0) + front)
    return torch.cat([torch.stack([nose, neck], dim=-2), limbs], dim=-2)


def plain_name(name: str) -> str:
    """A joint's name in lower case without prefix and punctuation: "mixamorig:RightArm" -> "rightarm"."""
    name = re.sub(
        r"^(bip\d*|valvebiped|mixamorig\d*|character\d*)[\s_:.]+", "", name.strip(), flags=re.IGNORECASE
    )
    return re.sub(r"[^a-z0-9]", "", name.split(":")[-1].lower())


def motion_of(
    path: Path, positions: Tensor, names: tuple[str, ...], fps: float | None, valid: Tensor | None = None,
    top: Tensor | None = None, unit_m: float | None = 1.0,
) -> Motion:  # fmt: skip
    """Build and check the motion read from a file.

    Args:
        path: the file, for messages.
        positions: (..., T, J, 3) in the world.
        names: names of the J joints.
        fps: frames per second.
        valid: (P, T) bool; None: everybody is present in all frames.
        top: (..., T, 3) top of the head.
        unit_m: unit of positions and top in metres; None: the common unit that makes the body closest to adult size.

    Raises:
        TensorsimError: no frame rate, no frames, NaN, missing joints, ``valid`` of another shape, or bodies that are
            too small or too large for people.
    """
    if fps is None:
        raise TensorsimError(f"{path}: got no frame rate in the file, expected one as fps")
    check_positive(fps, f"{path}: fps")
    check_range(fps, "frame rate", f"{path}: fps")
    if positions.shape[-3] < 1:
        raise TensorsimError(f"{path}: got no frames, expected at least one")
    check_finite(positions, str(path))
    try:
        if unit_m is None:
            unit_m = _likely_unit_m(body_joints(positions, names))
        joints = body_joints(positions * unit_m, names, None if top is None else top * unit_m)
    except TensorsimError as error:
        raise TensorsimError(f"{path}: {error}") from error
    if joints.dim() == 3:
        joints = joints[None]
    check_range(joints.shape[0], "people in a frame", str(path))
    if valid is None:
        valid = torch.ones(joints.shape[:2], dtype=torch.bool)
    if valid.shape != joints.shape[:2]:
        raise TensorsimError(
            f"{path}: got valid of shape {list(valid.shape)}, expected {list(joints.shape[:2])}"
        )
    for person, there in zip(joints, valid, strict=True):
        if bool(there.any()):
            _check_height(float(body_height(person[there]).median()), path)
    return Motion(joints.float(), valid, float(fps))


def _likely_unit_m(joints: Tensor) -> float:
    """The unit that makes bodies (..., T, 14, 3) closest to adult size."""
    tall = float(body_height(joints).median())
    return min(_UNITS_M, key=lambda unit: abs(math.log(max(tall * unit, 1e-9) / _TYPICAL_HEIGHT_M)))


def _check_height(height_m: float, path: Path) -> None:
    """Refuse a body too small or too large for a person, which usually means a wrong unit."""
    low, high, _ = RANGES["body height"]
    if not low <= height_m <= high:
        raise TensorsimError(
            f"{path}: got a person {height_m:.4g} m tall, expected {low:g} to {high:g} m: positions have to be in "
            "metres (load_motion takes other units as unit_m)"
        )

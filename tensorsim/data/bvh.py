"""Motion capture in BVH files, read by pybvh."""

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tensorsim.body.skeleton import mid_hips
from tensorsim.data.skeletons import Motion, motion_of, plain_name
from tensorsim.errors import TensorsimError
from tensorsim.files import reading

#: Units of capture files in metres: metre, centimetre, inch, millimetre, unit of CMU's ASF files.
_UNITS_M = (1.0, 0.01, 0.0254, 0.001, 0.0254 / 0.45)
#: Length of trunk, thigh and shank together, of a body 1.75 m tall.
_TYPICAL_M = 1.36


def read_bvh(path: Path, fps: float | None, unit_m: float | None) -> Motion:
    """The motion of a BVH file; arguments as in :func:`tensorsim.data.motion_files.load_motion`.

    Raises:
        TensorsimError: a file that is not BVH, unknown joints.
    """
    try:
        import pybvh
    except ImportError as error:
        raise TensorsimError(f"{path}: got no BVH reader; install it with `pip install pybvh`") from error
    with reading(path, "BVH"):
        clip = pybvh.read_bvh_file(path)
        nodes = torch.from_numpy(np.ascontiguousarray(clip.node_positions(), dtype=np.float64))
        # For example "+y". The frame stays right-handed, and people of y-up files face the radar.
        vertical = str(clip.world_up)
        head = next((n for n in clip.joint_names if plain_name(n) == "head"), None)
        end = None if head is None else clip.joint_tips.get(head)
        index = [clip.node_index[name] for name in clip.joint_names]
    nodes = _upright(nodes, vertical)
    top = None if end is None else nodes[:, end]
    names = tuple(clip.joint_names)
    motion = motion_of(path, nodes[:, index], names, clip.fps if fps is None else fps, top=top)
    if unit_m is None:
        size = _size(motion.joints[0])
        unit_m = min(_UNITS_M, key=lambda unit: abs(math.log(max(size * unit, 1e-9) / _TYPICAL_M)))
    return motion._replace(joints=motion.joints * unit_m)


def _upright(points: Tensor, vertical: str) -> Tensor:
    """Points of a right-handed frame with this vertical ("+y", "z", ...) turned to z up."""
    axis = "xyz".index(vertical[-1].lower())
    sign = -1.0 if vertical[0] == "-" else 1.0
    order = {0: (2, 1, 0), 1: (0, 2, 1), 2: (0, 1, 2)}[axis]
    turned = points[..., order].clone()
    # Swapping two axes mirrors; negating y as well makes it a rotation.
    flips = points.new_tensor([1.0, (1.0 if axis == 2 else -1.0) * sign, sign])
    return turned * flips


def _size(joints: Tensor) -> float:
    """Median over the frames of the length of trunk, thigh and shank together, of joints (T, 14, 3)."""

    def length(a: Tensor, b: Tensor) -> float:
        return float((a - b).norm(dim=-1).median())

    hips = mid_hips(joints)
    return (
        length(joints[:, 1], hips) + length(joints[:, 8], joints[:, 9]) + length(joints[:, 9], joints[:, 10])
    )

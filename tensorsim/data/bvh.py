"""Motion capture in BVH files, read by pybvh."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tensorsim.data.skeletons import Motion, motion_of, plain_name
from tensorsim.errors import TensorsimError
from tensorsim.files import reading


def read_bvh(path: Path, fps: float | None, unit_m: float | None) -> Motion:
    """The motion in a BVH file; arguments as in :func:`tensorsim.data.motion_files.load_motion`.

    Raises:
        TensorsimError: not a BVH file, or unknown joints.
    """
    try:
        import pybvh
    except ImportError as error:
        raise TensorsimError(f"{path}: got no BVH reader; install it with `pip install pybvh`") from error
    with reading(path, "BVH"):
        clip = pybvh.read_bvh_file(path)
        nodes = torch.from_numpy(np.ascontiguousarray(clip.node_positions(), dtype=np.float64))
        # For example "+y". The frame stays right-handed, and people in y-up files face the radar.
        vertical = str(clip.world_up)
        head = next((n for n in clip.joint_names if plain_name(n) == "head"), None)
        end = None if head is None else clip.joint_tips.get(head)
        index = [clip.node_index[name] for name in clip.joint_names]
    nodes = _upright(nodes, vertical)
    top = None if end is None else nodes[:, end]
    names = tuple(clip.joint_names)
    return motion_of(path, nodes[:, index], names, clip.fps if fps is None else fps, top=top, unit_m=unit_m)


def _upright(points: Tensor, vertical: str) -> Tensor:
    """Rotate points of a right-handed frame with this vertical axis ("+y", "z", ...) to z up."""
    axis = "xyz".index(vertical[-1].lower())
    sign = -1.0 if vertical[0] == "-" else 1.0
    order = {0: (2, 1, 0), 1: (0, 2, 1), 2: (0, 1, 2)}[axis]
    turned = points[..., order].clone()
    # Swapping two axes mirrors; negating y as well makes it a rotation.
    flips = points.new_tensor([1.0, (1.0 if axis == 2 else -1.0) * sign, sign])
    return turned * flips

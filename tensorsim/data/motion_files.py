"""Read motion capture files: npz, BVH, Human3.6M as published by VideoPose3D, AMASS.

Positions are converted to metres in the world frame (x right, y away, z up).
"""

import math
import os
from pathlib import Path

import torch.nn.functional as F

from tensorsim.body.skeleton import mid_hips
from tensorsim.data.bvh import read_bvh
from tensorsim.data.h36m import clips_of_h36m, read_h36m
from tensorsim.data.npz import motions_in, open_npz, preferred, read_npz
from tensorsim.data.skeletons import Motion
from tensorsim.errors import TensorsimError, check_positive, check_tensor
from tensorsim.limits import check_range

#: Height of a standing person's ankles above the floor.
ANKLE_HEIGHT_M = 0.07


def motion_keys(path: str | os.PathLike[str]) -> list[str | None]:
    """The ``key`` for :func:`load_motion` of each motion in a file; [None] if there is nothing to choose.

    Raises:
        TensorsimError: an npz that cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz" or not path.is_file():
        return [None]
    with open_npz(path) as arrays:
        if "positions_3d" in arrays.files:
            return [None]
        motions = motions_in(arrays)
        return [None] if preferred(motions) is not None else [*motions] or [None]


def h36m_keys(path: str | os.PathLike[str]) -> list[str]:
    """The clips ("S1/Walking") in VideoPose3D's ``data_3d_h36m.npz``.

    Raises:
        TensorsimError: no such file, or a different one.
    """
    path = Path(path)
    if not path.is_file():
        raise TensorsimError(f"{path}: no such file, expected data_3d_h36m.npz")
    with open_npz(path) as arrays:
        if "positions_3d" not in arrays.files:
            raise TensorsimError(f"{path}: got no positions_3d, expected Human3.6M of VideoPose3D")
        return list(clips_of_h36m(path, arrays))


def load_motion(
    path: str | os.PathLike[str],
    key: str | None = None,
    fps: float | None = None,
    joint_names: tuple[str, ...] | None = None,
    unit_m: float | None = None,
) -> Motion:
    """Read a motion capture file. The format follows from its suffix and, for npz, its arrays.

    - ``.bvh``: joints named as in CMU, Mixamo, Biped or Biovision; the reader finds the vertical axis.
    - ``.npz`` with ``joints_m``, or any array (T, J, 3) or (P, T, J, 3) in world axes, and ``fps``. Names of the
      joints, as ``joint_names`` in the file or as argument, are needed unless J is 14 (``tensorsim.JOINTS``), 17 (COCO)
      or 22, 24, 52 or more (SMPL). ``valid`` (P, T) is read if present.
    - ``.npz`` with ``joints`` or ``Jtr`` and ``mocap_framerate``: AMASS, SMPL joints, z up.
    - ``.npz`` with ``positions_3d``: VideoPose3D's Human3.6M, 32 joints. Its pickle may hold dictionaries, strings
      and arrays; anything else in it is refused and not run.

    Args:
        path: the file.
        key: the array in an npz, or subject and action as in ``"S1/Walking"``; not needed where there is only one.
        fps: frames per second, overriding the file's; needed if the file states none.
        joint_names: names of the joints in the file, in order.
        unit_m: length of the file's unit in metres. None: for BVH the unit that makes the body closest to adult size,
            for npz the metre.

    Raises:
        TensorsimError: a file that is missing or cannot be read, unknown joints, no frame rate, NaN.
    """
    path = Path(path)
    if not path.is_file():
        raise TensorsimError(f"{path}: no such file, expected motion capture (.bvh or .npz)")
    if fps is not None:
        check_positive(fps, "fps")
    if unit_m is not None:
        check_positive(unit_m, "unit_m")
    if path.suffix.lower() == ".bvh":
        return read_bvh(path, fps, unit_m)
    if path.suffix.lower() != ".npz":
        raise TensorsimError(f"{path}: got a {path.suffix or 'nameless'} file, expected .bvh or .npz")
    with open_npz(path) as arrays:
        if "positions_3d" in arrays.files:
            return read_h36m(path, arrays, key, fps)
        return read_npz(path, arrays, key, fps, joint_names, unit_m)


def place(motion: Motion, range_m: float | None = None, heading_rad: float = 0.0, x_m: float = 0.0) -> Motion:
    """Put a motion on the floor, turn it and move its start.

    Args:
        motion: one or more people; their relative positions are kept.
        range_m: y of the first person's hips in its first valid frame; None keeps x and y as they are.
        heading_rad: rotation about the vertical through these hips, counter-clockwise seen from above.
        x_m: x of these hips, used with ``range_m``.

    Returns:
        The motion with its lowest joint at ankle height over z = 0; joints of absent people are zeros.

    Raises:
        TensorsimError: the first person has no valid frame, or joints or the position are not finite.
    """
    joints = motion.joints
    check_tensor(joints, "motion", "(P, T, 14, 3)")
    for value, quantity, option in (
        (0.0 if range_m is None else range_m, "position", "range_m"),
        (x_m, "position", "x_m"),
        (math.degrees(heading_rad), "angle", "heading_rad in degrees"),
    ):
        check_range(value, quantity, option)
    if not bool(motion.valid[:1].any()):
        raise TensorsimError("motion: got a first person without a valid frame, expected at least one")
    first = int(motion.valid[0].int().argmax())
    middle = F.pad(mid_hips(joints[0, first])[:2], (0, 1))
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    turn = joints.new_tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    to = middle if range_m is None else joints.new_tensor([x_m, range_m, 0.0])
    joints = (joints - middle) @ turn.mT + to
    lift = ANKLE_HEIGHT_M - joints[motion.valid][..., 2].min()
    joints = joints + joints.new_tensor([0.0, 0.0, float(lift)])
    return motion._replace(joints=joints * motion.valid[..., None, None])

"""Motion capture files as joints, whatever their format: npz, BVH, Human3.6M of VideoPose3D, AMASS.

Positions are turned to metres in the world frame (x right, y away, z up).
"""

import math
import os
from pathlib import Path

import torch.nn.functional as F

from tensorsim.data.bvh import read_bvh
from tensorsim.data.h36m import clips_of_h36m, read_h36m
from tensorsim.data.npz import motions_in, open_npz, preferred, read_npz
from tensorsim.data.skeletons import Motion
from tensorsim.errors import TensorsimError, check_positive, check_tensor
from tensorsim.limits import check_range

#: Height of ankles over the floor that they stand on.
ANKLE_HEIGHT_M = 0.07


def motion_keys(path: str | os.PathLike[str]) -> list[str | None]:
    """The ``key`` of each motion of a file for :func:`load_motion`; [None] where there is nothing to choose.

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
    """The clips ("S1/Walking") of VideoPose3D's ``data_3d_h36m.npz``.

    Raises:
        TensorsimError: no such file, or another one.
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
    """Reads a motion capture file; what kind it is follows from its suffix and, for npz, its arrays.

    - ``.bvh``: joints named as by CMU, Mixamo, Biped or Biovision; the vertical axis is found by the reader.
    - ``.npz`` with ``joints_m``, or any array (T, J, 3) or (P, T, J, 3) in world axes, and ``fps``;
      ``joint_names`` in it or as argument, needed unless J is 14 (ours), 17 (COCO) or 22, 24, 52 or more (SMPL);
      ``valid`` (P, T) if there is one.
    - ``.npz`` with ``joints`` or ``Jtr`` and ``mocap_framerate``: AMASS, SMPL joints, z up.
    - ``.npz`` with ``positions_3d``: VideoPose3D's Human3.6M, 32 joints. Its pickle may hold dictionaries, strings
      and arrays; anything else in it is refused and not run.

    Args:
        path: the file.
        key: the array in an npz, or ``"S1/Walking"`` (subject and action); not needed when there is one.
        fps: frames per second; overrides the file, needed where it says nothing.
        joint_names: names of the joints in the file, in order.
        unit_m: metres per unit; None takes the unit in which a BVH is nearest to an adult, metres for npz.

    Raises:
        TensorsimError: files that are missing or not readable, unknown joints, no frame rate, NaN.
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
    """Puts a motion on the floor, turns it and moves its start.

    Args:
        motion: people; they keep their places relative to one another.
        range_m: y of the first person's hips in its first valid frame; None keeps x and y where they are.
        heading_rad: turn about the vertical through these hips, counter-clockwise seen from above.
        x_m: their x, used with ``range_m``.

    Returns:
        The motion with its lowest joint at ankle height over z = 0.

    Raises:
        TensorsimError: a first person who is never there, joints or a place that are not finite.
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
    middle = F.pad((joints[0, first, 8] + joints[0, first, 11])[:2] / 2, (0, 1))
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    turn = joints.new_tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    to = middle if range_m is None else joints.new_tensor([x_m, range_m, 0.0])
    joints = (joints - middle) @ turn.mT + to
    lift = ANKLE_HEIGHT_M - joints[motion.valid][..., 2].min()
    joints = joints + joints.new_tensor([0.0, 0.0, float(lift)])
    return motion._replace(joints=joints * motion.valid[..., None, None])

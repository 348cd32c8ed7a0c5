"""Motion capture in npz files: arrays of named joints, AMASS."""

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
import torch

from tensorsim.config import COCO_KEYPOINTS, JOINTS
from tensorsim.data.skeletons import Motion, motion_of
from tensorsim.errors import TensorsimError
from tensorsim.files import reading

#: Joints 0 to 21 of SMPL, SMPL-H and SMPL-X; further ones are hands and face.
SMPL_JOINTS = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip


#: Largest unpacked size of one array in bytes; an hour of 52 joints at 120 frames per second in float64 is half of it.
MAX_BYTES = 10**9


class Arrays:
    """The arrays in an npz file. Types and sizes are checked before data is read, and pickles are never run."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        #: Names of the arrays.
        self.files = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]

    def shape(self, name: str) -> tuple[int, ...]:
        """Dimensions of an array; reads its header only."""
        with self._archive.open(f"{name}.npy") as file:
            return _header(file)[0]

    def __getitem__(self, name: str) -> np.ndarray:
        with self._archive.open(f"{name}.npy") as file:
            shape, _, dtype = _header(file)
            if dtype.kind not in "fiubU":
                raise ValueError(f"{name} holds {dtype}, expected numbers")
            self._check_size(name, math.prod(shape) * dtype.itemsize)
        with self._archive.open(f"{name}.npy") as file:
            return np.lib.format.read_array(file, allow_pickle=False)

    def pickled(self, name: str) -> bytes:
        """The pickle that NumPy stores for an array of objects."""
        with self._archive.open(f"{name}.npy") as file:
            _, _, dtype = _header(file)
            if not dtype.hasobject:
                raise ValueError(f"{name} holds {dtype}, expected a dictionary")
            self._check_size(name, self._archive.getinfo(f"{name}.npy").file_size)
            return file.read()

    def _check_size(self, name: str, size: int) -> None:
        if size > MAX_BYTES:
            raise ValueError(f"{name} unpacks to {size / 1e6:.0f} MB, expected at most {MAX_BYTES / 1e6:.0f}")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return read(file)


@contextmanager
def open_npz(path: Path) -> Iterator[Arrays]:
    """The arrays in an npz file; errors name the file."""
    with reading(path, "npz"):
        if not zipfile.is_zipfile(path):
            raise ValueError("it is not an archive of arrays")
        with zipfile.ZipFile(path) as archive:
            yield Arrays(archive)


def motions_in(arrays: Arrays) -> list[str]:
    """Names of the arrays of shape (T, J, 3) or (P, T, J, 3)."""
    shapes = {name: arrays.shape(name) for name in arrays.files}
    return [name for name, shape in shapes.items() if len(shape) in (3, 4) and shape[-1] == 3]


def preferred(motions: list[str]) -> str | None:
    """Of several arrays, the one with a usual name; None if there is none."""
    return next((name for name in ("joints_m", "joints", "Jtr") if name in motions), None)


def read_npz(
    path: Path, arrays: Arrays, key: str | None, fps: float | None, names: tuple[str, ...] | None,
    unit_m: float | None,
) -> Motion:  # fmt: skip
    """The motion in opened ``arrays``; arguments as in :func:`tensorsim.data.motion_files.load_motion`.

    Raises:
        TensorsimError: no such array, joints without names, no frame rate.
    """
    candidates = motions_in(arrays)
    if key is None:
        key = candidates[0] if len(candidates) == 1 else preferred(candidates)
    if not candidates:
        shown = ", ".join(f"{name} {list(arrays.shape(name))}" for name in arrays.files[:12])
        raise TensorsimError(f"{path}: got the arrays {shown or 'none'}, expected one of shape (T, J, 3)")
    if key not in candidates:
        got = "several motions" if key is None else f"the motion {key!r}"
        raise TensorsimError(f"{path}: got {got}, expected one of {', '.join(candidates)} (--clip)")
    for name in (f"{key}_fps", "fps", "mocap_framerate", "mocap_frame_rate"):
        if fps is None and name in arrays.files:
            fps = float(arrays[name].item())  # also from a one-element array, as written by MATLAB
    positions = torch.from_numpy(arrays[key].astype(np.float64))
    count = positions.shape[-2]
    if names is None and "joint_names" in arrays.files:
        names = tuple(str(name) for name in arrays["joint_names"])
    if names is None:
        if count == len(JOINTS):
            names = JOINTS
        elif count == len(COCO_KEYPOINTS):
            names = COCO_KEYPOINTS
        elif count in (22, 24) or count >= 52:
            names, positions = SMPL_JOINTS, positions[..., :22, :]
        else:
            raise TensorsimError(
                f"{path}: got {count} joints without names, expected joint_names or 14, 17, 22, 24 or 52 joints"
            )
    if len(names) != positions.shape[-2]:
        raise TensorsimError(f"{path}: got {len(names)} joint names, expected {positions.shape[-2]}")
    if names == JOINTS:  # the head of our own skeleton is the nose
        names = ("nose", *JOINTS[1:])
    valid = torch.from_numpy(arrays["valid"].astype(bool)) if "valid" in arrays.files else None
    return motion_of(path, positions, names, fps, valid, unit_m=1.0 if unit_m is None else unit_m)

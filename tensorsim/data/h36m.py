"""Human3.6M as VideoPose3D publishes it: a pickle inside an npz."""

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tensorsim.data.skeletons import Motion, motion_of
from tensorsim.errors import TensorsimError

#: The joints of Human3.6M's 32 that the body needs, by index.
H36M_JOINTS = {
    14: "nose", 25: "right_shoulder", 26: "right_elbow", 27: "right_wrist", 17: "left_shoulder", 18: "left_elbow",
    19: "left_wrist", 1: "right_hip", 2: "right_knee", 3: "right_ankle", 6: "left_hip", 7: "left_knee", 8: "left_ankle",
}  # fmt: skip
H36M_FPS = 50.0


class _ArraysOnly(pickle.Unpickler):
    """Unpickles dictionaries, strings and numerical arrays; whatever else a pickle asks for is refused."""

    def find_class(self, module: str, name: str) -> Any:
        allowed = {"_reconstruct", "scalar"} if module.startswith(("numpy.core.", "numpy._core.")) else set()
        if module == "numpy":
            allowed = {"ndarray", "dtype"}
        if name not in allowed:
            raise pickle.UnpicklingError(f"the pickle asks for {module}.{name}, expected arrays only")
        return super().find_class(module, name)


def read_h36m(path: Path, key: str | None, fps: float | None) -> Motion:
    """The clip ``key`` ("S1/Walking") of VideoPose3D's ``data_3d_h36m.npz``.

    Raises:
        TensorsimError: a pickle that holds anything but dictionaries of arrays, no such clip.
    """
    with zipfile.ZipFile(path) as archive, archive.open("positions_3d.npy") as file:
        version = np.lib.format.read_magic(file)
        header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        header(file)
        try:
            subjects = _ArraysOnly(file, encoding="latin1").load().item()
            clips = {
                f"{subject}/{action}": clip
                for subject in subjects
                for action, clip in subjects[subject].items()
            }
        except (AttributeError, EOFError, ImportError, TypeError) as error:
            raise TensorsimError(f"{path}: got positions_3d that hold no dictionary ({error})") from error
    if key is None and len(clips) == 1:
        key = next(iter(clips))
    if key not in clips:
        shown = ", ".join(list(clips)[:12])
        raise TensorsimError(f"{path}: got key {key!r}, expected a subject and action such as {shown}")
    positions = torch.from_numpy(np.asarray(clips[key], dtype=np.float64))
    if positions.dim() != 3 or positions.shape[1:] != (32, 3):
        raise TensorsimError(f"{path}: got {key} of shape {list(positions.shape)}, expected (T, 32, 3)")
    positions = positions[:, list(H36M_JOINTS)]
    return motion_of(path, positions, tuple(H36M_JOINTS.values()), H36M_FPS if fps is None else fps)

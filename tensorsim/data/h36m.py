"""Human3.6M as published by VideoPose3D: a pickle inside an npz.

A pickle is a program, and one that builds NumPy objects from raw bytes can read and write any address of the process.
Here a pickle can refer to only five names. Each is replaced by a class of this file that stores its arguments; the
arrays are built afterwards, from plain numeric types.
"""

import io
import math
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tensorsim.data.npz import Arrays
from tensorsim.data.skeletons import Motion, motion_of
from tensorsim.errors import TensorsimError
from tensorsim.files import check_pickle_memo

#: The joints that the body needs, by index among the 32 joints of Human3.6M.
H36M_JOINTS = {
    14: "nose", 25: "right_shoulder", 26: "right_elbow", 27: "right_wrist", 17: "left_shoulder", 18: "left_elbow",
    19: "left_wrist", 1: "right_hip", 2: "right_knee", 3: "right_ankle", 6: "left_hip", 7: "left_knee", 8: "left_ankle",
}  # fmt: skip
H36M_FPS = 50.0

#: Array types that are read: no objects, structures or text.
_NUMBERS = ("f2", "f4", "f8")


class _Dtype:
    """The arguments and the state of a pickled ``numpy.dtype``."""

    def __init__(self, code: Any = "", *_: Any) -> None:
        self.code = code
        self.order = "|"

    def __setstate__(self, state: Any) -> None:
        # (version, byte order, subarray, names, fields, ...): the last three are for structured types.
        self.order = state[1]
        if any(part is not None for part in state[2:5]):
            self.code = "a structure"


class _Array:
    """The arguments and the state of a pickled ``numpy.ndarray``."""

    def __init__(self, *_: Any) -> None:
        self.state: tuple[Any, ...] = ()

    def __setstate__(self, state: Any) -> None:
        self.state = tuple(state)

    def item(self) -> Any:
        """The element of a zero-dimensional array of objects."""
        _, shape, dtype, _, content = self.state
        if dtype.code not in ("O", "O8") or shape != () or not isinstance(content, list):
            raise pickle.UnpicklingError("it is not a dictionary")
        (item,) = content
        return item

    def numbers(self) -> np.ndarray:
        """The array; refused unless it holds plain numbers, and as many bytes as its shape needs."""
        _, shape, dtype, columns_first, content = self.state
        if dtype.code not in _NUMBERS or dtype.order not in ("<", ">", "="):
            raise pickle.UnpicklingError(f"an array of {dtype.code!r}, expected one of {', '.join(_NUMBERS)}")
        plain = np.dtype(dtype.order + dtype.code)
        raw = content.encode("latin1") if isinstance(content, str) else content
        if not all(type(n) is int and n >= 0 for n in shape) or len(raw) != math.prod(shape) * plain.itemsize:
            raise pickle.UnpicklingError(f"an array of shape {shape} from {len(raw)} bytes")
        return np.frombuffer(raw, plain).reshape(shape, order="F" if columns_first else "C")


class _Encoded:
    """``_codecs.encode(text, "latin1")``, which older pickle protocols use to write bytes."""

    def __new__(cls, text: str, _: str) -> Any:
        """The bytes themselves."""
        return text.encode("latin1")

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("a function with a state")


class _ArraysOnly(pickle.Unpickler):
    """Unpickles dictionaries, strings and arrays; refuses all other objects."""

    def find_class(self, module: str, name: str) -> Any:
        core = module in ("numpy.core.multiarray", "numpy._core.multiarray")
        if (core and name == "_reconstruct") or (module, name) == ("numpy", "ndarray"):
            return _Array
        if (module, name) == ("numpy", "dtype"):
            return _Dtype
        if (module, name) == ("_codecs", "encode"):
            return _Encoded
        raise pickle.UnpicklingError(f"the pickle asks for {module}.{name}, expected arrays only")


def clips_of_h36m(path: Path, arrays: Arrays) -> dict[str, Any]:
    """The arrays of VideoPose3D's ``data_3d_h36m.npz`` by subject and action ("S1/Walking").

    Raises:
        TensorsimError: a pickle that holds anything but dictionaries of arrays.
    """
    data = arrays.pickled("positions_3d")
    try:
        file = io.BytesIO(data)
        check_pickle_memo(file)
        subjects = _ArraysOnly(file, encoding="latin1").load().item()
        return {
            f"{subject}/{action}": clip for subject in subjects for action, clip in subjects[subject].items()
        }
    except TensorsimError:
        raise
    except (AttributeError, EOFError, IndexError, TypeError, ValueError) as error:
        raise TensorsimError(f"{path}: got positions_3d that are not a dictionary ({error})") from error


def read_h36m(path: Path, arrays: Arrays, key: str | None, fps: float | None) -> Motion:
    """The clip ``key`` ("S1/Walking") of VideoPose3D's ``data_3d_h36m.npz``.

    Raises:
        TensorsimError: a pickle that holds anything but dictionaries of arrays, or no such clip.
    """
    clips = clips_of_h36m(path, arrays)
    if key is None and len(clips) == 1:
        key = next(iter(clips))
    if key not in clips:
        shown = ", ".join(list(clips)[:12])
        got = "several motions" if key is None else f"the motion {key!r}"
        raise TensorsimError(f"{path}: got {got}, expected a subject and action such as {shown} (--clip)")
    positions = torch.from_numpy(clips[key].numbers().astype(np.float64))
    if positions.dim() != 3 or positions.shape[1:] != (32, 3):
        raise TensorsimError(f"{path}: got {key} of shape {list(positions.shape)}, expected (T, 32, 3)")
    positions = positions[:, list(H36M_JOINTS)]
    return motion_of(path, positions, tuple(H36M_JOINTS.values()), H36M_FPS if fps is None else fps)

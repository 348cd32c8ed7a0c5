"""Named arrays in files: NumPy's .npz, MATLAB's .mat, HDF5."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tensorsim.exceptions import TensorsimError
from tensorsim.files import complete_file, write_bytes

ARRAY_FORMATS = ("npz", "mat", "h5")


def array_formats(text: str) -> tuple[str, ...]:
    """The formats in a list such as ``"mat,h5"``, after NumPy's, which is always written.

    Raises:
        TensorsimError: an unknown format, or one whose library is not installed.
    """
    names = [name.strip() for name in text.split(",")]
    unknown = [name for name in names if name not in ARRAY_FORMATS]
    if unknown:
        raise TensorsimError(f"--save: got {unknown[0]!r}, expected formats of {', '.join(ARRAY_FORMATS)}")
    if "h5" in names:
        _h5py()
    return tuple(name for name in ARRAY_FORMATS if name == "npz" or name in names)


def save_arrays(path: Path, arrays: dict[str, np.ndarray | float], formats: Sequence[str] = ("npz",)) -> None:
    """Write arrays under their names, compressed, once per format.

    In MATLAB files a vector becomes a column and a boolean array a logical one; HDF5 files have one data set per array.

    Args:
        path: the file, without a suffix.
        arrays: arrays by name.
        formats: names from :data:`ARRAY_FORMATS`.

    Raises:
        TensorsimError: h5py is not installed, or a file that cannot be written.
    """
    if "npz" in formats:
        named: dict[str, Any] = {name: np.asarray(x) for name, x in arrays.items()}
        with complete_file(path.with_suffix(".npz")) as scratch, scratch.open("wb") as target:
            np.savez_compressed(target, **named)
    if "mat" in formats:
        from scipy.io import savemat

        with complete_file(path.with_suffix(".mat")) as scratch, scratch.open("wb") as target:
            savemat(target, arrays, do_compression=True, oned_as="column")
    if "h5" in formats:
        content = io.BytesIO()  # HDF5 can crash the process when the disk is full
        with _h5py().File(content, "w") as file:
            for name, x in arrays.items():
                compression = {} if np.ndim(x) == 0 else {"compression": "gzip"}
                file.create_dataset(name, data=np.asarray(x), **compression)
        write_bytes(path.with_suffix(".h5"), content.getbuffer())


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise TensorsimError(
            f"--save h5: h5py cannot be imported ({error}); install it with: pip install h5py"
        ) from None
    return h5py

"""Shards on disk: tar files of WebDataset, HDF5, MATLAB, or pictures in class folders. Equal samples, equal bytes."""

import hashlib
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensorsim.data.sets.recipe import StorageConfig, folder_name, matlab_name
from tensorsim.data.sets.samples import Sample
from tensorsim.files import write_bytes

#: Suffix of the shards of each format; pictures have none.
SUFFIXES = {"webdataset": ".tar", "hdf5": ".h5", "mat": ".mat"}
_MAT_HEADER = b"MATLAB 5.0 MAT-file, tensorsim"


def shard_path(folder: Path, storage: StorageConfig, name: str) -> Path:
    """The file of a shard, or the folder of its pictures."""
    return folder / "shards" / f"{name}{SUFFIXES.get(storage.format, '')}"


def npy_bytes(array: npt.NDArray[Any]) -> bytes:
    """An array as an ``.npy`` file."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def write_shard(folder: Path, storage: StorageConfig, name: str, samples: Sequence[Sample]) -> dict[str, str]:
    """Write the samples of one shard; every file appears only when complete.

    Returns:
        SHA-256 of each file, by its path in the folder.
    """
    files: dict[Path, bytes] = {}
    if storage.format == "png":
        for sample in samples:
            files |= _pictures(folder, sample)
    else:
        files[shard_path(folder, storage, name)] = _BYTES[storage.format](samples)
    for path, content in files.items():
        write_bytes(path, content)
    return {str(path.relative_to(folder)): hashlib.sha256(files[path]).hexdigest() for path in sorted(files)}


def _pictures(folder: Path, sample: Sample) -> dict[Path, bytes]:
    import cv2

    row = sample.row
    place = folder / row["part"] / folder_name(row["label"])
    files = {}
    for name, array in sample.arrays.items():
        # In a picture for viewing the highest speed is at the top.
        content = cv2.imencode(".png", np.ascontiguousarray(array[::-1]))[1].tobytes()
        files[place / f"{row['id']}_{name.split('.')[0]}.png"] = content
    return files


def _tar(samples: Sequence[Sample]) -> bytes:
    import webdataset

    file = io.BytesIO()
    with webdataset.TarWriter(file, user="", group="", encoder=False, mtime=0) as tar:
        for sample in samples:
            entries: dict[str, Any] = {"__key__": sample.row["id"]}
            entries |= {f"{name}.npy": npy_bytes(array) for name, array in sample.arrays.items()}
            entries["json"] = json.dumps(sample.row).encode()
            entries["cls"] = str(sample.row["class_index"]).encode()
            tar.write(entries)
    return file.getvalue()


def _hdf5(samples: Sequence[Sample]) -> bytes:
    import h5py

    file = io.BytesIO()
    with h5py.File(file, "w") as store:
        for sample in samples:
            group = store.create_group(sample.row["id"])
            for name, array in sample.arrays.items():
                group.create_dataset(name, data=array)
            for name, value in sample.row.items():
                group.attrs[name] = np.nan if value is None else value
    return file.getvalue()


def _mat(samples: Sequence[Sample]) -> bytes:
    from scipy.io import savemat

    names = list(samples[0].arrays) if samples else []
    variables: dict[str, Any] = {
        "id": _cells([sample.row["id"] for sample in samples]),
        "label": _cells([sample.row["label"] for sample in samples]),
        "class_index": np.array([sample.row["class_index"] for sample in samples], np.float64),
    }
    for name in names:
        arrays = [_for_matlab(sample.arrays[name]) for sample in samples]
        alike = len({array.shape for array in arrays}) == 1
        variables[matlab_name(name)] = np.stack(arrays) if alike else _cells(arrays)
    file = io.BytesIO()
    savemat(file, variables, do_compression=True, oned_as="column")
    # The original header contains the time of writing.
    return _MAT_HEADER.ljust(116, b" ") + file.getvalue()[116:]


def _for_matlab(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Convert half precision, which MATLAB files do not have."""
    return array.astype(np.float32) if array.dtype == np.float16 else array


def _cells(values: Sequence[Any]) -> npt.NDArray[np.object_]:
    cells = np.empty(len(values), object)
    cells[:] = list(values)
    return cells


_BYTES: dict[str, Callable[[Sequence[Sample]], bytes]] = {"webdataset": _tar, "hdf5": _hdf5, "mat": _mat}

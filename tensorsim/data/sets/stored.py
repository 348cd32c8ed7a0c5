"""Arrays of stored samples, whatever the format of their shards."""

import io
import tarfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tensorsim.data.sets.recipe import DatasetRecipe, folder_name, matlab_name
from tensorsim.data.sets.shards import shard_path
from tensorsim.errors import TensorsimError
from tensorsim.files import reading


@lru_cache(maxsize=256)
def _members(path: Path, changed_ns: int) -> dict[str, tuple[int, int]]:
    """Offset and size of every file in a tar; ``changed_ns`` makes cached results expire when it changes."""
    with reading(path, "a shard"), tarfile.open(path) as tar:
        return {member.name: (member.offset_data, member.size) for member in tar}


@lru_cache(maxsize=4)
def _matlab(path: Path, changed_ns: int) -> dict[str, Any]:
    from scipy.io import loadmat

    with reading(path, "a shard"):
        content: dict[str, Any] = loadmat(path)
    return content


class StoredArrays:
    """Reads arrays of a data set.

    Args:
        folder: folder of the data set.
        recipe: recipe of the data set.
    """

    def __init__(self, folder: Path, recipe: DatasetRecipe) -> None:
        self.folder, self.recipe = folder, recipe

    def __call__(self, row: dict[str, Any], name: str) -> npt.NDArray[Any]:
        """The array ``RADAR.OUTPUT`` of the sample in a manifest row.

        Raises:
            TensorsimError: a shard that is missing or damaged, or no such array.
        """
        storage = self.recipe.storage
        path = shard_path(self.folder, storage, row["shard"])
        if storage.format == "png":
            return self._picture(row, name)
        if not path.is_file():
            raise TensorsimError(f"{path}: no such file, expected a shard of the data set")
        if storage.format == "webdataset":
            return self._of_tar(path, row, name)
        if storage.format == "hdf5":
            import h5py

            with reading(path, "a shard"), h5py.File(path) as store:
                array: npt.NDArray[Any] = store[row["id"]][name][()]
            return array
        content = _matlab(path, path.stat().st_mtime_ns)
        place = [str(cell[0]) for cell in content["id"][:, 0]].index(row["id"])
        stacked = content[matlab_name(name)]
        return np.asarray(stacked[place, 0] if stacked.dtype == object else stacked[place])

    def _of_tar(self, path: Path, row: dict[str, Any], name: str) -> npt.NDArray[Any]:
        member = f"{row['id']}.{name}.npy"
        members = _members(path, path.stat().st_mtime_ns)
        if member not in members:
            raise TensorsimError(f"{path}: got no {member}, expected one of {', '.join(list(members)[:5])}")
        offset, size = members[member]
        with path.open("rb") as file:
            file.seek(offset)
            content = file.read(size)
        with reading(path, "a shard"):
            return np.load(io.BytesIO(content), allow_pickle=False)

    def _picture(self, row: dict[str, Any], name: str) -> npt.NDArray[Any]:
        import cv2

        view = name.split(".")[0]
        path = self.folder / row["part"] / folder_name(row["label"]) / f"{row['id']}_{view}.png"
        found = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.is_file() else None
        if found is None:
            raise TensorsimError(f"{path}: no such picture, expected one of the data set")
        return found[::-1]

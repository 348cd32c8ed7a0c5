"""Check that the files of a finished data set are those that were written."""

import json
from pathlib import Path

from tensorsim.data.sets.build import DONE
from tensorsim.errors import TensorsimError
from tensorsim.files import reading, sha256_of


def wrong_files(folder: Path) -> tuple[int, dict[str, str]]:
    """Compare the shards, or pictures, of a data set with the SHA-256 values in its ``dataset.json``.

    Returns:
        The number of files listed, and by name what is wrong with those that differ.

    Raises:
        TensorsimError: no finished data set there, or a damaged ``dataset.json``.
    """
    path = folder / DONE
    if not path.is_file():
        raise TensorsimError(f"{folder}: got no {DONE}, expected a finished data set")
    with reading(path, "the summary of a data set"):
        expected: dict[str, str] = dict(json.loads(path.read_text(encoding="utf-8"))["sha256"])
    wrong = {}
    for name, digest in expected.items():
        if not (folder / name).is_file():
            wrong[name] = "no such file"
        elif (found := sha256_of(folder / name)) != digest:
            wrong[name] = f"got SHA-256 {found}, expected {digest}"
    return len(expected), wrong

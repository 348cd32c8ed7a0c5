"""Lists of labelled clips: folders with one folder per class, tables, and the layouts of public data sets.

Names of clips are relative to the folder, so that a data set does not depend on where the files are.
"""

import csv
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tensorsim.data.layouts.movi import movi_descriptions
from tensorsim.data.layouts.ntu import ntu_name
from tensorsim.data.motion_files import h36m_keys, motion_keys
from tensorsim.data.sets.clips import Clip
from tensorsim.data.sets.recipe import SourceConfig
from tensorsim.errors import TensorsimError
from tensorsim.files import reading

FILMS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".gif", ".wmv")
CAPTURED = (".bvh", ".npz")


def _folder(source: SourceConfig) -> Path:
    folder = Path(source.path or "")
    if not folder.is_dir():
        raise TensorsimError(f"{folder}: no such folder, expected one for the source {source.kind!r}")
    return folder


def _some(clips: list[Clip], where: Path | str, expected: str) -> list[Clip]:
    if not clips:
        raise TensorsimError(f"{where}: got no clips, expected {expected}")
    return clips


def _of_classes(source: SourceConfig, suffixes: tuple[str, ...], expected: str) -> list[Clip]:
    """Clips in a folder with one folder per class; each file counts as a different person."""
    folder = _folder(source)
    clips = []
    for group in sorted(path for path in folder.iterdir() if path.is_dir() and path.name[0] != "."):
        for file in sorted(group.rglob("*")):
            name = file.relative_to(folder).as_posix()
            if file.suffix.lower() in suffixes and file.is_file():
                clips += [
                    Clip(
                        f"{name}:{key}" if key else name,
                        group.name,
                        name,
                        name,
                        path=str(file),
                        key=key or "",
                    )
                    for key in _keys(file)
                ]
    return _some(clips, folder, expected)


def _keys(file: Path) -> list[str | None]:
    """Motions in a file; an unreadable file gets one, which fails with the reason when it is used."""
    try:
        return motion_keys(file)
    except TensorsimError:
        return [None]


def folder_of_films(source: SourceConfig) -> list[Clip]:
    """``CLASS/.../film.mp4``.

    Raises:
        TensorsimError: no such folder, or no videos in class folders.
    """
    return _of_classes(source, FILMS, f"films ({', '.join(FILMS)}) in a folder for each class")


def folder_of_keypoints(source: SourceConfig) -> list[Clip]:
    """``CLASS/.../film.json`` with COCO keypoints.

    Raises:
        TensorsimError: as :func:`folder_of_films`.
    """
    return _of_classes(source, (".json",), "COCO keypoints (.json) in a folder for each class")


def folder_of_motion(source: SourceConfig) -> list[Clip]:
    """``CLASS/.../motion.bvh`` or ``.npz``; each motion in a file is a clip.

    Raises:
        TensorsimError: as :func:`folder_of_films`.
    """
    return _of_classes(source, CAPTURED, "captured motion (.bvh, .npz) in a folder for each class")


def read_table(path: Path) -> list[dict[str, Any]]:
    """The rows of a CSV or Parquet file by column.

    Raises:
        TensorsimError: no such file, or one that cannot be read.
    """
    if not path.is_file():
        raise TensorsimError(f"{path}: no such file, expected a table (.csv or .parquet)")
    with reading(path, "a table"):
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet as pq

            rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
            return rows
        with path.open(newline="", encoding="utf-8-sig") as file:
            return list(csv.DictReader(file))


def _columns(path: Path, rows: list[dict[str, Any]], names: Iterable[str]) -> None:
    there = list(rows[0]) if rows else []
    missing = [name for name in names if name not in there]
    if missing:
        raise TensorsimError(
            f"{path}: got the columns {', '.join(map(str, there)) or 'none'}, expected {', '.join(missing)} as well"
        )


def _text(row: dict[str, Any], column: str) -> str:
    """The text of a row in a column that may be missing; "" if empty; 0 is not empty."""
    value = row.get(column)
    return "" if value is None else str(value)


def _needed(row: dict[str, Any], column: str, where: str) -> str:
    """The text of a row in a required column."""
    text = _text(row, column)
    if not text.strip():
        raise TensorsimError(f"{where}: got no {column}, expected one")
    return text


def _seconds(value: Any, where: str) -> float | None:
    """A number of seconds, or None if there is none."""
    if value is None or str(value).strip() == "":
        return None
    try:
        seconds = float(value)
    except ValueError:
        seconds = math.nan
    if not 0 <= seconds < math.inf:
        raise TensorsimError(f"{where}: got {value!r}, expected a number of seconds from 0 on")
    return seconds


def table(source: SourceConfig) -> list[Clip]:
    """A table with columns path and label, and optionally start, end (s), person, key and split.

    Paths are relative to the table. Without a person, each file counts as a different person.

    Raises:
        TensorsimError: no such table, missing columns, or a row without path or label.
    """
    path = Path(source.path or "")
    rows = read_table(path)
    _columns(path, rows, ("path", "label"))
    clips = []
    for number, row in enumerate(rows):
        where = f"{path}: row {number + 1}"
        start, end = _seconds(row.get("start"), where), _seconds(row.get("end"), where)
        name, label = _needed(row, "path", where), _needed(row, "label", where)
        clips.append(
            Clip(
                f"{name}#{number}", label, _text(row, "person") or name, name,
                _text(row, "split"), str(path.parent / name), _text(row, "key"), start, end,
            )
        )  # fmt: skip
    return _some(clips, path, "rows")


def ntu(source: SourceConfig) -> list[Clip]:
    """NTU RGB+D: ``.skeleton`` files; classes A001 and on, people P001 and on.

    Raises:
        TensorsimError: no such folder, no such files, or a file with a name of another form.
    """
    folder = _folder(source)
    clips = []
    for file in sorted(folder.rglob("*.skeleton")):
        name = ntu_name(file)
        where = file.relative_to(folder).as_posix()
        clips.append(Clip(where, f"A{name.action:03d}", f"P{name.performer:03d}", where, path=str(file)))
    return _some(clips, folder, "files such as S001C001P001R001A001.skeleton")


def _films(folder: Path) -> dict[str, Path]:
    """Videos in a folder and its subfolders by name without suffix; of equal names, the first in order of ``FILMS``."""
    files = (path for pattern in ("*", "*/*") for path in folder.glob(pattern))
    films = [path for path in files if path.suffix.lower() in FILMS]
    films.sort(key=lambda path: (FILMS.index(path.suffix.lower()), len(path.parts), path))
    return {path.stem: path for path in reversed(films)}


def kinetics(source: SourceConfig) -> list[Clip]:
    """Kinetics: a CSV with label, youtube_id, time_start, time_end and split, plus a folder of videos.

    Videos, in the folder or a subfolder, are called ``ID_START_END`` (six digits each) if they are already cut, or
    ``ID`` if the times are a section of them. Clips are the same whichever of the two exists, or neither. The person
    is the id. Source: W. Kay et al., "The Kinetics Human Action Video Dataset", 2017.

    Raises:
        TensorsimError: no such folder or table, columns that are missing, or a row without id or label.
    """
    folder, path = _folder(source), Path(source.table or "")
    rows = read_table(path)
    _columns(path, rows, ("label", "youtube_id", "time_start", "time_end"))
    films = _films(folder)
    parts = {"train": "train", "val": "validation", "validate": "validation", "test": "test"}
    clips = []
    for number, row in enumerate(rows):
        where = f"{path}: row {number + 1}"
        start, end = _seconds(row["time_start"], where), _seconds(row["time_end"], where)
        name, label = _needed(row, "youtube_id", where), _needed(row, "label", where)
        short = f"{name}_{int(start or 0):06d}_{int(end or 0):06d}"
        film = films.get(short) or films.get(name) or folder / f"{short}.mp4"
        part = parts.get(_text(row, "split"), "")
        clips.append(Clip(short, label, name, name, part, str(film), "", start, end))
    return _some(clips, path, "rows")


def charades(source: SourceConfig) -> list[Clip]:
    """Charades: a CSV with id, subject and actions, plus a folder of videos ``ID.mp4``; one clip per action.

    ``actions`` look like ``c092 11.90 21.20;c147 0.00 12.60``: class, start and end in seconds. Source: G. Sigurdsson
    et al., "Hollywood in Homes", ECCV 2016.

    Raises:
        TensorsimError: no such folder or table, columns that are missing, a row without id, or actions of another form.
    """
    folder, path = _folder(source), Path(source.table or "")
    rows = read_table(path)
    _columns(path, rows, ("id", "subject", "actions"))
    films = _films(folder)
    clips = []
    for line, row in enumerate(rows):
        name = _needed(row, "id", f"{path}: row {line + 1}")
        person = _text(row, "subject") or name
        for number, action in enumerate(filter(None, _text(row, "actions").split(";"))):
            words = action.split()
            if len(words) != 3 or not re.fullmatch(r"c\d{3}", words[0]):
                raise TensorsimError(
                    f"{path}: {name}: got the action {action!r}, expected one such as c092 11.9 21.2"
                )
            start, end = (_seconds(word, f"{path}: {name}") for word in words[1:])
            film = str(films.get(name, folder / f"{name}.mp4"))
            clips.append(Clip(f"{name}#{number}", words[0], person, name, "", film, "", start, end))
    return _some(clips, path, "rows with actions")


def movi(source: SourceConfig) -> list[Clip]:
    """MoVi: ``F_amass_Subject_N.mat``; one clip per motion, its class the description.

    With a ``table`` that has the columns file and label: AMASS ``.npz`` files with joints, and their labels.

    Raises:
        TensorsimError: no such folder, no such files, columns that are missing, or a row without file or label.
    """
    folder = _folder(source)
    clips = []
    if source.table is not None:
        rows = read_table(Path(source.table))
        _columns(Path(source.table), rows, ("file", "label"))
        for number, row in enumerate(rows):
            where = f"{source.table}: row {number + 1}"
            name, label = _needed(row, "file", where), _needed(row, "label", where)
            clips.append(
                Clip(name, label, _text(row, "person") or _subject(name), name, path=str(folder / name))
            )
        return _some(clips, source.table, "rows")
    for file in sorted(folder.rglob("*_amass_Subject_*.mat")):
        where = file.relative_to(folder).as_posix()
        try:
            labels = movi_descriptions(file)
        except TensorsimError:
            labels = ["unreadable"]
        clips += [
            Clip(f"{where}#{k}", label, _subject(where), where, path=str(file), key=str(k))
            for k, label in enumerate(labels)
        ]
    return _some(clips, folder, "files such as F_amass_Subject_1.mat")


def _subject(name: str) -> str:
    found = re.search(r"Subject_(\d+)", name)
    return name if found is None else f"Subject_{found.group(1)}"


def h36m(source: SourceConfig) -> list[Clip]:
    """Human3.6M as published by VideoPose3D, ``data_3d_h36m.npz``: classes are actions without their number.

    Raises:
        TensorsimError: no such file, or a different one.
    """
    path = Path(source.path or "")
    clips = []
    for key in h36m_keys(path):
        subject, action = key.split("/", 1)
        clips.append(Clip(key, re.sub(r"\s*\d+$", "", action), subject, path.name, path=str(path), key=key))
    return _some(clips, path, "subjects with actions")

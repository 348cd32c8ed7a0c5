"""Files and folders appear whole, with ordinary rights, or not at all."""

import errno
import json
import math
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

import tensorsim as ts
from tensorsim.array_files import save_arrays
from tensorsim.errors import TensorsimError
from tensorsim.files import NotWrittenError, complete_file, complete_or_nothing, write_json, write_text
from tensorsim.plot.figure import new_figure, save_figure
from tensorsim.weights import save_weights


def test_a_file_appears_at_the_end_in_a_folder_that_is_made(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    with complete_file(path) as scratch:
        scratch.write_text("half")
        assert not path.exists()
        scratch.write_text("whole")
    assert path.read_text() == "whole"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


def test_a_file_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, calls = tmp_path / "a.txt", []
    fsync, replace = os.fsync, os.replace

    def synced(number: int) -> None:
        calls.append((os.fstat(number).st_size, path.exists()))
        fsync(number)

    def replaced(source: Path, target: Path) -> None:
        calls.append((source.stat().st_size, path.exists()))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    write_text(path, "whole")
    assert calls == [(5, False), (5, False)]
    assert path.read_text() == "whole"


def test_a_block_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), complete_file(path) as scratch:  # noqa: PT012
        scratch.write_text("half")
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt), complete_or_nothing(tmp_path / "folder") as folder:  # noqa: PT012
        (folder / "b.txt").write_text("half")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert path.read_text() == "old"


def test_others_may_read_what_is_written(tmp_path: Path) -> None:
    (tmp_path / "usual").touch()
    ts.export.to_torchscript(nn.Linear(2, 2), tmp_path / "m.pt")
    save_weights(nn.Linear(2, 2), tmp_path / "m.safetensors", {})
    assert len({p.stat().st_mode for p in tmp_path.iterdir()}) == 1
    assert torch.jit.load(tmp_path / "m.pt")(torch.zeros(1, 2)).shape == (1, 2)


def files_in(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text() for p in folder.iterdir()}


def write_run(out: Path, name: str, *files: str) -> None:
    with complete_or_nothing(out) as folder:
        for file in files:
            (folder / file).write_text(name)
        write_json(folder / "summary.json", {"run": name, "files": [*files, "summary.json"]})


def test_a_folder_holds_the_files_of_one_run(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    write_run(out, "first", "a", "only_the_first")
    (out / "mine").write_text("kept")
    write_run(out, "second", "a", "b")
    assert set(files_in(out)) == {"a", "b", "mine", "summary.json"}
    assert files_in(out)["a"] == files_in(out)["b"] == "second"
    assert [p.name for p in out.parent.iterdir()] == ["out"]


def test_results_appear_together_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    write_run(out, "first", "a", "b")
    before = files_in(out)
    (out / "c").mkdir()
    with pytest.raises(TensorsimError, match="out/c: got a folder, expected a file"):
        write_run(out, "second", "a", "c")
    (out / "c").rmdir()
    assert files_in(out) == before

    replace = os.replace
    for failing in range(1, 7):
        calls = iter(range(1, 100))

        def fails_once(source: Path, target: Path, failing: int = failing, calls: Any = calls) -> None:
            # The first rename belongs to the JSON that the block writes.
            if next(calls) == failing + 1:
                raise OSError("the disk is gone")
            replace(source, target)

        monkeypatch.setattr(os, "replace", fails_once)
        with pytest.raises(OSError, match="the disk is gone"):
            write_run(out, "second", "a", "b")
        monkeypatch.undo()
        assert files_in(out) == before
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("the disk is gone")))
    with pytest.raises(OSError, match="gone"), complete_or_nothing(tmp_path / "new") as folder:
        (folder / "a").touch()
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_the_source_of_a_run_is_neither_replaced_nor_removed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_run(out, "first", "film", "maps")
    # It would be removed with the earlier run, of whatever name the new files are.
    with (
        pytest.raises(TensorsimError, match="whose film is the source"),
        complete_or_nothing(out, out / "film"),
    ):
        pytest.fail("the work has begun")
    (out / "mine").write_text("mine")
    os.symlink(out / "mine", tmp_path / "link")
    with (
        pytest.raises(TensorsimError, match="whose mine is the source"),
        complete_or_nothing(out, tmp_path / "link") as folder,
    ):
        (folder / "mine").write_text("second")
    assert {"film": "first", "maps": "first", "mine": "mine"}.items() <= files_in(out).items()
    with complete_or_nothing(out, out / "mine") as folder:
        (folder / "maps").write_text("third")
    assert files_in(out)["mine"] == "mine"


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with complete_or_nothing(out) as folder:
        (folder / "half").touch()
        scratch = folder.parent
        shutil.copytree(scratch, tmp_path / "copy")
    shutil.rmtree(out)
    out.mkdir()
    (tmp_path / "copy").rename(scratch)
    write_run(out, "next", "a")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert set(files_in(out)) == {"a", "summary.json"}


def test_only_the_folder_itself_has_to_take_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may be a link to another file system, or in a folder in which nothing can be made."""
    elsewhere, out = tmp_path / "elsewhere", tmp_path / "out"
    elsewhere.mkdir()
    out.symlink_to(elsewhere)
    replace = os.replace

    def within_one_system(source: Path, target: Path) -> None:
        if {elsewhere in Path(path).resolve().parents for path in (source, target)} != {True}:
            raise OSError(errno.EXDEV, "Invalid cross-device link")
        replace(source, target)

    monkeypatch.setattr(os, "replace", within_one_system)
    for name in ("first", "second"):
        with complete_or_nothing(out) as folder:
            assert {path.name for path in tmp_path.iterdir()} == {"elsewhere", "out"}
            (folder / name).touch()
            write_json(folder / "summary.json", {"files": [name, "summary.json"]})
        assert set(files_in(elsewhere)) == {name, "summary.json"}


def fail_beside(folder: Path, name: str | None) -> None:
    """A run that fails, in one case after something else has been put next to its folder."""
    with complete_or_nothing(folder):
        if name is not None:
            (folder.parent / name).touch()
        raise ValueError("broken")


def test_a_failed_run_leaves_no_folders(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError, match="broken"):
        fail_beside(tmp_path / "there" / "new" / "out", None)
    assert list(tmp_path.rglob("*")) == [tmp_path / "there"]
    with pytest.raises(ValueError, match="broken"):
        fail_beside(tmp_path / "new" / "out", "other")
    assert sorted(tmp_path.rglob("*")) == sorted(tmp_path / name for name in ("there", "new", "new/other"))


def test_a_second_run_into_a_folder_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with complete_or_nothing(out) as folder:
        (folder / "a").write_text("first")
        with pytest.raises(TensorsimError, match="out: another run is writing"):
            write_run(out, "second", "a")
    assert files_in(out) == {"a": "first"}
    write_run(out, "third", "a")
    assert files_in(out)["a"] == "third"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_json_is_strict(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": [math.nan, 1.5, {"b": math.inf}], "c": (True, None, "NaN")})
    text = (tmp_path / "a.json").read_text()
    content = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert content == {"a": [None, 1.5, {"b": None}], "c": [True, None, "NaN"]}


@contextmanager
def full_disk() -> Iterator[None]:
    """A limit on the size of files stands for the end of the disk."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


NOISE = np.random.default_rng(0).random(10_000)
WRITERS: dict[str, Callable[[Path], Any]] = {
    "a.txt": lambda path: write_text(path, "a" * 10_000),
    "a.npz": lambda path: save_arrays(path.with_suffix(""), {"a": NOISE}),
    "a.mat": lambda path: save_arrays(path.with_suffix(""), {"a": NOISE}, ("mat",)),
    "a.h5": lambda path: save_arrays(path.with_suffix(""), {"a": NOISE}, ("h5",)),
    "a.png": lambda path: save_figure(new_figure(), path),
    "a.safetensors": lambda path: save_weights(nn.Linear(100, 100), path, {}),
    "a.pt": lambda path: ts.export.to_torchscript(nn.Linear(100, 100), path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_reported_with_the_name_of_the_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    with full_disk(), pytest.raises(NotWrittenError) as failure:
        WRITERS[name](path)
    assert str(failure.value) == f"{path}: could not be written (File too large)"
    assert list(tmp_path.iterdir()) == []
    # In a folder of results the file has the name that it would have had.
    with full_disk(), pytest.raises(NotWrittenError) as failure, complete_or_nothing(tmp_path / "out") as new:
        WRITERS[name](new / name)
    assert str(failure.value) == f"{tmp_path / 'out' / name}: could not be written (File too large)"
    assert str(pickle.loads(pickle.dumps(failure.value))) == str(failure.value)
    assert list(tmp_path.iterdir()) == []


def test_a_place_where_nothing_can_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "a.json", tmp_path / "file" / "deeper" / "a.json"):
        with pytest.raises(NotWrittenError, match=r"could not be written \((File exists|Not a directory)\)"):
            write_json(path, {})
        with pytest.raises(NotWrittenError, match=r"could not be written \("), complete_or_nothing(path):
            pytest.fail("the work has begun")


def test_errors_that_are_not_of_the_file_pass(tmp_path: Path) -> None:
    for error in (FileNotFoundError(2, "No such file", "/elsewhere/film.mp4"), OSError("no number")):
        with pytest.raises(OSError, match=r"No such file|no number"), complete_file(tmp_path / "a"):
            raise error

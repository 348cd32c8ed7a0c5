"""Read files with one kind of error; write files and folders completely or not at all."""

import hashlib
import json
import math
import os
import pickletools
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from tensorsim.exceptions import TensorsimError

if TYPE_CHECKING:
    import numpy.typing as npt

#: The file that identifies the run that a results folder comes from.
SUMMARY = "summary.json"
#: What a run keeps in its folder until it ends: a lock, and incomplete files.
LOCK, SCRATCH = ".tensorsim.lock", ".tensorsim.scratch"
#: Most memo entries of a pickle; Human3.6M and the largest published networks have a few thousand.
MAX_MEMO = 1_000_000


def check_folder(path: Path, option: str = "--out") -> None:
    """Refuse a file where a folder is wanted; the folder need not exist yet."""
    if path.exists() and not path.is_dir():
        raise TensorsimError(f"{option}: {path} is a file, expected a folder")


def shown_name(name: str) -> str:
    """A file name as text that can be written in UTF-8: bytes that are not UTF-8 become escapes like ``\\udcff``."""
    return name.encode(errors="backslashreplace").decode()


def check_name(path: Path, name: str) -> None:
    """Refuse a path that is not UTF-8: it would crash OpenCV, and the process with it."""
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        raise TensorsimError(f"{name}: got {shown_name(os.fspath(path))}, expected a name in UTF-8") from None


class NotWrittenError(TensorsimError):
    """A file, or a folder of results, that could not be written: the disk is full, or the folder is not writable.

    Attributes:
        path: the file.
        reason: the operating system's message.
    """

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(path, reason)
        self.path, self.reason = path, reason

    def __str__(self) -> str:
        return f"{self.path}: could not be written ({self.reason})"


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn a system error into one that names the file, or the folder that it cannot be written to.

    Errors that name other files pass through.
    """
    try:
        yield
    except TensorsimError:
        raise
    except Exception as error:
        number, name = getattr(error, "errno", None), getattr(error, "filename", None)
        in_rust = re.search(r"\(os error (\d+)\)", str(error))  # safetensors has its own exception
        number = int(in_rust[1]) if in_rust else number
        if number is None or not (name is None or path.is_relative_to(Path(name).parent)):
            raise
        culprit = Path(name) if name is not None and path.is_relative_to(name) else path
        raise NotWrittenError(culprit, os.strerror(number)) from error


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Turn any error that a reader raises on a damaged or wrong file into one that names the file."""
    try:
        yield
    except TensorsimError:
        raise
    except Exception as error:  # such exceptions share no base class
        raise TensorsimError(f"{path}: got a file that cannot be read as {kind} ({error})") from error


def check_pickle_memo(file: IO[bytes]) -> None:
    """Refuse the pickle that begins here in a file if its memo is huge; the file position is left as it was.

    The memo is a list as long as its highest index, which an instruction of a few bytes can set to anything.

    Raises:
        TensorsimError: an index above :data:`MAX_MEMO`.
        ValueError: not a pickle.
    """
    start = file.tell()
    for opcode, argument, _ in pickletools.genops(file):
        if "PUT" in opcode.name and (argument or 0) > MAX_MEMO:
            raise TensorsimError(f"a pickle with a memo of {argument} entries, expected at most {MAX_MEMO}")
    file.seek(start)


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of the content of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def complete_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A scratch path that is renamed to ``path`` when the block succeeds, and removed otherwise.

    The folder is created if needed. The scratch path is in the same folder and ends in ``.tmp``. The file gets the
    usual permissions of new files, and is flushed to disk before the rename: even after a power failure it is either
    complete or absent.

    Raises:
        NotWrittenError: the disk is full, or the folder is not writable.
    """
    path = Path(path)
    scratch = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            scratch.touch()
            rights = scratch.stat().st_mode
            yield scratch
            os.chmod(scratch, rights)  # safetensors makes files readable by their owner only
            with scratch.open("r+b") as file:
                os.fsync(file.fileno())
            os.replace(scratch, path)
        finally:
            scratch.unlink(missing_ok=True)


def sha256_of_arrays(*arrays: "npt.NDArray[Any]") -> str:
    """Hexadecimal SHA-256 of the content of arrays, one after the other."""
    return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()


def read_settings(folder: Path) -> Any:
    """The settings that a folder of results was made with, from its ``settings.json``.

    Raises:
        TensorsimError: no such file, or a damaged one.
    """
    path = folder / "settings.json"
    with reading(path, "settings"):
        return json.loads(path.read_text(encoding="utf-8"))


def keep_settings(folder: Path, settings: dict[str, Any]) -> None:
    """Write the settings of a folder of results to its ``settings.json``, or compare them with those already there.

    Raises:
        TensorsimError: the folder holds results made with other settings, or a damaged file.
    """
    path = folder / "settings.json"
    if path.is_file():
        there = read_settings(folder)
        if there != settings:
            raise TensorsimError(f"{folder}: got maps of {there}, expected {settings}")
    else:
        write_text(path, json.dumps(settings, indent=2))


@contextmanager
def complete_or_nothing(out: Path, source: Path | None = None) -> Iterator[Path]:
    """A scratch folder whose files are moved to ``out`` when the block succeeds; otherwise ``out`` is unchanged.

    Other files in ``out`` stay, except those from an earlier run, which its ``summary.json`` lists under ``files``.
    ``summary.json`` is removed first and written last, so that a folder that has one holds the files of a single run,
    even after a crash. The scratch folder is inside ``out``, and therefore on the same file system.

    Args:
        out: a folder, created if needed, with its parents; those created here are removed again if they stay empty.
        source: the file or folder that the results are made from.

    Raises:
        TensorsimError: another process is writing into ``out``, there is a folder where a file should go, or
            ``source`` would be replaced or removed.
        NotWrittenError: the disk is full, or the folder is not writable.
    """
    with locked(out):
        _keep(source, out, _listed(out))
        scratch = out / SCRATCH
        shutil.rmtree(scratch, ignore_errors=True)  # left by a run that was killed; the lock is ours
        try:
            new, old = scratch / "new", scratch / "old"
            with writing(out):
                new.mkdir(parents=True)
                old.mkdir()
            yield new
            _keep(source, out, [file.name for file in new.iterdir()])
            _exchange(out, new, old)
        except NotWrittenError as error:
            if not error.path.is_relative_to(new):
                raise
            raise NotWrittenError(out / error.path.relative_to(new), error.reason) from error
        finally:
            shutil.rmtree(scratch, ignore_errors=True)


def _keep(source: Path | None, out: Path, names: list[str]) -> None:
    """Refuse to replace or remove the source."""
    if source is None:
        return
    for file in (out / name for name in names):
        if file.exists() and source.exists() and file.samefile(source):
            raise TensorsimError(f"--out: got {out}, whose {file.name} is the source and would be replaced")


def _exchange(out: Path, new: Path, old: Path) -> None:
    """Move the files of ``new`` to ``out``, and those that they replace to ``old``; all or none."""
    names = sorted((file.name for file in new.iterdir()), key=lambda name: (name == SUMMARY, name))
    for name in names:
        if (out / name).is_dir():
            raise TensorsimError(f"{out / name}: got a folder, expected a file or nothing there")
    moves = [
        (out / name, old / name)
        for name in (SUMMARY, *sorted({*names, *_listed(out)} - {SUMMARY}))
        if (out / name).is_file()
    ]
    moves += [(new / name, out / name) for name in names]
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            os.replace(source, target)
            done.append((source, target))
    except BaseException:
        for source, target in reversed(done):
            os.replace(target, source)
        raise


def _listed(out: Path) -> list[str]:
    """Names of the files listed in the summary of an earlier run; empty if there is no summary."""
    try:
        names = json.loads((out / SUMMARY).read_text(encoding="utf-8"))["files"]
        return [name for name in names if Path(name).name == name]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return []


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Lock a folder for this process; the lock is released when the process ends, even by a crash.

    The folder and its parents are created if needed, and those created are removed again if they are still empty.
    """
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    try:
        with writing(out):
            out.mkdir(parents=True, exist_ok=True)
        with _only_one(out):
            yield
    finally:
        with suppress(OSError):  # it is not empty
            for folder in made:
                folder.rmdir()


@contextmanager
def _only_one(out: Path) -> Iterator[None]:
    """Hold the lock of an existing folder."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    path = out / LOCK
    with writing(out):
        file = os.open(path, os.O_CREAT | os.O_RDWR, 0o644)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if not path.exists() or not os.path.samestat(os.stat(path), os.fstat(file)):
                raise BlockingIOError  # its last holder removed it, and another run has made a new one
        except BlockingIOError:
            raise TensorsimError(
                f"{out}: another run is writing into this folder, expected one at a time"
            ) from None
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
    finally:
        os.close(file)


def write_bytes(path: str | os.PathLike[str], content: bytes | memoryview) -> None:
    """Write bytes; the file appears only when complete."""
    with complete_file(path) as scratch:
        scratch.write_bytes(content)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write text in UTF-8; the file appears only when complete."""
    write_bytes(path, text.encode())


def write_json(path: str | os.PathLike[str], content: Any) -> None:
    """Write strict JSON, with ``null`` for NaN and infinity; the file appears only when complete."""
    write_text(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content

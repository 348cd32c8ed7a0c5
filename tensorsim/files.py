"""Files that are read with one kind of error; files and folders that appear whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tensorsim.errors import TensorsimError


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Whatever a reader stumbles over in a file that is damaged or another is one error that names the file."""
    try:
        yield
    except TensorsimError:
        raise
    except Exception as error:  # such exceptions share no base class
        raise TensorsimError(f"{path}: got a file that cannot be read as {kind} ({error})") from error


@contextmanager
def complete_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A scratch path that becomes ``path`` when the block ends well; otherwise nothing remains of it.

    The folder is made if it is not there. The scratch path lies beside ``path`` and ends in ``.tmp``. The file gets
    the rights that new files usually have.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        scratch.touch()
        rights = scratch.stat().st_mode
        yield scratch
        os.chmod(scratch, rights)  # safetensors writes for the owner's eyes alone
        os.replace(scratch, path)
    finally:
        scratch.unlink(missing_ok=True)


@contextmanager
def complete_or_nothing(out: Path) -> Iterator[Path]:
    """A scratch folder whose files move to ``out`` when the block ends well; otherwise nothing remains of it."""
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    try:
        yield scratch
        out.mkdir(exist_ok=True)
        for file in scratch.iterdir():
            os.replace(file, out / file.name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)

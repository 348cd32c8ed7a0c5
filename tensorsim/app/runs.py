"""Runs of the app: one at a time, monitored, cancellable, kept in temporary folders for a while."""

import re
import secrets
import shutil
import sys
import traceback
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

import numpy as np

from tensorsim.errors import TensorsimError
from tensorsim.files import complete_file
from tensorsim.progress import watched

#: Number of runs kept; the oldest finished one is removed for a new one.
KEPT = 12
ARCHIVE = "all.zip"
#: Seconds to wait for a cancelled run to end; a stage that reports no progress does not notice the cancellation.
LONGEST_END_S = 10.0


class CancelledError(TensorsimError):
    """The user has cancelled the run."""


class Run:
    """A simulation in its own thread.

    Attributes:
        token: its secret name.
        folder: folder of its results, complete once it has succeeded.
        stage, done, total: current stage and its progress.
        pictures: the newest picture (H, W, 3) uint8 RGB by name, ``"film"`` and ``"world"``.
        error: one sentence if it failed, else None.
    """

    def __init__(self, folder: Path) -> None:
        self.token, self.folder = folder.name, folder
        self.stage, self.done = "waiting", 0
        self.total: int | None = None
        self.pictures: dict[str, np.ndarray] = {}
        self.error: str | None = None
        self.finished, self.cancelled = Event(), Event()

    def advanced(self, stage: str, done: int, total: int | None) -> None:
        """See :class:`~tensorsim.progress.Watcher`."""
        self.stage, self.done, self.total = stage, done, total
        if self.cancelled.is_set():
            raise CancelledError("cancelled")

    def pictured(self, name: str, draw: Callable[[], np.ndarray]) -> None:
        """See :class:`~tensorsim.progress.Watcher`."""
        self.pictures[name] = draw()

    def files(self) -> list[Path]:
        """The result files."""
        return (
            sorted(path for path in self.folder.iterdir() if path.is_file()) if self.folder.is_dir() else []
        )


class Runs:
    """All runs of the app.

    Args:
        root: a temporary folder, removed by its owner.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.known: OrderedDict[str, Run] = OrderedDict()
        self.one_at_a_time, self.lock = Lock(), Lock()

    def start(self, command_for: Callable[[Path], Any]) -> Run:
        """Run ``command_for(folder).run()`` in a thread; if ``command_for`` fails, that is an error of the run."""
        run = Run(self.root / secrets.token_urlsafe(16))
        with self.lock:
            self.known[run.token] = run
            finished = [old for old in self.known.values() if old.finished.is_set()]
            for old in finished[: max(0, len(self.known) - KEPT)]:
                del self.known[old.token]
                shutil.rmtree(old.folder, ignore_errors=True)
        Thread(target=self._work, args=(run, command_for), daemon=True).start()
        return run

    def _work(self, run: Run, command_for: Callable[[Path], Any]) -> None:
        try:
            with self._turn_of(run), watched(run):
                run.advanced("starting", 0, None)
                command_for(run.folder).run()
                _add_configuration(run.folder)
                _add_archive(run.folder)
        except TensorsimError as error:
            run.error = self._without_paths(" ".join(str(error).split()))
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            run.error = f"the simulation failed ({type(error).__name__}); see the terminal for details"
        finally:
            run.finished.set()

    @contextmanager
    def _turn_of(self, run: Run) -> Iterator[None]:
        """Wait until no other run is active, unless this one is cancelled."""
        while not self.one_at_a_time.acquire(timeout=0.2):
            run.advanced("waiting", 0, None)
        try:
            yield
        finally:
            self.one_at_a_time.release()

    def _without_paths(self, message: str) -> str:
        """The message with file names but without the temporary folders that contain them."""
        return re.sub(re.escape(str(self.root.parent)) + r"/([^\s/]+/)*", "", message)

    def cancel(self, token: str | None) -> None:
        """Cancel a run; does nothing if it has already ended."""
        with suppress(KeyError):
            self.known[token or ""].cancelled.set()

    def close(self) -> None:
        """Cancel all runs and wait for them: a thread still computing when Python exits aborts the process."""
        for run in self.known.values():
            run.cancelled.set()
        for run in self.known.values():
            run.finished.wait(LONGEST_END_S)

    def file(self, token: str, name: str) -> Path | None:
        """The file of a run with this name, None if there is none; no other files can be read."""
        run = self.known.get(token)
        if run is None or not run.finished.is_set():
            return None
        return next((path for path in run.files() if path.name == name), None)


def _add_configuration(folder: Path) -> None:
    """Write the configuration of the run as YAML for ``--config``."""
    from tensorsim.config import SimulationConfig

    SimulationConfig.from_yaml(folder / "summary.json").to_yaml(folder / "configuration.yaml")


def _add_archive(folder: Path) -> None:
    """Put all files into one archive."""
    files = sorted(path for path in folder.iterdir() if path.is_file())
    with (
        complete_file(folder / ARCHIVE) as scratch,
        zipfile.ZipFile(scratch, "w", zipfile.ZIP_STORED) as archive,
    ):
        for path in files:
            archive.write(path, path.name)

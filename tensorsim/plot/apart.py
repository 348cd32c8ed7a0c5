"""Figures drawn in a process of their own, which loads matplotlib while this one loads torch and finds people."""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tensorsim.exceptions import TensorsimError
from tensorsim.plot.figure import save_figure
from tensorsim.plot.maps import map_figure
from tensorsim.process import cpu_quota, is_command, leave

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Drawing:
    """Draws figures and writes them to files, at once and in this process.

    Example:
        >>> drawing = Drawing()
        >>> with drawing.complete():
        ...     drawing.draw(lambda: map_figure(np.eye(3), np.arange(3), np.arange(3), "map", "row"), Path("map.png"))
    """

    def draw(self, figure: "Callable[[], Figure]", path: Path) -> None:
        """Draw a figure and write it as :func:`~tensorsim.plot.save_figure` does.

        Args:
            figure: makes it. For another process, which imports it and loads what it is given, it must be a function,
                or a ``partial`` of one, that needs no torch.
            path: of the file.
        """
        save_figure(figure(), path)

    @contextmanager
    def complete(self) -> Iterator[None]:
        """At the end of the block all figures are written, or, if it fails, none is written any more.

        Raises:
            TensorsimError: a figure cannot be written.
        """
        yield


class _DrawingApart(Drawing):
    """Draws in the process at the other end of ``there``, one figure after another."""

    def __init__(self, there: Connection, pool: ThreadPoolExecutor) -> None:
        self._there, self._pool = there, pool
        self._begun: list[Future[None]] = []

    def draw(self, figure: "Callable[[], Figure]", path: Path) -> None:
        self._begun.append(self._pool.submit(self._drawn, figure, path))

    def _drawn(self, figure: "Callable[[], Figure]", path: Path) -> None:
        try:
            self._there.send((figure, path))
            error = self._there.recv()
        except (EOFError, OSError):
            raise TensorsimError(
                f"{path.name}: the process that draws figures has ended; out of memory?"
            ) from None
        if error is not None:
            raise error

    @contextmanager
    def complete(self) -> Iterator[None]:
        try:
            yield
            for future in self._begun:
                future.result()
        finally:
            for future in self._begun:
                future.cancel()
            wait(self._begun)


@contextmanager
def drawing_apart() -> Iterator[Drawing]:
    """A process for drawing during the block; only for the command and if there is a second processor.

    Programs that use this package may not expect to be imported once more by a second process.
    """
    if not is_command() or cpu_quota() < 2:
        yield Drawing()
        return
    context = get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there,), daemon=True)
    process.start()
    there.close()  # ours; so each process notices when the other ends
    try:
        with ThreadPoolExecutor(1) as pool:
            yield _DrawingApart(here, pool)
    finally:
        here.close()
        process.join()


def _serve(jobs: Connection) -> None:
    """Draw figures until there are no more; interrupts are left to the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _load()
    with suppress(EOFError, OSError):
        while True:
            figure, path = jobs.recv()
            error = None
            try:
                save_figure(figure(), path)
            except Exception as failure:
                error = failure
            jobs.send(error)
    leave()


def _load() -> None:
    """Load matplotlib and its fonts, by drawing a map."""
    import_module("mpl_toolkits.mplot3d")
    line = np.linspace(1.0, 2.0, 9)
    map_figure(np.outer(line, line), line, line, "map", "row", line[None], 1.0, subtitle="0").canvas.draw()

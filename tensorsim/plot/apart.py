"""Figures drawn in a process of their own, which loads matplotlib while this one loads torch and finds people."""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tensorsim.exceptions import TensorsimError
from tensorsim.plot.figure import save_figure
from tensorsim.plot.maps import map_figure
from tensorsim.process import cpu_quota, end_with_parent, is_command

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Drawing:
    """Draws figures and writes them to files.

    Args:
        pool: of the process that does it; None: at once, in this process.
    """

    def __init__(self, pool: Executor | None = None) -> None:
        self._pool = pool
        self._begun: list[Future[None]] = []

    def draw(self, figure: "Callable[[], Figure]", path: Path) -> None:
        """Draw a figure and write it as :func:`~tensorsim.plot.save_figure` does.

        Args:
            figure: makes it; another process must be able to import the function, and to load what it is given
                without torch.
            path: of the file.
        """
        if self._pool is None:
            _draw(figure, path)
        else:
            self._begun.append(self._pool.submit(_draw, figure, path))

    @contextmanager
    def complete(self) -> Iterator[None]:
        """At the end of the block all figures are written, or, if it fails, none is written any more.

        Raises:
            TensorsimError: a file cannot be written, or the process was killed.
        """
        try:
            yield
            for future in self._begun:
                future.result()
        except BrokenProcessPool:
            raise TensorsimError("figures: the process that draws them was killed; out of memory?") from None
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
    with ProcessPoolExecutor(1, get_context("spawn"), _begin) as pool:
        pool.submit(_load)
        yield Drawing(pool)


def _begin() -> None:
    """Leave interrupts to the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _load() -> None:
    """Load matplotlib and its fonts, by drawing a map."""
    import_module("mpl_toolkits.mplot3d")
    line = np.linspace(1.0, 2.0, 9)
    map_figure(np.outer(line, line), line, line, "map", "row", line[None], 1.0, subtitle="0").canvas.draw()


def _draw(figure: "Callable[[], Figure]", path: Path) -> None:
    save_figure(figure(), path)

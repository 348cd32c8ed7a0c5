"""Progress of long work: a bar on the terminal, and whoever watches, such as the app."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

import numpy as np
from tqdm import tqdm


class Watcher(Protocol):
    """Is told what is done; an exception that it raises ends the work."""

    def advanced(self, stage: str, done: int, total: int | None) -> None:
        """``done`` of ``total`` (None: not known) units of a stage are done."""

    def pictured(self, name: str, draw: Callable[[], np.ndarray]) -> None:
        """There is something to see; ``draw`` gives it as (H, W, 3) uint8 RGB."""


_watcher: ContextVar[Watcher | None] = ContextVar("watcher", default=None)


class ProgressBar(tqdm):  # type: ignore[misc]  # tqdm has no types
    """A bar that tells a watcher of its steps, even where the bar itself is hidden."""

    done = 0

    def update(self, n: float | None = 1) -> bool | None:
        """Count ``n`` more units."""
        self.done += int(n or 0)
        watcher = _watcher.get()
        if watcher is not None:
            watcher.advanced(self.stage, self.done, None if self.total is None else int(self.total))
        return super().update(n)


def progress_bar(name: str, total: int | None, quiet: bool) -> Any:
    """A progress bar of frames."""
    bar = ProgressBar(desc=f"{name:<12}", total=total, disable=quiet, unit="frame", leave=True)
    bar.stage, bar.total = name, total  # a bar that is not shown does not keep them
    return bar


def picture(name: str, draw: Callable[[], np.ndarray]) -> None:
    """Offer a picture to the watcher; without one, nothing is drawn."""
    watcher = _watcher.get()
    if watcher is not None:
        watcher.pictured(name, draw)


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Tell a watcher of the work in the block."""
    token = _watcher.set(watcher)
    try:
        yield
    finally:
        _watcher.reset(token)

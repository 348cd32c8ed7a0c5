"""Progress of long work: a bar on the terminal, and watchers such as the app."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol

import numpy as np
from tqdm import tqdm


class Watcher(Protocol):
    """Receives progress reports; an exception that it raises ends the work."""

    def advanced(self, stage: str, done: int, total: int | None) -> None:
        """``done`` of ``total`` (None: not known) units of a stage are done."""

    def pictured(self, name: str, draw: Callable[[], np.ndarray]) -> None:
        """A picture is available; ``draw`` returns it as (H, W, 3) uint8 RGB."""


_watcher: ContextVar[Watcher | None] = ContextVar("watcher", default=None)


class ProgressBar(tqdm):  # type: ignore[misc]  # tqdm has no types
    """A bar that reports its steps to a watcher, even when the bar itself is hidden."""

    done = 0

    def update(self, n: float | None = 1) -> bool | None:
        """Count ``n`` more units."""
        self.done += int(n or 0)
        watcher = _watcher.get()
        if watcher is not None:
            watcher.advanced(self.stage, self.done, None if self.total is None else int(self.total))
        return super().update(n)


def progress_bar(name: str, total: int | None, quiet: bool) -> Any:
    """A progress bar that counts frames."""
    bar = ProgressBar(desc=f"{name:<12}", total=total, disable=quiet, unit="frame", leave=True)
    bar.stage, bar.total = name, total  # tqdm does not keep them in a hidden bar
    return bar


def picture(name: str, draw: Callable[[], np.ndarray]) -> None:
    """Offer a picture to the watcher; without one, nothing is drawn."""
    watcher = _watcher.get()
    if watcher is not None:
        watcher.pictured(name, draw)


@contextmanager
def watched(watcher: Watcher) -> Iterator[None]:
    """Report the work in the block to a watcher."""
    token = _watcher.set(watcher)
    try:
        yield
    finally:
        _watcher.reset(token)

"""Work in a second thread: decoding and encoding of films, in which OpenCV lets other threads run."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from threading import Event
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def ahead(items: Generator[Item, None, None], count: int = 2) -> Iterator[Item]:
    """The same items, made in another thread, at most ``count`` more than were taken; errors come in their place."""
    nothing: Any = object()
    with ThreadPoolExecutor(1) as pool:
        try:
            waiting = deque(pool.submit(next, items, nothing) for _ in range(count))
            while (item := waiting.popleft().result()) is not nothing:
                waiting.append(pool.submit(next, items, nothing))
                yield item
        finally:
            pool.submit(items.close)


@contextmanager
def beside(work: Callable[[Iterable[Item]], Result], items: Iterable[Item]) -> Iterator["Future[Result]"]:
    """``work(items)`` in another thread during the block, which waits for it at its end.

    If the block fails, the items end early and what ``work`` made of them is of no use.
    """
    stopped = Event()

    def until_stopped() -> Iterator[Item]:
        for item in items:
            if stopped.is_set():
                return
            yield item

    with ThreadPoolExecutor(1) as pool:
        try:
            future = pool.submit(copy_context().run, work, until_stopped())
            yield future
            future.result()
        except BaseException:
            stopped.set()
            raise

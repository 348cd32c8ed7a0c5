"""Work in other threads: decoding and encoding videos, and running networks on several parts of a video at a time."""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from contextvars import copy_context
from functools import wraps
from threading import Event, Lock
from typing import Any, TypeVar

import torch

from tensorsim.device import one_thread

Item = TypeVar("Item")
Result = TypeVar("Result")


def shared(
    settings: Callable[[], AbstractContextManager[None]],
) -> Callable[[], AbstractContextManager[None]]:
    """Process-wide settings for blocks in several threads, held from the start of the first to the end of the last.

    If each thread restored what it had found, one could find what another had set, and leave that in place forever.
    """
    lock, held, inside = Lock(), ExitStack(), 0

    @wraps(settings)
    @contextmanager
    def block() -> Iterator[None]:
        nonlocal inside
        with lock:
            if inside == 0:
                held.enter_context(settings())
            inside += 1
        try:
            yield
        finally:
            with lock:
                inside -= 1
                if inside == 0:
                    held.close()

    return block


def ahead(items: Generator[Item, None, None], count: int = 2) -> Iterator[Item]:
    """The same items, made in another thread up to ``count`` ahead; errors are raised when their item is reached."""
    nothing: Any = object()
    with ThreadPoolExecutor(1) as pool:
        try:
            waiting = deque(pool.submit(next, items, nothing) for _ in range(count))
            while (item := waiting.popleft().result()) is not nothing:
                waiting.append(pool.submit(next, items, nothing))
                yield item
        finally:
            pool.submit(items.close)


#: Most items at work at a time; one more waits. For a video, each needs memory for its frames.
MOST_AT_A_TIME = 4


def spread(work: Callable[[Item], Result], items: Iterable[Item], device: torch.device) -> Iterator[Result]:
    """``work`` of each item, in the order of the items; on the CPU, several threads run in parallel.

    Small convolutions gain little from a second thread, while two parts of a video in parallel take half as long. So
    each item runs with one torch thread, and as many items run at a time as torch had threads. ``work`` must not
    depend on earlier items. Items are taken in the caller's thread; errors are raised when their item is reached.
    """
    count = min(torch.get_num_threads(), MOST_AT_A_TIME) if device.type == "cpu" else 1
    if count == 1:
        yield from map(work, items)
        return
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def in_mode(item: Item) -> Result:
        # Both modes are set per thread.
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            return work(item)

    waiting: deque[Future[Result]] = deque()
    with one_thread(), ThreadPoolExecutor(count) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(copy_context().run, in_mode, item))
                if len(waiting) > count:  # one waits, so that no thread does
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


@contextmanager
def beside(work: Callable[[Iterable[Item]], Result], items: Iterable[Item]) -> Iterator["Future[Result]"]:
    """Run ``work(items)`` in another thread during the block, which waits for it at its end.

    If the block fails, the items end early and the result of ``work`` must not be used.
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

"""Work in other threads: decoding and encoding of films, and networks on several parts of a film at a time."""

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
    """Settings of the whole process for blocks in several threads, from when the first begins to when the last ends.

    If each thread put back what it had found, one could find what another had set, and leave that for ever.
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


#: Items that are worked on at a time, at most: of a film each needs the memory of its frames.
MOST_AT_A_TIME = 4


def spread(work: Callable[[Item], Result], items: Iterable[Item], device: torch.device) -> Iterator[Result]:
    """``work`` of each item, in the order of the items; on the CPU by several threads at a time.

    Small convolutions gain little from a second thread, while two parts of a film side by side take half as long. So
    torch computes on one thread in each, and as many items are worked on as it had threads. ``work`` must not
    depend on what it was given before. Items are taken in the thread of the caller, and errors come in their place.
    """
    count = min(torch.get_num_threads(), MOST_AT_A_TIME) if device.type == "cpu" else 1
    if count == 1:
        yield from map(work, items)
        return
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def in_mode(item: Item) -> Result:
        # Both modes are of a thread.
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):
            return work(item)

    waiting: deque[Future[Result]] = deque()
    with one_thread(), ThreadPoolExecutor(count) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(copy_context().run, in_mode, item))
                if len(waiting) == count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


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

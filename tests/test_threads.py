"""Work in a second thread: order, bounds, errors, ends."""

import threading
from collections.abc import Iterable, Iterator
from contextvars import ContextVar

import pytest

from tensorsim.threads import ahead, beside


class Counted:
    """A generator that notes what it made and whether it was closed."""

    def __init__(self, count: int, fails: bool = False) -> None:
        self.count, self.fails = count, fails
        self.made, self.closed = 0, threading.Event()

    def __iter__(self) -> Iterator[int]:
        try:
            for number in range(self.count):
                self.made += 1
                yield number
            if self.fails:
                raise ValueError("broken")
        finally:
            self.closed.set()


def test_items_come_in_order_and_not_far_ahead() -> None:
    source = Counted(50)
    taken = 0
    for number in ahead(iter(source), 3):  # type: ignore[arg-type]
        assert number == taken
        taken += 1
        assert source.made <= taken + 3
    assert taken == 50
    assert source.closed.is_set()


def test_an_error_comes_after_the_items_before_it() -> None:
    items = ahead(iter(Counted(4, fails=True)))  # type: ignore[arg-type]
    assert [next(items) for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="broken"):
        next(items)


def test_items_that_nobody_takes_are_closed() -> None:
    source = Counted(10**9)
    items = ahead(iter(source))  # type: ignore[arg-type]
    assert next(items) == 0
    items.close()  # type: ignore[attr-defined]
    assert source.closed.wait(5.0)
    assert source.made < 10


def test_work_beside_a_block_has_its_context_and_gives_its_result() -> None:
    setting: ContextVar[str] = ContextVar("setting", default="none")
    setting.set("of the block")

    def work(items: Iterable[int]) -> tuple[int, str, bool]:
        return sum(items), setting.get(), threading.current_thread() is threading.main_thread()

    with beside(work, range(5)) as result:
        pass
    assert result.result() == (10, "of the block", False)


def test_a_block_that_fails_ends_the_work() -> None:
    source = Counted(10**9)
    with pytest.raises(KeyboardInterrupt), beside(sum, iter(source)):
        raise KeyboardInterrupt
    assert source.made < 10**9


def test_work_that_fails_fails_the_block() -> None:
    with pytest.raises(ValueError, match="broken"), beside(sum, iter(Counted(3, fails=True))):
        pass

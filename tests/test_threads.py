"""Work in a second thread: order, bounds, errors, ends."""

import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import pytest
import torch

from tensorsim.threads import ahead, beside, shared, spread


def test_settings_hold_from_the_first_to_the_last_block() -> None:
    set_to = ["usual"]

    @shared
    @contextmanager
    def settings() -> Iterator[None]:
        before, set_to[0] = set_to[0], "of the block"
        try:
            yield
        finally:
            set_to[0] = before

    for _ in range(2):
        first, second = settings(), settings()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)  # the one that began first ends first
        assert set_to == ["of the block"]
        second.__exit__(None, None, None)
        assert set_to == ["usual"]
    with pytest.raises(ValueError, match="broken"), settings():
        raise ValueError("broken")
    assert set_to == ["usual"]


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


CPU = torch.device("cpu")


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_items_are_worked_on_side_by_side_and_come_in_order() -> None:
    met = threading.Barrier(2)

    def work(number: int) -> int:
        met.wait(10.0)  # two at a time, or never
        return number * number

    source = Counted(20)
    taken = 0
    for found in spread(work, iter(source), CPU):
        assert found == taken * taken
        taken += 1
        assert source.made <= taken + 2
    assert taken == 20
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_work_in_threads_has_the_modes_and_the_context_of_the_caller() -> None:
    setting: ContextVar[str] = ContextVar("setting", default="none")
    setting.set("of the caller")

    def work(number: int) -> tuple[bool, bool, int, str]:
        return (
            torch.is_inference_mode_enabled(),
            torch.is_grad_enabled(),
            torch.get_num_threads(),
            setting.get(),
        )

    with torch.inference_mode():
        assert set(spread(work, range(4), CPU)) == {(True, False, 1, "of the caller")}
    with torch.no_grad():
        assert set(spread(work, range(4), CPU)) == {(False, False, 1, "of the caller")}
    assert set(spread(work, range(4), CPU)) == {(False, True, 1, "of the caller")}


@pytest.mark.usefixtures("two_threads")
def test_an_error_in_one_item_comes_in_its_place_and_ends_the_others() -> None:
    begun = []

    def work(number: int) -> int:
        begun.append(number)
        if number == 3:
            raise ValueError("broken")
        return number

    results = spread(work, range(1000), CPU)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="broken"):
        next(results)
    assert max(begun) < 7
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_on_other_devices_items_are_worked_on_one_by_one() -> None:
    def work(number: int) -> str:
        return threading.current_thread().name

    assert set(spread(work, range(3), torch.device("cuda"))) == {threading.current_thread().name}

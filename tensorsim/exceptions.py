"""Exceptions of tensorsim, without torch, so that the command line can report bad options before loading torch."""

import math
import sys
import warnings
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any


class TensorsimError(ValueError):
    """Invalid input (a ValueError); the message states what was received and what was expected."""


class TensorsimWarning(UserWarning):
    """Issued when a result is returned but may not be what the caller expects."""


def check_positive(value: float, name: str) -> None:
    """Refuse anything but a number that is finite and above zero."""
    if not isinstance(value, float):  # int and NumPy numbers; TorchScript leaves this out
        value = _number(value, name)
    if not (value > 0.0 and value < float("inf")):
        raise TensorsimError(f"{name}: got {value}, expected a positive finite number")


def check_not_negative(value: float, name: str) -> None:
    """Refuse anything but a number that is finite and not below zero."""
    if not isinstance(value, float):
        value = _number(value, name)
    if not (value >= 0.0 and value < float("inf")):
        raise TensorsimError(f"{name}: got {value}, expected a finite number >= 0")


def _number(value: Any, name: str) -> Any:
    """The value if it can be compared as a single number; refuses strings, None, booleans and several numbers."""
    try:
        if str(getattr(value, "dtype", type(value).__name__)).endswith("bool"):
            raise TypeError
        bool(value > 0.0)
    except (TypeError, ValueError, RuntimeError):
        raise TensorsimError(f"{name}: got {value!r}, expected a positive finite number") from None
    return value


def check_count(value: object, name: str, least: int = 1, most: float = math.inf) -> int:
    """``value`` as a Python int from ``least`` to ``most``; anything else, including a bool, is refused."""
    count = int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None
    if count is None or not least <= count <= most:
        within = f"of at least {least}" if most == math.inf else f"from {least} to {most}"
        raise TensorsimError(f"{name}: got {value!r}, expected an integer {within}")
    return count


def check_seed(seed: object, name: str) -> int:
    """The seed as a Python int; refuses one that some random generator would not accept."""
    return check_count(seed, name, 0, 2**32 - 1)


def check_choice(value: object, choices: Collection[str], name: str) -> None:
    """Refuse anything but one of these names."""
    if not isinstance(value, str) or value not in choices:
        raise TensorsimError(f"{name}: got {value!r}, expected one of {', '.join(choices)}")


def check_score(value: object, name: str) -> None:
    """Refuse anything but a number between 0 and 1: any other threshold would pass all scores or none."""
    if not isinstance(value, Real) or not 0 < float(value) < 1:
        raise TensorsimError(f"{name}: got {value!r}, expected a score in (0, 1)")


def check_per_person(values: object, name: str) -> None:
    """Refuse anything but a tuple or list of positive finite numbers, one per person."""
    if not isinstance(values, tuple | list):
        raise TensorsimError(f"{name}: got {values!r}, expected a tuple of one number per person")
    if len(values) == 0:
        raise TensorsimError(f"{name}: got no values, expected one per person")
    for person, value in enumerate(values):
        check_positive(value, f"{name}[{person}]")


def check_distinct(values: Iterable[object], name: str) -> None:
    """Refuse a list with duplicates."""
    seen: list[object] = []
    for value in values:
        if value in seen:
            raise TensorsimError(f"{name}: got {value!r} twice, expected each once")
        seen.append(value)


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or its class name if there is no message."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(":")


@contextmanager
def collected_warnings() -> Iterator[list[str]]:
    """Collect the messages of tensorsim's own warnings in the block, each once; other warnings pass through."""
    messages: list[str] = []
    show = warnings.showwarning

    def collect(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if not issubclass(category, TensorsimWarning):
            show(message, category, *rest, **more)
        elif str(message) not in messages:
            messages.append(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", TensorsimWarning)
        warnings.showwarning = collect
        yield messages


def print_warnings(messages: Iterable[str]) -> None:
    """Print the messages that :func:`collected_warnings` collected to standard error."""
    for message in messages:
        print(f"tensorsim: warning: {message}", file=sys.stderr)

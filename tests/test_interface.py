"""What may be left out when a public class or function is called, and what it then is: a promise to users.

After a change that is meant, ``python -m tests.test_interface > tests/interface.txt`` writes it anew.
"""

import importlib
import inspect
from collections.abc import Callable
from pathlib import Path

FILE = Path(__file__).with_name("interface.txt")
ROOMS = (
    "tensorsim",
    *(f"tensorsim.{room}" for room in ("enhance", "motion", "radar", "recognition", "vision")),
)


def interface() -> list[str]:
    """A line for each public name, and each public method of it, whose arguments have defaults."""
    lines = []
    for room in map(importlib.import_module, ROOMS):
        for name in sorted(room.__all__):
            public = getattr(room, name)
            if callable(public) and not (isinstance(public, type) and issubclass(public, Exception)):
                lines.append((f"{room.__name__}.{name}", public))
                own = vars(public) if isinstance(public, type) and room.__name__ != "tensorsim" else {}
                lines += [
                    (f"{room.__name__}.{name}.{key}", getattr(public, key))
                    for key, value in own.items()
                    if inspect.isfunction(getattr(value, "__func__", value)) and not key.startswith("_")
                ]
    return [f"{name}({shown})" for name, value in lines if (shown := defaults(value))]


def defaults(called: Callable[..., object]) -> str:
    """Arguments that may be left out, without their types."""
    arguments = inspect.signature(called).parameters.values()
    return ", ".join(f"{p.name}={p.default!r}" for p in arguments if p.default is not p.empty)


def test_defaults_are_those_of_the_interface() -> None:
    written = FILE.read_text(encoding="utf-8").splitlines()
    assert interface() == written, f"if this is meant: python -m tests.test_interface > tests/{FILE.name}"


if __name__ == "__main__":
    print("\n".join(interface()))

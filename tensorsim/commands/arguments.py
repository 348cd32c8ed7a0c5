"""How the command line reads options that need not be given, and options of several numbers."""

from typing import Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

_T = TypeVar("_T")
#: An option that is None unless it is given: the help shows the default that its description names, not "None".
Option = Annotated[_T | None, tyro.conf.DisallowNone, tyro.conf.arg(help_behavior_hint="")]


def numbers(metavar: str, kind: type[float] = float) -> PrimitiveConstructorSpec[Any]:
    """How the command line reads an option that is None by default.

    Args:
        metavar: what the help calls the numbers, one word each, such as ``"X Y Z"``.
        kind: ``float`` or ``int``.
    """

    def read(given: list[str]) -> tuple[float, ...]:
        try:
            return tuple(kind(number) for number in given)
        except ValueError:
            whole = "whole " if kind is int else ""
            raise ValueError(f"got {' '.join(given)}, expected {len(given)} {whole}numbers") from None

    return PrimitiveConstructorSpec(
        nargs=len(metavar.split()),
        metavar=metavar,
        instance_from_str=read,
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: ["None"] if value is None else [str(number) for number in value],
    )

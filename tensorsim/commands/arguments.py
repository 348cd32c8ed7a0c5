"""How the command line describes options, and parses optional options and options with several numbers."""

import ast
import inspect
import re
import textwrap
from dataclasses import fields
from types import MappingProxyType
from typing import Annotated, Any, TypeVar

import tyro
from tyro.constructors import PrimitiveConstructorSpec

_T = TypeVar("_T")
#: An option that is None unless given: the help shows the default stated in its description, not "None".
Option = Annotated[_T | None, tyro.conf.DisallowNone, tyro.conf.arg(help_behavior_hint="")]
#: An option with any number of values, empty unless given: the help shows no "(default: )".
Several = Annotated[tuple[_T, ...], tyro.conf.arg(help_behavior_hint="")]


def paragraphs(text: str) -> str:
    """A text with each of its paragraphs on one line: the help wraps them to the width of the terminal."""
    return "\n\n".join(" ".join(part.split()) for part in re.split(r"\n\s*\n", text.strip()))


def help_texts(command: type) -> dict[str, str]:
    """The string below each field of a data class and of its bases, as :func:`paragraphs`."""
    texts: dict[str, str] = {}
    for base in reversed(command.__mro__[:-1]):
        try:
            source = inspect.getsource(base)
        except OSError:  # only compiled files exist
            continue
        body = ast.parse(textwrap.dedent(source)).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            is_text = isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and is_text:
                texts[field.target.id] = paragraphs(str(text.value.value))  # type: ignore[attr-defined]
    return texts


def describe_options(command: type) -> None:
    """Give tyro the :func:`help_texts` of a command; tyro itself would keep the line breaks of the source."""
    texts = help_texts(command)
    for field in fields(command):
        if field.name in texts:
            field.metadata = MappingProxyType({**field.metadata, "help": texts[field.name]})


def numbers(metavar: str, kind: type[float] = float) -> PrimitiveConstructorSpec[Any]:
    """Specifies how the command line parses an option that is None by default.

    Args:
        metavar: names of the numbers in the help, one word each, such as ``"X Y Z"``.
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

"""Convert configurations from and to plain documents (mappings, lists, numbers), as stored in YAML."""

import dataclasses
import difflib
import hashlib
import json
import types
import typing
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, TypeVar

from tensorsim.exceptions import TensorsimError

T = TypeVar("T")


def to_document(value: Any) -> Any:
    """A configuration as mappings, lists, numbers and strings; NumPy values become Python ones."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_document(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return [to_document(item) for item in value] if isinstance(value, (tuple, list)) else value


def digest(settings: Any) -> str:
    """Ten hexadecimal digits that identify a configuration and the version of this package."""
    text = json.dumps([version("tensorsim"), to_document(settings)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def from_document(where: str, config: type, document: Any, more_keys: tuple[str, ...] = ()) -> Any:
    """A configuration of this dataclass from a mapping; missing fields keep their defaults.

    Args:
        where: start of error messages, e.g. file and section.
        config: a dataclass.
        document: a mapping whose keys are the fields; numbers may be strings: YAML 1.1 reads ``77e9`` as one.
        more_keys: further keys to list in the message about an unknown key.

    Raises:
        TensorsimError: an unknown key, a value of the wrong type, or one that the configuration refuses.
    """
    if not isinstance(document, dict):
        raise TensorsimError(f"{where}: got {document!r}, expected keys with values")
    hints = typing.get_type_hints(config)
    values = {}
    for key, value in document.items():
        if key not in hints:
            known = [*hints, *more_keys]
            raise TensorsimError(
                f"{where}: got the key {key!r}, expected one of {', '.join(known)}{suggestion(str(key), known)}"
            )
        values[key] = _convert(f"{where}: {key}", value, hints[key])
    try:
        return config(**values)
    except TensorsimError as error:
        raise TensorsimError(f"{where}: {error}") from None


def find_named(table: Mapping[str, T], name: str, kind: str) -> T:
    """The entry with this name.

    Raises:
        TensorsimError: no such entry; the message lists the known ones.
    """
    if name not in table:
        known = list(table)
        raise TensorsimError(
            f"{kind}: got {name!r}, expected one of {', '.join(known)}{suggestion(name, known)}"
        )
    return table[name]


def suggestion(name: str, known: list[str]) -> str:
    """``, perhaps 'x'`` if one of the known names is similar to this one; else an empty string."""
    close = difflib.get_close_matches(name.lower(), known, n=1)
    return f", perhaps {close[0]!r}" if close else ""


def _convert(where: str, value: Any, hint: Any) -> Any:
    """A value of a document converted to the type of a field."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(where, value, arguments)
    if dataclasses.is_dataclass(hint):
        return from_document(where, typing.cast(type, hint), value)
    if origin is tuple:
        if not isinstance(value, list):
            raise TensorsimError(f"{where}: got {value!r}, expected {_kind(hint)}")
        # The configuration checks the length.
        return tuple(_convert(where, item, arguments[0]) for item in value)
    if origin is typing.Literal:
        return value  # the configuration checks its choices
    if hint in (bool, str):
        if isinstance(value, hint):
            return value
        quoted = f', in quotes: "{value}"' if hint is str and isinstance(value, (int, float)) else ""
        raise TensorsimError(f"{where}: got {value!r}, expected {_kind(hint)}{quoted}")
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value  # a float would round integers beyond 2**53
    number = _number(value)
    if number is None or (hint is int and not number.is_integer()):
        raise TensorsimError(f"{where}: got {value!r}, expected {_kind(hint)}")
    return int(number) if hint is int else number


def _convert_union(where: str, value: Any, kinds: tuple[Any, ...]) -> Any:
    if value is None and type(None) in kinds:
        return None
    # A list of lists means a tuple of tuples, if the field accepts both that and a plain tuple.
    nested = isinstance(value, list) and any(isinstance(item, list) for item in value)
    fitting = [
        kind
        for kind in kinds
        if kind is not type(None)
        and (typing.get_origin(kind) is tuple) == isinstance(value, list)
        and (typing.get_origin((*typing.get_args(kind), None)[0]) is tuple) == nested
    ]
    if not fitting:
        expected = dict.fromkeys(_kind(kind) for kind in kinds if kind is not type(None))
        raise TensorsimError(f"{where}: got {value!r}, expected {' or '.join(expected)}")
    return _convert(where, value, fitting[0])


def _kind(hint: Any) -> str:
    """How a document represents this type, in words."""
    if typing.get_origin(hint) is tuple:
        return f"a list of {'names' if typing.get_args(hint)[0] is str else 'numbers'}"
    if dataclasses.is_dataclass(hint):
        return "keys with values"
    return {bool: "true or false", str: "text", int: "a whole number"}.get(hint, "a number")


def _number(value: Any) -> float | None:
    try:
        return None if isinstance(value, bool) or not isinstance(value, (int, float, str)) else float(value)
    except (ValueError, OverflowError):
        return None

"""Checks shared by the configurations."""

import dataclasses
import math
from numbers import Real
from typing import Any, get_args

from tensorsim.exceptions import TensorsimError, check_count
from tensorsim.limits import check_range

Vector = tuple[float, float, float]


def is_finite(value: Any) -> bool:
    """Whether this is a real number other than NaN and infinity."""
    return isinstance(value, Real) and math.isfinite(value)


def require_positive(owner: str, **values: float) -> None:
    """Refuse values that are not positive finite numbers."""
    for name, value in values.items():
        if not (is_finite(value) and value > 0):
            raise TensorsimError(f"{owner}.{name}: got {value!r}, expected a positive finite number")


def require_finite(config: Any, *names: str) -> None:
    """Refuse fields of a configuration that are not finite numbers."""
    for name in names:
        value = getattr(config, name)
        if not is_finite(value):
            raise TensorsimError(f"{type(config).__name__}.{name}: got {value!r}, expected a finite number")


def require_ranges(config: Any, **quantities: str) -> None:
    """Refuse fields of a configuration outside the range of their quantity, see :mod:`tensorsim.limits`."""
    for name, quantity in quantities.items():
        check_range(getattr(config, name), quantity, f"{type(config).__name__}.{name}")


def as_plain(value: Any) -> Any:
    """Turn arrays and lists into tuples and NumPy numbers into Python ones; anything else is returned as is."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(as_plain(v) for v in value) if isinstance(value, list | tuple) else value


def make_plain(config: Any) -> None:
    """Apply :func:`as_plain` to every field: configurations become hashable, and modules made from them scriptable."""
    for field in dataclasses.fields(config):
        object.__setattr__(config, field.name, as_plain(getattr(config, field.name)))


def listed(positions: Any) -> tuple[Vector, ...]:
    """One position or several, as a tuple of positions."""
    several = isinstance(positions, tuple) and len(positions) > 0 and isinstance(positions[0], tuple)
    return positions if several else (positions,)


def require_vector(owner: str, **values: Vector) -> None:
    """Refuse values that are not three finite numbers."""
    for name, value in values.items():
        if not (isinstance(value, tuple) and len(value) == 3 and all(is_finite(v) for v in value)):
            raise TensorsimError(
                f"{owner}.{name}: got {value!r}, expected three finite numbers (x, y, z) in metres"
            )


def require_position(owner: str, **values: Vector) -> None:
    """Refuse values that are not three plausible coordinates."""
    require_vector(owner, **values)
    for name, value in values.items():
        for coordinate in value:
            check_range(coordinate, "position", f"{owner}.{name}")


def require_choices(config: Any, **choices: Any) -> None:
    """Refuse fields of a configuration that are not one of the values of their ``Literal`` type."""
    for name, literal in choices.items():
        value, allowed = getattr(config, name), get_args(literal)
        if value not in allowed:
            listed_values = ", ".join(repr(choice) for choice in allowed)
            raise TensorsimError(
                f"{type(config).__name__}.{name}: got {value!r}, expected one of {listed_values}"
            )


def require_counts(config: Any, *names: str, least: int = 1, most: float = math.inf) -> None:
    """Refuse fields that are not integers from ``least`` to ``most``; NumPy integers become Python ones."""
    for name in names:
        value = check_count(getattr(config, name), f"{type(config).__name__}.{name}", least, most)
        object.__setattr__(config, name, value)

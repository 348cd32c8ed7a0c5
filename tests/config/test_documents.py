"""Configurations from plain documents."""

from dataclasses import dataclass

import pytest

from tensorsim.config.documents import from_document
from tensorsim.errors import TensorsimError


@dataclass(frozen=True)
class Settings:
    seed: int = 0
    rate: float = 1.0


@pytest.mark.parametrize("number", [0, -3, 2**53 + 1, -(2**64) - 1])
def test_whole_numbers_are_exact(number: int) -> None:
    assert from_document("own", Settings, {"seed": number}) == Settings(seed=number)


def test_numbers_of_another_kind_are_converted_or_refused() -> None:
    made = from_document("own", Settings, {"seed": "4e2", "rate": 3})
    assert made == Settings(400, 3.0)
    assert (type(made.seed), type(made.rate)) == (int, float)
    for value in (True, 2.5, "x"):
        with pytest.raises(TensorsimError, match=f"own: seed: got {value!r}, expected a whole number"):
            from_document("own", Settings, {"seed": value})

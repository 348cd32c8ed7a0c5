"""Plausible ranges of physical quantities and counts: one table, quoted in error messages.

The ranges are wide: they catch wrong units and numbers that cannot be computed with, not unusual radars or people.
"""

from numbers import Real
from typing import NamedTuple

from tensorsim.exceptions import TensorsimError


class Range(NamedTuple):
    """From ``low`` to ``high``, both included."""

    low: float
    high: float
    unit: str


RANGES: dict[str, Range] = {
    # films and motion
    "frame rate": Range(0.1, 1000.0, "frames per second"),
    "time": Range(0.0, 1e6, "s"),
    "length of a window": Range(1e-6, 1000.0, "s"),
    "stride": Range(1, 100_000, "frames"),
    "image side": Range(2, 8190, "pixels"),
    "people in a frame": Range(1, 64, "people"),
    "people": Range(1, 256, "people"),
    "size of a file": Range(0, 1e9, "bytes"),
    # bodies and places
    "body height": Range(0.3, 3.0, "m"),
    "distance": Range(0.1, 1000.0, "m"),
    "position": Range(-1000.0, 1000.0, "m"),
    "field of view": Range(1.0, 175.0, "degrees"),
    "angle": Range(-36_000.0, 36_000.0, "degrees"),
    # radar
    "carrier frequency": Range(1e8, 1e12, "Hz"),
    "bandwidth": Range(1.0, 1e11, "Hz"),
    "chirp duration": Range(1e-7, 0.1, "s"),
    "pulse repetition frequency": Range(1.0, 1e6, "Hz"),
    "sample rate": Range(1e3, 1e10, "Hz"),
    "samples per chirp": Range(2, 65_536, "samples"),
    "antennas": Range(1, 256, "antennas"),
    "gain": Range(-100.0, 100.0, "dB"),
    "bits of a converter": Range(1, 24, "bits"),
    "ratio of powers": Range(-200.0, 300.0, "dB"),
    # matter
    "relative permittivity": Range(1.0, 1000.0, "times that of vacuum"),
    "loss tangent": Range(0.0, 100.0, "(ratio)"),
    "length": Range(0.0, 1000.0, "m"),
}


def check_range(value: float, quantity: str, option: str) -> None:
    """Refuse a value outside the range of its quantity.

    Args:
        value: the number.
        quantity: a key of :data:`RANGES`.
        option: how the value was given, such as ``"--fps"`` or ``"RadarConfig.prf_hz"``.

    Raises:
        TensorsimError: not a number, NaN, or a value outside the range.
    """
    low, high, unit = RANGES[quantity]
    number = isinstance(value, Real)
    if not (number and low <= value <= high):
        got = f"{value:.6g}" if number else repr(value)
        raise TensorsimError(f"{option}: got {got}, expected {quantity} from {low:g} to {high:g} {unit}")

"""The table of the paper's equations points at functions and tests that exist."""

import ast
import importlib
from pathlib import Path
from typing import Any

import pytest

import tensorsim
from tensorsim.paper import EQUATIONS, Equation

ROOT = Path(__file__).parents[1]
ROWS = [row for rows in EQUATIONS.values() for row in rows]


def found(path: str) -> Any:
    """The object of a dotted path, of which a first part is a module."""
    parts = path.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            target = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for name in parts[cut:]:
            target = getattr(target, name)
        return target
    raise AssertionError(f"{path} does not import")


@pytest.mark.parametrize("row", ROWS, ids=[row.topic for row in ROWS])
def test_targets_exist(row: Equation) -> None:
    target = found(row.function)
    assert callable(target)
    assert target.__doc__
    file, name = row.test.split("::")
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_the_table_is_in_the_docstring_of_the_package() -> None:
    assert len({row.topic for row in ROWS}) == len(ROWS)
    for row in ROWS:
        for text in row:
            assert text in (tensorsim.__doc__ or "")


#: Functions of one formula, which the API reference shows as mathematics.
FORMULAS = (
    "tensorsim.radar.radar_equation_amplitude",
    "tensorsim.radar.intermediate_frequency",
    "tensorsim.radar.synthesis.wall.slab_coefficients",
    "tensorsim.radar.synthesis.wall.fresnel",
    "tensorsim.radar.synthesis.wall.paper_transmission",
    "tensorsim.radar.two_way_wall_transmission",
    "tensorsim.radar.mirror_delays",
    "tensorsim.radar.ReceiverNoise",
    "tensorsim.radar.range_profile",
    "tensorsim.radar.two_pulse_canceller",
    "tensorsim.radar.doppler_time_map",
    "tensorsim.vision.lifting.metric_pose.accumulated_displacement",
    "tensorsim.vision.smoothing.kalman.constant_velocity_predict",
    "tensorsim.vision.smoothing.kalman.kalman_update",
)


@pytest.mark.parametrize("path", FORMULAS)
def test_formulas_are_mathematics_in_the_reference(path: str) -> None:
    """A display formula, in rows of the table."""
    text = found(path).__doc__
    assert text.count("$$") >= 2
    assert text.count("$$") % 2 == 0
    assert path in {row.function for row in ROWS}

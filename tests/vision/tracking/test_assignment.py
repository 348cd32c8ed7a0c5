"""The assignment against scipy.optimize.linear_sum_assignment on the padded problem, and its conventions."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tensorsim.errors import TensorsimError
from tensorsim.vision.tracking.assignment import assign

scripted = torch.jit.script(assign)


def least_total(cost: np.ndarray, allowed: np.ndarray, unassigned_cost: float) -> float:
    """Total cost of the optimum by SciPy: one private column per row stands for leaving it unassigned."""
    from scipy.optimize import linear_sum_assignment

    n, m = cost.shape
    forbidden = 1e7
    padded = np.full((n, m + n), forbidden)
    padded[:, :m][allowed] = cost[allowed]
    padded[np.arange(n), m + np.arange(n)] = unassigned_cost
    return float(padded[linear_sum_assignment(padded)].sum())


def check(cost: np.ndarray, allowed: np.ndarray, unassigned_cost: float) -> list[int]:
    columns = assign(torch.from_numpy(cost), torch.from_numpy(allowed), unassigned_cost)
    assert columns.dtype == torch.int64
    assert columns.shape == cost.shape[:1]
    chosen = columns.tolist()
    pairs = [(i, j) for i, j in enumerate(chosen) if j >= 0]
    assert len({j for _, j in pairs}) == len(pairs), "a column was given twice"
    assert all(allowed[i, j] for i, j in pairs), "a forbidden pair was matched"
    total = sum(cost[i, j] for i, j in pairs) + unassigned_cost * (len(chosen) - len(pairs))
    assert total == pytest.approx(least_total(cost, allowed, unassigned_cost), abs=1e-8)
    return chosen


@pytest.mark.parametrize("kind", ["uniform", "normal", "integers", "ties"])
@pytest.mark.parametrize("density", [0.0, 0.3, 0.7, 1.0])
def test_thousands_of_random_matrices_cost_as_little_as_scipys(kind: str, density: float) -> None:
    rng = np.random.default_rng(7)
    for _ in range(250):
        n, m = rng.integers(0, 9, 2)
        cost = {
            "uniform": lambda n=n, m=m: rng.random((n, m)),
            "normal": lambda n=n, m=m: 3.0 * rng.standard_normal((n, m)),
            "integers": lambda n=n, m=m: rng.integers(-9, 10, (n, m)).astype(float),
            "ties": lambda n=n, m=m: rng.integers(0, 2, (n, m)).astype(float),
        }[kind]()
        allowed = rng.random((n, m)) < density
        unassigned_cost = float(rng.choice([-1.0, 0.0, 0.4, 2.0, 1000.0]))
        chosen = check(cost, allowed, unassigned_cost)
        if n <= 4:  # the interpreter of scripted code is slow; small ones reach every branch
            again = scripted(torch.from_numpy(cost), torch.from_numpy(allowed), unassigned_cost)
            assert again.tolist() == chosen


@pytest.mark.parametrize("shape", [(60, 60), (20, 90), (90, 20), (0, 5), (5, 0), (1, 1)])
def test_larger_and_degenerate_shapes(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    check(rng.random(shape), np.ones(shape, bool), 1e3)
    check(rng.random(shape), rng.random(shape) < 0.1, 0.7)
    cost, allowed = torch.from_numpy(rng.random(shape)), torch.from_numpy(rng.random(shape) < 0.5)
    assert torch.equal(scripted(cost, allowed, 0.7), assign(cost, allowed, 0.7))


@settings(max_examples=150, deadline=None)
@given(
    st.integers(1, 6).flatmap(
        lambda m: st.lists(
            st.lists(st.one_of(st.none(), st.integers(-20, 20)), min_size=m, max_size=m),
            min_size=1,
            max_size=6,
        )
    ),
    st.integers(-20, 60),
)
def test_any_small_integer_problem(table: list[list[int | None]], unassigned_cost: int) -> None:
    allowed = np.array([[c is not None for c in row] for row in table])
    cost = np.array([[0.0 if c is None else float(c) for c in row] for row in table])
    check(cost, allowed, float(unassigned_cost))


def test_greedy_would_be_worse() -> None:
    cost = torch.tensor([[1.0, 2.0], [1.1, 9.0]])
    assert assign(cost, torch.ones(2, 2, dtype=torch.bool), 100.0).tolist() == [1, 0]


def test_a_row_stays_alone_when_that_is_cheaper() -> None:
    cost = torch.tensor([[1.0, 5.0]])
    allowed = torch.ones(1, 2, dtype=torch.bool)
    assert assign(cost, allowed, 1.5).tolist() == [0]
    assert assign(cost, allowed, 0.5).tolist() == [-1]


def test_a_large_unassigned_cost_matches_as_many_as_possible() -> None:
    cost = torch.tensor([[0.0, 10.0], [0.0, 0.0]])
    allowed = torch.tensor([[True, True], [True, False]])
    assert assign(cost, allowed, 1.0).tolist().count(-1) == 1
    assert assign(cost, allowed, 50.0).tolist() == [1, 0]


def test_what_is_forbidden_may_be_nan() -> None:
    cost = torch.tensor([[float("nan"), 1.0]])
    assert assign(cost, torch.tensor([[False, True]]), 5.0).tolist() == [1]


@pytest.mark.parametrize(
    ("cost", "allowed", "unassigned_cost", "message"),
    [
        (torch.zeros(2, 2, dtype=torch.int64), torch.ones(2, 2, dtype=torch.bool), 1.0, "dtype"),
        (torch.zeros(2), torch.ones(2, dtype=torch.bool), 1.0, r"\(n, m\)"),
        (torch.zeros(2, 2), torch.ones(2, 3, dtype=torch.bool), 1.0, r"allowed.*\[2, 3\].*\[2, 2\]"),
        (torch.zeros(2, 2), torch.ones(2, 2), 1.0, "expected bool"),
        (torch.zeros(2, 2), torch.ones(2, 2, dtype=torch.bool), float("inf"), "unassigned_cost"),
        (torch.full((2, 2), torch.nan), torch.ones(2, 2, dtype=torch.bool), 1.0, "NaN"),
    ],
)
def test_refuses(cost: torch.Tensor, allowed: torch.Tensor, unassigned_cost: float, message: str) -> None:
    with pytest.raises(TensorsimError, match=message):
        assign(cost, allowed, unassigned_cost)

"""Hungarian assignment (global nearest neighbour) with gating: who is who from one frame to the next."""

import math

import torch
from torch import Tensor

from tensorsim.errors import TensorsimError, check_finite, check_floating, check_mask, check_rank


def assign(cost: Tensor, allowed: Tensor, unassigned_cost: float) -> Tensor:
    """Hungarian assignment: the matching of rows to columns with the least total cost.

    Total cost is the sum of ``cost`` over matched pairs plus ``unassigned_cost`` for every row left without a
    column; columns may stay unmatched at no cost, and pairs not ``allowed`` are never matched. It is the
    square problem on ``cost`` extended by one private column per row at ``unassigned_cost``. A large
    ``unassigned_cost`` (above ``2 n max|cost|``) matches as many pairs as possible.

    Shortest augmenting paths (Jonker and Volgenant, Computing 38, 1987) with column potentials,
    O(n^2 (n + m)), in float64 on the CPU: the matrices of a tracker are too small for a device. Not
    differentiable.

    Args:
        cost: (n, m) finite where allowed; either side may be 0.
        allowed: (n, m) bool.
        unassigned_cost: finite.

    Returns:
        (n,) int64 column of each row, -1 where unassigned, on the device of ``cost``. Which of several
        matchings of equal cost is returned is unspecified but deterministic.

    Raises:
        TensorsimError: wrong rank, dtype or shapes, or a cost that is not finite.
    """
    check_floating(cost, "cost")
    check_rank(cost, 2, "cost", "(n, m)")
    check_mask(allowed, list(cost.shape), "allowed")
    if not math.isfinite(unassigned_cost):
        raise TensorsimError(f"unassigned_cost: got {unassigned_cost}, expected a finite number")
    check_finite(torch.where(allowed, cost, 0.0), "cost where allowed")
    gated = torch.where(allowed, cost, math.inf).to(torch.device("cpu"), torch.float64)
    rows: list[list[float]] = gated.tolist()
    columns = _shortest_augmenting_paths(rows, cost.shape[1], unassigned_cost)
    return torch.tensor(columns, dtype=torch.int64, device=cost.device)


def _shortest_augmenting_paths(cost: list[list[float]], m: int, unassigned_cost: float) -> list[int]:
    """Column of each row or -1; forbidden pairs are infinite.

    Rows enter one by one. From the new row Dijkstra's search walks alternating paths over reduced costs and
    ends at the nearest free column, or by leaving a row on the way unassigned, whichever is cheaper. An
    unassigned row is never reached again: only its own private column leads to it.
    """
    n = len(cost)
    column_of = [-1] * n
    row_of = [-1] * m
    potential = [0.0] * m
    for start in range(n):
        distance = [math.inf] * m
        before = [-1] * m  # the row from which a column was reached
        todo = list(range(m))
        done: list[int] = []
        row, reached, offset = start, 0.0, 0.0
        end_cost, end_row, end_column = unassigned_cost, start, -1
        while True:
            costs = cost[row]
            shift = reached - offset
            nearest, least = -1, math.inf
            for k, j in enumerate(todo):
                d = shift + costs[j] - potential[j]
                if d < distance[j]:
                    distance[j] = d
                    before[j] = row
                if distance[j] < least:
                    nearest, least = k, distance[j]
            if nearest < 0 or least >= end_cost:
                break
            column = todo[nearest]
            reached = least
            if row_of[column] < 0:
                end_cost, end_row, end_column = reached, before[column], column
                break
            todo[nearest] = todo[-1]
            todo.pop()
            done.append(column)
            row = row_of[column]
            offset = cost[row][column] - potential[column]  # the row's potential
            leave = reached + unassigned_cost - offset
            if leave < end_cost:
                end_cost, end_row, end_column = leave, row, -1
        for j in done:
            potential[j] += distance[j] - end_cost
        # Shift the matching along the path, back to the row that started it.
        row, column = end_row, end_column
        while True:
            previous = column_of[row]
            column_of[row] = column
            if column >= 0:
                row_of[column] = row
            if row == start:
                break
            column = previous
            row = before[column]
    return column_of

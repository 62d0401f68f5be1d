"""The optimum of many problems at once: what a policy's costs are compared with."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR, MAX_ALL_PAIRS_CELLS, Grid
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.problem import MAX_AGENTS, check_grid
from mapp_env.solvers.held_karp import route_costs, shortest_routes
from mapp_env.solvers.solution import cell_distances, team_of
from mapp_env.validation import check_choice, check_count, describe

__all__ = ["MAX_BATCH_LANDMARKS", "Workspace", "optimal_costs", "solve_rows"]

MAX_BATCH_LANDMARKS = 12
"""Largest number of landmarks of each problem."""

CHUNK_WORK = 4_000_000  # between two chances to interrupt: some milliseconds


class Workspace(NamedTuple):
    """What solving one problem of K landmarks after another needs."""

    between: NDArray[np.int32]  # (K + 1, K + 1)
    routes: NDArray[np.int32]  # (2 ** K, K)
    costs: NDArray[np.int32]  # (2 ** K,)
    worst: NDArray[np.int32]  # (2, 2 ** (K - 1))

    @classmethod
    def of(cls, n_landmarks: int) -> Workspace:
        """Allocate it."""
        size = 1 << n_landmarks
        return cls(
            np.empty((n_landmarks + 1, n_landmarks + 1), np.int32),
            np.empty((size, n_landmarks), np.int32),
            np.empty(size, np.int32),
            np.empty((2, size // 2), np.int32),
        )


def optimal_costs(
    grid: Grid, landmarks: object, n_agents: int = 3, objective: str = "cover_time"
) -> NDArray[np.int32]:
    """Return the proven optimum of many problems of one grid.

    The same as :func:`mapp_env.solve` with ``method="exact"``, without the plans: with five
    landmarks a problem takes less than a microsecond.

    Parameters
    ----------
    grid : Grid
        The grid.
    landmarks : array_like of int, shape (P, K)
        Landmark cells, a problem a row; K from 1 to 12.
    n_agents : int
        1 to 16.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised.

    Returns
    -------
    ndarray of int32, shape (P,)
        The smallest cost of each problem.

    Raises
    ------
    ValueError
        If an argument is invalid, or a row is not a problem of the grid (rule R2); the message
        names the row.
    """
    check_grid("grid", grid)
    check_count("n_agents", n_agents, 1, MAX_AGENTS)
    check_choice("objective", objective, OBJECTIVES)
    cells = _check_rows(grid, landmarks)
    n_problems, n_landmarks = cells.shape
    optimum = np.empty(n_problems, np.int32)
    teams, closed = team_of(objective, n_agents, n_landmarks)
    workspace = Workspace.of(n_landmarks)
    chunk = max(1, CHUNK_WORK // 3**n_landmarks)
    # Few enough rows that their cells' distances fit, unless those of all cells do.
    together = max(1, n_problems)
    if grid.reachable.size >= MAX_ALL_PAIRS_CELLS:
        together = (MAX_ALL_PAIRS_CELLS - 1) // n_landmarks
    for first in range(0, n_problems, together):
        part = cells[first : first + together]
        used = np.zeros(grid.n_cells, np.bool_)
        used[part] = True
        nodes = np.concatenate(([grid.depot], np.flatnonzero(used)))
        distances = cell_distances(grid, nodes)
        places = np.empty(grid.n_cells, np.int32)
        places[nodes] = np.arange(len(nodes))
        rows = places[part]
        for start in range(0, len(part), chunk):
            piece = optimum[first + start : first + start + chunk][: len(part) - start]
            solve_rows(distances, rows[start : start + chunk], teams, closed, piece, workspace)
    return optimum


def _check_rows(grid: Grid, landmarks: object) -> NDArray[np.int64]:
    """Return landmarks as cells (P, K), each row a problem by rule R2."""
    try:
        rows = np.asarray(landmarks)
    except ValueError:  # ragged
        rows = np.empty(0)
    whole = rows.ndim == 2 and rows.dtype.kind in "iu"
    if not whole or not 1 <= rows.shape[1] <= MAX_BATCH_LANDMARKS:
        raise ValueError(
            f"landmarks must be integers of shape (P, K) with K in 1..{MAX_BATCH_LANDMARKS}, got "
            f"{describe(landmarks) if rows.ndim == 0 else f'{rows.dtype} of shape {rows.shape}'}"
        )
    allowed = np.zeros(grid.n_cells, np.bool_)
    allowed[grid.reachable] = True
    inside = (rows >= 0) & (rows < grid.n_cells)
    fine = inside & allowed[np.where(inside, rows, 0)]
    ordered = np.sort(rows, axis=1)
    bad = ~fine.all(axis=1) | (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(
            f"landmarks[{row}] must be distinct cells reachable from the depot, and not the depot, "
            f"got {rows[row].tolist()}"
        )
    return rows.astype(np.int64)


@kernel
def solve_rows(
    distances: NDArray[np.int32],
    rows: NDArray[Any],
    teams: int,
    closed: bool,
    optimum: NDArray[np.int32],
    workspace: Workspace,
) -> None:
    """Fill in the ``optimum``, shape (p,), of each row of landmarks' nodes, shape (p, K).

    ``distances``, shape (S, S), are between nodes; node 0 is the depot. ``teams``, at most K, and
    ``closed`` are from :func:`~mapp_env.solvers.solution.team_of`.
    """
    between, routes, costs, worst = workspace
    n_landmarks = rows.shape[1]
    between[0, 0] = 0
    for row in range(rows.shape[0]):
        for a in range(n_landmarks):
            between[0, a + 1] = between[a + 1, 0] = distances[0, rows[row, a]]
            for b in range(n_landmarks):
                between[a + 1, b + 1] = distances[rows[row, a], rows[row, b]]
        shortest_routes(between, routes)
        route_costs(between, routes, closed, costs)
        optimum[row] = least_worst(costs, teams, worst)


@kernel
def least_worst(costs: NDArray[np.int32], teams: int, worst: NDArray[np.int32]) -> int:
    """Return the smallest possible cost of the costliest of so many sets that hold everything.

    ``costs``, shape (2 ** K,), is what each set costs one agent; ``worst``, shape
    (2, 2 ** (K - 1)), the answer for fewer agents and each set without the highest landmark.
    """
    half = worst.shape[1]
    if teams == 1:
        return int(costs[-1])
    fewer = 0
    for left in range(half):
        worst[0, left] = costs[left]
    for _ in range(2, teams):
        more = 1 - fewer
        worst[more, 0] = 0
        top = 1
        for left in range(1, half):
            if left == 2 * top:
                top = left
            # One agent visits the highest landmark, and any of the others.
            others = left ^ top
            least = FAR
            part = others
            while True:
                least = min(least, max(costs[top | part], worst[fewer, others ^ part]))
                if part == 0:
                    break
                part = (part - 1) & others
            worst[more, left] = least
        fewer = more
    least = FAR
    for part in range(half):
        least = min(least, max(costs[half | part], worst[fewer, (half - 1) ^ part]))
    return int(least)

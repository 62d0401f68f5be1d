"""The rules of version 0 (R2 to R8), written once, as kernels over one row.

A *row* is one problem in progress, an int32 vector for N agents and K landmarks::

    [ agents' cells (N) | landmarks' cells (K) | visited flags (K) | step (1)
    | cells moved (N) | at the last claim: cell (N), cells moved (N), step (N) ]

Its head is the paper's observation (R9), its tail is what the metrics (R8) need. A *table* turns
a grid into one line of int32 a cell::

    [ next cell for left, right, up, down, wait | row, col | steps home | 1 for a wall ]

so that borders and walls vanish from the rules.

Cells and actions are indexed as ``uint32``: a signed index costs a test for a negative one, which
took a quarter of a batched step.

With ``NUMBA_DISABLE_JIT=1`` the same source runs as plain Python.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR, Grid

__all__ = [
    "ALL_PAIRS",
    "BY_COORDINATES",
    "COL",
    "FAR",
    "HOME",
    "MAX_TABLE_CELLS",
    "NO_DISTANCES",
    "N_ACTIONS",
    "ROW",
    "WAIT",
    "WALL",
    "Reward",
    "cell_table",
    "landmark_source",
    "manhattan_table",
    "measure_row",
    "reset_row",
    "row_length",
    "step_row",
]

N_ACTIONS = 4  # left, right, up, down: the paper's order (R3)
WAIT = 4
ROW, COL, HOME, WALL = 5, 6, 7, 8  # columns of a table, after the five moves

# Where the distances of a row's landmarks stand: from this line of `distances` on, or
ALL_PAIRS = -1  # in `distances`, in the line of each landmark's cell
BY_COORDINATES = -2  # nowhere: Manhattan distances are computed from rows and columns

MAX_TABLE_CELLS = (
    256  # largest grid for a table of Manhattan distances: it should stay in the cache
)

# Distances are read-only arrays without exception: numba would compile a second version of every
# kernel for others.
NO_DISTANCES = np.zeros((1, 1), np.int32)
NO_DISTANCES.flags.writeable = False


class Reward(IntEnum):
    """The kinds of team reward (R6); :func:`step_row` takes their numbers."""

    MANHATTAN = 0
    GEODESIC = 1
    STEP = 2


def row_length(n_agents: int, n_landmarks: int) -> int:
    """Return the number of int32 in a row."""
    return 5 * n_agents + 2 * n_landmarks + 1


def cell_table(grid: Grid) -> NDArray[np.int32]:
    """Return the grid as the kernels read it, shape (C, 9) int32."""
    cells = np.arange(grid.n_cells)
    row, col = np.divmod(cells, grid.cols)
    columns: list[NDArray[Any]] = [grid.moves, cells, row, col, grid.home, grid.walls.ravel()]
    table = np.column_stack(columns).astype(np.int32)
    table.flags.writeable = False
    return table


def manhattan_table(grid: Grid) -> NDArray[np.int32]:
    """Return the Manhattan distances between all pairs of cells, shape (C, C) int32."""
    table = grid.manhattan_from(range(grid.n_cells))
    table.flags.writeable = False
    return table


# -- the rules -----------------------------------------------------------


@kernel
def step_row(
    row: NDArray[np.int32],
    actions: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    max_cycles: int,
    reward: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
) -> tuple[float, bool, bool]:
    """Carry out one joint action.

    Parameters
    ----------
    row : ndarray of int32, shape (row_length,)
        Changed in place.
    actions : ndarray of int64, shape (N,)
        Valid actions, one an agent.
    n_agents, n_landmarks, max_cycles, reward : int
        Sizes of the problem, the step limit and a :class:`Reward`.
    table : ndarray of int32, shape (C, 9)
        From :func:`cell_table`.
    distances : ndarray of int32, shape (S, C)
        Distances from sources to cells: Manhattan, or shortest paths for the geodesic reward.
    first_field : int
        Line of ``distances`` that belongs to the first landmark, ``ALL_PAIRS`` or, for Manhattan
        distances, ``BY_COORDINATES``.

    Returns
    -------
    float, bool, bool
        The team reward (R6), terminated and truncated (R7).
    """
    step = _move(row, actions, n_agents, n_landmarks, table)
    if first_field == BY_COORDINATES:
        unvisited, distance = _visit(
            row, n_agents, n_landmarks, step, _nearest_by_coordinates, table, first_field
        )
    else:
        unvisited, distance = _visit(
            row, n_agents, n_landmarks, step, _nearest_by_table, distances, first_field
        )
    if unvisited == 0:
        return 0.0, True, False
    if reward == Reward.STEP:
        distance = 1
    return -float(distance), False, step >= max_cycles


@kernel
def _move(
    row: NDArray[np.int32],
    actions: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    table: NDArray[np.int32],
) -> int:
    """Move all agents at once (R3, R4) and return the number of this step."""
    clock = n_agents + 2 * n_landmarks
    moved = clock + 1
    row[clock] += 1
    for agent in range(n_agents):
        cell = row[agent]
        to = table[np.uint32(cell), np.uint32(actions[agent])]
        row[agent] = to
        row[moved + agent] += to != cell
    return int(row[clock])


@kernel
def _visit(
    row: NDArray[np.int32],
    n_agents: int,
    n_landmarks: int,
    step: int,
    nearest: Callable[[NDArray[np.int32], int, int, NDArray[np.int32], int], int],
    distances: NDArray[np.int32],
    first_field: int,
) -> tuple[int, int]:
    """Visit the landmarks under agents (R5).

    Returns
    -------
    int, int
        How many landmarks are left, and the sum of their distances from the nearest agent (R6).
    """
    visited = n_agents + n_landmarks
    unvisited = 0
    total = 0
    for landmark in range(n_landmarks):
        # All landmarks alike, visited or not: whether one is visited is as good as random to the
        # processor, and a branch on it would cost more than a distance.
        flag = row[visited + landmark]
        distance = nearest(row, n_agents, landmark, distances, first_field)
        if (distance == 0) & (flag == 0):
            _claim(row, n_agents, n_landmarks, landmark, step)
            flag = np.int32(1)
        left = 1 - flag
        unvisited += left
        total += left * distance
    return unvisited, total


@kernel
def _nearest_by_table(
    row: NDArray[np.int32],
    n_agents: int,
    landmark: int,
    distances: NDArray[np.int32],
    first_field: int,
) -> int:
    """Return the distance from the nearest agent to a landmark, looked up."""
    source = np.uint32(landmark_source(row, n_agents, landmark, first_field))
    least = FAR
    for agent in range(n_agents):
        least = min(least, distances[source, np.uint32(row[agent])])
    return least  # type: ignore[return-value]


@kernel
def _nearest_by_coordinates(
    row: NDArray[np.int32],
    n_agents: int,
    landmark: int,
    table: NDArray[np.int32],
    first_field: int,
) -> int:
    """Return the Manhattan distance from the nearest agent to a landmark, computed."""
    cell = np.uint32(row[n_agents + landmark])
    least = FAR
    for agent in range(n_agents):
        at = np.uint32(row[agent])
        distance = abs(table[at, ROW] - table[cell, ROW]) + abs(table[at, COL] - table[cell, COL])
        least = min(least, np.int32(distance))
    return least  # type: ignore[return-value]


@kernel
def _claim(
    row: NDArray[np.int32], n_agents: int, n_landmarks: int, landmark: int, step: int
) -> None:
    """Mark a landmark as visited for good (R5), and note what R8 needs of the agent that claims it.

    That is the agent of the lowest index on it.
    """
    visited = n_agents + n_landmarks
    moved = visited + n_landmarks + 1
    claim_cell = moved + n_agents
    claim_moved = claim_cell + n_agents
    claim_step = claim_moved + n_agents
    cell = row[n_agents + landmark]
    agent = 0
    while row[agent] != cell:
        agent += 1
    row[visited + landmark] = 1
    row[claim_cell + agent] = cell
    row[claim_moved + agent] = row[moved + agent]
    row[claim_step + agent] = step


@kernel
def landmark_source(row: NDArray[np.int32], n_agents: int, landmark: int, first_field: int) -> int:
    """Return the line of ``distances`` with the steps from a landmark."""
    if first_field == ALL_PAIRS:
        return int(row[n_agents + landmark])
    return first_field + landmark


@kernel
def reset_row(
    row: NDArray[np.int32],
    landmarks: NDArray[np.int32],
    depot: int,
    n_agents: int,
    n_landmarks: int,
) -> None:
    """Start an episode (R2) on landmarks that satisfy its conditions, shape (K,)."""
    row[:] = 0
    for agent in range(n_agents):
        row[agent] = depot
    for landmark in range(n_landmarks):
        row[n_agents + landmark] = landmarks[landmark]


@kernel
def measure_row(
    row: NDArray[np.int32], n_agents: int, n_landmarks: int, table: NDArray[np.int32]
) -> tuple[float, float, float]:
    """Return cover time, makespan and total distance (R8), inf if a landmark is left.

    An agent's route is cut at its last claim and closed by a shortest path home; without a claim
    it is empty.
    """
    visited = n_agents + n_landmarks
    clock = visited + n_landmarks
    claim_cell = clock + 1 + n_agents
    claim_moved = claim_cell + n_agents
    claim_step = claim_moved + n_agents
    for landmark in range(n_landmarks):
        if row[visited + landmark] == 0:
            return np.inf, np.inf, np.inf
    makespan = 0
    distance = 0
    for agent in range(n_agents):
        step = row[claim_step + agent]
        if step > 0:
            home = table[row[claim_cell + agent], HOME]
            makespan = max(makespan, step + home)
            distance += row[claim_moved + agent] + home
    return float(row[clock]), float(makespan), float(distance)

"""The rules of version 0 (R2 to R8), written once, as kernels over one row; row loops beside them.

A *row* is one problem in progress, an int32 vector for N agents and K landmarks::

    [ agents' cells (N) | landmarks' cells (K) | visited flags (K) | step (1)
    | cells moved (N) | at the last claim: cell (N), cells moved (N), step (N) ]

Its head is the paper's observation (R9), its tail is what the metrics (R8) need. A *table* turns
a grid into one line of int32 a cell::

    [ next cell for left, right, up, down, wait | row, col | steps home | 1 for a wall ]

so that borders and walls vanish from the rules.

With ``NUMBA_DISABLE_JIT=1`` the same source runs as plain Python.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapp_env.grid import Grid, fill_distances
from mapp_env.problem import draw_landmarks

__all__ = [
    "ALL_PAIRS",
    "N_ACTIONS",
    "WAIT",
    "Reward",
    "action_masks",
    "cell_table",
    "fill_fields",
    "find_bad_action",
    "measure_rows",
    "reset_rows",
    "row_length",
    "step_row",
    "step_rows",
]

N_ACTIONS = 4  # left, right, up, down: the paper's order (R3)
WAIT = 4
ROW, COL, HOME, WALL = 5, 6, 7, 8  # columns of a table, after the five moves

ALL_PAIRS = -1
"""In place of a row's first field: ``distances`` has a line for every cell of the grid."""


FAR = 1 << 30  # more than any distance on a grid


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
    columns = [grid.moves, cells, row, col, grid.home, grid.walls.ravel()]
    table = np.column_stack(columns).astype(np.int32)
    table.flags.writeable = False
    return table


# -- the rules, for one row ------------------------------------------------------------------------


@njit(cache=True)
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
        Steps from sources to cells; read for geodesic rewards only.
    first_field : int
        Line of ``distances`` that belongs to the first landmark, or ``ALL_PAIRS``.

    Returns
    -------
    float, bool, bool
        The team reward (R6), terminated and truncated (R7).
    """
    step = _move(row, actions, n_agents, n_landmarks, table)
    unvisited = _visit(row, n_agents, n_landmarks, step)
    if unvisited == 0:
        return 0.0, True, False
    if reward == Reward.MANHATTAN:
        value = _manhattan(row, n_agents, n_landmarks, table)
    elif reward == Reward.GEODESIC:
        value = _geodesic(row, n_agents, n_landmarks, distances, first_field)
    else:
        value = 1
    return -float(value), False, step >= max_cycles


@njit(cache=True)
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
        to = table[cell, actions[agent]]
        row[agent] = to
        row[moved + agent] += to != cell
    return row[clock]


@njit(cache=True)
def _visit(row: NDArray[np.int32], n_agents: int, n_landmarks: int, step: int) -> int:
    """Mark the landmarks under agents as visited (R5) and return how many are left.

    The agent of the lowest index on a landmark claims it.
    """
    visited = n_agents + n_landmarks
    moved = visited + n_landmarks + 1
    claim_cell = moved + n_agents
    claim_moved = claim_cell + n_agents
    claim_step = claim_moved + n_agents
    unvisited = 0
    for landmark in range(n_landmarks):
        if row[visited + landmark] == 0:
            unvisited += 1
            cell = row[n_agents + landmark]
            for agent in range(n_agents):
                if row[agent] == cell:
                    row[visited + landmark] = 1
                    row[claim_cell + agent] = cell
                    row[claim_moved + agent] = row[moved + agent]
                    row[claim_step + agent] = step
                    unvisited -= 1
                    break
    return unvisited


@njit(cache=True)
def _manhattan(
    row: NDArray[np.int32], n_agents: int, n_landmarks: int, table: NDArray[np.int32]
) -> int:
    """Return the sum over unvisited landmarks of the smallest Manhattan distance to an agent."""
    total = 0
    for landmark in range(n_landmarks):
        if row[n_agents + n_landmarks + landmark] == 0:
            cell = row[n_agents + landmark]
            nearest = FAR
            for agent in range(n_agents):
                at = row[agent]
                distance = abs(table[at, ROW] - table[cell, ROW]) + abs(
                    table[at, COL] - table[cell, COL]
                )
                nearest = min(nearest, distance)
            total += nearest
    return total


@njit(cache=True)
def _geodesic(
    row: NDArray[np.int32],
    n_agents: int,
    n_landmarks: int,
    distances: NDArray[np.int32],
    first_field: int,
) -> int:
    """Return the sum over unvisited landmarks of the shortest path from the nearest agent."""
    total = 0
    for landmark in range(n_landmarks):
        if row[n_agents + n_landmarks + landmark] == 0:
            source = landmark_source(row, n_agents, landmark, first_field)
            nearest = FAR
            for agent in range(n_agents):
                nearest = min(nearest, distances[source, row[agent]])
            total += nearest
    return total


@njit(cache=True)
def landmark_source(
    row: NDArray[np.int32], n_agents: int, landmark: int, first_field: int
) -> int:
    """Return the line of ``distances`` with the steps from a landmark."""
    if first_field == ALL_PAIRS:
        return row[n_agents + landmark]
    return first_field + landmark


# -- row loops -------------------------------------------------------------------------------------


@njit(cache=True)
def step_rows(
    rows: NDArray[np.int32],
    actions: NDArray[np.int64],
    skip: NDArray[np.bool_],
    n_agents: int,
    n_landmarks: int,
    limits: NDArray[np.int64],
    reward: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    rewards: NDArray[np.float64],
    terminations: NDArray[np.bool_],
    truncations: NDArray[np.bool_],
) -> None:
    """Carry out one joint action in each row but those to skip, which get reward 0 and no flag.

    Shapes: ``rows`` (B, row_length), ``actions`` (B, N), all others (B,); the rest as in
    :func:`step_row`.
    """
    for index in range(rows.shape[0]):
        if skip[index]:
            rewards[index] = 0.0
            terminations[index] = False
            truncations[index] = False
            continue
        field = first_field if first_field == ALL_PAIRS else index * n_landmarks
        rewards[index], terminations[index], truncations[index] = step_row(
            rows[index],
            actions[index],
            n_agents,
            n_landmarks,
            limits[index],
            reward,
            table,
            distances,
            field,
        )


@njit(cache=True)
def reset_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    words: NDArray[np.uint64],
    candidates: NDArray[np.int32],
    depot: int,
    n_agents: int,
    n_landmarks: int,
) -> None:
    """Start a new episode (R2) in each row of ``indices``, its landmarks drawn from its word.

    Shapes: ``rows`` (B, row_length), ``indices`` and ``words`` (M,), ``candidates`` (F,).
    """
    for index, word in zip(indices, words):  # noqa: B905 - numba knows no strict zip
        row = rows[index]
        row[:] = 0
        row[:n_agents] = depot
        draw_landmarks(word, candidates, row[n_agents : n_agents + n_landmarks])


@njit(cache=True)
def fill_fields(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    table: NDArray[np.int32],
    n_agents: int,
    n_landmarks: int,
    fields: NDArray[np.int32],
    queue: NDArray[np.int32],
) -> None:
    """Write the steps from every landmark of some rows: how grids too large for all pairs do it.

    Shapes: ``rows`` (B, row_length), ``indices`` (M,), ``fields`` (B * K, C), ``queue`` (C,).
    """
    for index in indices:
        for landmark in range(n_landmarks):
            start = rows[index, n_agents + landmark]
            fill_distances(table, start, fields[index * n_landmarks + landmark], queue)


@njit(cache=True)
def action_masks(
    rows: NDArray[np.int32],
    n_agents: int,
    table: NDArray[np.int32],
    masks: NDArray[np.int8],
) -> None:
    """Write 1 for each move that does not bump and for waiting, else 0.

    Shapes: ``rows`` (B, row_length), ``masks`` (B, N, A).
    """
    for index in range(rows.shape[0]):
        for agent in range(n_agents):
            cell = rows[index, agent]
            for action in range(masks.shape[2]):
                masks[index, agent, action] = action == WAIT or table[cell, action] != cell


@njit(cache=True)
def measure_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    table: NDArray[np.int32],
    out: NDArray[np.float64],
) -> None:
    """Write cover time, makespan and total distance (R8) of ``indices``, or inf if unsolved.

    Shapes: ``rows`` (B, row_length), ``indices`` (M,), ``out`` (M, 3). An agent's route is cut at
    its last claim and closed by a shortest path home; without a claim it is empty.
    """
    visited = n_agents + n_landmarks
    clock = visited + n_landmarks
    claim_cell = clock + 1 + n_agents
    claim_moved = claim_cell + n_agents
    claim_step = claim_moved + n_agents
    for place, index in enumerate(indices):
        solved = True
        for landmark in range(n_landmarks):
            solved = solved and rows[index, visited + landmark] == 1
        if not solved:
            out[place, :] = np.inf
            continue
        makespan = 0
        distance = 0
        for agent in range(n_agents):
            step = rows[index, claim_step + agent]
            if step > 0:
                home = table[rows[index, claim_cell + agent], HOME]
                makespan = max(makespan, step + home)
                distance += rows[index, claim_moved + agent] + home
        out[place, 0] = rows[index, clock]
        out[place, 1] = makespan
        out[place, 2] = distance


@njit(cache=True)
def find_bad_action(actions: NDArray[np.int64], n_actions: int) -> int:
    """Return the flat position of the first action outside ``0..n_actions - 1``, or -1.

    Shape: ``actions`` (M,).
    """
    bad = False
    for action in actions:
        # No early exit: the loop without one is vectorised, and bad actions are rare.
        bad |= (action < 0) | (action >= n_actions)
    if bad:
        for position, action in enumerate(actions):
            if action < 0 or action >= n_actions:
                return position
    return -1

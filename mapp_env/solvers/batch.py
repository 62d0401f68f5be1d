"""The optimum of many problems at once, or of all of a grid: what policies are compared with."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR, MAX_ALL_PAIRS_CELLS, Grid
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.problem import MAX_AGENTS, check_grid
from mapp_env.solvers.held_karp import Steps, route_costs, shortest_routes
from mapp_env.solvers.oracle.states import (
    CHUNK_WORK,
    MAX_BATCH_LANDMARKS,
    Room,
    fill_optima,
    list_states,
)
from mapp_env.solvers.solution import cell_distances, team_of
from mapp_env.validation import as_array, check_choice, check_count, describe

MAX_UNIVERSE_PROBLEMS = 10_000_000  # of a grid: up to half a gigabyte of answers
MAX_UNIVERSE_WORK = 20_000_000_000  # of them times 3 ** n_landmarks: some minutes


class Workspace(NamedTuple):
    """What solving one problem of K landmarks after another needs."""

    between: Steps  # (K + 1, K + 1)
    routes: Steps  # (2 ** K, K)
    costs: Steps  # (2 ** K,)
    worst: Steps  # (2, 2 ** (K - 1))

    @classmethod
    def of(cls, n_landmarks: int) -> Workspace:
        """Allocate it."""
        size = 1 << n_landmarks
        shapes = ((n_landmarks + 1, n_landmarks + 1), (size, n_landmarks), (size,), (2, size // 2))
        return cls(*(np.empty(shape, np.int32) for shape in shapes))


def optimal_costs(
    grid: Grid,
    landmarks: object,
    n_agents: int = 3,
    objective: str = "cover_time",
    starts: object = None,
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
    starts : array_like of int, shape (P, N), optional
        Where each problem's agents stand at first: reachable cells or the depot, none of them a
        landmark of its row. Without it all start on the depot, which is faster.

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
    _check(grid, n_agents, objective)
    cells = _check_rows(grid, landmarks)
    n_problems, n_landmarks = cells.shape
    optimum = np.empty(n_problems, np.int32)
    if starts is not None:
        agents = _check_starts(grid, starts, n_agents, cells)
        room = Room.of(n_agents, n_landmarks)
        for some, states in list_states(grid, cells, agents, objective != "cover_time"):
            fill_optima(states, objective == "total_distance", room, optimum[some])
        return optimum
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


def solve_universe(
    grid: Grid, n_landmarks: int = 5, n_agents: int = 3, objective: str = "cover_time"
) -> tuple[NDArray[Any], NDArray[np.int32]]:
    """Return every set of landmarks on a grid, with its proven optimum.

    The same optimum as :func:`mapp_env.solve` with ``method="exact"``, for all problems at once.

    Parameters
    ----------
    grid : Grid
        The grid; F of its cells may hold a landmark.
    n_landmarks : int
        Landmarks K of each problem, 1 to 12.
    n_agents : int
        1 to 16.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised.

    Returns
    -------
    landmarks : ndarray of int16 (int32 on grids of more than 32,767 cells), shape (P, K)
        All ``P = C(F, K)`` sets, each ascending, in lexicographic order.
    optimum : ndarray of int32, shape (P,)
        The smallest cost of each.

    Raises
    ------
    ValueError
        If there are no such problems, more than ten million, or too large ones for their number;
        the message says how many, and nothing has been allocated.
    """
    _check(grid, n_agents, objective)
    check_count("n_landmarks", n_landmarks, 1, MAX_BATCH_LANDMARKS)
    cells = grid.reachable
    n_problems = math.comb(len(cells), n_landmarks)
    if n_problems == 0:
        raise ValueError(
            f"n_landmarks must be at most {len(cells)}, the cells of this grid that may hold one; "
            f"got {n_landmarks}"
        )
    if n_problems > MAX_UNIVERSE_PROBLEMS or n_problems * 3**n_landmarks > MAX_UNIVERSE_WORK:
        raise ValueError(
            f"this grid has {n_problems:,} problems of {n_landmarks} landmarks; a universe "
            f"takes at most {MAX_UNIVERSE_PROBLEMS:,}, and {MAX_UNIVERSE_WORK:,} problems times "
            f"3 ** n_landmarks: use sample_problems() and solve()"
        )
    cell_type = np.int16 if grid.n_cells <= np.iinfo(np.int16).max else np.int32
    teams, closed = team_of(objective, n_agents, n_landmarks)
    if n_landmarks == 1:
        # No distances between landmarks: a large grid would have too many.
        return cells.astype(cell_type)[:, None], grid.home[cells] * (2 if closed else 1)
    distances = cell_distances(grid, np.concatenate(([grid.depot], cells)))
    landmarks = np.empty((n_problems, n_landmarks), cell_type)
    optimum = np.empty(n_problems, np.int32)
    workspace = Workspace.of(n_landmarks)
    chosen = np.arange(n_landmarks)
    chunk = max(1, CHUNK_WORK // 3**n_landmarks)
    ranks = np.empty((min(chunk, n_problems), n_landmarks), np.int32)
    for first in range(0, n_problems, chunk):
        part = ranks[: n_problems - first]
        list_sets(chosen, len(cells), part)
        landmarks[first : first + chunk] = cells[part]
        solve_rows(distances, part + 1, teams, closed, optimum[first : first + chunk], workspace)
    return landmarks, optimum


def _check(grid: object, n_agents: object, objective: object) -> None:
    check_grid("grid", grid)
    check_count("n_agents", n_agents, 1, MAX_AGENTS)
    check_choice("objective", objective, OBJECTIVES)


def _check_rows(grid: Grid, landmarks: object) -> NDArray[np.int64]:
    """Return landmarks as cells (P, K), each row a problem by rule R2."""
    rows = as_array(landmarks)
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


def _check_starts(
    grid: Grid, starts: object, n_agents: int, landmarks: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return starts as cells (P, N), on which each row's agents may begin."""
    shape = (len(landmarks), n_agents)
    rows = as_array(starts)
    if rows.shape != shape or rows.dtype.kind not in "iu":
        raise ValueError(
            f"starts must be integers of shape {shape}, a row for each of landmarks, got "
            f"{describe(starts) if rows.ndim == 0 else f'{rows.dtype} of shape {rows.shape}'}"
        )
    inside = (rows >= 0) & (rows < grid.n_cells)
    bad = ~inside | (grid.home[np.where(inside, rows, 0)] < 0)
    bad |= (rows[:, :, None] == landmarks[:, None, :]).any(axis=2)
    if bad.any():
        row = int(bad.any(axis=1).argmax())
        raise ValueError(
            f"starts[{row}] must be cells reachable from the depot, none of them a landmark of the "
            f"row, got {rows[row].tolist()}"
        )
    return rows.astype(np.int64)


@kernel
def solve_rows(
    distances: Steps, rows: Steps, teams: int, closed: bool, optimum: Steps, workspace: Workspace
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
def least_worst(costs: Steps, teams: int, worst: Steps) -> int:
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


@kernel
def list_sets(chosen: NDArray[np.int64], n_items: int, sets: Steps) -> None:
    """Write sets of items, 0 to ``n_items - 1``, in lexicographic order: ``sets``, shape (p, K).

    ``chosen``, shape (K,), is the first, ascending; left as the one after the last, if any.
    """
    n_chosen = chosen.shape[0]
    last = n_items - n_chosen
    for row in range(sets.shape[0]):
        for place in range(n_chosen):
            sets[row, place] = chosen[place]
        place = n_chosen - 1
        while place >= 0 and chosen[place] == last + place:
            place -= 1
        if place < 0:
            return
        chosen[place] += 1
        for after in range(place + 1, n_chosen):
            chosen[after] = chosen[after - 1] + 1

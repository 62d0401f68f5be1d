"""The optimum of every problem of a grid: what makes a whole universe a benchmark."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import Grid
from mapp_env.plan import OBJECTIVES
from mapp_env.problem import MAX_AGENTS, check_grid
from mapp_env.solvers.distances import cell_distances
from mapp_env.solvers.held_karp import route_costs, shortest_routes
from mapp_env.validation import check_choice, check_count

__all__ = ["MAX_UNIVERSE_LANDMARKS", "MAX_UNIVERSE_PROBLEMS", "MAX_UNIVERSE_WORK", "solve_universe"]

MAX_UNIVERSE_PROBLEMS = 10_000_000
"""Largest number of problems: up to half a gigabyte of answers."""

MAX_UNIVERSE_LANDMARKS = 12
"""Largest number of landmarks of each."""

MAX_UNIVERSE_WORK = 20_000_000_000
"""Largest number of problems times ``3 ** n_landmarks``: some minutes."""

CHUNK_WORK = 4_000_000  # between two chances to interrupt: some milliseconds
FAR = np.int32(1 << 29)


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
    check_grid("grid", grid)
    check_count("n_landmarks", n_landmarks, 1, MAX_UNIVERSE_LANDMARKS)
    check_count("n_agents", n_agents, 1, MAX_AGENTS)
    check_choice("objective", objective, OBJECTIVES)
    cells = grid.reachable
    n_problems = math.comb(len(cells), n_landmarks)
    if n_problems == 0:
        raise ValueError(
            f"n_landmarks must be at most {len(cells)}, the cells of this grid that may hold one; "
            f"got {n_landmarks}"
        )
    if n_problems > MAX_UNIVERSE_PROBLEMS or n_problems * 3**n_landmarks > MAX_UNIVERSE_WORK:
        raise ValueError(
            f"this grid has {n_problems:,} problems of {n_landmarks} landmarks; solve_universe() "
            f"takes at most {MAX_UNIVERSE_PROBLEMS:,}, and {MAX_UNIVERSE_WORK:,} problems times "
            f"3 ** n_landmarks: use sample_problems() and solve()"
        )
    cell_type = np.int16 if grid.n_cells <= np.iinfo(np.int16).max else np.int32
    closed = objective != "cover_time"
    if n_landmarks == 1:
        # No distances between landmarks: a large grid would have too many.
        return cells.astype(cell_type)[:, None], grid.home[cells] * (2 if closed else 1)
    distances = cell_distances(grid, np.concatenate(([grid.depot], cells)))
    teams = 1 if objective == "total_distance" else min(n_agents, n_landmarks)
    landmarks = np.empty((n_problems, n_landmarks), cell_type)
    optimum = np.empty(n_problems, np.int32)
    size = 1 << n_landmarks
    chosen = np.arange(n_landmarks)
    scratch = (
        np.empty((n_landmarks + 1, n_landmarks + 1), np.int32),
        np.empty((size, n_landmarks), np.int32),
        np.empty(size, np.int32),
        np.empty((2, size // 2), np.int32),
    )
    chunk = max(1, CHUNK_WORK // 3**n_landmarks)
    for first in range(0, n_problems, chunk):
        part = slice(first, first + chunk)
        solve_next(
            distances, cells, chosen, teams, closed, landmarks[part], optimum[part], *scratch
        )
    return landmarks, optimum


@kernel
def solve_next(
    distances: NDArray[np.int32],
    cells: NDArray[np.int32],
    chosen: NDArray[np.int64],
    teams: int,
    closed: bool,
    landmarks: NDArray[Any],
    optimum: NDArray[np.int32],
    between: NDArray[np.int32],
    routes: NDArray[np.int32],
    costs: NDArray[np.int32],
    worst: NDArray[np.int32],
) -> None:
    """Solve some problems, in lexicographic order from ``chosen`` on.

    Parameters
    ----------
    distances : ndarray of int32, shape (F + 1, F + 1)
        Between the depot and the cells that may hold a landmark.
    cells : ndarray of int32, shape (F,)
        Those cells.
    chosen : ndarray of int64, shape (K,)
        The first set, as ascending positions in ``cells``; left as the one after the last.
    teams : int
        Number of agents.
    closed : bool
        Whether tours are closed.
    landmarks, optimum : ndarray, shape (p, K) and (p,)
        The results.
    between, routes, costs, worst : ndarray of int32
        Scratch space: (K + 1, K + 1), (2 ** K, K), (2 ** K,), (2, 2 ** (K - 1)).
    """
    n_landmarks = chosen.shape[0]
    for problem in range(optimum.shape[0]):
        between[0, 0] = 0
        for a in range(n_landmarks):
            landmarks[problem, a] = cells[chosen[a]]
            between[0, a + 1] = between[a + 1, 0] = distances[0, chosen[a] + 1]
            for b in range(n_landmarks):
                between[a + 1, b + 1] = distances[chosen[a] + 1, chosen[b] + 1]
        shortest_routes(between, routes)
        route_costs(between, routes, closed, costs)
        optimum[problem] = least_worst(costs, teams, worst)
        place = n_landmarks - 1
        last = cells.shape[0] - n_landmarks
        while place >= 0 and chosen[place] == last + place:
            place -= 1
        if place < 0:
            return
        chosen[place] += 1
        for after in range(place + 1, n_landmarks):
            chosen[after] = chosen[after - 1] + 1


@kernel
def least_worst(costs: NDArray[np.int32], teams: int, worst: NDArray[np.int32]) -> int:
    """Return the smallest possible cost of the costliest of so many sets that hold everything.

    Parameters
    ----------
    costs : ndarray of int32, shape (2 ** K,)
        What each set costs one agent.
    teams : int
        Number of agents.
    worst : ndarray of int32, shape (2, 2 ** (K - 1))
        Scratch space: the answer for fewer agents and each set without the highest landmark.
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

"""The optimum of every problem of a grid: what makes a whole universe a benchmark."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import Grid
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.problem import MAX_AGENTS, check_grid
from mapp_env.solvers.batch import CHUNK_WORK, MAX_BATCH_LANDMARKS, Workspace, solve_rows
from mapp_env.solvers.solution import cell_distances, team_of
from mapp_env.validation import check_choice, check_count

__all__ = ["MAX_UNIVERSE_PROBLEMS", "MAX_UNIVERSE_WORK", "solve_universe"]

MAX_UNIVERSE_PROBLEMS = 10_000_000
"""Largest number of problems: up to half a gigabyte of answers."""

MAX_UNIVERSE_WORK = 20_000_000_000
"""Largest number of problems times ``3 ** n_landmarks``: some minutes."""


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
    check_count("n_landmarks", n_landmarks, 1, MAX_BATCH_LANDMARKS)
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


@kernel
def list_sets(chosen: NDArray[np.int64], n_items: int, sets: NDArray[np.int32]) -> None:
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

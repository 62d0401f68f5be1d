"""An anytime search for problems of any size: ruin and recreate under simulated annealing.

The iterations themselves are in ``ruin_recreate``.

Nothing but the seed and the number of iterations decides what is found.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import clock
from mapp_env.problem import Problem
from mapp_env.solvers.bounds import lower_bound
from mapp_env.solvers.ruin_recreate import (
    BEST,
    BEST_TOTAL,
    COST,
    CYCLE,
    DONE,
    WORD,
    Layout,
    Scratch,
    Team,
    improve,
)
from mapp_env.solvers.solution import UNBOUNDED, Routes, Solution, landmark_distances, solution_of
from mapp_env.validation import check_count

DEFAULT_ITERATIONS = 200_000
"""Iterations without a time limit: well under a second for 50 landmarks, on any clock."""

MAX_ITERATIONS = 10**12

CHUNK = 500  # iterations between two looks at the clock: some milliseconds

# In units of the mean distance between landmarks over the square root of their number: roughly
# from one landmark to the next.
HOT = 20.0
COLD = 0.2
FIRST_CYCLE = 5_000


def solve_search(
    problem: Problem,
    objective: str,
    *,
    time_limit: float | None = None,
    seed: int = 0,
    iterations: int | None = None,
    on_better: Callable[[int], None] | None = None,
) -> Solution:
    """Return short routes, proven optimal where they meet a lower bound.

    Parameters
    ----------
    problem : Problem
        Of any size.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised; of routes with equal cover time or makespan the search keeps those of
        smaller total distance.
    time_limit : float, optional
        Seconds. At least one plan is made, however few they are.
    seed : int
        The same seed and number of iterations give the same routes.
    iterations : int, optional
        Most iterations to carry out; without it 200,000, or as many as the time limit lets.
    on_better : callable, optional
        Called with each smaller cost.

    Returns
    -------
    Solution
        The search ends early when the cost meets the bound.

    Raises
    ------
    ValueError
        If ``objective`` is unknown or ``iterations`` not a positive integer.
    """
    if iterations is None:
        iterations = DEFAULT_ITERATIONS if time_limit is None else MAX_ITERATIONS
    check_count("iterations", iterations, 1, MAX_ITERATIONS)
    deadline = math.inf if time_limit is None else clock() + time_limit
    distances = landmark_distances(problem)
    bound = lower_bound(problem, objective, distances)
    search = Search(distances, problem.n_agents, objective, seed)
    best = UNBOUNDED
    chunk = 1
    while search.iterations < iterations:
        going = search.run(min(chunk, iterations - search.iterations), bound)
        if search.cost < best and on_better is not None:
            on_better(search.cost)
        best = search.cost
        if not going or clock() >= deadline:
            break
        chunk = CHUNK
    return solution_of(problem, search.routes(), search.cost, bound)


class Search:
    """A search that can be carried on.

    Parameters
    ----------
    distances : ndarray of int32, shape (K + 1, K + 1)
        Between the depot (node 0) and the landmarks; K is at least 1.
    n_agents : int
        Number of agents.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised.
    seed : int
        Not negative.
    """

    def __init__(
        self, distances: NDArray[np.int32], n_agents: int, objective: str, seed: int = 0
    ) -> None:
        distances = np.ascontiguousarray(distances, np.int32)
        n_landmarks = len(distances) - 1
        # No team walks less than one agent, by the triangle inequality.
        n_routes = 1 if objective == "total_distance" else n_agents
        home = distances[0].copy()
        self._layout = Layout(
            distances,
            np.zeros_like(home) if objective == "cover_time" else home,
            (np.argsort(distances[:, 1:], axis=1, kind="stable") + 1).astype(np.int32),
            0 if objective == "total_distance" else 2 * n_agents,
        )
        self._teams = [
            Team(
                np.zeros((n_routes, n_landmarks), np.int32),
                np.zeros(n_routes, np.int64),
                np.zeros(n_routes, np.int64),
            )
            for _ in range(3)
        ]
        self._scratch = Scratch(
            np.full(n_landmarks + 1, -1),
            np.zeros(n_landmarks, np.int64),
            np.zeros(n_landmarks, np.int64),
            np.zeros(n_routes, np.bool_),
        )
        self._memory = np.zeros(8, np.int64)
        self._memory[WORD] = np.random.SeedSequence(seed).generate_state(1)[0]
        self._memory[[COST, BEST, BEST_TOTAL]] = UNBOUNDED
        self._memory[CYCLE] = FIRST_CYCLE
        leg = max(float(distances[1:, 1:].mean()) / math.sqrt(n_landmarks), 0.5)
        self._heat = np.array([COLD * leg, 1.0, HOT * leg, COLD * leg])

    def run(self, iterations: int, bound: int = -1) -> bool:
        """Carry out so many iterations at most; return whether more could do better.

        ``bound`` is a cost that cannot be beaten: once it is reached, only the total distance is
        left to improve, and no more is to be done when that has not fallen for a while.
        """
        going = improve(
            iterations, bound, self._layout, *self._teams, self._scratch, self._memory, self._heat
        )
        return bool(going)

    @property
    def cost(self) -> int:
        """The smallest cost so far."""
        return int(self._memory[BEST])

    @property
    def iterations(self) -> int:
        """Iterations carried out."""
        return int(self._memory[DONE])

    def routes(self) -> Routes:
        """Return the best routes so far, as nodes 1 to K, for at most as many as agents."""
        best = self._teams[-1]
        pairs = zip(best.routes, best.sizes, strict=True)
        return tuple(tuple(route[:size].tolist()) for route, size in pairs)

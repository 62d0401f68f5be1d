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
from mapp_env.solvers.ruin_recreate import BEST, DONE, Layout, Scratch, Team, improve
from mapp_env.solvers.solution import (
    UNBOUNDED,
    Routes,
    Solution,
    landmark_distances,
    problem_distances,
    solution_of,
)
from mapp_env.validation import check_count

DEFAULT_ITERATIONS = 200_000  # without a time limit: well under a second for 50 landmarks
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
    """Return short routes, proven optimal where they meet a lower bound, at which the search ends.

    Of routes with equal cover time or makespan it keeps those of smaller total distance. The same
    ``seed`` and number of ``iterations`` give the same routes; without a number there are 200,000,
    or as many as ``time_limit``, in seconds, lets. At least one plan is made, however few they are.
    ``on_better`` is called with each smaller cost.

    Raises a ValueError if ``objective`` is unknown or ``iterations`` not a positive integer.
    """
    if iterations is None:
        iterations = DEFAULT_ITERATIONS if time_limit is None else MAX_ITERATIONS
    check_count("iterations", iterations, 1, MAX_ITERATIONS)
    deadline = math.inf if time_limit is None else clock() + time_limit
    distances = landmark_distances(problem)
    bound = lower_bound(problem, objective, problem_distances(problem))
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

    ``distances``, shape (K + 1, K + 1) int32 with K at least 1, are between the depot (node 0) and
    the landmarks; ``seed`` is not negative.
    """

    def __init__(
        self, distances: NDArray[np.int32], n_agents: int, objective: str, seed: int = 0
    ) -> None:
        distances = np.ascontiguousarray(distances, np.int32)
        n_landmarks = len(distances) - 1
        total = objective == "total_distance"
        # No team walks less than one agent, by the triangle inequality.
        n_routes = 1 if total else n_agents
        self._layout = Layout(
            distances,
            distances[0] * np.int32(objective != "cover_time"),
            (np.argsort(distances[:, 1:], axis=1, kind="stable") + 1).astype(np.int32),
            0 if total else 2 * n_agents,
        )
        self._teams = [
            Team(np.zeros((n_routes, n_landmarks), np.int32), *np.zeros((2, n_routes), np.int64))
            for _ in range(3)
        ]
        self._scratch = Scratch(
            np.full(n_landmarks + 1, -1),
            np.arange(1, n_landmarks + 1),
            np.zeros(n_landmarks, np.int64),
            np.zeros(n_routes, np.bool_),
        )
        word = int(np.random.SeedSequence(seed).generate_state(1)[0])
        # In the order of their places: WORD to CYCLE.
        self._memory = np.array([word, *[UNBOUNDED] * 3, 0, 0, 0, FIRST_CYCLE], np.int64)
        leg = max(float(distances[1:, 1:].mean()) / math.sqrt(n_landmarks), 0.5)
        self._heat = np.array([COLD * leg, 1.0, HOT * leg, COLD * leg])

    def run(self, iterations: int, bound: int = -1) -> bool:
        """Carry out so many iterations at most; return whether more could do better.

        ``bound`` is a cost that cannot be beaten: once it is reached, only the total distance is
        left to improve, and no more is to be done when that has not fallen for a while.
        """
        rest = (*self._teams, self._scratch, self._memory, self._heat)
        return bool(improve(iterations, bound, self._layout, *rest))

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

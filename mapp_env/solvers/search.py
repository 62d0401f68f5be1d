"""An anytime search for problems of any size: ruin and recreate under simulated annealing.

The iterations themselves are in ``ruin_recreate``.

Nothing but the seed and the number of iterations decides what is found.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import clock, kernel
from mapp_env.problem import Problem
from mapp_env.solvers.bounds import lower_bound
from mapp_env.solvers.ruin_recreate import BEST, DONE, Layout, Scratch, Team, improve
from mapp_env.solvers.solution import (
    UNBOUNDED,
    Distances,
    Routes,
    Solution,
    problem_distances,
    solution_of,
)
from mapp_env.validation import check_count

DEFAULT_ITERATIONS = 200_000  # without a time limit: well under a second for 50 landmarks
MAX_ITERATIONS = 10**12
FEWEST, FEW, CHUNK = 4, 16, 500  # iterations between two looks at the clock

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
    bound: Callable[[Distances], int] | None = None,
) -> Solution:
    """Return short routes, proven optimal where they meet a lower bound, at which the search ends.

    Of routes with equal cover time or makespan it keeps those of smaller total distance. The same
    ``seed`` and number of ``iterations`` give the same routes; without a number there are 200,000,
    or as many as ``time_limit``, in seconds, lets. At least one plan is made, however few they are.
    ``on_better`` is called with each smaller cost; ``bound`` takes the place of
    :func:`~mapp_env.solvers.bounds.lower_bound`.

    Raises a ValueError if ``objective`` is unknown or ``iterations`` not a positive integer.
    """
    if iterations is None:
        iterations = DEFAULT_ITERATIONS if time_limit is None else MAX_ITERATIONS
    check_count("iterations", iterations, 1, MAX_ITERATIONS)
    start = clock()
    deadline = math.inf if time_limit is None else start + time_limit
    distances = problem_distances(problem)
    low = lower_bound(problem, objective, distances) if bound is None else bound(distances)
    search = Search(distances.between, problem.n_agents, objective, seed, distances.starts)
    best = UNBOUNDED
    chunk = 1
    while search.iterations < iterations:
        chunk = min(chunk, iterations - search.iterations)
        going = search.run(chunk, low)
        if search.cost < best and on_better is not None:
            on_better(search.cost)
        best = search.cost
        if not going:
            break
        before, start = start, clock()
        if start >= deadline:
            break
        # As many as there is time for, as far as the last ones tell, but for the very first.
        left = FEW if chunk == 1 else chunk * (deadline - start) / max(start - before, 1e-9)
        chunk = int(min(max(left, FEWEST), CHUNK))
    return solution_of(problem, search.routes(), search.cost, low)


class Search:
    """A search that can be carried on.

    ``between``, shape (K + 1, K + 1) int32 with K at least 1, are the steps between the depot (node
    0) and the landmarks; ``starts``, shape (N, K + 1) int32, those from where each agent starts,
    the depot without it. ``seed`` is not negative.
    """

    def __init__(
        self,
        between: NDArray[np.int32],
        n_agents: int,
        objective: str,
        seed: int = 0,
        starts: NDArray[np.int32] | None = None,
    ) -> None:
        between = np.ascontiguousarray(between, np.int32)
        n_nodes = len(between)
        n_landmarks = n_nodes - 1
        if starts is None:
            starts = np.repeat(between[:1], n_agents, axis=0)
        total = objective == "total_distance"
        if total and not starts[:, 0].any():
            # From the depot no team walks less than one agent, by the triangle inequality.
            starts = starts[:1]
        n_routes = len(starts)
        distances = np.empty((n_nodes, n_nodes + n_routes), np.int32)
        back, reach = np.zeros(n_nodes + n_routes, np.int32), np.empty(n_nodes, np.int32)
        alike = np.empty(n_routes, np.int64)
        closed = objective != "cover_time"
        apart = lay_out(
            between, np.ascontiguousarray(starts), closed, distances, back, reach, alike
        )
        near = np.zeros((n_nodes, n_landmarks), np.int32)
        weight = 0 if total else 2 * n_agents
        self._layout = Layout(distances, back, reach, near, alike, weight)
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
        # In the order of their places: WORD to CYCLE.
        self._memory = np.array([_word(seed), *[UNBOUNDED] * 3, 0, 0, 0, FIRST_CYCLE], np.int64)
        leg = max(apart / n_landmarks**2 / math.sqrt(n_landmarks), 0.5)
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


@lru_cache(maxsize=64)
def _word(seed: int) -> int:
    """Return the random word that a search with a seed begins with."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


@kernel
def lay_out(
    between: NDArray[np.int32],
    starts: NDArray[np.int32],
    closed: bool,
    distances: NDArray[np.int32],
    back: NDArray[np.int32],
    reach: NDArray[np.int32],
    alike: NDArray[np.int64],
) -> int:
    """Fill in the parts of a :class:`Layout`; return the sum of steps between all landmarks.

    ``between`` and ``starts`` are as in :class:`Search`; ``back`` is zero on entry.
    """
    n_nodes, n_agents = between.shape[0], starts.shape[0]
    apart = 0
    for node in range(n_nodes):
        for other in range(n_nodes):
            distances[node, other] = between[node, other]
            if node > 0 and other > 0:
                apart += between[node, other]
        reach[node] = starts[0, node]
        for agent in range(n_agents):
            distances[node, n_nodes + agent] = starts[agent, node]
            reach[node] = min(reach[node], starts[agent, node])
        if closed:
            back[node] = between[0, node]
    for agent in range(n_agents):
        twin = 0
        while not _equal(starts[twin], starts[agent]):
            twin += 1
        alike[agent] = twin
    return apart


@kernel
def _equal(line: NDArray[np.int32], other: NDArray[np.int32]) -> bool:
    place = 0
    while place < line.shape[0] and line[place] == other[place]:
        place += 1
    return bool(place == line.shape[0])

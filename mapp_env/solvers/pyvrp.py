"""PyVRP as a solver, for comparison: an iterated local search for vehicle routing.

PyVRP (Wouda, Lan and Kool 2024, doi:10.1287/ijoc.2023.0055) minimises the sum of routes. So

- the longest route is made short by asking for any routes of at most so many steps, one step less
  each time, until it finds none;
- open routes are closed ones whose arcs back to the depot cost nothing.

It comes with the extra ``pyvrp`` and is imported when a problem is solved.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import clock
from mapp_env.problem import Problem
from mapp_env.solvers.bounds import lower_bound
from mapp_env.solvers.solution import (
    UNBOUNDED,
    Routes,
    Solution,
    landmark_distances,
    solution_of,
)

__all__ = ["DEFAULT_SECONDS", "search_routes", "solve_pyvrp"]

DEFAULT_SECONDS = 2.0
"""Time limit if none is given."""

# PyVRP's own penalties for too long a route, up to 100,000 a step, leave a search that has to live
# with a tight limit no way through plans that break it.
MAX_PENALTY = 100.0
PENALTY_ROUNDS = 50


def solve_pyvrp(
    problem: Problem,
    objective: str,
    *,
    time_limit: float | None = None,
    seed: int = 0,
    on_better: Callable[[int], None] | None = None,
) -> Solution:
    """Return short routes found by PyVRP, proven optimal where they meet a lower bound.

    Parameters
    ----------
    problem : Problem
        Of any size.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised.
    time_limit : float, optional
        Seconds; by default 2. PyVRP builds at least one plan, however few they are.
    seed : int
        Of the search, which is bounded by time, so the answer depends on the machine as well.
    on_better : callable, optional
        Called with each smaller cost.

    Returns
    -------
    Solution
        The search ends early when the cost meets the bound.

    Raises
    ------
    ImportError
        If PyVRP is not installed.
    ValueError
        If ``objective`` is unknown.
    """
    import_pyvrp()
    deadline = clock() + (DEFAULT_SECONDS if time_limit is None else time_limit)
    distances = landmark_distances(problem)
    bound = lower_bound(problem, objective, distances)
    cost, nodes = search_routes(
        distances, problem.n_agents, objective, deadline, seed, bound, on_better
    )
    return solution_of(problem, nodes, cost, bound)


def search_routes(
    distances: NDArray[np.int32],
    n_agents: int,
    objective: str,
    deadline: float,
    seed: int = 0,
    bound: int = 0,
    on_better: Callable[[int], None] | None = None,
) -> tuple[int, Routes]:
    """Return the cost and the routes, as nodes 1 to K, of the agents that have one.

    Parameters
    ----------
    distances : ndarray of int32, shape (K + 1, K + 1)
        Between the depot (node 0) and the landmarks.
    n_agents : int
        Number of agents.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised.
    deadline : float
        When to stop, on ``clock()``'s clock.
    seed : int
        Of the search.
    bound : int
        A cost that is good enough to stop.
    on_better : callable, optional
        Called with each smaller cost.
    """
    pyvrp = import_pyvrp()
    arcs = distances.astype(np.int64)
    if objective == "cover_time":
        arcs[:, 0] = 0
    word = int(np.random.SeedSequence(seed).generate_state(1)[0])
    penalty = pyvrp.PenaltyParams(max_penalty=MAX_PENALTY, solutions_between_updates=PENALTY_ROUNDS)
    params = pyvrp.SolveParams(penalty=penalty)
    total = objective == "total_distance"
    best = UNBOUNDED
    routes: Routes = ()
    while True:
        limit = {}
        if routes:
            # Closed tours on a grid have even length.
            limit = {"max_distance": best - (1 if objective == "cover_time" else 2)}
        data = pyvrp.ProblemData(
            locations=[pyvrp.Location(0, 0) for _ in arcs],
            clients=[pyvrp.Client(node) for node in range(1, len(arcs))],
            depots=[pyvrp.Depot(0)],
            # No team walks less than one agent, by the triangle inequality.
            vehicle_types=[pyvrp.VehicleType(1 if total else n_agents, **limit)],
            distance_matrices=[arcs],
            duration_matrices=[np.zeros_like(arcs)],
        )
        # Where the longest route counts, any plan within the limit will do.
        stop = _Stop(deadline, bound, on_better) if total else _Stop(deadline, UNBOUNDED - 1, None)
        with warnings.catch_warnings():
            # It says that no plan is in sight, and that is how this ends.
            warnings.simplefilter("ignore", pyvrp.exceptions.PenaltyBoundWarning)
            # From scratch each time: starting from the plan before gives longer routes.
            found = pyvrp.solve(data, stop, word, collect_stats=False, params=params).best
        if not found.is_feasible():
            break
        lengths = [route.distance() for route in found.routes()]
        best = int(sum(lengths) if total else max(lengths))
        routes = tuple(
            tuple(visit.idx + 1 for visit in route.schedule() if visit.is_client())
            for route in found.routes()
        )
        if on_better is not None and not total:
            on_better(best)
        if total or best <= bound or clock() >= deadline:
            break
    if not routes:
        raise RuntimeError("PyVRP found no plan, though nothing limits one")
    return best, routes


class _Stop:
    """Tells PyVRP when to stop: at a time, or at a cost (which is far above any no plan).

    PyVRP asks in each iteration, so this is also who sees costs fall.
    """

    def __init__(self, deadline: float, cost: int, on_better: Callable[[int], None] | None) -> None:
        self._deadline = deadline
        self._cost = cost
        self._on_better = on_better
        self._best = UNBOUNDED

    def __call__(self, best_cost: float) -> bool:
        if best_cost < self._best:
            self._best = int(best_cost)
            if self._on_better is not None:
                self._on_better(self._best)
        return best_cost <= self._cost or clock() >= self._deadline


def import_pyvrp() -> Any:
    """Return the package, or say how to get it."""
    try:
        import pyvrp
        import pyvrp.exceptions
    except ImportError as error:
        raise ImportError(
            'method "pyvrp" needs the package of that name: pip install "pyvrp>=0.14,<0.15"'
        ) from error
    return pyvrp

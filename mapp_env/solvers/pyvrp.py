"""PyVRP as a solver, for comparison: an iterated local search for vehicle routing.

PyVRP (Wouda, Lan and Kool 2024, doi:10.1287/ijoc.2023.0055) minimises the sum of routes. So

- the longest route is made short by asking for any routes of at most so many steps, one step less
  each time, until it finds none;
- open routes are closed ones whose arcs back to the depot cost nothing;
- agents that start elsewhere are vehicles of another depot; those of one start, of one type.

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
    Distances,
    Routes,
    Solution,
    problem_distances,
    solution_of,
)

DEFAULT_SECONDS = 2.0  # if there is no time limit

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

    As :func:`~mapp_env.solvers.search.solve_search`, but it is bounded by time alone, 2 seconds by
    default, so that the answer depends on the machine as well as on the ``seed``.

    Raises an ImportError if PyVRP is not installed, a ValueError if ``objective`` is unknown.
    """
    pyvrp = import_pyvrp()
    deadline = clock() + (DEFAULT_SECONDS if time_limit is None else time_limit)
    distances = problem_distances(problem)
    bound = lower_bound(problem, objective, distances)
    total = objective == "total_distance"
    groups, arcs = _group(problem, distances)
    # From the depot no team walks less than one agent, by the triangle inequality.
    alone = total and len(arcs) == len(distances.between)
    if objective == "cover_time":
        arcs[:, 0] = 0
    word = int(np.random.SeedSequence(seed).generate_state(1)[0])
    penalty = pyvrp.PenaltyParams(max_penalty=MAX_PENALTY, solutions_between_updates=PENALTY_ROUNDS)
    params = pyvrp.SolveParams(penalty=penalty)
    best = UNBOUNDED
    routes: Routes = ()
    while True:
        # Closed tours on a grid have even length, if they begin on the depot.
        step = 2 if objective == "makespan" and len(arcs) == len(distances.between) else 1
        limit = {"max_distance": best - step} if routes else {}
        data = pyvrp.ProblemData(
            locations=[pyvrp.Location(0, 0) for _ in arcs],
            clients=[pyvrp.Client(node) for node in range(1, len(distances.between))],
            depots=[pyvrp.Depot(0), *map(pyvrp.Depot, range(len(distances.between), len(arcs)))],
            vehicle_types=[
                pyvrp.VehicleType(1 if alone else len(agents), start_depot=depot, **limit)
                for depot, agents in groups.items()
            ],
            distance_matrices=[arcs],
            duration_matrices=[np.zeros_like(arcs)],
        )
        # Where the longest route counts, any plan within the limit will do.
        enough = (bound, on_better) if total else (UNBOUNDED - 1, None)
        stop = _stop_at(deadline, *enough)
        with warnings.catch_warnings():
            # It says that no plan is in sight, and that is how this ends.
            warnings.simplefilter("ignore", pyvrp.exceptions.PenaltyBoundWarning)
            # From scratch each time: starting from the plan before gives longer routes.
            found = pyvrp.solve(data, stop, word, collect_stats=False, params=params).best
        if not found.is_feasible():
            break
        lengths = [route.distance() for route in found.routes()]
        best = int(sum(lengths) if total else max(lengths))
        left = [list(agents) for agents in groups.values()]
        by_agent: list[tuple[int, ...]] = [()] * problem.n_agents
        for route in found.routes():
            agent = left[route.vehicle_type()].pop(0)
            visits = (visit.idx for visit in route.schedule() if visit.is_client())
            by_agent[agent] = tuple(client + 1 for client in visits)
        routes = tuple(by_agent)
        if on_better is not None and not total:
            on_better(best)
        if total or best <= bound or clock() >= deadline:
            break
    if not routes:
        raise RuntimeError("PyVRP found no plan, though nothing limits one")
    return solution_of(problem, routes, best, bound)


def _group(
    problem: Problem, distances: Distances
) -> tuple[dict[int, list[int]], NDArray[np.int64]]:
    """Return the agents of each depot, and the steps between depot, landmarks and other depots.

    Depot 0 is there in any case, with or without agents; the others are starts.
    """
    starts = dict.fromkeys(problem.start_cells)
    starts.pop(problem.grid.depot, None)
    places = {cell: place for place, cell in enumerate([problem.grid.depot, *starts])}
    groups: dict[int, list[int]] = {}
    for agent, cell in enumerate(problem.start_cells):
        groups.setdefault(places[cell], []).append(agent)
    n_nodes = len(distances.between)
    arcs = np.zeros((n_nodes + len(starts), n_nodes + len(starts)), np.int64)
    arcs[:n_nodes, :n_nodes] = distances.between
    for place, agents in groups.items():
        if place > 0:
            node = n_nodes + place - 1
            arcs[node, :n_nodes] = arcs[:n_nodes, node] = distances.starts[agents[0]]
    return groups, arcs


def _stop_at(
    deadline: float, cost: int, on_better: Callable[[int], None] | None
) -> Callable[[float], bool]:
    """Return what tells PyVRP to stop: at a time, or at a cost.

    PyVRP asks in each iteration, so this is also who sees costs fall.
    """
    best = UNBOUNDED

    def stop(best_cost: float) -> bool:
        nonlocal best
        if best_cost < best:
            best = int(best_cost)
            if on_better is not None:
                on_better(best)
        return best_cost <= cost or clock() >= deadline

    return stop


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

"""Solvers: one signature, one file each; :func:`solve` turns what they find into plans."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

from mapp_env.compiled import clock
from mapp_env.plans.plan import OBJECTIVES, Plan
from mapp_env.plans.replay import play_episode
from mapp_env.plans.tours import walk_routes
from mapp_env.problem import Problem
from mapp_env.solvers.batch import optimal_costs, solve_universe
from mapp_env.solvers.bounds import tree_bound
from mapp_env.solvers.exact import MAX_EXACT_LANDMARKS, solve_exact
from mapp_env.solvers.oracle import next_costs, next_costs_of, regrets
from mapp_env.solvers.solution import Distances, Routes, Solution, Solver
from mapp_env.solvers.vrplib import save_vrplib
from mapp_env.validation import MAX_SEED, as_real, check_choice, check_count, describe

__all__ = [
    "METHODS",
    "Solution",
    "next_costs",
    "next_costs_of",
    "optimal_costs",
    "regrets",
    "save_vrplib",
    "solve",
    "solve_many",
    "solve_universe",
]

METHODS = ("auto", "exact", "search", "pyvrp")

TREE_SECONDS = 3e-7  # that the bound by spanning trees takes, for each pair of nodes
QUICK_LANDMARKS = 16  # that the exact solver takes a fraction of a second for; for 20, two seconds


def solve(
    problem: Problem,
    objective: str = "cover_time",
    method: str = "auto",
    time_limit: float | None = None,
    seed: int = 0,
) -> Plan:
    """Return a plan of a problem that is short in one objective, and what is proven about it.

    Parameters
    ----------
    problem : Problem
        Its agents may start anywhere. Its step limit is ignored: it belongs to an episode, not to
        the optimum.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised. Ties in the first two go to the smaller total distance, with "exact"
        always.
    method : {"auto", "exact", "search", "pyvrp"}
        "exact" proves the optimum of up to 20 landmarks; "search" takes problems of any size and
        proves the optimum only where it meets a lower bound; "pyvrp" is another search, from the
        package of that name. "auto" is "exact" up to 20 landmarks (16, if ``time_limit`` is less
        than two seconds), else "search".
    time_limit : float, optional
        Seconds that a search may take; "exact" has no use for it. The distances between landmarks
        come first and a plan's tours last, however few seconds there are: together half a second
        for 64 landmarks on 512 x 512 cells, a second where tours have a hundred thousand cells.
    seed : int
        For the random choices of a search.

    Returns
    -------
    Plan
        ``status`` is "optimal" if the cost equals ``bound``, a proven lower bound, else "feasible".
        All costs are what the rules give for ``plan.joint_actions()``. Neither ``seconds`` nor the
        time limit counts what it takes to compile or load the kernels.

    Raises
    ------
    ValueError
        If an argument is invalid, or the method cannot take the problem; the message names one
        that can.
    """
    if not isinstance(problem, Problem):
        raise ValueError(f"problem must be a mapp_env.Problem, got {describe(problem)}")
    limit, seed = _check(objective, method, time_limit, seed)
    return _solve(problem, objective, method, limit, seed)


def solve_many(
    problems: Iterable[Problem],
    objective: str = "cover_time",
    method: str = "search",
    time_limit: float | None = 0.001,
    seed: int = 0,
    iterations: int | None = None,
) -> list[Plan]:
    """Return a plan of each of many problems, as :func:`solve` does of one, in little time each.

    Parameters
    ----------
    problems : iterable of Problem
        They may differ in all: grid, landmarks, agents, starts.
    objective, method
        As in :func:`solve`.
    time_limit : float, optional
        Seconds for each problem. For "search" that is all in all: distances, bound, search, and the
        making of the plan, by what the last one took, but at least half of it for the rest.
    seed : int
        For the random choices of each search: problems do not depend on those beside them.
    iterations : int, optional
        How long "search" goes on, in place of the time limit: then nothing but this number and the
        seed decides what is found.

    Returns
    -------
    list of Plan
        In the order of the problems. The ``bound`` of "search" proves less often than that of
        :func:`solve`: it is that of spanning trees and of the farthest landmark, without the
        optimum of twelve of the landmarks; and of the farthest landmark alone where the trees would
        take more than a fourth of the time limit: within a millisecond, from 30 landmarks on.

    Raises
    ------
    ValueError
        If an argument is invalid, or the method cannot take a problem; nothing is solved then but
        the problems before it.
    """
    if not isinstance(problems, Iterable) or isinstance(problems, str | bytes):
        raise ValueError(f"problems must be a sequence of problems, got {describe(problems)}")
    every = list(problems)
    for index, problem in enumerate(every):
        if not isinstance(problem, Problem):
            raise ValueError(
                f"problems[{index}] must be a mapp_env.Problem, got {describe(problem)}"
            )
    limit, seed = _check(objective, method, time_limit, seed)
    options: dict[str, Any] = {}
    if iterations is not None:
        if method != "search":
            raise ValueError(f"iterations is for method 'search', got {describe(method)}")
        limit, options["iterations"] = None, check_count("iterations", iterations, 1, 10**12)
    if method == "search":
        options["bound"] = partial(_quick_bound, objective, limit)
    plans: list[Plan] = []
    own = limit
    for problem in every:
        plans.append(_solve(problem, objective, method, own, seed, **options))
        if limit is not None and own is not None and method == "search":
            # What it took longer, mostly to make the plan, the next one is to have in its limit.
            own = min(limit, max(limit / 2, limit + own - plans[-1].seconds))
    return plans


def _quick_bound(objective: str, limit: float | None, distances: Distances) -> int:
    """Return a lower bound that takes at most about a fourth of a time limit, if there is one."""
    if limit is None or TREE_SECONDS * len(distances.between) ** 2 < limit / 4:
        return tree_bound(distances, objective)
    back = distances.between[0] if objective != "cover_time" else 0
    return int((distances.starts.min(axis=0) + back)[1:].max())


def _check(
    objective: object, method: object, time_limit: object, seed: object
) -> tuple[float | None, int]:
    """Return the time limit as a float, or None, and the seed; refuse what is none."""
    check_choice("objective", objective, OBJECTIVES)
    check_choice("method", method, METHODS)
    limit = as_real(time_limit)
    if time_limit is not None and (limit is None or limit <= 0):
        raise ValueError(
            f"time_limit must be a positive number or None, got {describe(time_limit)}"
        )
    return limit, check_count("seed", seed, 0, MAX_SEED)


def _solve(
    problem: Problem, objective: str, method: str, limit: float | None, seed: int, **options: Any
) -> Plan:
    """Return a plan, by arguments that were checked; ``options`` are the method's own."""
    if method == "auto":
        quick = QUICK_LANDMARKS if limit is not None and limit < 2 else MAX_EXACT_LANDMARKS
        method = "exact" if len(problem.landmarks) <= quick else "search"
    solver = _solver(method)
    start = clock()
    solution = solver(problem, objective, time_limit=limit, seed=seed, **options)
    return _plan_of(problem, objective, solution, method, start)


def _solver(method: str) -> Solver:
    if method == "search":
        from mapp_env.solvers.search import solve_search

        return solve_search
    if method == "pyvrp":
        from mapp_env.solvers.pyvrp import import_pyvrp, solve_pyvrp

        import_pyvrp()  # now, as it takes a while
        return solve_pyvrp
    return solve_exact


def _plan_of(
    problem: Problem,
    objective: str,
    solution: Solution,
    method: str = "replay",
    start: float = math.inf,
) -> Plan:
    """Return what the rules make of a solver's routes, if that is what the solver claims.

    ``start`` is when the ``method`` began, by the clock.
    """
    routes = _idle_last(problem, solution.routes)
    endless = problem if problem.max_cycles is None else replace(problem, max_cycles=None)
    episode = play_episode(endless, walk_routes(problem, routes))
    cost = getattr(episode, objective)
    claimed = cost == solution.bound if solution.optimal else cost >= solution.bound
    if cost == math.inf or not claimed:
        raise RuntimeError(
            f"a solver claims the bound {solution.bound} (optimal={solution.optimal}), but its "
            f"routes cost {cost}: please report {problem!r}, objective {objective!r}"
        )
    return Plan(
        **episode._asdict(),
        objective=objective,
        status="optimal" if cost == solution.bound else "feasible",
        solver=method,
        seconds=max(0.0, clock() - start),
        bound=solution.bound,
        problem=problem,
    )


def _idle_last(problem: Problem, routes: Routes) -> Routes:
    """Return routes in which agents without one come last among those of their start.

    Such agents are exchangeable, and who comes later may follow: see ``walk_tours``.
    """
    if all(routes):
        return routes
    left: dict[int, list[tuple[int, ...]]] = {}
    for cell, route in zip(problem.start_cells, routes, strict=True):
        left.setdefault(cell, []).append(route)
    ordered = {cell: iter(sorted(line, key=lambda route: not route)) for cell, line in left.items()}
    return tuple(next(ordered[cell]) for cell in problem.start_cells)

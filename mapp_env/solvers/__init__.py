"""Solvers: one signature, one file each; :func:`solve` turns what they find into plans."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

from mapp_env.compiled import clock
from mapp_env.plans.plan import OBJECTIVES, Plan, replay
from mapp_env.plans.tours import walk_routes
from mapp_env.problem import Problem
from mapp_env.solvers.batch import optimal_costs, solve_universe
from mapp_env.solvers.bounds import tree_bound
from mapp_env.solvers.exact import MAX_EXACT_LANDMARKS, solve_exact
from mapp_env.solvers.solution import Routes, Solution, Solver
from mapp_env.solvers.vrplib import save_vrplib
from mapp_env.validation import MAX_SEED, as_real, check_choice, check_count, describe

__all__ = [
    "METHODS",
    "Solution",
    "optimal_costs",
    "save_vrplib",
    "solve",
    "solve_many",
    "solve_universe",
]

METHODS = ("auto", "exact", "search", "pyvrp")

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
        Its step limit is ignored: it belongs to an episode, not to the optimum.
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
        Seconds that a search may take for each problem, its distances and its bound included. To
        make the plan comes on top: a tenth of a millisecond for 20 landmarks on 32 x 32 cells.
    seed : int
        For the random choices of each search: problems do not depend on those beside them.
    iterations : int, optional
        How long "search" goes on, in place of the time limit: then nothing but this number and the
        seed decides what is found.

    Returns
    -------
    list of Plan
        In the order of the problems. The ``bound`` of "search" is the one that takes a tenth of a
        millisecond (spanning trees, and the farthest landmark) without the optimum of twelve of the
        landmarks, so it proves less often than that of :func:`solve`.

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
        options["bound"] = partial(tree_bound, objective=objective)
    return [_solve(problem, objective, method, limit, seed, **options) for problem in every]


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
    plan = _plan_of(problem, objective, solution)
    return replace(plan, solver=method, seconds=clock() - start)


def _solver(method: str) -> Solver:
    if method == "search":
        from mapp_env.solvers.search import solve_search

        return solve_search
    if method == "pyvrp":
        from mapp_env.solvers.pyvrp import import_pyvrp, solve_pyvrp

        import_pyvrp()  # now, as it takes a while
        return solve_pyvrp
    return solve_exact


def _plan_of(problem: Problem, objective: str, solution: Solution) -> Plan:
    """Return what the rules make of a solver's routes, if that is what the solver claims."""
    routes = _idle_last(problem, solution.routes)
    endless = problem if problem.max_cycles is None else replace(problem, max_cycles=None)
    plan = replay(endless, walk_routes(problem, routes), objective)
    claimed = plan.cost == solution.bound if solution.optimal else plan.cost >= solution.bound
    if not plan.success or not claimed:
        raise RuntimeError(
            f"a solver claims the bound {solution.bound} (optimal={solution.optimal}), but its "
            f"routes cost {plan.cost}: please report {problem!r}, objective {objective!r}"
        )
    status = "optimal" if plan.cost == solution.bound else "feasible"
    return replace(plan, problem=problem, status=status, bound=solution.bound)


def _idle_last(problem: Problem, routes: Routes) -> Routes:
    """Return routes in which agents without one come last among those of their start.

    Such agents are exchangeable, and who comes later may follow: see ``walk_tours``.
    """
    order = sorted(range(len(routes)), key=lambda agent: not routes[agent])
    left = {
        cell: [n for n in order if problem.start_cells[n] == cell]
        for cell in set(problem.start_cells)
    }
    return tuple(routes[left[cell].pop(0)] for cell in problem.start_cells)

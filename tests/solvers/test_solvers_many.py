"""Many problems at once: what solve() gives for each, whatever stands beside it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mapp_env import Plan, Problem, make_grid, sample_problems, solve, solvers
from mapp_env.solvers import _plan_of, solve_many
from mapp_env.solvers.search import solve_search

OBJECTIVES = ("cover_time", "makespan", "total_distance")
KINDS = ("random", "rooms", "maze", "warehouse")


def mixed_problems(count: int, seed: int) -> list[Problem]:
    """Return problems of all sizes on grids of all kinds, half of them with starts."""
    rng = np.random.default_rng(seed)
    problems = []
    for index in range(count):
        rows, cols = rng.integers(9, 33, 2).tolist()
        grid = make_grid(KINDS[index % 4], rows=rows, cols=cols, seed=index)
        n_landmarks, n_agents = int(rng.integers(1, 14)), int(rng.integers(1, 7))
        landmarks = sample_problems(grid, 1, n_landmarks, index)[0]
        starts = None
        if index % 2:
            cells = np.setdiff1d(grid.reachable, landmarks)
            starts = rng.choice(cells, n_agents).tolist()
        limit = None if index % 3 else 7
        problems.append(Problem(grid, landmarks.tolist(), n_agents, limit, starts))
    return problems


def without_proof(plan: Plan) -> Plan:
    """Return a plan without what depends on the lower bound."""
    return replace(plan, bound=None, status="feasible")


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_many_are_as_one(objective: str) -> None:
    """Row by row the plan of one search with the same iterations and seed, action by action."""
    problems = mixed_problems(24, 0)
    plans = solve_many(problems, objective, iterations=300, seed=5)
    for problem, plan in zip(problems, plans, strict=True):
        solution = solve_search(problem, objective, iterations=300, seed=5)
        one = replace(_plan_of(problem, objective, solution), solver="search")
        assert without_proof(plan) == without_proof(one)
        assert plan.actions == one.actions
        assert plan.problem == problem
        assert (plan.solver, plan.objective) == ("search", objective)
        plan.verify()


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_bounds_hold(objective: str) -> None:
    """No bound is above the optimum, no cost below; "optimal" is said only where they meet."""
    proven = 0
    problems = mixed_problems(24, 1)
    plans = solve_many(problems, objective, iterations=100)
    optima = solve_many(problems, objective, "exact", time_limit=None)
    for plan, optimum in zip(plans, optima, strict=True):
        assert optimum.status == "optimal"
        assert plan.bound is not None
        assert 0 < plan.bound <= optimum.cost <= plan.cost < math.inf
        assert (plan.status == "optimal") == (plan.cost == plan.bound)
        proven += plan.status == "optimal"
    assert 0 < proven < 24


def test_problems_do_not_depend_on_their_neighbours() -> None:
    """Alone, in another order or repeated: each problem has its plan."""
    problems = mixed_problems(12, 2)
    plans = solve_many(problems, iterations=150)
    order = np.random.default_rng(0).permutation(24) % 12
    assert solve_many([problems[index] for index in order], iterations=150) == [
        plans[index] for index in order
    ]
    assert [solve_many([problem], iterations=150)[0] for problem in problems] == plans
    assert solve_many(iter(problems), iterations=150) == plans
    other = solve_many(problems, iterations=150, seed=1)
    assert any(one.tours != two.tours for one, two in zip(plans, other, strict=True))


@pytest.mark.parametrize("method", ["exact", "auto"])
def test_other_methods(method: str) -> None:
    """Exact plans are those of solve(), and "auto" takes the exact solver where solve() does."""
    problems = mixed_problems(10, 3)
    for limit in (None, 0.001):
        plans = solve_many(problems, "makespan", method, limit)
        assert plans == [solve(problem, "makespan", method, limit) for problem in problems]
        assert {plan.solver for plan in plans} == {"exact"}


def test_searches_within_a_time_limit() -> None:
    """With a time limit all plans are whole, and longer searches are better in all."""
    grid = make_grid("random", rows=32, cols=32, seed=0)
    problems = [Problem(grid, row.tolist(), 5) for row in sample_problems(grid, 20, 20)]
    sums = []
    for limit in (1e-9, 0.02):
        plans = solve_many(problems, time_limit=limit)
        for plan in plans:
            plan.verify()
        sums.append(sum(plan.cost for plan in plans))
    assert sums[1] < sums[0]


def test_the_bound_leaves_time_for_the_search() -> None:
    """Where spanning trees would take most of the limit, the farthest landmark bounds the cost."""
    grid = make_grid("rooms", rows=32, cols=32, seed=0)
    problem = Problem(grid, sample_problems(grid, 1, 120, 0)[0].tolist(), 2)
    home = grid.home[list(problem.landmarks)].max()
    for objective, farthest in zip(OBJECTIVES, (home, 2 * home, 2 * home), strict=True):
        (short,) = solve_many([problem], objective, time_limit=0.001)
        (longer,) = solve_many([problem], objective, iterations=20)
        assert short.bound == farthest
        assert longer.bound is not None
        assert farthest < longer.bound <= longer.cost


def test_a_plan_is_made_within_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a problem took beyond its limit the next search leaves, but never more than half."""
    problem = Problem(make_grid(), (0, 6), 2)
    plan, limits = solve(problem), []
    seconds = iter([1.2, 0.9, 5.0, 0.1, 1.0])

    def timed(*arguments: object, **_: object) -> Plan:
        limits.append(arguments[3])
        return replace(plan, seconds=next(seconds))

    monkeypatch.setattr(solvers, "_solve", timed)
    assert len(solve_many([problem] * 5, time_limit=1.0)) == 5
    assert limits == pytest.approx([1.0, 0.8, 0.9, 0.5, 1.0])


def test_nothing_to_solve() -> None:
    """No problems, no plans."""
    assert solve_many([]) == []


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"problems": make_grid()}, "problems must be a sequence of problems"),
        ({"problems": "abc"}, "problems must be a sequence of problems"),
        ({"problems": [3]}, r"problems\[1\] must be a mapp_env.Problem, got 3"),
        ({"objective": "speed"}, "objective must be one of"),
        ({"method": "guess"}, "method must be one of"),
        ({"time_limit": 0}, "time_limit must be a positive number or None"),
        ({"time_limit": math.nan}, "time_limit must be a positive number or None"),
        ({"seed": -1}, "seed must be an integer"),
        ({"iterations": 0}, r"iterations must be an integer in 1\.\."),
        ({"iterations": 2.0}, r"iterations must be an integer in 1\.\."),
        ({"iterations": 5, "method": "exact"}, "iterations is for method 'search'"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, object], reason: str) -> None:
    """The message names argument and value; nothing is solved before it."""
    problems: list[object] = [Problem(make_grid(), (0, 6), 2)]
    given = arguments.get("problems", [])
    everything = {
        **arguments,
        "problems": [*problems, *given] if isinstance(given, list) else given,
    }
    with pytest.raises(ValueError, match=reason):
        solve_many(**everything)  # type: ignore[arg-type]


def test_a_problem_too_large_is_refused() -> None:
    """The exact solver names its limit, as in solve()."""
    problem = Problem(make_grid(), make_grid().reachable[:21].tolist())
    with pytest.raises(ValueError, match="takes at most 20 landmarks"):
        solve_many([problem], method="exact")

"""The searches against the exact solver, the bounds, and what an anytime search promises."""

from __future__ import annotations

import builtins
import importlib.util
import itertools
import os
import subprocess
import sys

import numpy as np
import pytest

from mapp_env import Grid, Problem, make_grid, sample_problems, solve
from mapp_env.solvers import _plan_of
from mapp_env.solvers import search as search_module
from mapp_env.solvers.bounds import lower_bound
from mapp_env.solvers.exact import solve_exact
from mapp_env.solvers.pyvrp import solve_pyvrp
from mapp_env.solvers.ruin_recreate import recreate
from mapp_env.solvers.search import Search, solve_search
from mapp_env.solvers.solution import Solution, landmark_distances, problem_distances, solution_of

OBJECTIVES = ("cover_time", "makespan", "total_distance")
needs_pyvrp = pytest.mark.skipif(
    importlib.util.find_spec("pyvrp") is None, reason="the extra 'pyvrp' is not installed"
)


def random_problem(seed: int, most_landmarks: int = 8, most_agents: int = 5) -> Problem:
    """Return a problem on a small grid of random walls, with a depot anywhere."""
    rng = np.random.default_rng([11, seed])
    while True:
        walls = rng.random(rng.integers(1, 12, 2)) < rng.choice((0.0, 0.2, 0.35))
        if walls.all():
            continue
        grid = Grid(walls, int(rng.choice(np.flatnonzero(~walls))))
        if grid.reachable.size:
            break
    count = int(rng.integers(1, min(most_landmarks, grid.reachable.size) + 1))
    landmarks = rng.choice(grid.reachable, count, replace=False).tolist()
    return Problem(grid, landmarks, int(rng.integers(1, most_agents + 1)))


def generated_problem(kind: str, side: int, n_landmarks: int, n_agents: int, seed: int) -> Problem:
    """Return a problem on a generated grid."""
    grid = make_grid(kind, rows=side, cols=side, seed=seed)
    return Problem(grid, sample_problems(grid, 1, n_landmarks, seed)[0].tolist(), n_agents)


def costs(problem: Problem, solution: Solution) -> dict[str, int]:
    """Return what routes cost, after checking that they visit every landmark once."""
    assert len(solution.routes) == problem.n_agents
    visited = sorted(cell for route in solution.routes for cell in route)
    assert visited == sorted(problem.landmarks)
    opened, closed = [0], [0]
    for route in filter(None, solution.routes):
        cells = (problem.grid.depot, *route)
        steps = problem.grid.distances_from(cells)
        length = sum(int(steps[index, cell]) for index, cell in enumerate(cells[1:]))
        opened.append(length)
        closed.append(length + int(steps[0, cells[-1]]))
    return {"cover_time": max(opened), "makespan": max(closed), "total_distance": sum(closed)}


# -- search --------------------------------------------------------------


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_search_equals_exact_on_small_problems(objective: str) -> None:
    """On 100 random small problems the search finds the optimum, of the same total distance."""
    for seed in range(100):
        problem = random_problem(seed)
        optimum = solve_exact(problem, objective)
        found = solve_search(problem, objective, iterations=4000, seed=seed)
        assert costs(problem, found)[objective] == optimum.bound, seed
        total = costs(problem, optimum)["total_distance"]
        assert costs(problem, found)["total_distance"] == total, seed
        assert found.bound <= optimum.bound, seed
        assert found.optimal == (found.bound == optimum.bound), seed


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("iterations", [1, 3, 50])
def test_search_is_never_below_the_optimum(objective: str, iterations: int) -> None:
    """However short the search: optimum <= cost, and "optimal" only where they are equal."""
    above = 0
    for seed in range(40):
        problem = random_problem(seed, 9)
        optimum = solve_exact(problem, objective).bound
        found = solve_search(problem, objective, iterations=iterations, seed=seed)
        cost = costs(problem, found)[objective]
        assert found.bound <= optimum <= cost, seed
        assert not found.optimal or cost == optimum, seed
        above += cost > optimum
    # Else this test would say nothing of searches that stop too early.
    assert iterations > 1 or objective == "total_distance" or above


@pytest.mark.parametrize("kind", ["random", "rooms", "warehouse"])
def test_search_finds_optima_of_middling_problems(kind: str) -> None:
    """32 x 32, 14 landmarks, 4 agents: 5000 iterations, some 20 ms, reach every optimum."""
    for seed in range(3):
        problem = generated_problem(kind, 32, 14, 4, seed)
        for objective in OBJECTIVES:
            found = solve_search(problem, objective, iterations=5000)
            optimum = solve_exact(problem, objective).bound
            assert costs(problem, found)[objective] == optimum, (seed, objective)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize(
    ("n_landmarks", "n_agents"), [(1, 1), (1, 16), (2, 5), (3, 16), (256, 1), (256, 16), (20, 7)]
)
def test_search_takes_all_sizes(objective: str, n_landmarks: int, n_agents: int) -> None:
    """From one landmark and one agent to 256 and 16, routes are whole and not below the bound."""
    problem = generated_problem("rooms", 24, n_landmarks, n_agents, 5)
    found = solve_search(problem, objective, iterations=300)
    cost = costs(problem, found)[objective]
    assert found.bound == lower_bound(problem, objective, problem_distances(problem))
    assert found.bound <= cost
    assert found.optimal == (cost == found.bound)
    plan = solve(problem, objective, method="search", time_limit=0.01)
    assert plan.bound is not None
    assert plan.bound <= plan.cost
    plan.verify(problem)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_seed_and_iterations_decide(objective: str) -> None:
    """The same seed and iterations give the same routes; some other seed gives others."""
    problem = generated_problem("random", 40, 40, 4, 1)
    found = [solve_search(problem, objective, iterations=700, seed=7) for _ in range(2)]
    assert found[0] == found[1]
    others = [solve_search(problem, objective, iterations=700, seed=seed) for seed in (0, 1, 2)]
    assert any(other.routes != found[0].routes for other in others)


def test_pieces_make_the_same_run() -> None:
    """A run in pieces of any length finds what one run finds."""
    distances = landmark_distances(generated_problem("maze", 31, 30, 3, 2))
    whole, pieces = (Search(distances, 3, "makespan", seed=4) for _ in range(2))
    whole.run(5300)
    for length in (1, 2, 997, 4000, 300):
        pieces.run(length)
    assert pieces.iterations == whole.iterations == 5300
    assert (pieces.cost, pieces.routes()) == (whole.cost, whole.routes())


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_more_iterations_are_never_worse(objective: str) -> None:
    """Cost never rises with iterations, nor total distance at equal cost, over the reheatings."""
    problem = generated_problem("random", 64, 50, 5, 3)
    before = (10**9, 10**9)
    for iterations in (1, 2, 10, 100, 1000, 5000, 5001, 9000, 15000, 20000):
        all_costs = costs(problem, solve_search(problem, objective, iterations=iterations))
        now = (all_costs[objective], all_costs["total_distance"])
        assert now <= before, iterations
        before = now


def test_no_more_iterations_than_asked_for() -> None:
    """What is found in 700 iterations is what 700 iterations find, where more would do better."""
    problem = generated_problem("random", 40, 40, 4, 1)
    distances = landmark_distances(problem)
    found = []
    for iterations in (700, 1001):
        search = Search(distances, problem.n_agents, "makespan", 3)
        search.run(iterations)
        found.append(solution_of(problem, search.routes(), search.cost, 0).routes)
    assert found[0] != found[1]
    assert solve_search(problem, "makespan", iterations=700, seed=3).routes == found[0]


def test_on_better_reports_falling_costs() -> None:
    """Costs reported on the way fall strictly, and the last is that of the answer."""
    problem = generated_problem("random", 64, 60, 3, 3)
    seen: list[int] = []
    found = solve_search(problem, "makespan", iterations=5000, on_better=seen.append)
    assert len(seen) > 1
    assert seen == sorted(set(seen), reverse=True)
    assert seen[-1] == costs(problem, found)["makespan"]


def test_search_keeps_to_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A time limit is neither passed by more than a few iterations nor left unused."""
    problem = generated_problem("random", 64, 60, 3, 3)
    solve_search(problem, "cover_time", iterations=1)  # loads the kernels
    times = itertools.count(5.0)
    asked, run = [], Search.run

    def watched(search: Search, iterations: int, bound: int) -> bool:
        asked.append(iterations)
        return run(search, iterations, bound)

    monkeypatch.setattr(Search, "run", watched)
    monkeypatch.setattr(search_module, "clock", lambda: next(times))
    assert not solve_search(problem, "cover_time", time_limit=6.0).optimal
    assert next(times) == 12.0  # it began at 5 and was told at 11 that it was over
    assert len(asked) == 6
    assert max(asked) <= 1000


@pytest.mark.parametrize("kind", ["random", "maze"])
def test_the_largest_grids_take_little_longer(kind: str) -> None:
    """On 512 x 512 cells distances and tours, which are not in the time limit, take little."""
    grid = make_grid(kind, rows=512, cols=512, seed=1)
    problem = Problem(grid, sample_problems(grid, 1, 64, 3)[0].tolist(), 5)
    for objective in OBJECTIVES:
        plan = solve(problem, objective, method="search", time_limit=0.05)
        assert plan.cost < 10**9


def test_search_ends_at_the_bound() -> None:
    """Where the bound is met the search ends, however much time is left."""
    problem = generated_problem("random", 32, 20, 16, 0)
    assert solve_search(problem, "cover_time", time_limit=1e6).optimal


def test_search_proves_small_optima() -> None:
    """Five landmarks of the default grid: what the search finds is proven, and at once."""
    problem = Problem(make_grid(), (0, 6, 20, 42, 48), 3)
    plan = solve(problem, method="search")
    assert (plan.cost, plan.status, plan.bound) == (12, "optimal", 12)


def test_search_without_limits_ends() -> None:
    """Without a time limit a fixed number of iterations is carried out."""
    problem = generated_problem("random", 16, 6, 2, 0)
    counted = solve_search(problem, "makespan", iterations=search_module.DEFAULT_ITERATIONS)
    assert solve_search(problem, "makespan") == counted


def test_a_step_above_the_bound_is_not_the_end() -> None:
    """A search at its bound ends in the end; at a cost one above it goes on."""
    problem = Problem(make_grid(), (0, 6, 20, 42, 48), 3)
    search = Search(landmark_distances(problem), 3, "cover_time")
    assert search.run(10_000, 11)
    assert search.iterations == 10_000
    assert search.cost == 12
    assert not search.run(10_000, 12)


def test_an_empty_route_hides_no_other() -> None:
    """A landmark goes where it costs least, also if an agent before that one has no route."""
    grid = Grid(np.zeros((1, 6), np.bool_), 0)
    search = Search(landmark_distances(Problem(grid, (4, 5), 2)), 2, "makespan", 1)
    layout, team = search._layout._replace(weight=0), search._teams[1]
    team.routes[1, 0], team.sizes[1], team.lengths[1] = 1, 1, 8
    search._scratch.removed[0] = 2
    recreate(1, layout, team, search._scratch, search._memory)
    assert (team.sizes.tolist(), team.lengths.tolist()) == ([0, 2], [0, 10])


def test_depot_next_to_every_landmark() -> None:
    """Landmarks around the depot, where all distances are alike, are split evenly."""
    grid = Grid(np.zeros((3, 3), np.bool_), (1, 1))
    problem = Problem(grid, [1, 3, 5, 7], 2)
    found = solve_search(problem, "makespan", iterations=500)
    assert sorted(map(len, found.routes)) == [2, 2]
    assert found == Solution(found.routes, 4, True)


@pytest.mark.parametrize("iterations", [0, -1, 2.0, True, "many"])
def test_bad_iterations_are_refused(iterations: object) -> None:
    """The message names argument and value."""
    problem = random_problem(0)
    with pytest.raises(ValueError, match=r"iterations must be an integer in 1\.\."):
        solve_search(problem, "makespan", iterations=iterations)  # type: ignore[arg-type]


def test_unknown_objective_is_refused() -> None:
    """Both searches say which objectives there are."""
    for solver in (solve_search, solve_pyvrp):
        with pytest.raises(ValueError, match="objective must be one of 'cover_time'"):
            solver(random_problem(0), "span")


def test_plain_python_finds_the_same() -> None:
    """Without compilation the same source takes the same decisions."""
    script = (
        "from mapp_env import Problem, make_grid\n"
        "from mapp_env.solvers.search import solve_search\n"
        "problem = Problem(make_grid(), (0, 6, 20, 42, 48, 1, 3, 30), 3)\n"
        "for objective in ('cover_time', 'makespan', 'total_distance'):\n"
        "    print(solve_search(problem, objective, iterations=60, seed=2).routes)\n"
    )
    printed = [
        subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "NUMBA_DISABLE_JIT": flag},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for flag in "01"
    ]
    assert printed[0] == printed[1]
    assert printed[0].count("((") == 3


# -- pyvrp ---------------------------------------------------------------


@needs_pyvrp
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_pyvrp_equals_exact_on_small_problems(objective: str) -> None:
    """PyVRP's routes are whole and never below the optimum, and mostly meet it."""
    met = 0
    for seed in range(12):
        problem = random_problem(seed)
        optimum = solve_exact(problem, objective).bound
        found = solve_pyvrp(problem, objective, time_limit=0.1)
        cost = costs(problem, found)[objective]
        assert found.bound <= optimum <= cost, seed
        assert found.optimal == (cost == found.bound), seed
        met += cost == optimum
    assert met >= 11


@needs_pyvrp
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_search_is_no_worse_than_pyvrp(objective: str) -> None:
    """Each some fifth of a second, 64 landmarks and 4 agents."""
    problem = generated_problem("random", 64, 64, 4, 2)
    ours = solve_search(problem, objective, iterations=40_000)
    seen: list[int] = []
    theirs = solve_pyvrp(problem, objective, time_limit=0.2, on_better=seen.append)
    assert costs(problem, ours)[objective] <= costs(problem, theirs)[objective]
    assert seen == sorted(set(seen), reverse=True)
    assert seen[-1] == costs(problem, theirs)[objective]


@needs_pyvrp
@pytest.mark.parametrize(("n_landmarks", "n_agents"), [(1, 1), (1, 16), (256, 16)])
def test_pyvrp_takes_all_sizes(n_landmarks: int, n_agents: int) -> None:
    """Through solve() as well."""
    problem = generated_problem("rooms", 24, n_landmarks, n_agents, 5)
    for objective in OBJECTIVES:
        plan = solve(problem, objective, method="pyvrp", time_limit=0.2)
        plan.verify(problem)


def test_missing_pyvrp_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the package the error says how to get it, and nothing else needs it."""
    real_import = builtins.__import__

    def fake_import(name: str, *args: object, **options: object) -> object:
        if name.split(".")[0] == "pyvrp":
            raise ModuleNotFoundError(f"No module named {name!r}")
        return real_import(name, *args, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", fake_import)
    with pytest.raises(ImportError, match=r"pip install \"pyvrp>=0.14,<0.15\""):
        solve_pyvrp(random_problem(0), "makespan")
    assert solve_search(random_problem(0), "makespan", iterations=1).routes


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_agents_without_a_tour_come_last(objective: str) -> None:
    """In whatever order a solver leaves its routes, idle agents come last, and nobody waits."""
    for rows in ("...\n.D.\n...", "D.."):  # with landmarks all around the depot, and a bump
        grid = Grid.from_text(rows)
        cells = grid.reachable[::2].tolist() if len(rows) < 5 else [1, 3, 5, 7]
        problem = Problem(grid, cells, 7)
        found = solve_exact(problem, objective)
        for routes in (found.routes[::-1], (*found.routes[3:], *found.routes[:3])):
            plan = _plan_of(problem, objective, Solution(routes, found.bound, found.optimal))
            walking = [bool(tour) for tour in plan.tours]
            assert walking == sorted(walking, reverse=True)
            assert not walking[-1]
            assert plan.cost == found.bound
            assert plan.joint_actions().max() < 4

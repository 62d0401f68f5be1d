"""The searches from any starts: against brute force, and what they find from the depot as ever."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import itertools
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mapp_env import Grid, Problem, make_grid, sample_problems, solve
from mapp_env.solvers import save_vrplib
from mapp_env.solvers.exact import solve_exact
from mapp_env.solvers.pyvrp import solve_pyvrp
from mapp_env.solvers.ruin_recreate import recreate, sort_near
from mapp_env.solvers.search import Search, solve_search
from mapp_env.solvers.solution import Solution, problem_distances

OBJECTIVES = ("cover_time", "makespan", "total_distance")
needs_pyvrp = pytest.mark.skipif(
    importlib.util.find_spec("pyvrp") is None, reason="the extra 'pyvrp' is not installed"
)


def random_problem(seed: int, most_landmarks: int = 7, most_agents: int = 5) -> Problem:
    """Return a problem on a small grid of random walls, with a depot and agents anywhere."""
    rng = np.random.default_rng([12, seed])
    while True:
        walls = rng.random(rng.integers(1, 10, 2)) < rng.choice((0.0, 0.2, 0.35))
        if walls.all():
            continue
        grid = Grid(walls, int(rng.choice(np.flatnonzero(~walls))))
        if grid.reachable.size:
            break
    count = int(rng.integers(1, min(most_landmarks, grid.reachable.size) + 1))
    landmarks = rng.choice(grid.reachable, count, replace=False)
    others = np.setdiff1d(np.append(grid.reachable, grid.depot), landmarks)
    # Sometimes few cells, so that agents share them.
    cells = rng.choice(others, rng.integers(1, 5))
    starts = rng.choice(cells, rng.integers(1, most_agents + 1)).tolist()
    return Problem(grid, landmarks.tolist(), len(starts), starts=starts)


def generated_problem(kind: str, side: int, n_landmarks: int, n_agents: int, seed: int) -> Problem:
    """Return a problem on a generated grid, all agents on the depot."""
    grid = make_grid(kind, rows=side, cols=side, seed=seed)
    return Problem(grid, sample_problems(grid, 1, n_landmarks, seed)[0].tolist(), n_agents)


def scattered(problem: Problem, seed: int) -> Problem:
    """Return the problem with its agents on random cells."""
    rng = np.random.default_rng(seed)
    cells = np.setdiff1d(problem.grid.reachable, problem.landmarks)
    return dataclasses.replace(problem, starts=rng.choice(cells, problem.n_agents).tolist())


def costs(problem: Problem, routes: tuple[tuple[int, ...], ...]) -> dict[str, int]:
    """Return what routes cost, after checking that they visit every landmark once."""
    assert len(routes) == problem.n_agents
    assert sorted(itertools.chain(*routes)) == sorted(problem.landmarks)
    opened, closed = [0], [0]
    for start, route in zip(problem.start_cells, routes, strict=True):
        if route:
            steps = problem.grid.distances_from((start, *route))
            opened.append(sum(int(steps[place, cell]) for place, cell in enumerate(route)))
            closed.append(opened[-1] + int(problem.grid.home[route[-1]]))
    return {"cover_time": max(opened), "makespan": max(closed), "total_distance": sum(closed)}


def brute_force(problem: Problem) -> dict[str, int]:
    """Return the optimum of each objective over all assignments and orders."""
    steps = problem.grid.distances_from((*problem.start_cells, *problem.landmarks))
    home = problem.grid.home
    n_agents = problem.n_agents

    @cache
    def shortest(agent: int, members: tuple[int, ...]) -> tuple[int, int]:
        """Return the shortest open and closed way of an agent through landmarks, by number."""
        opened, closed = [], []
        for order in itertools.permutations(members):
            nodes = (agent, *(n_agents + landmark for landmark in order))
            length = sum(
                int(steps[node, problem.landmarks[landmark]])
                for node, landmark in zip(nodes, order, strict=False)
            )
            opened.append(length)
            closed.append(length + int(home[problem.landmarks[order[-1]]]) if order else 0)
        return min(opened), min(closed)

    found = dict.fromkeys(OBJECTIVES, 10**9)
    for owners in itertools.product(range(n_agents), repeat=len(problem.landmarks)):
        parts = [
            shortest(agent, tuple(k for k, owner in enumerate(owners) if owner == agent))
            for agent in range(n_agents)
        ]
        opened, closed = zip(*parts, strict=True)
        now = (max(opened), max(closed), sum(closed))
        found = {name: min(found[name], cost) for name, cost in zip(OBJECTIVES, now, strict=True)}
    return found


def test_search_equals_brute_force_on_small_problems() -> None:
    """On 150 problems from any starts it finds the optimum, and is never below it."""
    met = 0
    for seed in range(150):
        problem = random_problem(seed, 5, 3)
        optima = brute_force(problem)
        for objective in OBJECTIVES:
            found = solve_search(problem, objective, iterations=2000, seed=seed)
            cost = costs(problem, found.routes)[objective]
            assert found.bound <= optima[objective] <= cost, (seed, objective)
            assert found.optimal == (cost == found.bound), (seed, objective)
            met += cost == optima[objective]
    assert met >= 448


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("iterations", [1, 20])
def test_short_searches_are_never_below_the_optimum(objective: str, iterations: int) -> None:
    """However short the search from any starts: bound <= optimum <= cost."""
    above = 0
    for seed in range(60):
        problem = random_problem(seed, 8)
        optimum = solve_exact(problem, objective).bound
        found = solve_search(problem, objective, iterations=iterations, seed=seed)
        cost = costs(problem, found.routes)[objective]
        assert found.bound <= optimum <= cost, seed
        above += cost > optimum
    assert above or iterations > 1


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_search_finds_optima_of_middling_problems(objective: str) -> None:
    """32 x 32, 13 landmarks, 4 agents on random cells: 5000 iterations reach every optimum."""
    for seed in range(4):
        problem = scattered(generated_problem("rooms", 32, 13, 4, seed), seed)
        plan = solve(problem, objective, "exact")
        found = solve_search(problem, objective, iterations=5000)
        assert costs(problem, found.routes)[objective] == plan.cost
        plan.verify()


def test_agents_share_what_one_alone_would_walk_longer() -> None:
    """For the least total distance two agents work, where one alone would have to come back."""
    problem = Problem(Grid.from_text("...D..."), (0, 6), 2, starts=(1, 5))
    for solver in (solve_search, solve_exact):
        found = solver(problem, "total_distance")
        assert sorted(found.routes) == [(0,), (6,)]
        assert costs(problem, found.routes)["total_distance"] == found.bound == 8
    # Also from one start: two ways home, each past a landmark.
    around = Problem(Grid.from_text(".......\n.#####.\n...D..."), (1, 5, 14, 20), 2, starts=(3, 3))
    found = solve_search(around, "total_distance")
    assert sorted(map(len, found.routes)) == [2, 2]
    assert costs(around, found.routes)["total_distance"] == found.bound == 16


def test_only_agents_of_one_start_are_alike() -> None:
    """An empty route is tried for each start, and hides no other of another start."""
    # The first agent is far from the landmark, the second beside it: both have empty routes.
    problem = Problem(Grid.from_text("D......."), (7,), 3, starts=(1, 1, 6))
    distances = problem_distances(problem)
    search = Search(distances.between, 3, "cover_time", 0, distances.starts)
    assert search._layout.alike.tolist() == [0, 0, 2]
    team = search._teams[1]
    search._scratch.removed[0] = 1
    recreate(1, search._layout, team, search._scratch, search._memory)
    assert (team.sizes.tolist(), team.lengths.tolist()) == ([0, 0, 1], [0, 0, 1])


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_renamed_agents_cost_the_same(objective: str) -> None:
    """In another order the same agents reach the same cost."""
    rng = np.random.default_rng(0)
    for seed in range(40):
        problem = random_problem(seed)
        starts = rng.permutation(problem.start_cells).tolist()
        renamed = dataclasses.replace(problem, starts=starts)
        found = [solve_search(one, objective, iterations=2000) for one in (problem, renamed)]
        first, second = (costs(problem, found[0].routes), costs(renamed, found[1].routes))
        assert first[objective] == second[objective], seed


def test_landmarks_by_distance_are_those_of_numpy() -> None:
    """The compiled sort is a stable one, whatever the ties and the number."""
    rng = np.random.default_rng(0)
    for count in (1, 2, 3, 7, 20, 60, 256):
        for _ in range(20):
            distances = rng.integers(0, rng.choice((2, 10, 1000)), count + 4).astype(np.int32)
            near = np.zeros(count, np.int32)
            sort_near(distances, near)
            assert (near == distances[1 : count + 1].argsort(kind="stable") + 1).all()


# Digests of the routes that the search found from the depot before it knew of starts, for each
# objective: on a grid of this kind and side, with so many landmarks and agents.
RECORDED = {
    ("random", 16, 5, 3): ("3933bcd4cfd4a2ad", "cf42fd3abcccc864", "523e59eb84ed53bf"),
    ("rooms", 24, 12, 4): ("7c721f2c1e43e574", "eb8fbb39ecd517f4", "d07a452146b4a8af"),
    ("maze", 21, 30, 3): ("2289c7dadcba7327", "16627b81f679edaa", "445194ebefdba141"),
    ("warehouse", 32, 60, 5): ("69e6cac60133fe1b", "4a0d95a26033bad0", "17472b9025f365cb"),
    ("random", 64, 100, 16): ("b328a1a79e7b0b3a", "a3e2cebf141ff268", "05968d3d6d04cc12"),
    ("random", 24, 1, 3): ("92bb71da4c76a1ed", "30f9730d74ef828f", "6b1013bfb63b4bfd"),
    ("rooms", 20, 200, 7): ("911e6ca32d8f0822", "8e714b446c379d5d", "0bfbb433a5a68a91"),
}


@pytest.mark.parametrize("case", RECORDED)
def test_from_the_depot_nothing_has_changed(case: tuple[str, int, int, int]) -> None:
    """The same seed and iterations find the recorded routes, starts on the depot said or not."""
    for seed, (objective, digest) in enumerate(zip(OBJECTIVES, RECORDED[case], strict=True)):
        problem = generated_problem(*case, seed)
        said = dataclasses.replace(problem, starts=(problem.grid.depot,) * problem.n_agents)
        for one in (problem, said):
            found = solve_search(one, objective, iterations=2500, seed=7 + seed)
            assert hashlib.sha256(repr(found.routes).encode()).hexdigest()[:16] == digest


# -- pyvrp, vrplib ---------------------------------------------------------------------------------


@needs_pyvrp
@pytest.mark.parametrize("objective", OBJECTIVES)
def test_pyvrp_from_any_starts(objective: str) -> None:
    """PyVRP's routes are whole, never below the optimum, and mostly meet it."""
    met = 0
    for seed in range(12):
        problem = random_problem(seed)
        optimum = solve_exact(problem, objective)
        found = solve_pyvrp(problem, objective, time_limit=0.1)
        cost = costs(problem, found.routes)[objective]
        assert found.bound <= optimum.bound <= cost, seed
        assert found.optimal == (cost == found.bound), seed
        solve(problem, objective, method="pyvrp", time_limit=0.02).verify(problem)
        met += cost == optimum.bound
    assert met >= 11


def test_a_vrplib_file_has_one_depot(tmp_path: Path) -> None:
    """Problems with starts are refused, and nothing is written."""
    problem = Problem(make_grid(), (0, 6), 2, starts=(3, 24))
    with pytest.raises(ValueError, match=r"all agents start on the depot.*got starts \(3, 24\)"):
        save_vrplib(problem, tmp_path / "problem.vrp")
    assert not list(tmp_path.iterdir())
    save_vrplib(dataclasses.replace(problem, starts=(24, 24)), tmp_path / "problem.vrp")


def test_solutions_name_agents_by_their_starts() -> None:
    """Each landmark is visited by the agent beside it, for all solvers."""
    grid = Grid(np.zeros((7, 7), bool))
    problem = Problem(grid, (0, 6, 42, 48), 4, starts=(47, 43, 5, 1))
    expected = Solution(((48,), (42,), (6,), (0,)), 1, True)
    for solver in (solve_search, solve_exact):
        assert solver(problem, "cover_time") == expected

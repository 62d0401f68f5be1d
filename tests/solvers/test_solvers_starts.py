"""The exact side of the solvers from any starts: against brute force, the rules and symmetries.

Brute force here shares nothing with the solvers, not even the breadth-first search for distances.
"""

from __future__ import annotations

import itertools
from collections import deque
from functools import cache

import numpy as np
import pytest

from mapp_env import Grid, Problem
from mapp_env.solvers.bounds import lower_bound, tree_bound
from mapp_env.solvers.exact import solve_exact
from mapp_env.solvers.solution import Solution, problem_distances

OBJECTIVES = ("cover_time", "makespan", "total_distance")
SHAPES = ((7, 7), (1, 9), (12, 1), (2, 5), (5, 3), (4, 11), (3, 3), (9, 6), (2, 2), (10, 10))


def random_problem(
    rng: np.random.Generator,
    most_landmarks: int,
    most_agents: int,
    shape: tuple[int, int] | None = None,
    least_landmarks: int = 1,
    least_agents: int = 1,
) -> Problem:
    """Return a problem on a grid of random walls, with a depot and agents anywhere."""
    while True:
        rows, cols = SHAPES[rng.integers(len(SHAPES))] if shape is None else shape
        walls = rng.random((rows, cols)) < rng.choice((0.0, 0.15, 0.3, 0.4))
        depot = int(rng.integers(rows * cols))
        walls.flat[depot] = False
        grid = Grid(walls, depot)
        room = min(most_landmarks, grid.reachable.size)
        if room >= least_landmarks:
            break
    count = int(rng.integers(least_landmarks, room + 1))
    landmarks = rng.choice(grid.reachable, count, replace=False).tolist()
    others = np.setdiff1d(np.append(grid.reachable, depot), landmarks)
    # Sometimes few cells, so that agents share them.
    cells = rng.choice(others, int(rng.integers(1, 1 + min(4, len(others)))), replace=False)
    n_agents = int(rng.integers(least_agents, most_agents + 1))
    return Problem(grid, landmarks, n_agents, starts=rng.choice(cells, n_agents).tolist())


def steps_from(grid: Grid, source: int) -> dict[int, int]:
    """Return the steps from a cell to all others, from the walls alone."""
    steps = {source: 0}
    queue = deque([source])
    while queue:
        row, col = divmod(cell := queue.popleft(), grid.cols)
        for r, c in ((row, col - 1), (row, col + 1), (row - 1, col), (row + 1, col)):
            to = r * grid.cols + c
            on_grid = 0 <= r < grid.rows and 0 <= c < grid.cols
            if on_grid and not grid.walls[r, c] and to not in steps:
                steps[to] = steps[cell] + 1
                queue.append(to)
    return steps


def all_steps(problem: Problem) -> dict[int, dict[int, int]]:
    """Return the steps from each cell that matters to all others."""
    cells = {problem.grid.depot, *problem.landmarks, *problem.start_cells}
    return {cell: steps_from(problem.grid, cell) for cell in cells}


def costs_of_routes(problem: Problem, routes: tuple[tuple[int, ...], ...]) -> dict[str, int]:
    """Return the three costs of agents that walk shortest ways through their landmarks and home."""
    steps, depot = all_steps(problem), problem.grid.depot
    times, tours = [0], [0]
    for start, route in zip(problem.start_cells, routes, strict=True):
        time = sum(steps[a][b] for a, b in itertools.pairwise((start, *route)))
        times.append(time)
        tours.append(time + steps[route[-1]][depot] if route else 0)
    return dict(zip(OBJECTIVES, (max(times), max(tours), sum(tours)), strict=True))


def brute_force(problem: Problem) -> dict[str, tuple[int, int]]:
    """Return for each objective the least (cost, total distance), over all assignments and orders.

    An assignment gives each landmark to an agent; the orders of one agent's landmarks matter to
    the others only through the time and the distance that they take.
    """
    depot, steps = problem.grid.depot, all_steps(problem)

    @cache
    def ways(start: int, cells: tuple[int, ...]) -> list[tuple[int, int]]:
        """Return (time of the last landmark, length of the tour) of each order worth a look."""
        if not cells:
            return [(0, 0)]
        found = set()
        for order in itertools.permutations(cells):
            time = sum(steps[a][b] for a, b in itertools.pairwise((start, *order)))
            found.add((time, time + steps[order[-1]][depot]))
        return [
            way
            for way in found
            if not any(o != way and o[0] <= way[0] and o[1] <= way[1] for o in found)
        ]

    best = dict.fromkeys(OBJECTIVES, (10**9, 10**9))
    for owners in itertools.product(range(problem.n_agents), repeat=len(problem.landmarks)):
        parts = [
            ways(start, tuple(c for c, o in zip(problem.landmarks, owners, strict=True) if o == n))
            for n, start in enumerate(problem.start_cells)
        ]
        for team in itertools.product(*parts):
            total = sum(tour for _, tour in team)
            costs = (max(time for time, _ in team), max(tour for _, tour in team), total)
            for name, cost in zip(OBJECTIVES, costs, strict=True):
                best[name] = min(best[name], (cost, total))
    return best


def check(problem: Problem, objective: str, solution: Solution, cost: int, total: int) -> None:
    """Check that a solution's routes visit every landmark once and cost what they should."""
    visited = [cell for route in solution.routes for cell in route]
    assert sorted(visited) == sorted(problem.landmarks)
    costs = costs_of_routes(problem, solution.routes)
    assert (costs[objective], costs["total_distance"]) == (cost, total), (problem, objective)
    assert (solution.bound, solution.optimal) == (cost, True)


# -- the optimum ---------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
def test_exact_is_brute_force(seed: int) -> None:
    """On 1,000 problems of all shapes: the optimum of every objective, and the least distance."""
    rng = np.random.default_rng(seed)
    for _ in range(100):
        problem = random_problem(rng, 5, 4)
        for objective, best in brute_force(problem).items():
            check(problem, objective, solve_exact(problem, objective), *best)
            distances = problem_distances(problem)
            assert lower_bound(problem, objective, distances) == best[0]
            assert tree_bound(distances, objective) <= best[0]

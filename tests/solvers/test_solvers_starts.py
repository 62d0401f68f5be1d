"""The exact side of the solvers from any starts: against brute force, the rules and symmetries.

Brute force here shares nothing with the solvers, not even the breadth-first search for distances.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from functools import cache
from typing import Any

import numpy as np
import pytest

from mapp_env import Grid, Problem, solve
from mapp_env.engine.rules import measure_row, reset_row, step_row
from mapp_env.engine.state import State, new_rows, split
from mapp_env.engine.world import make_world
from mapp_env.grid import FAR
from mapp_env.solvers import exact, families, partition
from mapp_env.solvers.bounds import lower_bound, tree_bound
from mapp_env.solvers.exact import solve_exact
from mapp_env.solvers.solution import Distances, Solution, problem_distances

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


def test_plans_cost_what_is_proven() -> None:
    """Walked by the rules, the routes cost the optimum and have the least distance, idle or not."""
    rng = np.random.default_rng(30)
    for _ in range(100):
        problem = random_problem(rng, 5, 4)
        for objective, best in brute_force(problem).items():
            plan = solve(problem, objective, "exact")
            assert (plan.cost, plan.total_distance) == best, (problem, objective)
            assert (plan.status, plan.bound) == ("optimal", plan.cost)
            plan.verify(problem)


@pytest.mark.parametrize(("landmarks", "agents"), [(6, 6), (7, 2), (7, 3)])
def test_exact_is_brute_force_on_larger_problems(landmarks: int, agents: int) -> None:
    """The same for as many agents as landmarks, and for more landmarks."""
    rng = np.random.default_rng(landmarks * agents)
    for _ in range(3):
        problem = random_problem(rng, landmarks, agents, (6, 7), landmarks, agents)
        for objective, best in brute_force(problem).items():
            check(problem, objective, solve_exact(problem, objective), *best)


def search_states(problem: Problem, objective: str, limit: int) -> float:
    """Return the least cost over all joint action sequences, found through the rules alone.

    Breadth-first over what the rest of an episode can depend on: the agents' cells, the visited
    flags and, for the costs with a way home, what each agent would have paid so far. Costs above
    ``limit`` are not told apart.
    """
    sizes = problem.n_agents, len(problem.landmarks)
    world = make_world(problem.grid, *sizes)
    start = new_rows(1, *sizes)[0]
    landmarks, cells = (np.array(c, np.int32) for c in (problem.landmarks, problem.start_cells))
    reset_row(start, landmarks, cells, world)
    home = problem.grid.home
    joint_actions = np.array(list(itertools.product(range(5), repeat=problem.n_agents)), np.int64)

    def key(row: np.ndarray) -> tuple[bytes, ...]:
        state = split(row, *sizes)
        met = (state.cells.tobytes(), state.visited.tobytes())
        claimed = state.claim_steps > 0
        if objective == "makespan":
            back = state.claim_steps + home[state.claim_cells]
            return (*met, np.where(claimed, back, 0).tobytes())
        if objective == "total_distance":
            return (*met, paid_by(state).tobytes(), np.minimum(state.moved, limit + 1).tobytes())
        return met

    def paid_by(state: State) -> np.ndarray:
        claimed = state.claim_steps > 0
        return np.where(claimed, state.claim_moved + home[state.claim_cells], 0)

    best = math.inf
    known = {key(start)}
    layer = [start]
    while layer and not (objective == "cover_time" and best < math.inf):
        after = []
        for row_before in layer:
            for actions in joint_actions:
                row = row_before.copy()
                _, terminated, _ = step_row(row, actions, 10**6, world)
                if terminated:
                    costs = measure_row(row, world)
                    best = min(best, costs[OBJECTIVES.index(objective)])
                    continue
                if objective == "total_distance" and paid_by(split(row, *sizes)).sum() > limit:
                    continue
                if objective == "makespan" and split(row, *sizes).step[0] > limit:
                    continue
                state = key(row)
                if state not in known:
                    known.add(state)
                    after.append(row)
        layer = after
    return best


@pytest.mark.parametrize("seed", range(20))
def test_exact_is_the_best_of_all_joint_actions(seed: int) -> None:
    """The optimum is what a search over all joint actions through the step kernel finds."""
    rng = np.random.default_rng(1000 + seed)
    shape = ((3, 3), (2, 4), (1, 6), (3, 4))[seed % 4]
    problem = random_problem(rng, 4, 2, shape)
    assert search_states(problem, "cover_time", 0) == solve_exact(problem, "cover_time").bound


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("objective", ["makespan", "total_distance"])
def test_exact_is_the_best_of_all_ways_home(objective: str, seed: int) -> None:
    """The same for the costs that count the way home, whatever agents do in between."""
    rng = np.random.default_rng(2000 + seed)
    shape = ((2, 2), (1, 4), (2, 3), (3, 2))[seed % 4]
    problem = random_problem(rng, 2, 2, shape)
    optimum = solve_exact(problem, objective).bound
    assert search_states(problem, objective, optimum) == optimum


def plain_split(tours: list[np.ndarray]) -> int:
    """Return the least sum of tours over all partitions, by the definition."""
    sums = tours[0].astype(np.int64)
    for table in tours[1:]:
        more = sums.copy()
        for members in range(len(sums)):
            part = members
            while part:
                more[members] = min(more[members], int(table[part]) + sums[members ^ part])
                part = (part - 1) & members
        sums = more
    return int(sums[-1])


def test_every_way_of_joining_agents_gives_the_least_sum(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether sets are looked at from the whole or from a part, all of them or the hopeful ones."""
    rng = np.random.default_rng(20)
    used = {"add_any_part": 0, "add_each_part": 0}
    for name in used:
        kernel = getattr(partition, name)

        def counted(*arguments: Any, name: str = name, kernel: Any = kernel) -> None:
            used[name] += 1
            kernel(*arguments)

        monkeypatch.setattr(partition, name, counted)
    for _ in range(30):
        problem = random_problem(rng, 8, 7, (9, 9), 6, 3)
        distances = problem_distances(problem)
        for closed in (False, True):
            limit = families.smallest_limit_from(distances, closed)
            for slack, many in ((0, 0), (3, 10**9), (3, 0), (30, 10**9)):
                monkeypatch.setattr(partition, "MANY_PAIRS", many)
                tours = tour_tables(distances, closed, limit + slack)
                parts = partition.split_among(distances, closed, limit + slack, tours)
                assert sum(parts) == len(tours[0]) - 1 == np.bitwise_or.reduce(parts)
                costs = [int(table[part]) for table, part in zip(tours, parts, strict=True)]
                assert sum(costs) == plain_split(tours)
    assert min(used.values()) > 30


def tour_tables(distances: Distances, closed: bool, limit: int) -> list[np.ndarray]:
    """Return what each set costs each agent within a limit."""
    between, starts = distances
    tables = []
    for start in starts:
        routes = np.empty((1 << (len(between) - 1), len(between) - 1), np.int32)
        tables.append(np.empty(len(routes), np.int32))
        families.tours_from(between, start, closed, limit, routes, tables[-1])
    return tables


def test_counting_agents_one_after_another_finds_what_they_can_visit() -> None:
    """For every set and limit: so many of the first agents are the fewest whose parts can join."""
    rng = np.random.default_rng(21)
    for _ in range(30):
        problem = random_problem(rng, 6, 5, None, 1, 2)
        distances = problem_distances(problem)
        for closed in (False, True):
            optimum = families.smallest_limit_from(distances, closed)
            for limit in range(max(0, optimum - 2), optimum + 3):
                able = [table < FAR for table in tour_tables(distances, closed, limit)]
                fewest = families.fewest_agents(distances, closed, limit)
                together = np.arange(len(fewest)) == 0
                for count, own in enumerate(able, 1):
                    pairs = itertools.product(np.flatnonzero(together), np.flatnonzero(own))
                    together = np.isin(np.arange(len(fewest)), [a | b for a, b in pairs])
                    assert (together == (fewest <= count)).all()
                assert bool(together[-1]) == (limit >= optimum)


def test_twenty_landmarks() -> None:
    """The largest size is solved, its routes cost what it says, and no objective beats another."""
    rng = np.random.default_rng(7)
    walls = rng.random((32, 32)) < 0.2
    walls[16, 16] = False
    grid = Grid(walls, (16, 16))
    cells = rng.choice(grid.reachable, 24, replace=False).tolist()
    problem = Problem(grid, cells[:20], 4, starts=cells[20:])
    found = {objective: solve_exact(problem, objective) for objective in OBJECTIVES}
    for solution in found.values():
        costs = costs_of_routes(problem, solution.routes)
        for name, cost in costs.items():
            assert cost >= found[name].bound
    assert costs_of_routes(problem, found["makespan"].routes)["makespan"] == found["makespan"].bound


# -- what must hold whatever the problem ---------------------------------


def costs_of(problem: Problem) -> list[tuple[int, int]]:
    """Return the three optima, each with the total distance of its routes."""
    found = [solve_exact(problem, objective) for objective in OBJECTIVES]
    totals = [costs_of_routes(problem, one.routes)["total_distance"] for one in found]
    return [(one.bound, total) for one, total in zip(found, totals, strict=True)]


def test_symmetries_of_the_square_change_nothing() -> None:
    """Turned and mirrored problems cost the same."""
    rng = np.random.default_rng(8)
    for _ in range(8):
        problem = random_problem(rng, 7, 4)
        grid = problem.grid
        names = np.arange(grid.n_cells).reshape(grid.walls.shape)
        expected = costs_of(problem)
        for turns, mirrored in itertools.product(range(4), (False, True)):
            walls, places = np.rot90(grid.walls, turns), np.rot90(names, turns)
            if mirrored:
                walls, places = walls[:, ::-1], places[:, ::-1]
            cell = {int(old): new for new, old in enumerate(places.ravel())}
            image = Grid(np.ascontiguousarray(walls), cell[grid.depot])
            landmarks = [cell[landmark] for landmark in problem.landmarks]
            starts = [cell[start] for start in problem.start_cells]
            assert costs_of(Problem(image, landmarks, problem.n_agents, starts=starts)) == expected


def test_names_of_landmarks_and_agents_change_nothing() -> None:
    """Landmarks in another order have the same routes, agents in another order the same costs."""
    rng = np.random.default_rng(9)
    for _ in range(30):
        problem = random_problem(rng, 8, 4)
        other = rng.permutation(problem.landmarks).tolist()
        starts = problem.start_cells
        for objective in OBJECTIVES:
            renamed = Problem(problem.grid, other, problem.n_agents, starts=starts)
            assert solve_exact(renamed, objective) == solve_exact(problem, objective)
        shuffled = rng.permutation(starts).tolist()
        renamed = Problem(problem.grid, problem.landmarks, problem.n_agents, starts=shuffled)
        assert costs_of(renamed) == costs_of(problem)


def test_less_to_do_is_never_harder() -> None:
    """A landmark less, or an agent more anywhere, raises no optimum."""
    rng = np.random.default_rng(11)
    for _ in range(60):
        problem = random_problem(rng, 7, 4, None, 2)
        grid, landmarks, starts = problem.grid, problem.landmarks, problem.start_cells
        others = np.setdiff1d(np.append(grid.reachable, grid.depot), landmarks)
        more = (*starts, int(rng.choice(others)))
        easier = (
            Problem(grid, landmarks[1:], len(starts), starts=starts),
            Problem(grid, landmarks, len(more), starts=more),
        )
        for objective in OBJECTIVES:
            optimum = solve_exact(problem, objective).bound
            for other in easier:
                assert solve_exact(other, objective).bound <= optimum


def test_starts_on_the_depot_are_no_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Said or left out, the answer is the same; and the general way to it gives the same costs."""
    rng = np.random.default_rng(12)
    for _ in range(60):
        problem = random_problem(rng, 8, 5)
        grid, n_agents = problem.grid, problem.n_agents
        plain = Problem(grid, problem.landmarks, n_agents)
        said = Problem(grid, problem.landmarks, n_agents, starts=(grid.depot,) * n_agents)
        distances = problem_distances(plain)
        for objective in OBJECTIVES:
            answer = solve_exact(plain, objective)
            assert solve_exact(said, objective) == answer
            total = costs_of_routes(plain, answer.routes)["total_distance"]
            if objective == "total_distance":
                general, routes = exact.least_total(distances)
            else:
                general, routes = exact.least_longest(distances, objective == "makespan")
            cells = tuple(tuple(problem.landmarks[k] for k in route) for route in routes)
            costs = costs_of_routes(plain, cells)
            assert (general, costs[objective]) == (answer.bound, answer.bound)
            assert costs["total_distance"] == total


def test_bounds_are_never_above_the_optimum() -> None:
    """Beyond 12 landmarks as well; they lie above the trees' bound, and sometimes it is theirs."""
    rng = np.random.default_rng(13)
    raised = tight = 0
    for _ in range(40):
        problem = random_problem(rng, 14, 6, (9, 9), 10)
        distances = problem_distances(problem)
        for objective in OBJECTIVES:
            optimum = solve_exact(problem, objective).bound
            low = tree_bound(distances, objective)
            bound = lower_bound(problem, objective, distances)
            assert 0 < low <= bound <= optimum
            assert bound == optimum or len(problem.landmarks) > 12
            raised += low < bound
            tight += low == bound == optimum
    assert raised > 20
    assert tight > 5


def test_an_agent_that_claims_nothing_costs_nothing() -> None:
    """One that stands far off stays out of it, though its way home is long."""
    grid = Grid.from_text("D......................")
    problem = Problem(grid, (1, 2), 2, starts=(0, 22))
    for objective, cost in zip(OBJECTIVES, (2, 4, 4), strict=True):
        solution = solve_exact(problem, objective)
        assert (solution.bound, solution.routes[1]) == (cost, ())


def test_two_agents_from_one_cell_may_walk_less_than_one() -> None:
    """Away from the depot: on two ways home that are far apart one walks less than in turn."""
    lane, wall = "........", ".######."
    grid = Grid.from_text("\n".join((lane, wall, wall, ".######D", wall, wall, lane)))
    landmarks = (1, 6, 49, 54)
    both = solve_exact(Problem(grid, landmarks, 2, starts=(24, 24)), "total_distance")
    assert both.bound == 26
    assert sorted(map(sorted, both.routes)) == [[1, 6], [49, 54]]
    assert solve_exact(Problem(grid, landmarks, 1, starts=(24,)), "total_distance").bound == 29

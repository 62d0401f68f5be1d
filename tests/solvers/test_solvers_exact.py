"""The exact solver against brute force, against the rules themselves, and against what must hold.

Brute force here shares nothing with the solver but the breadth-first search for distances.
"""

from __future__ import annotations

import itertools
import math
import os
import subprocess
import sys
from collections import deque
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import mapp_env
from mapp_env import Grid, Problem, mapp_v0, replay, solve
from mapp_env.engine.rules import measure_row, reset_row, step_row
from mapp_env.engine.state import State, World, new_rows, split
from mapp_env.engine.world import make_world
from mapp_env.solvers import exact, solve_universe
from mapp_env.solvers.batch import least_worst
from mapp_env.solvers.bounds import lower_bound, tree_bound
from mapp_env.solvers.held_karp import route_costs, shortest_routes
from mapp_env.solvers.solution import landmark_distances, problem_distances

OBJECTIVES = ("cover_time", "makespan", "total_distance")
SHAPES = ((7, 7), (1, 9), (12, 1), (2, 5), (5, 3), (4, 11), (3, 3), (9, 6), (2, 2), (10, 10))


def random_problem(
    rng: np.random.Generator,
    most_landmarks: int,
    most_agents: int,
    shape: tuple[int, int] | None = None,
    least_landmarks: int = 1,
) -> Problem:
    """Return a problem on a grid of random walls, with a depot anywhere."""
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
    return Problem(grid, landmarks, int(rng.integers(1, most_agents + 1)))


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


def brute_force(problem: Problem) -> dict[str, tuple[int, int]]:
    """Return for each objective the least (cost, total distance), over all assignments and orders.

    An assignment gives each landmark to an agent; the orders of one agent's landmarks matter to
    the others only through the time and the distance that they take.
    """
    depot = problem.grid.depot
    steps = {cell: steps_from(problem.grid, cell) for cell in (depot, *problem.landmarks)}

    @cache
    def ways(cells: tuple[int, ...]) -> list[tuple[int, int]]:
        """Return (time of the last landmark, length of the closed tour) of each order."""
        if not cells:
            return [(0, 0)]
        found = set()
        for order in itertools.permutations(cells):
            time = sum(steps[a][b] for a, b in itertools.pairwise((depot, *order)))
            found.add((time, time + steps[order[-1]][depot]))
        # Orders that are worse in both, or equal, cannot be part of a better plan.
        return [
            way
            for way in found
            if not any(o != way and o[0] <= way[0] and o[1] <= way[1] for o in found)
        ]

    best = dict.fromkeys(OBJECTIVES, (10**9, 10**9))
    for owners in itertools.product(range(problem.n_agents), repeat=len(problem.landmarks)):
        parts = [
            tuple(c for c, o in zip(problem.landmarks, owners, strict=True) if o == agent)
            for agent in range(problem.n_agents)
        ]
        for team in itertools.product(*map(ways, parts)):
            total = sum(tour for _, tour in team)
            costs = (max(time for time, _ in team), max(tour for _, tour in team), total)
            for name, cost in zip(OBJECTIVES, costs, strict=True):
                best[name] = min(best[name], (cost, total))
    return best


# -- the optimum ---------------------------------------------------------


@pytest.mark.parametrize("seed", range(11))
def test_exact_is_brute_force(seed: int) -> None:
    """On 1,100 problems of all shapes: the optimum of every objective, and the least distance."""
    rng = np.random.default_rng(seed)
    for _ in range(100):
        problem = random_problem(rng, 5, 4)
        for objective, (cost, total) in brute_force(problem).items():
            plan = solve(problem, objective, "exact")
            assert (plan.cost, plan.total_distance) == (cost, total), (problem, objective)
            assert (plan.status, plan.bound, plan.solver) == ("optimal", cost, "exact")
            plan.verify(problem)


@pytest.mark.parametrize(("landmarks", "agents"), [(6, 6), (7, 2), (7, 3)])
def test_exact_is_brute_force_on_larger_problems(landmarks: int, agents: int) -> None:
    """The same for as many agents as landmarks, and for more landmarks."""
    rng = np.random.default_rng(landmarks * agents)
    for _ in range(3):
        problem = random_problem(rng, landmarks, 1, (7, 7), landmarks)
        problem = Problem(problem.grid, problem.landmarks, agents)
        for objective, (cost, total) in brute_force(problem).items():
            plan = solve(problem, objective, "exact")
            assert (plan.cost, plan.total_distance) == (cost, total)


def row_at_reset(problem: Problem) -> tuple[np.ndarray, World]:
    """Return a row of the rules at reset, and its world."""
    sizes = (problem.n_agents, len(problem.landmarks))
    world = make_world(problem.grid, *sizes)
    row = new_rows(1, *sizes)[0]
    cells = np.array(problem.start_cells, np.int32)
    reset_row(row, np.array(problem.landmarks, np.int32), cells, world)
    return row, world


def search_states(problem: Problem, objective: str, limit: int) -> float:
    """Return the least cost over all joint action sequences, found through the rules alone.

    Breadth-first over what the rest of an episode can depend on: the agents' cells, the visited
    flags and, for the costs with a way home, what each agent would have paid so far. Costs above
    ``limit`` are not told apart.
    """
    start, world = row_at_reset(problem)
    home = problem.grid.home
    joint_actions = np.array(list(itertools.product(range(5), repeat=problem.n_agents)), np.int64)

    def parts_of(row: np.ndarray) -> State:
        return split(row, problem.n_agents, len(problem.landmarks))

    def key(row: np.ndarray) -> tuple[bytes, ...]:
        state = parts_of(row)
        met = (state.cells.tobytes(), state.visited.tobytes())
        claimed = state.claim_steps > 0
        if objective == "makespan":
            back = state.claim_steps + home[state.claim_cells]
            return (*met, np.where(claimed, back, 0).tobytes())
        if objective == "total_distance":
            moved = np.minimum(state.moved, limit + 1)
            return (*met, paid_by(state).tobytes(), moved.tobytes())
        return met

    def paid_by(state: State) -> np.ndarray:
        claimed = state.claim_steps > 0
        return np.where(claimed, state.claim_moved + home[state.claim_cells], 0)

    best = math.inf
    seen = {key(start)}
    layer = [start]
    while layer and not (objective == "cover_time" and best < math.inf):
        following = []
        for before in layer:
            for actions in joint_actions:
                row = before.copy()
                _, terminated, _ = step_row(row, actions, 10**6, world)
                if terminated:
                    costs = measure_row(row, world)
                    best = min(best, costs[OBJECTIVES.index(objective)])
                    continue
                if objective == "total_distance" and paid_by(parts_of(row)).sum() > limit:
                    continue
                if objective == "makespan" and parts_of(row).step[0] > limit:
                    continue
                state = key(row)
                if state not in seen:
                    seen.add(state)
                    following.append(row)
        layer = following
    return best


@pytest.mark.parametrize("seed", range(30))
def test_exact_is_the_best_of_all_joint_actions(seed: int) -> None:
    """The optimum is what a search over all joint actions through the step kernel finds."""
    rng = np.random.default_rng(1000 + seed)
    shape = ((3, 3), (2, 4), (1, 6), (3, 4))[seed % 4]
    problem = random_problem(rng, 4, 2, shape)
    plan = solve(problem, "cover_time")
    assert search_states(problem, "cover_time", 0) == plan.cost


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("objective", ["makespan", "total_distance"])
def test_exact_is_the_best_of_all_ways_home(objective: str, seed: int) -> None:
    """The same for the costs that count the way home, whatever agents do in between."""
    rng = np.random.default_rng(2000 + seed)
    shape = ((2, 2), (1, 4), (2, 3), (3, 2))[seed % 4]
    problem = random_problem(rng, 2, 2, shape)
    plan = solve(problem, objective)
    assert search_states(problem, objective, int(plan.cost)) == plan.cost


def test_three_agents_in_the_joint_state_space() -> None:
    """The same for three agents on a small grid."""
    problem = Problem(Grid.from_text("..#\n.D.\n#.."), (0, 5, 8), 3)
    plan = solve(problem)
    assert search_states(problem, "cover_time", 0) == plan.cost


def test_counting_agrees_with_direct_partitions() -> None:
    """Up to 11 landmarks: the counted minimum equals the minimum over all partitions."""
    rng = np.random.default_rng(5)
    for _ in range(40):
        problem = random_problem(rng, 11, 8, (9, 9), 8)
        n_landmarks = len(problem.landmarks)
        distances = landmark_distances(problem)
        routes = np.empty((1 << n_landmarks, n_landmarks), np.int32)
        costs = np.empty(1 << n_landmarks, np.int32)
        shortest_routes(distances, routes)
        for objective, closed in (("cover_time", False), ("makespan", True)):
            route_costs(distances, routes, closed, costs)
            scratch = np.empty((2, 1 << (n_landmarks - 1)), np.int32)
            expected = least_worst(costs, min(problem.n_agents, n_landmarks), scratch)
            assert solve(problem, objective, "exact").cost == expected


def test_both_ways_of_breaking_ties_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    """A table an agent, and one table for any number of agents, give the same two costs."""
    rng = np.random.default_rng(6)
    for _ in range(60):
        problem = random_problem(rng, 9, 5, None, 3)
        for objective in ("cover_time", "makespan"):
            found = []
            for few in (1, 100):
                monkeypatch.setattr(exact, "FEW_AGENTS", few)
                plan = solve(problem, objective, "exact")
                found.append((plan.cost, plan.total_distance))
            assert found[0] == found[1]


def test_ties_are_not_broken_with_agents_there_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the table for any number of agents takes three, the plan makes do with its two."""
    problem = Problem(Grid(np.zeros((4, 11), bool), 9), (42, 30, 27, 41, 10), 2)
    for few in (1, 100):
        monkeypatch.setattr(exact, "FEW_AGENTS", few)
        plan = solve(problem, "cover_time", "exact")
        assert (plan.cost, plan.total_distance) == brute_force(problem)["cover_time"] == (6, 22)


def test_twenty_landmarks() -> None:
    """The largest size is solved, its plan verifies, and no objective beats another's own."""
    rng = np.random.default_rng(7)
    walls = rng.random((32, 32)) < 0.2
    walls[16, 16] = False
    grid = Grid(walls, (16, 16))
    problem = Problem(grid, rng.choice(grid.reachable, 20, replace=False).tolist(), 5)
    plans = {objective: solve(problem, objective, "exact") for objective in OBJECTIVES}
    for plan in plans.values():
        plan.verify(problem)
        for objective in OBJECTIVES:
            assert getattr(plan, objective) >= plans[objective].cost


# -- what must hold whatever the problem ---------------------------------


def costs_of(problem: Problem) -> tuple[tuple[float, float], ...]:
    """Return the three optima, each with the total distance of its plan."""
    plans = [solve(problem, objective, "exact") for objective in OBJECTIVES]
    return tuple((plan.cost, plan.total_distance) for plan in plans)


def test_symmetries_of_the_square_change_nothing() -> None:
    """Turned and mirrored problems cost the same."""
    rng = np.random.default_rng(8)
    for _ in range(15):
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
            assert costs_of(Problem(image, landmarks, problem.n_agents)) == expected


def test_names_of_landmarks_change_nothing() -> None:
    """In whatever order landmarks are named, the plan is the same, tours and all."""
    rng = np.random.default_rng(9)
    for _ in range(30):
        problem = random_problem(rng, 8, 4)
        other = rng.permutation(problem.landmarks).tolist()
        for objective in OBJECTIVES:
            plan = solve(problem, objective)
            again = solve(Problem(problem.grid, other, problem.n_agents), objective)
            assert (plan.tours, plan.claims, plan.actions) == (
                again.tours,
                again.claims,
                again.actions,
            )


def test_names_of_agents_change_nothing() -> None:
    """With the columns of its joint actions in another order, a plan costs the same."""
    rng = np.random.default_rng(10)
    for _ in range(30):
        problem = random_problem(rng, 6, 5)
        for objective in ("cover_time", "makespan"):
            plan = solve(problem, objective)
            # With waits: agents without a task claim nothing, in whatever order.
            actions = plan.joint_actions(allow_wait=True)
            for _ in range(3):
                shuffled = actions[:, rng.permutation(problem.n_agents)]
                assert replay(problem, shuffled, objective).cost == plan.cost


def test_less_to_do_is_never_harder() -> None:
    """A landmark less or an agent more raises no optimum; a wall more lowers none."""
    rng = np.random.default_rng(11)
    walls_tried = 0
    for _ in range(60):
        problem = random_problem(rng, 7, 4)
        grid, landmarks, n_agents = problem.grid, problem.landmarks, problem.n_agents
        optima = [solve(problem, objective).cost for objective in OBJECTIVES]
        easier = [Problem(grid, landmarks, n_agents + 1)]
        if len(landmarks) > 1:
            easier += [Problem(grid, landmarks[:-1], n_agents), Problem(grid, landmarks[1:])]
            easier[-1] = Problem(grid, landmarks[1:], n_agents)
        for other in easier:
            costs = [solve(other, objective).cost for objective in OBJECTIVES]
            assert all(cost <= optimum for cost, optimum in zip(costs, optima, strict=True))
        for _ in range(3):
            walls = grid.walls.copy()
            walls.flat[rng.integers(grid.n_cells)] = True
            if walls.flat[grid.depot]:
                continue
            try:
                other = Problem(Grid(walls, grid.depot), landmarks, n_agents)
            except ValueError:
                continue  # a landmark is cut off
            walls_tried += 1
            costs = [solve(other, objective).cost for objective in OBJECTIVES]
            assert all(cost >= optimum for cost, optimum in zip(costs, optima, strict=True))
    assert walls_tried > 30


def test_bound_below_optimum_below_policies() -> None:
    """No policy is cheaper than the optimum, and the lower bound is never above it."""
    rng = np.random.default_rng(12)
    tight = solved = 0
    for _ in range(150):
        problem = random_problem(rng, 8, 4)
        distances = problem_distances(problem)
        actions = rng.integers(0, 5, (300, problem.n_agents))
        for objective in OBJECTIVES:
            optimum = solve(problem, objective, "exact").cost
            bound = lower_bound(problem, objective, distances)
            assert bound <= optimum
            tight += bound == optimum
            plan = replay(problem, actions, objective)
            assert plan.cost >= optimum
            solved += plan.success
    # The two comparisons compare something.
    assert tight > 200
    assert solved > 60


def test_bound_is_the_optimum_of_few_landmarks() -> None:
    """Up to 12 landmarks the lower bound is the optimum; beyond, it is not below the trees' one."""
    rng = np.random.default_rng(16)
    raised = 0
    for _ in range(30):
        problem = random_problem(rng, 14, 6, (9, 9), 10)
        distances = problem_distances(problem)
        for objective in OBJECTIVES:
            optimum = solve(problem, objective, "exact").cost
            bound = lower_bound(problem, objective, distances)
            low = tree_bound(distances, objective)
            there = distances.between[0].max() * (1 if objective == "cover_time" else 2)
            assert there <= low <= bound <= optimum
            assert bound == optimum or len(problem.landmarks) > 12
            raised += low < bound and len(problem.landmarks) > 12
    assert raised > 5


def test_distance_alone_is_one_agents_tour() -> None:
    """The least total distance of a team is that of one agent, who walks alone in the plan."""
    rng = np.random.default_rng(13)
    for _ in range(40):
        problem = random_problem(rng, 8, 5)
        plan = solve(problem, "total_distance")
        alone = solve(Problem(problem.grid, problem.landmarks, 1), "makespan")
        assert plan.cost == alone.cost == plan.makespan
        assert sum(map(bool, plan.tours)) == 1


# -- the plan in the environment -----------------------------------------


def play(problem: Problem, actions: np.ndarray, allow_wait: bool) -> dict[str, float]:
    """Return the metrics of an episode of the PettingZoo environment."""
    env = mapp_v0.parallel_env(
        problem.grid,
        problem.n_agents,
        len(problem.landmarks),
        max_cycles=max(1, len(actions)),
        allow_wait=allow_wait,
    )
    env.reset(options={"landmarks": list(problem.landmarks)})
    for index, joint_action in enumerate(actions):
        chosen = dict(zip(env.possible_agents, joint_action.tolist(), strict=True))
        _, _, terminations, truncations, infos = env.step(chosen)
        last = index == len(actions) - 1
        assert set(terminations.values()) == {last}
        assert not any(truncations.values())
    return infos["agent_0"]["metrics"]


@pytest.mark.parametrize("allow_wait", [False, True])
def test_plans_play_in_the_environment(allow_wait: bool) -> None:
    """In the environment, with or without the action to wait, plans cost what they say."""
    rng = np.random.default_rng(14)
    for _ in range(60):
        problem = random_problem(rng, 7, 6)
        for objective in OBJECTIVES:
            plan = solve(problem, objective)
            actions = plan.joint_actions(allow_wait=allow_wait)
            assert actions.dtype == np.int64
            assert actions.shape == (plan.cover_time, problem.n_agents)
            assert actions.max() < 5 if allow_wait else actions.max() < 4
            metrics = play(problem, actions, allow_wait)
            assert metrics["success"]
            for name in OBJECTIVES:
                assert metrics[name] == getattr(plan, name)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_idle_agents_take_nothing(objective: str) -> None:
    """Where every neighbour of the depot is a landmark, idle agents still claim none of them."""
    grid = Grid.from_text("...\n.D.\n...")
    problem = Problem(grid, (1, 3, 5, 7), 9)
    plan = solve(problem, objective)
    cost, total = {"cover_time": (1, 8), "makespan": (2, 8), "total_distance": (8, 8)}[objective]
    assert (plan.cost, plan.total_distance) == (cost, total)
    assert play(problem, plan.joint_actions(), False)["total_distance"] == total


# -- universe ------------------------------------------------------------


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_universe_is_solve(objective: str) -> None:
    """On a sample of the default grid's problems, in all sizes, the optimum is solve()'s."""
    rng = np.random.default_rng(15)
    grid = mapp_env.make_grid()
    for n_landmarks, n_agents in ((1, 3), (2, 1), (3, 5), (4, 2), (5, 3)):
        landmarks, optimum = solve_universe(grid, n_landmarks, n_agents, objective)
        assert landmarks.shape == (math.comb(40, n_landmarks), n_landmarks)
        assert landmarks.dtype == np.int16
        assert optimum.dtype == np.int32
        for index in rng.integers(len(optimum), size=100):
            problem = Problem(grid, landmarks[index].tolist(), n_agents)
            assert solve(problem, objective).cost == optimum[index]


def test_universe_is_complete_and_in_order() -> None:
    """A small grid's universe is every combination, in lexicographic order, with its optimum."""
    grid = Grid.from_text("..#.\n.D..\n....")
    for n_landmarks in range(1, 11):
        landmarks, optimum = solve_universe(grid, n_landmarks, 3)
        expected = list(itertools.combinations(grid.reachable.tolist(), n_landmarks))
        assert landmarks.tolist() == [list(cells) for cells in expected]
        for cells, cost in list(zip(expected, optimum.tolist(), strict=True))[::17]:
            assert solve(Problem(grid, cells, 3)).cost == cost


def test_universe_in_parts_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many problems are solved at a time, the results are the same."""
    grid = mapp_env.make_grid()
    landmarks, optimum = solve_universe(grid, 3, 2, "makespan")
    monkeypatch.setattr("mapp_env.solvers.batch.CHUNK_WORK", 27 * 7)
    again = solve_universe(grid, 3, 2, "makespan")
    np.testing.assert_array_equal(again[0], landmarks)
    np.testing.assert_array_equal(again[1], optimum)


def test_universe_refuses_what_is_too_large() -> None:
    """Absurd numbers of problems are refused at once, and the message says how many they are."""
    grid = Grid(np.zeros((100, 100), bool))
    with pytest.raises(ValueError, match=f"{math.comb(9999, 5):,} problems"):
        solve_universe(grid, 5)
    with pytest.raises(ValueError, match=f"{math.comb(40, 7):,} problems"):
        solve_universe(mapp_env.make_grid(), 7)
    with pytest.raises(ValueError, match=r"3 \*\* n_landmarks"):
        solve_universe(Grid(np.zeros((4, 6), bool)), 11)
    with pytest.raises(ValueError, match="at most 2"):
        solve_universe(Grid.from_text("D.."), 3)
    with pytest.raises(ValueError, match=r"n_landmarks must be an integer in 1\.\.12"):
        solve_universe(grid, 13)
    cells, optimum = solve_universe(Grid(np.zeros((512, 512), bool)), 1, 3, "makespan")
    assert len(cells) == 512 * 512 - 1
    assert cells.dtype == np.int32
    assert optimum.max() == 2 * 512


# -- what bad input gets -------------------------------------------------


def test_solve_refuses_bad_arguments() -> None:
    """Each argument is checked, and the message names it."""
    problem = Problem(mapp_env.make_grid(), (0, 6), 2)
    with pytest.raises(ValueError, match="problem must be"):
        solve((0, 6))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="objective must be one of"):
        solve(problem, "distance")
    with pytest.raises(ValueError, match="method must be one of"):
        solve(problem, method="magic")
    for limit in (0, -1, math.nan, math.inf, True, "1", 10**400, 1j, np.complex128(1)):
        with pytest.raises(ValueError, match="time_limit must be"):
            solve(problem, time_limit=limit)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seed must be"):
        solve(problem, seed=-1)


def test_exact_refuses_what_is_too_large() -> None:
    """More landmarks than the exact solver takes are refused at once, with a method that can."""
    grid = mapp_env.make_grid()
    for count in (21, 40):
        problem = Problem(grid, grid.reachable[:count].tolist(), 3)
        with pytest.raises(ValueError, match=r"at most 20 landmarks.*method='search'"):
            solve(problem, method="exact")


def test_the_step_limit_is_the_episodes() -> None:
    """A problem's step limit leaves its optimum alone."""
    grid = mapp_env.make_grid()
    plan = solve(Problem(grid, (0, 6, 20, 42, 48), 3, max_cycles=2))
    assert plan.cost == solve(Problem(grid, (0, 6, 20, 42, 48), 3)).cost == 12
    plan.verify()


COMPILING = """
import sys, time
import mapp_env
from mapp_env.solvers.search import Search

run, calls = Search.run, []

def watched(*arguments):
    calls.append(1)
    return run(*arguments)

Search.run = watched
grid = mapp_env.make_grid()
problem = mapp_env.Problem(grid, grid.reachable[:20].tolist(), 3)
start = time.perf_counter()
plan = mapp_env.solve(problem, method=sys.argv[1], time_limit=0.5)
print(time.perf_counter() - start, plan.seconds, len(calls))
"""


@pytest.mark.parametrize("method", ["exact", "search"])
def test_compiling_is_not_counted(method: str, tmp_path: Path) -> None:
    """The first plan of an installation takes the solver's time, not the compiler's.

    Nor does the compiler use up a search's time.
    """
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", COMPILING, method],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    whole, counted, calls = map(float, done.stdout.split())
    assert 0 < counted < whole / 2
    assert whole > 2
    assert method == "exact" or calls > 5


def test_auto_proves_what_there_is_time_for() -> None:
    """Up to 20 landmarks are proven, 16 where less than two seconds may pass; beyond, searched."""
    grid = mapp_env.make_grid()
    cells = mapp_env.sample_problems(grid, 1, n_landmarks=18, seed=1)[0].tolist()
    problem = Problem(grid, cells)
    assert solve(problem, time_limit=2.0).solver == "exact"
    assert solve(problem).solver == "exact"
    assert solve(problem, time_limit=1e-3).solver == "search"
    assert solve(Problem(grid, cells[:16]), time_limit=1e-3).solver == "exact"


def test_universe_names_cells_of_any_grid() -> None:
    """Landmarks are the cells themselves, in 16 bits where these have room for all."""
    for cols, kind in ((63, np.int16), (64, np.int32), (128, np.int32)):
        walls = np.ones((512, cols), bool)
        walls[-1, -4:] = False
        grid = Grid(walls)
        landmarks, optimum = solve_universe(grid, 2, 1)
        assert landmarks.dtype == kind
        assert landmarks.tolist() == list(map(list, itertools.combinations(grid.reachable, 2)))
        assert landmarks.min() > 0
        assert len(optimum) == 3


def test_tours_run_in_the_faster_direction() -> None:
    """Of equally short tours the one that is through with its landmarks first is taken."""
    rng = np.random.default_rng(8)
    slower = 0
    for _ in range(40):
        problem = random_problem(rng, 5, 1)
        plan = solve(problem, "total_distance")
        (tour,) = plan.tours
        marks = set(problem.landmarks)
        last = max(tour.index(cell) for cell in marks)
        back = tour[::-1]
        assert plan.cover_time == last <= max(back.index(cell) for cell in marks)
        slower += last < max(back.index(cell) for cell in marks)
    assert slower > 10

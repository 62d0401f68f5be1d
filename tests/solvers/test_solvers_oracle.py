"""The cost of every decision, against brute force, the exact solver and the rules."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

import mapp_env
from mapp_env import Grid, Problem, replay
from mapp_env.solvers import next_costs, next_costs_of, optimal_costs, regrets
from mapp_env.solvers.exact import solve_exact
from mapp_env.solvers.oracle import states as oracle_states
from mapp_env.solvers.oracle.decisions import action_costs
from mapp_env.solvers.solution import problem_distances

PAPER = mapp_env.make_grid()
NEVER = np.iinfo(np.int32).max


def random_grid(rng: np.random.Generator) -> Grid:
    """Return a grid of random walls with at least six cells for landmarks, a depot anywhere."""
    while True:
        shape = ((7, 7), (1, 9), (12, 1), (4, 11), (3, 3), (9, 6))[rng.integers(6)]
        walls = rng.random(shape) < rng.choice((0.0, 0.2, 0.35))
        depot = int(rng.integers(walls.size))
        walls.flat[depot] = False
        grid = Grid(walls, depot)
        if grid.reachable.size >= 6:
            return grid


def random_problem(
    rng: np.random.Generator, grid: Grid, n_landmarks: int, n_agents: int, max_cycles: Any = None
) -> Problem:
    """Return a problem on a grid, its agents anywhere."""
    landmarks = rng.choice(grid.reachable, n_landmarks, replace=False).tolist()
    others = np.setdiff1d(np.append(grid.reachable, grid.depot), landmarks)
    return Problem(grid, landmarks, n_agents, max_cycles, rng.choice(others, n_agents).tolist())


def brute_force(problem: Problem) -> np.ndarray:
    """Return the least cover time for each agent's next landmark, (N, K + 1), by definition.

    Over all assignments of landmarks to agents, and all orders of each agent's.
    """
    n_agents, n_landmarks = problem.n_agents, len(problem.landmarks)
    between, starts = (array.tolist() for array in problem_distances(problem))
    best = np.full((n_agents, n_landmarks + 1), NEVER)
    for owners in itertools.product(range(n_agents), repeat=n_landmarks):
        # For each agent the least time for each first landmark of its own.
        times: list[dict[int, int]] = []
        for agent in range(n_agents):
            own = [k for k in range(n_landmarks) if owners[k] == agent]
            firsts = {} if own else {n_landmarks: 0}
            for order in itertools.permutations(own):
                if order:
                    time = starts[agent][order[0] + 1]
                    time += sum(between[a + 1][b + 1] for a, b in itertools.pairwise(order))
                    firsts[order[0]] = min(time, firsts.get(order[0], NEVER))
            times.append(firsts)
        for agent, firsts in enumerate(times):
            rest = max((min(t.values()) for n, t in enumerate(times) if n != agent), default=0)
            for first, time in firsts.items():
                best[agent, first] = min(best[agent, first], max(time, rest))
    return best


# -- the next landmark ---------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_each_choice_costs_what_brute_force_says(seed: int) -> None:
    """On 400 small problems of all shapes, every entry; the least of a line is the optimum."""
    rng = np.random.default_rng(seed)
    for _ in range(100):
        grid = random_grid(rng)
        problem = random_problem(rng, grid, int(rng.integers(1, 6)), int(rng.integers(1, 5)))
        costs = next_costs(problem)
        assert costs.dtype == np.int32
        np.testing.assert_array_equal(costs, brute_force(problem))
        assert (costs.min(axis=1) == solve_exact(problem, "cover_time").bound).all()
        # Only for a single agent there is something that no plan does.
        assert (costs == NEVER).sum() == (problem.n_agents == 1)


@pytest.mark.parametrize(("n_landmarks", "n_agents"), [(12, 3), (10, 5), (7, 16), (12, 1)])
def test_the_best_choice_has_the_optimal_cost(n_landmarks: int, n_agents: int) -> None:
    """For as many landmarks and agents as there may be, each agent's best choice is optimal."""
    rng = np.random.default_rng(n_landmarks)
    grid = mapp_env.make_grid("rooms", rows=20, cols=20, seed=1)
    problems = [random_problem(rng, grid, n_landmarks, n_agents) for _ in range(5)]
    best = next_costs(problems).min(axis=2)
    optima = [solve_exact(problem, "cover_time").bound for problem in problems]
    assert (best == np.array(optima)[:, None]).all()


def test_many_problems_are_each_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """On several grids, some of them equal, in any order, however few are solved at a time."""
    rng = np.random.default_rng(5)
    grids = [random_grid(rng) for _ in range(4)]
    grids += [Grid(grids[0].walls, grids[0].depot), mapp_env.make_grid("maze", rows=70, cols=71)]
    problems = [random_problem(rng, grids[rng.integers(len(grids))], 4, 3) for _ in range(80)]
    costs = next_costs(problems)
    assert costs.shape == (80, 3, 5)
    for problem, one in zip(problems, costs, strict=True):
        np.testing.assert_array_equal(next_costs(problem), one)
    monkeypatch.setattr(oracle_states, "CHUNK_WORK", 3**6)
    monkeypatch.setattr(oracle_states, "MAX_ALL_PAIRS_CELLS", 20)
    np.testing.assert_array_equal(next_costs(problems), costs)


def test_states_by_their_distances_are_their_problems() -> None:
    """With some landmarks visited, what is left costs what the problem of it does."""
    rng = np.random.default_rng(6)
    problems = [random_problem(rng, PAPER, 5, 3) for _ in range(60)]
    tables = [problem_distances(problem) for problem in problems]
    between = np.array([table.between[1:, 1:] for table in tables])
    starts = np.array([table.starts[:, 1:] for table in tables])
    np.testing.assert_array_equal(next_costs_of(between, starts), next_costs(problems))
    left = rng.random((60, 5)) < 0.6
    costs = next_costs_of(between.tolist(), starts.tolist(), left.tolist())
    for problem, flags, found in zip(problems, left, costs, strict=True):
        assert (found[:, :5][:, ~flags] == NEVER).all()
        if not flags.any():
            assert (found[:, 5] == 0).all()
            continue
        landmarks = [cell for cell, flag in zip(problem.landmarks, flags, strict=True) if flag]
        rest = Problem(PAPER, landmarks, 3, starts=problem.starts)
        np.testing.assert_array_equal(found[:, np.append(flags, True)], next_costs(rest))


def test_names_and_directions_change_nothing() -> None:
    """Landmarks, agents and cells in another order: the costs are in that order."""
    rng = np.random.default_rng(7)
    for _ in range(40):
        grid = random_grid(rng)
        problem = random_problem(rng, grid, 5, 4)
        costs = next_costs(problem)
        turn, swap = rng.permutation(5), rng.permutation(4)
        landmarks, starts = np.array(problem.landmarks), np.array(problem.start_cells)
        renamed = Problem(grid, landmarks[turn].tolist(), 4, starts=starts[swap].tolist())
        np.testing.assert_array_equal(next_costs(renamed), costs[swap][:, np.append(turn, 5)])
        # From right to left and from bottom to top: a cell is as far from the end as it was from 0.
        image = Grid(grid.walls[::-1, ::-1].copy(), grid.n_cells - 1 - grid.depot)
        landmarks, starts = grid.n_cells - 1 - landmarks, grid.n_cells - 1 - starts
        mirrored = Problem(image, landmarks.tolist(), 4, starts=starts.tolist())
        np.testing.assert_array_equal(next_costs(mirrored), costs)


def test_without_starts_agents_choose_alike() -> None:
    """On the depot the costs are those of starts that say so, and the same for every agent."""
    rng = np.random.default_rng(8)
    for _ in range(20):
        cells = rng.choice(PAPER.reachable, 5, replace=False).tolist()
        costs = next_costs(Problem(PAPER, cells, 3))
        assert (costs == costs[0]).all()
        said = Problem(PAPER, cells, 3, starts=(PAPER.depot,) * 3)
        np.testing.assert_array_equal(next_costs(said), costs)
        assert costs.min() == optimal_costs(PAPER, [cells], 3)[0]


# -- the joint action ----------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_regrets_sum_to_what_was_lost(seed: int) -> None:
    """In episodes by chance each is 0, 1 or 2, and if solved they sum to the steps above optimum.

    If not, to those and what the rest costs.
    """
    rng = np.random.default_rng(seed)
    solved = 0
    for _ in range(60):
        grid = random_grid(rng)
        problem = random_problem(rng, grid, int(rng.integers(1, 6)), int(rng.integers(1, 4)), 5)
        actions = rng.integers(0, 5, (60, problem.n_agents))
        found = regrets(problem, actions)
        assert set(found.tolist()) <= {0, 1, 2}
        unlimited = Problem(grid, problem.landmarks, problem.n_agents, starts=problem.starts)
        optimum = solve_exact(problem, "cover_time").bound
        plan = replay(unlimited, actions)
        if plan.success:
            solved += 1
            assert len(found) == plan.cover_time == found.sum() + optimum
        else:
            rest = unlimited.after(actions)
            assert rest is not None
            left = solve_exact(rest, "cover_time").bound
            assert len(found) == 60
            assert found.sum() == 60 + left - optimum
    assert solved > 20


@pytest.mark.parametrize(("n_landmarks", "n_steps"), [(5, 25), (13, 12), (14, 12)])
def test_each_regret_is_what_its_step_lost(n_landmarks: int, n_steps: int) -> None:
    """By the exact solver, on the problems that are left before and after each joint action."""
    rng = np.random.default_rng(n_landmarks)
    for _ in range(4):
        problem = random_problem(rng, PAPER, n_landmarks, 3)
        actions = rng.integers(0, 5, (n_steps, 3))
        costs = []
        for step in range(n_steps + 1):
            rest = problem.after(actions[:step])
            costs.append(0 if rest is None else solve_exact(rest, "cover_time").bound)
            if rest is None:
                break
        np.testing.assert_array_equal(regrets(problem, actions), np.diff(costs) + 1)


def test_an_optimal_plan_has_no_regret() -> None:
    """From any starts, and what comes after the last landmark is not carried out."""
    rng = np.random.default_rng(9)
    for n_landmarks in (1, 3, 6, 13):
        cells = rng.choice(PAPER.reachable, n_landmarks, replace=False).tolist()
        problem = Problem(PAPER, cells, 3, max_cycles=1)
        plan = mapp_env.solve(problem)
        actions = np.concatenate((plan.joint_actions(), np.zeros((7, 3), int)))
        assert regrets(problem, actions).tolist() == [0] * int(plan.cover_time)


def test_the_best_joint_action_has_no_regret() -> None:
    """In every state some joint action has none; each one's is what action_costs() says of it."""
    rng = np.random.default_rng(10)
    for _ in range(10):
        problem = random_problem(rng, PAPER, 4, 2)
        landmarks, cells = np.array([problem.landmarks]), np.array([problem.start_cells])
        left = np.ones((1, 4), bool)
        costs = action_costs(PAPER, landmarks, left, cells, PAPER.moves)[0]
        lost = [regrets(problem, [divmod(joint, 4)])[0] for joint in range(16)]
        assert min(lost) == 0
        np.testing.assert_array_equal(costs + 1 - solve_exact(problem, "cover_time").bound, lost)


def test_no_joint_actions_no_regret() -> None:
    """Nothing was done, nothing is lost."""
    problem = Problem(PAPER, (0, 6), 2)
    assert regrets(problem, []).shape == (0,)


# -- what bad input gets -------------------------------------------------


@pytest.mark.parametrize(
    ("problems", "message"),
    [
        ((0, 6), "problems must be mapp_env.Problem, one or several"),
        (None, "problems must be mapp_env.Problem, one or several, got None"),
        ([], "got 0 problems"),
        (
            [Problem(PAPER, (0, 6), 2), Problem(PAPER, (0, 6), 3)],
            "same numbers of agents and landmarks, got 2 problems of 2 different",
        ),
        (Problem(PAPER, PAPER.reachable[:13].tolist()), "at most 12 landmarks, got 13"),
    ],
)
def test_wrong_problems_are_refused(problems: Any, message: str) -> None:
    """What is no problem, or not of one size, is refused by name."""
    with pytest.raises(ValueError, match=message):
        next_costs(problems)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"starts": np.zeros((2, 3), int)}, r"starts must be of shape \(B, N, K\)"),
        ({"starts": np.zeros((2, 17, 4), int)}, r"starts must be of 1\.\.16 agents, got 17"),
        ({"starts": np.zeros((2, 3, 13), int)}, r"starts must be of shape .* K in 1\.\.12"),
        ({"starts": np.zeros((2, 3, 0), int)}, r"starts must be of shape .* K in 1\.\.12"),
        ({"starts": -np.ones((2, 3, 4), int)}, r"starts must be integers in 0\.\.10,000,000"),
        ({"between": np.zeros((2, 4, 4))}, r"between must be integers in .* float64 of shape"),
        ({"between": np.zeros((3, 4, 4), int)}, r"between must be of shape \(2, 4, 4\)"),
        ({"unvisited": np.ones((2, 4), int)}, r"unvisited must be bool of shape \(2, 4\)"),
        ({"unvisited": np.ones((2, 3), bool)}, r"unvisited must be bool of shape \(2, 4\)"),
    ],
)
def test_wrong_distances_are_refused(changes: dict[str, Any], message: str) -> None:
    """A wrong shape, type or number of steps is refused by name."""
    fine = {"between": np.zeros((2, 4, 4), int), "starts": np.zeros((2, 3, 4), int)}
    with pytest.raises(ValueError, match=message):
        next_costs_of(**{**fine, **changes})


def test_wrong_episodes_are_refused() -> None:
    """What is no problem or joint action, and more landmarks than can be solved."""
    with pytest.raises(ValueError, match=r"^problem must be a"):
        regrets((0, 6), [[0]])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at most 20 landmarks, got 21"):
        regrets(Problem(PAPER, PAPER.reachable[:21].tolist()), [[0, 0, 0]])
    with pytest.raises(ValueError, match=r"joint_actions must be integers of shape \(T, 3\)"):
        regrets(Problem(PAPER, (0, 6)), [[0, 0]])
    with pytest.raises(ValueError, match=r"joint_actions\[0, 1\] must be in 0\.\.4, got 5"):
        regrets(Problem(PAPER, (0, 6)), [[0, 5, 0]])

"""Going home, starting anywhere and walking to landmarks: what holds for every grid and policy."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from model import MOVES, REWARDS, Model, lively_action, shortest, symmetries, transform
from model_pools import Game, random_game, random_landmarks, random_starts

import mapp_env
from mapp_env import mapp_v0

REPOSITORY = Path(__file__).resolve().parents[2]

FORMS = [(actions, home) for actions in ("moves", "landmarks") for home in (False, True)]


def grid_of(rows: tuple[str, ...]) -> mapp_env.Grid:
    """Return the package's grid of these rows."""
    return mapp_env.Grid.from_text("\n".join(rows) + "\n")


def small_problem(seed: int, away: bool = False) -> tuple[tuple[str, ...], mapp_env.Problem]:
    """Return a random grid and a problem on it that the exact solver solves at once."""
    rng, game = random.Random(seed), random_game(seed)
    rows = game.pool[0]
    count = min(game.n_landmarks, 5)
    cells = random_landmarks(rng, rows, count)
    n_agents = min(game.n_agents, 4)
    starts = random_starts(rng, Game((rows,), n_agents, count).episode(0, cells)) if away else None
    return rows, mapp_env.Problem(grid_of(rows), cells, n_agents, starts=starts)


def make_central(problem: mapp_env.Problem, **changes: Any) -> gymnasium.Env:
    """Return the meta-agent's environment of a problem, reset on it."""
    env = gymnasium.make(
        "mapp_env/Central-v0",
        disable_env_checker=True,
        grid=problem.grid,
        n_agents=problem.n_agents,
        n_landmarks=len(problem.landmarks),
        **{"central_action": "multi", "max_cycles": 400, **changes},
    )
    env.reset(options={"problem": problem})
    return env


@pytest.mark.parametrize("reward", REWARDS)
@pytest.mark.parametrize("away", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_walking_optimal_tours_home_takes_the_optimum(seed: int, away: bool, reward: str) -> None:
    """Agents that walk the tours of least makespan, then home, end the episode at that step.

    Each walks to the landmarks that it claims in the plan, in their order, by landmark actions.
    With the reward "step" the return is then one less than minus the optimum, as the last is 0.
    An agent without a landmark has no tour, but it has to come home as well if it starts away.
    """
    _, problem = small_problem(seed, away)
    plan = mapp_env.solve(problem, objective="makespan")
    assert plan.status == "optimal"
    env = make_central(problem, actions="landmarks", return_home=True, reward=reward)
    n_landmarks = len(problem.landmarks)
    left = [[problem.landmarks.index(cell) for cell in claims] for claims in plan.claims]
    total, steps, over, cells = 0.0, 0, False, list(problem.start_cells)
    while not over:
        for agent, route in enumerate(left):
            while route and cells[agent] == problem.landmarks[route[0]]:
                route.pop(0)
        action = [route[0] if route else n_landmarks for route in left]
        observation, value, over, truncated, info = env.step(np.array(action))
        cells = observation[: problem.n_agents].astype(int).tolist()
        total, steps = total + value, steps + 1
        assert not truncated
        assert (value == 0) is over
    idle = [
        int(problem.grid.home[start])
        for start, tour in zip(problem.start_cells, plan.tours, strict=True)
        if not tour
    ]
    assert steps == max(plan.makespan, *idle, 0) == info["metrics"]["makespan"]
    walked = sum(max(len(tour) - 1, 0) for tour in plan.tours)
    assert info["metrics"]["total_distance"] <= walked + sum(idle)
    if reward == "step":
        assert total == 1 - steps
    assert cells == [problem.grid.depot] * problem.n_agents


@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_no_policy_is_home_before_the_optimum(actions: str) -> None:
    """Whatever agents do, an episode with the way home costs no less than each proven optimum.

    What it says of itself is what was really walked: its length, and the cells that were moved.
    """
    solved = 0
    for seed in range(30):
        rows, problem = small_problem(seed)
        optimum = {
            name: mapp_env.solve(problem, objective=name).cost
            for name in ("cover_time", "makespan", "total_distance")
        }
        settings: dict[str, Any] = {"actions": actions, "return_home": True}
        if actions == "moves":
            settings["allow_wait"] = True
        env = make_central(problem, **settings)
        rng = random.Random(seed)
        for _ in range(3):
            env.reset(options={"problem": problem})
            model = Model(
                rows, problem.landmarks, problem.n_agents, max_cycles=400, actions=actions,
                allow_wait=actions == "moves", return_home=True,
            )  # fmt: skip
            moved, cells, over = 0, np.array(problem.start_cells), False
            while not over:
                joint = lively_action(model, rng)
                model.step(joint)
                observation, _, over, truncated, info = env.step(np.array(joint))
                here = observation[: problem.n_agents].astype(int)
                moved += int((here != cells).sum())
                cells, over = here, over or truncated
            metrics = info["metrics"]
            if not metrics["success"]:
                continue
            solved += 1
            assert metrics["makespan"] == model.steps
            assert metrics["total_distance"] == moved
            assert metrics["cover_time"] < metrics["makespan"]
            for name, least in optimum.items():
                assert metrics[name] >= least
    assert solved > 40


@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_solved_only_when_all_are_home(actions: str) -> None:
    """An episode goes on until the last agent is home, and a way past the depot is not the end."""
    grid = mapp_env.Grid.from_text("...D...\n")
    env = mapp_v0.parallel_env(
        grid=grid, n_agents=2, n_landmarks=2, return_home=True, actions=actions
    )
    _, infos = env.reset(options={"landmarks": [1, 4]})
    left, right = 0, 1  # as moves, and as the landmarks
    home = {"agent_0": 1, "agent_1": 0} if actions == "moves" else dict.fromkeys(env.agents, 2)
    steps = [
        ({"agent_0": left, "agent_1": right}, -1.0),  # cells 2 and 4: landmark 1 is a step away
        ({"agent_0": left, "agent_1": home["agent_1"]}, -2.0),  # all visited; 1 and 3
        ({"agent_0": home["agent_0"], "agent_1": home["agent_1"]}, None),
    ]
    for joint, value in steps:
        _, rewards, terminations, truncations, infos = env.step(joint)
        assert value is None or rewards["agent_0"] == value
        assert not any([*terminations.values(), *truncations.values()])
        assert "metrics" not in infos["agent_0"]
    if actions == "moves":  # agent 1 walked on, past the depot: both are one step from home
        assert rewards["agent_0"] == -2.0
        joint = {"agent_0": 1, "agent_1": 1}
    else:
        assert rewards["agent_0"] == -1.0
        joint = dict.fromkeys(env.agents, 2)
    _, rewards, terminations, truncations, infos = env.step(joint)
    assert rewards == {"agent_0": 0.0, "agent_1": 0.0}
    assert terminations == {"agent_0": True, "agent_1": True}
    assert not any(truncations.values())
    assert infos["agent_1"]["metrics"] == {
        "success": True,
        "cover_time": 2.0,
        "makespan": 4.0,
        "total_distance": 8.0 if actions == "moves" else 6.0,
    }


def test_all_visited_and_not_home_at_the_limit_is_no_success() -> None:
    """Truncated on the way home: every cost is infinite, and success is False."""
    env = mapp_v0.parallel_env(
        grid=mapp_env.Grid.from_text("D..\n"), n_agents=1, n_landmarks=1, return_home=True,
        max_cycles=3,
    )  # fmt: skip
    env.reset(options={"landmarks": [2]})
    for action in (1, 1, 0):
        _, rewards, terminations, truncations, infos = env.step({"agent_0": action})
    assert (terminations["agent_0"], truncations["agent_0"]) == (False, True)
    assert rewards["agent_0"] == -1.0
    metrics = infos["agent_0"]["metrics"]
    assert metrics == {
        "success": False,
        "cover_time": np.inf,
        "makespan": np.inf,
        "total_distance": np.inf,
    }


def test_ways_home_are_measured_as_the_reward_is() -> None:
    """From the last visit on the reward is minus the ways home: by coordinates, by paths, or -1."""
    grid = mapp_env.Grid.from_text("D#.\n.#.\n...\n")
    expected = {"manhattan": (-2.0, -3.0), "geodesic": (-6.0, -5.0), "step": (-1.0, -1.0)}
    for reward, (last_visit, next_step) in expected.items():
        env = mapp_v0.parallel_env(
            grid=grid, n_agents=1, n_landmarks=1, return_home=True, reward=reward
        )
        env.reset(options={"landmarks": [2]})
        for action in (3, 3, 1, 1, 2, 2):
            _, rewards, *_ = env.step({"agent_0": action})
        assert rewards["agent_0"] == last_visit
        _, rewards, *_ = env.step({"agent_0": 3})
        assert rewards["agent_0"] == next_step


def test_first_direction_that_shortens_is_taken() -> None:
    """On an open grid a walk to a landmark goes left or right first, then up or down (R11)."""
    grid = mapp_env.Grid(np.zeros((5, 5), bool))
    env = mapp_v0.parallel_env(grid=grid, n_agents=1, n_landmarks=4, actions="landmarks")
    cells = [0, 4, 20, 24]
    for landmark, (across, along) in enumerate([(-1, -5), (1, -5), (-1, 5), (1, 5)]):
        env.reset(options={"landmarks": cells})
        walked = []
        for _ in range(4):
            observations, *_ = env.step({"agent_0": landmark})
            walked.append(int(observations["agent_0"][0]))
        assert walked == [12 + across, 12 + 2 * across, 12 + 2 * across + along, cells[landmark]]
        observations, *_ = env.step({"agent_0": landmark})  # there already: it stays
        assert observations["agent_0"][0] == cells[landmark]
        observations, *_ = env.step({"agent_0": 4})  # and so it does by the last action
        assert observations["agent_0"][0] == cells[landmark]


@pytest.mark.parametrize("home", [False, True])
def test_the_same_choice_shortens_the_way_at_each_step(home: bool) -> None:
    """An agent that chooses one landmark is on it after as many steps as a shortest path has.

    From any start; visited landmarks are walked to as others are, and so is the depot.
    """
    for seed in range(40):
        rng, game = random.Random(seed), random_game(seed)
        rows = game.pool[0]
        model = Game((rows,), 1, game.n_landmarks).episode(
            0, random_landmarks(rng, rows, game.n_landmarks)
        )
        start = random_starts(rng, model)
        problem = mapp_env.Problem(grid_of(rows), model.landmarks, 1, starts=start)
        env = make_central(problem, actions="landmarks", return_home=home)
        cell, over = start[0], False
        for _ in range(6):
            if over:
                break
            choice = rng.randrange(game.n_landmarks + home)
            goal = [*model.landmarks, problem.grid.depot][choice]
            steps = shortest(rows, goal)
            for left in reversed(range(steps[cell])):
                observation, *_, over, _, _ = env.step(np.array([choice]))
                cell = int(observation[0])
                assert steps[cell] == left
                if over:
                    break
            if not over:
                assert cell == goal


def play(rows: tuple[str, ...], model: Model, joint: list[list[int]], starts: Any) -> list[Any]:
    """Return what an environment on a pool says of a problem with starts, step by step."""
    other = grid_of(("D" + "." * len(model.landmarks),))
    env = mapp_v0.parallel_env(
        grid=[other, grid_of(rows)],
        n_agents=model.n_agents,
        n_landmarks=len(model.landmarks),
        max_cycles=model.max_cycles,
        reward=model.reward_kind,
        observation="distances",
        actions=model.actions,
        return_home=model.return_home,
    )
    problem = mapp_env.Problem(grid_of(rows), model.landmarks, model.n_agents, starts=starts)
    views, _ = env.reset(options={"problem": problem})
    said = [(env.state()[: model.n_agents].astype(int).tolist(), views)]
    for actions in joint:
        views, rewards, ends, cuts, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        cells = env.state()[: model.n_agents].astype(int).tolist()
        metrics = infos["agent_0"].get("metrics")
        said.append((cells, views, rewards, ends, cuts, metrics))
        if not env.agents:
            break
    return said


@pytest.mark.parametrize("home", [False, True])
def test_mirrored_grids_give_mirrored_trajectories(home: bool, same: Any) -> None:
    """Moves on a turned or mirrored grid, from starts turned with it, change no other number.

    The distances that agents see, rewards, ends and metrics are the same to the last bit.
    """
    for seed in range(8):
        game, rng = random_game(seed), random.Random(seed)
        rows = game.pool[-1]
        base = Game((rows,), game.n_agents, game.n_landmarks, game.reward, return_home=home)
        cells = random_landmarks(rng, rows, game.n_landmarks)
        starts = random_starts(rng, base.episode(0, cells))
        model, joint = base.episode(0, cells, starts), []
        while not model.ended and len(joint) < 25:
            joint.append(lively_action(model, rng))
            model.step(joint[-1])
        original = play(rows, model, joint, starts)
        for matrix in symmetries():
            turned = transform(rows, matrix)
            moved = [[turned.action[action] for action in actions] for actions in joint]
            other = Model(
                turned.rows, tuple(turned.cell[cell] for cell in cells), model.n_agents,
                model.reward_kind, return_home=home,
            )  # fmt: skip
            said = play(turned.rows, other, moved, [turned.cell[cell] for cell in starts])
            for (first, *more), (second, *rest) in zip(original, said, strict=True):
                assert second == [turned.cell[cell] for cell in first]
                same(rest, more)


@pytest.mark.parametrize("home", [False, True])
def test_mirrored_trees_give_mirrored_walks_to_landmarks(home: bool, same: Any) -> None:
    """Where there is one shortest path only, walks to landmarks are mirrored with the grid.

    Elsewhere they need not be: ties go to left, right, up, down, in this order, and a mirror turns
    left to right.
    """
    for seed in range(8):
        rng = random.Random(seed)
        rows = random_tree(rng, rng.randint(2, 4), rng.randint(2, 4))
        n_agents, n_landmarks = rng.randint(1, 4), rng.randint(1, 5)
        game = Game(
            (rows,), n_agents, n_landmarks, rng.choice(REWARDS), "landmarks", return_home=home
        )
        cells = random_landmarks(rng, rows, n_landmarks)
        starts = random_starts(rng, game.episode(0, cells))
        model, joint = game.episode(0, cells, starts), []
        while not model.ended:
            joint.append(lively_action(model, rng))
            model.step(joint[-1])
        original = play(rows, model, joint, starts)
        for matrix in symmetries():
            turned = transform(rows, matrix)
            other = Model(
                turned.rows, tuple(turned.cell[cell] for cell in cells), n_agents,
                game.reward, actions="landmarks", return_home=home,
            )  # fmt: skip
            said = play(turned.rows, other, joint, [turned.cell[cell] for cell in starts])
            for (first, *more), (second, *rest) in zip(original, said, strict=True):
                assert second == [turned.cell[cell] for cell in first]
                same(rest, more)


def random_tree(rng: random.Random, n_rows: int, n_cols: int) -> tuple[str, ...]:
    """Return a maze without a circle: rooms on even places, a wall or a door between two."""
    letters = [["#"] * (2 * n_cols - 1) for _ in range(2 * n_rows - 1)]
    letters[0][0] = "D"
    rooms = [(0, 0)]
    while len(rooms) < n_rows * n_cols:
        row, col = rng.choice(rooms)
        by_row, by_col = rng.choice(MOVES[:4])
        there = row + by_row, col + by_col
        if there in rooms or not (0 <= there[0] < n_rows and 0 <= there[1] < n_cols):
            continue
        rooms.append(there)
        letters[2 * row + by_row][2 * col + by_col] = letters[2 * there[0]][2 * there[1]] = "."
    return tuple("".join(row) for row in letters)


@pytest.mark.parametrize(("actions", "home"), FORMS)
def test_a_start_of_each_agent_counts(actions: str, home: bool) -> None:
    """Every agent begins on its own start, whichever of them it is, and tours begin there."""
    for seed in range(12):
        rng = random.Random(seed)
        rows = random_game(seed).pool[0]
        n_agents = rng.randint(2, 6)
        game = Game((rows,), n_agents, 1, actions=actions, return_home=home)
        cells = random_landmarks(rng, rows, 1)
        starts = random_starts(rng, game.episode(0, cells))
        problem = mapp_env.Problem(grid_of(rows), cells, n_agents, starts=starts)
        env = make_central(problem, actions=actions, return_home=home)
        assert env.unwrapped.state()[:n_agents].tolist() == list(starts)
        env.reset(options={"landmarks": list(cells)})
        assert env.unwrapped.state()[:n_agents].tolist() == [problem.grid.depot] * n_agents
        env.reset(options={"problem": problem})
        assert env.unwrapped.state()[:n_agents].tolist() == list(starts)


def test_compiled_and_plain_kernels_play_the_same() -> None:
    """With NUMBA_DISABLE_JIT=1 pools, starts, landmark actions and ways home are the same bits."""
    digests = []
    for disabled in ("0", "1"):
        done = subprocess.run(
            [sys.executable, "tests/engine/digest_pools.py"],
            capture_output=True,
            text=True,
            cwd=REPOSITORY,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), "NUMBA_DISABLE_JIT": disabled},
            check=False,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        digests.append(done.stdout.strip())
    assert len(digests[0]) == 64
    assert digests[0] == digests[1]

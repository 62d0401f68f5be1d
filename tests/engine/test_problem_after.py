"""The problem that is left in the middle of an episode is that episode's rest."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from model import lively_action
from model_pools import Game, random_game, random_landmarks, random_starts

import mapp_env
from mapp_env import mapp_v0

GAMES = range(16)


def played(seed: int, limit: int | None) -> tuple[Game, mapp_env.Problem, list[Any]]:
    """Return a problem with starts and an episode of it: (joint action, reward, model's state)."""
    rng = random.Random(seed)
    rows = random_game(seed).pool[0]
    game = Game((rows,), random_game(seed).n_agents, random_game(seed).n_landmarks, allow_wait=True)
    cells = random_landmarks(rng, rows, game.n_landmarks)
    starts = random_starts(rng, game.episode(0, cells)) if seed % 3 else None
    model = game.episode(0, cells, starts, 200 if limit is None else limit)
    grid = mapp_env.Grid.from_text("\n".join(rows) + "\n")
    problem = mapp_env.Problem(grid, cells, game.n_agents, limit, starts)
    steps = []
    while not model.ended:
        joint = lively_action(model, rng)
        reward, *_ = model.step(joint)
        steps.append((joint, reward, list(model.cells), list(model.visited)))
    return game, problem, steps


@pytest.mark.parametrize("limit", [None, 200])
@pytest.mark.parametrize("seed", GAMES)
def test_what_is_left_is_what_the_model_has_left(seed: int, limit: int | None) -> None:
    """Unvisited landmarks in their order, agents' cells, the steps left; None if all are visited.

    The problem itself is as before, and no step at all leaves what it was.
    """
    _, problem, steps = played(seed, limit)
    joint = [list(step[0]) for step in steps]
    for count, (_, _, cells, visited) in enumerate(steps, 1):
        left = problem.after(joint[:count])
        if all(visited):
            assert left is None
            break
        unvisited = [
            cell for cell, seen in zip(problem.landmarks, visited, strict=True) if not seen
        ]
        if limit is not None and count == limit:
            break
        assert left is not None
        assert left.landmarks == tuple(unvisited)
        assert left.starts == left.start_cells == tuple(cells)
        assert left.max_cycles == (None if limit is None else limit - count)
        assert (left.grid, left.n_agents) == (problem.grid, problem.n_agents)
    for nothing in ([], np.empty((0, problem.n_agents), int)):
        same = problem.after(nothing)
        assert same == problem
        assert same is not None
        assert same.start_cells == problem.start_cells


@pytest.mark.parametrize("seed", GAMES)
def test_two_parts_are_the_whole(seed: int) -> None:
    """What is left after some steps, and then some more, is what is left after all of them."""
    _, problem, steps = played(seed, None)
    joint = np.array([step[0] for step in steps])
    rng = random.Random(seed)
    for _ in range(4):
        first = rng.randrange(len(joint))
        second = rng.randrange(first, len(joint))
        middle = problem.after(joint[:first])
        assert middle is not None
        left, whole = middle.after(joint[first:second]), problem.after(joint[:second])
        assert left == whole
        assert left is not None
        assert whole is not None
        assert left.start_cells == whole.start_cells
    assert (problem.after(joint) is None) == all(steps[-1][-1])


@pytest.mark.parametrize("reward", ["manhattan", "geodesic", "step"])
@pytest.mark.parametrize("seed", GAMES)
def test_playing_on_from_what_is_left_is_playing_on(seed: int, reward: str) -> None:
    """Reset on what is left, the environment gives the same rewards, ends and cells from there."""
    game, problem, steps = played(seed, 30)
    settings: dict[str, Any] = {"n_agents": game.n_agents, "reward": reward, "allow_wait": True}
    count = len(steps) // 2
    left = problem.after([step[0] for step in steps[:count]])
    assert left is not None
    whole = mapp_v0.parallel_env(grid=problem.grid, n_landmarks=len(problem.landmarks), **settings)
    rest = mapp_v0.parallel_env(grid=problem.grid, n_landmarks=len(left.landmarks), **settings)
    whole.reset(options={"problem": problem})
    for joint, *_ in steps[:count]:
        whole.step(dict(zip(whole.agents, joint, strict=True)))
    rest.reset(options={"problem": left})
    for joint, *_ in steps[count:]:
        said = [env.step(dict(zip(env.agents, joint, strict=True)))[1:4] for env in (whole, rest)]
        assert said[0] == said[1]
        cells = [env.state()[: game.n_agents].tolist() for env in (whole, rest)]
        assert cells[0] == cells[1]
    assert not whole.agents
    assert not rest.agents


def test_refusals() -> None:
    """Actions that are none, or more steps than the limit with landmarks left, are refused."""
    grid = mapp_env.Grid.from_text("D....\n")
    problem = mapp_env.Problem(grid, (4,), 2, 3)
    for wrong in ([[0, 5]], [[0]], [[0, -1]], [[0, 0.5]], 3, [[0, 0, 0]], "00"):
        with pytest.raises(ValueError, match="joint_actions"):
            problem.after(wrong)  # type: ignore[arg-type]
    for count in (3, 4):
        with pytest.raises(ValueError, match=r"joint_actions.*limit.*3"):
            problem.after([[0, 0]] * count)
    left = problem.after([[1, 0]] * 2)
    assert left is not None
    assert (left.max_cycles, left.starts) == (1, (2, 0))

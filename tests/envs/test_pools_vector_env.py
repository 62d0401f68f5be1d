"""A batch over a pool is its rows, bit for bit, and a pool of one grid is that grid."""

from __future__ import annotations

import copy
import pickle
import random
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from model import OBSERVATIONS
from model_pools import Game, random_game, random_landmarks, random_starts

import mapp_env
from mapp_env import mapp_v0

MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)

# Walls, depots and sizes differ; a random walk on each ends both ways.
POOL_ROWS = (
    ("...", ".D#", "...", "#.."),
    (".....D",),
    ("..", "D.", "#.", ".."),
    ("D...#.", "....#.", "..####"),
)
POOL = [mapp_env.Grid.from_text("\n".join(rows) + "\n") for rows in POOL_ROWS]
# Distances of all pairs are not kept for such a grid, but those of each landmark.
LARGE = mapp_env.Grid.from_text("\n".join(["D" + "." * 65, *["." * 66] * 64]) + "\n")

FORMS: dict[str, dict[str, Any]] = {
    "moves": {},
    "moves home": {
        "return_home": True, "allow_wait": True, "reward": "step", "n_landmarks": 1,
        "max_cycles": 30,
    },
    "landmarks": {"actions": "landmarks", "reward": "geodesic"},
    "landmarks home": {"actions": "landmarks", "return_home": True},
}  # fmt: skip


def settings(form: str = "moves", **changes: Any) -> dict[str, Any]:
    """Return the arguments of a small, lively environment over the pool."""
    base = {"grid": POOL, "n_agents": 2, "n_landmarks": 3, "max_cycles": 12}
    return {**base, **FORMS[form], **changes}


def make_sync(n_rows: int, mode: AutoresetMode, **arguments: Any) -> SyncVectorEnv:
    """Return Gymnasium's own vector environment over single Central environments."""

    def make() -> gymnasium.Env:
        return gymnasium.make(
            "mapp_env/Central-v0",
            disable_env_checker=True,
            **{"central_action": "multi", **arguments},
        )

    return SyncVectorEnv([make] * n_rows, autoreset_mode=mode)


def random_actions(rng: np.random.Generator, envs: Any, infos: dict[str, Any]) -> np.ndarray:
    """Return a batch of actions, most of them of those that the mask advises."""
    shape = envs.action_space.shape
    advised = (rng.random((*shape, envs.single_action_space.nvec[0])) * infos["action_mask"]) > 0
    chance = rng.random(advised.shape)
    return (chance + 2 * advised * (rng.random((*shape, 1)) < 0.8)).argmax(axis=-1)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_rows_equal_sync_vector_env(kind: str, form: str, mode: AutoresetMode, same: Any) -> None:
    """Observations, rewards, flags and whole infos, grids too, equal SyncVectorEnv's."""
    n_rows, ends, successes, grids = 6, 0, 0, set()
    arguments = settings(form, observation=kind)
    if form == "landmarks":
        arguments["max_cycles"] = 5  # else nearly all of them are solved
    ours = mapp_env.make_vec(n_rows, autoreset_mode=mode, **arguments)
    result = ours.reset(seed=21)
    theirs = make_sync(n_rows, mode, **arguments)
    for name in ("single_observation_space", "observation_space", "single_action_space"):
        assert getattr(ours, name) == getattr(theirs, name)
    same(result, theirs.reset(seed=[int(seed) for seed in ours.np_random_seed]))
    rng = np.random.default_rng(3)
    for _ in range(110):
        actions = random_actions(rng, ours, result[-1])
        result = ours.step(actions)
        same(result, theirs.step(actions.copy()))
        _, _, terminations, truncations, infos = result
        ended = terminations | truncations
        ends += int(ended.sum())
        successes += int(terminations.sum())
        grids.update(infos["grid"].tolist())
        if mode == AutoresetMode.DISABLED and ended.any():
            mask = {"reset_mask": ended.copy()}
            result = ours.reset(options=dict(mask))
            same(result, theirs.reset(options=dict(mask)))
            result[-1]["action_mask"][:] = 1
    assert grids == set(range(len(POOL)))
    assert ends >= 3 * n_rows
    assert 0 < successes < ends


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("form", ["moves home", "landmarks", "landmarks home"])
@pytest.mark.parametrize("kind", ["geodesic", "distances"])
def test_pools_with_large_grids_equal_sync_vector_env(
    kind: str, form: str, mode: AutoresetMode, same: Any
) -> None:
    """The same where a grid is too large for all pairs: distances are those of each row's grid."""
    arguments = settings(
        form, observation=kind, reward="geodesic", grid=[POOL[0], LARGE, POOL[3]], max_cycles=6
    )
    ours = mapp_env.make_vec(5, autoreset_mode=mode, **arguments)
    result = ours.reset(seed=8)
    theirs = make_sync(5, mode, **arguments)
    same(result, theirs.reset(seed=[int(seed) for seed in ours.np_random_seed]))
    rng, grids = np.random.default_rng(3), set()
    for _ in range(30):
        actions = random_actions(rng, ours, result[-1])
        result = ours.step(actions)
        same(result, theirs.step(actions.copy()))
        ended = result[2] | result[3]
        grids.update(result[-1]["grid"].tolist())
        if mode == AutoresetMode.DISABLED and ended.any():
            mask = {"reset_mask": ended.copy()}
            result = ours.reset(options=dict(mask))
            same(result, theirs.reset(options=dict(mask)))
            result[-1]["action_mask"][:] = 1
    assert grids == {0, 1, 2}


def row_options(rng: random.Random, game: Game, n_rows: int, form: str) -> list[dict[str, Any]]:
    """Return options of each row, in one of the forms."""
    found: list[dict[str, Any]] = []
    for _ in range(n_rows):
        grid = rng.randrange(len(game.pool))
        cells = random_landmarks(rng, game.pool[grid], game.n_landmarks)
        starts = random_starts(rng, game.episode(grid, cells))
        own = mapp_env.Grid.from_text("\n".join(game.pool[grid]) + "\n")
        problem = mapp_env.Problem(own, cells, game.n_agents, rng.randint(1, 9), starts)
        found.append(
            {
                "grid": {"grid": grid},
                "landmarks": {"grid": grid, "landmarks": list(cells)},
                "pairs": {
                    "grid": grid,
                    "landmarks": [divmod(cell, len(game.pool[grid][0])) for cell in cells],
                },
                "problem": {"problem": problem},
            }[form]
        )
    return found


def batch_options(rows: list[dict[str, Any]], as_array: bool) -> dict[str, Any]:
    """Return the same as options of a batch."""
    options: dict[str, Any] = {}
    for name in rows[0]:
        values = [row[name] for row in rows]
        options[name] = np.array(values) if as_array and name != "problem" else values
    if "landmarks" in options:
        options["landmarks"] = np.array(options["landmarks"])
    return options


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("form", ["grid", "landmarks", "pairs", "problem"])
def test_options_of_each_row_are_its_own(form: str, mode: AutoresetMode, same: Any) -> None:
    """Row i, reset with its part of the options, is the single environment reset with that."""
    for seed in range(12):
        game, rng, n_rows = random_game(seed), random.Random(seed), 5
        arguments = {
            "grid": [mapp_env.Grid.from_text("\n".join(rows) + "\n") for rows in game.pool],
            **game.settings(observation=OBSERVATIONS[seed % 5]),
        }
        envs = mapp_env.make_vec(n_rows, autoreset_mode=mode, **arguments)
        envs.reset(seed=seed)
        singles = [
            gymnasium.make(
                "mapp_env/Central-v0", central_action="multi", disable_env_checker=True, **arguments
            )
            for _ in range(n_rows)
        ]
        for env, own in zip(singles, envs.np_random_seed, strict=True):
            env.reset(seed=int(own))
        given = row_options(rng, game, n_rows, form)
        batch, infos = envs.reset(options=batch_options(given, seed % 2 == 0))
        for row, env in enumerate(singles):
            observation, info = env.reset(options=given[row])
            same(observation, batch[row])
            same(info["action_mask"], infos["action_mask"][row])
            assert info["grid"] == infos["grid"][row]
        actions, ended = np.random.default_rng(seed), np.zeros(n_rows, bool)
        while not ended.any():
            joint = actions.integers(game.n_actions, size=(n_rows, game.n_agents))
            batch, rewards, terminations, truncations, infos = envs.step(joint)
            ended = terminations | truncations
            for row, env in enumerate(singles):
                observation, reward, terminated, truncated, info = env.step(joint[row])
                assert rewards[row] == reward
                assert (terminations[row], truncations[row]) == (terminated, truncated)
                if not ended[row]:  # else what is shown depends on the mode
                    same(observation, batch[row])
                    same(info["action_mask"], infos["action_mask"][row])
                    assert info["grid"] == infos["grid"][row]


def test_options_hold_for_one_episode_and_rows_of_the_mask(same: Any) -> None:
    """Options of rows outside of the mask are not looked at, and no row keeps its options."""
    envs = mapp_env.make_vec(4, autoreset_mode="SameStep", **settings(max_cycles=2))
    twin = mapp_env.make_vec(4, autoreset_mode="SameStep", **settings(max_cycles=2))
    for each in (envs, twin):
        each.reset(seed=1)
    mask = np.array([True, False, True, False])
    for options in ({"grid": [3, 0, 1, 0]}, {"grid": [3, 2, 1, 1]}):
        same(
            envs.reset(options={**options, "reset_mask": mask}),
            twin.reset(options={"grid": [3, 3, 1, 3], "reset_mask": mask}),
        )
    grids = set()
    for _ in range(30):
        found = envs.step(np.zeros((4, 2), int))
        same(found, twin.step(np.zeros((4, 2), int)))
        grids.add(tuple(found[-1]["grid"].tolist()))
    assert len(grids) > 8


FACES: dict[str, Callable[..., Any]] = {
    "parallel": mapp_v0.parallel_env,
    "aec": mapp_v0.env,
    "central": lambda **more: gymnasium.make("mapp_env/Central-v0", **more),
    "tuple": lambda **more: gymnasium.make("mapp_env/Tuple-v0", **more),
    **{mode.name: lambda mode=mode, **more: mapp_env.make_vec(3, autoreset_mode=mode, **more)
       for mode in MODES},
}  # fmt: skip


def without_grid(item: Any) -> Any:
    """Return a nested result without what infos say of grids."""
    if isinstance(item, dict):
        return {k: without_grid(v) for k, v in item.items() if k not in ("grid", "_grid")}
    if isinstance(item, (list, tuple)):
        return type(item)(without_grid(part) for part in item)
    return item


def run(env: Any, face: str, steps: int, seed: int | None) -> list[Any]:
    """Play random actions, resetting where an episode ends; return copies of all that is said."""
    rng = np.random.default_rng(7)
    said: list[Any] = [env.reset(seed=seed)] if seed is not None else []
    ended: Any = np.zeros(3, bool)
    for _ in range(steps):
        if face == "parallel":
            if not env.agents:
                said.append(env.reset())
            joint = {a: int(rng.integers(env.action_space(a).n)) for a in env.agents}
            said.append((env.step(joint), env.state()))
        elif face == "aec":
            if not env.agents:
                env.reset()
            said.append((env.last(), env.state()))
            agent = env.agent_selection
            over = env.terminations[agent] or env.truncations[agent]
            env.step(None if over else int(rng.integers(env.action_space(agent).n)))
        elif face in ("central", "tuple"):
            env.action_space.seed(int(rng.integers(2**31)))
            said.append(env.step(env.action_space.sample()))
            if said[-1][2] or said[-1][3]:
                said.append(env.reset())
        else:
            if face == "DISABLED" and ended.any():
                said.append(env.reset(options={"reset_mask": ended.copy()}))
            said.append(
                env.step(rng.integers(env.single_action_space.nvec, size=env.action_space.shape))
            )
            ended = said[-1][2] | said[-1][3]
    return copy.deepcopy(said)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("face", FACES)
def test_a_pool_of_one_is_its_grid(face: str, form: str, same: Any) -> None:
    """In every face, bit for bit but for the grid in infos, whatever is observed."""
    for number, kind in enumerate(OBSERVATIONS):
        grid = (*POOL, LARGE)[number]
        changes = {"observation": kind, "max_cycles": 9}
        single = FACES[face](**settings(form, grid=grid, **changes))
        pool = FACES[face](**settings(form, grid=[grid], **changes))
        first, second = run(single, face, 40, 5), run(pool, face, 40, 5)
        same(without_grid(second), first)
        if face != "tuple":
            assert "grid" in repr(second)
        for name in ("observation_space", "action_space", "state_space"):
            if hasattr(single, name) and face not in ("parallel", "aec"):
                assert getattr(single, name) == getattr(pool, name)


@pytest.mark.parametrize("copier", ["pickle", "deepcopy"])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("face", FACES)
def test_copies_in_mid_episode_continue_identically(
    face: str, form: str, copier: str, same: Any
) -> None:
    """A copy, stepped first, plays on, draws on, and shares nothing with the original."""
    for pool in (POOL, [POOL[0], LARGE, POOL[1]]):
        env = FACES[face](
            **settings(form, grid=pool, max_cycles=8, observation="distances", reward="geodesic")
        )
        run(env, face, 11, 4)
        twin = pickle.loads(pickle.dumps(env)) if copier == "pickle" else copy.deepcopy(env)
        for each in (twin, env):
            if face == "aec":  # a wrapper's own order of calls goes on with the copy
                assert each.agents == env.agents
            if hasattr(each, "action_space") and face in ("central", "tuple"):
                each.action_space.seed(1)
        first = run(twin, face, 40, None)
        same(first, run(env, face, 40, None))


def test_large_batches_and_pools() -> None:
    """A thousand grids, a row each: every row plays on the grid that its info names."""
    rng = random.Random(0)
    grids = []
    for _ in range(1000):
        rows, cols = rng.randint(2, 9), rng.randint(2, 9)
        walls = np.array([[rng.random() < 0.2 for _ in range(cols)] for _ in range(rows)])
        walls[0, :2] = False
        grids.append(mapp_env.Grid(walls, depot=0))
    envs = mapp_env.make_vec(1000, grid=grids, n_agents=2, n_landmarks=1)
    cells, infos = envs.reset(seed=0, options={"grid": np.arange(1000)[::-1]})
    assert infos["grid"].tolist() == list(range(1000))[::-1]
    ended, actions = np.zeros(1000, bool), np.random.default_rng(0)
    for _ in range(60):
        here, joint = cells[:, :2].astype(int), actions.integers(4, size=(1000, 2))
        cells, _, terminations, truncations, infos = envs.step(joint)
        for row, index in enumerate(infos["grid"]):
            grid = grids[index]
            wanted = [grid.depot] * 2 if ended[row] else grid.moves[here[row], joint[row]].tolist()
            assert cells[row, :2].tolist() == wanted
        ended = terminations | truncations
    assert len(set(infos["grid"].tolist())) > 500


def test_of_equal_grids_a_problem_takes_the_first() -> None:
    """A pool may hold a grid twice: a problem on it is on the first, a number means its own."""
    twice = [POOL[1], POOL[0], mapp_env.Grid.from_text("\n".join(POOL_ROWS[0]) + "\n")]
    problem = mapp_env.Problem(twice[2], (0, 1, 2), 2)
    env = mapp_v0.parallel_env(**settings(grid=twice))
    assert env.reset(options={"problem": problem})[1]["agent_0"]["grid"] == 1
    assert env.reset(options={"grid": 2})[1]["agent_0"]["grid"] == 2
    envs = mapp_env.make_vec(2, **settings(grid=twice))
    assert envs.reset(options={"problem": [problem] * 2})[1]["grid"].tolist() == [1, 1]
    assert envs.reset(options={"grid": [2, 1]})[1]["grid"].tolist() == [2, 1]
    assert {env.reset(seed=seed)[1]["agent_0"]["grid"] for seed in range(30)} == {0, 1, 2}

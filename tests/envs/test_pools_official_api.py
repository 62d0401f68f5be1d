"""The official tests pass with pools, landmark actions and the way home, without a warning."""

from __future__ import annotations

import functools
import json
import warnings
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from model import OBSERVATIONS

import mapp_env
from mapp_env import mapp_v0

with warnings.catch_warnings():  # these import PettingZoo's own environments the deprecated way
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
    from pettingzoo.test import max_cycles_test as official_max_cycles_test
    from pettingzoo.test.state_test import state_test as official_state_test

POOL = (
    mapp_env.make_grid("paper-7x7"),
    mapp_env.Grid.from_text("....#\n.##.#\nD....\n"),
    mapp_env.Grid.from_text("..\n.#\n..\n.D\n..\n..\n..\n..\n..\n"),
)

over_the_forms = pytest.mark.parametrize(
    "settings",
    [
        pytest.param(
            {
                "grid": POOL, "observation": kind, "n_agents": count, "actions": actions,
                "return_home": home,
            },
            id=f"{kind}-{count}-{actions}-{'home' if home else 'visit'}",
        )
        for kind in OBSERVATIONS
        for count in (1, 3)
        for actions in ("moves", "landmarks")
        for home in (False, True)
    ],
)  # fmt: skip


@pytest.fixture(autouse=True)
def warnings_are_failures() -> Iterator[None]:
    """Turn every warning inside these tests into an error, whatever the configuration says."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@over_the_forms
def test_parallel_api(settings: dict[str, Any]) -> None:
    """PettingZoo's parallel_api_test passes without a warning."""
    parallel_api_test(mapp_v0.parallel_env(**settings), num_cycles=40)


@over_the_forms
def test_aec_api(settings: dict[str, Any]) -> None:
    """PettingZoo's api_test, the stricter one, passes on the AEC face without a warning."""
    api_test(mapp_v0.env(**settings), num_cycles=60)


@over_the_forms
def test_seeding(settings: dict[str, Any]) -> None:
    """PettingZoo's seed_test and parallel_seed_test find equal environments for equal seeds."""
    seed_test(functools.partial(mapp_v0.env, **settings), num_cycles=30)
    parallel_seed_test(functools.partial(mapp_v0.parallel_env, **settings), num_cycles=30)


@over_the_forms
def test_state(settings: dict[str, Any]) -> None:
    """PettingZoo's state_test finds every state inside state_space, on both faces."""
    official_state_test(mapp_v0.env(**settings), mapp_v0.parallel_env(**settings), num_cycles=60)


@over_the_forms
def test_gymnasium_checker(settings: dict[str, Any]) -> None:
    """Gymnasium's check_env accepts Central-v0 unwrapped, and its passive checker plays along."""
    env = gymnasium.make("mapp_env/Central-v0", **settings)
    check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=3)
    for _ in range(20):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()


@over_the_forms
def test_spaces_hold_every_observation(settings: dict[str, Any]) -> None:
    """Episodes on all grids stay inside the one space, on the parallel and the batched face."""
    env = mapp_v0.parallel_env(**settings)
    rng = np.random.default_rng(0)
    for grid in range(len(POOL)):
        observations, _ = env.reset(seed=5, options={"grid": grid})
        while env.agents:
            for agent, observation in observations.items():
                assert env.observation_space(agent).contains(observation)
                assert np.isfinite(observation).all()
            actions = {agent: rng.integers(env.action_space(agent).n) for agent in env.agents}
            observations, *_ = env.step(actions)
    envs = mapp_env.make_vec(4, **settings)
    batch, _ = envs.reset(seed=5)
    for _ in range(60):
        assert envs.observation_space.contains(batch)
        nvec = envs.single_action_space.nvec
        batch, *_ = envs.step(rng.integers(nvec, size=envs.action_space.shape))


@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_max_cycles(actions: str) -> None:
    """PettingZoo's max_cycles_test: both faces end exactly at the limit."""
    grid = [POOL[0], mapp_env.Grid(np.zeros((9, 8), bool))]
    settings = {"n_landmarks": 30, "grid": grid, "actions": actions, "return_home": True}
    module = SimpleNamespace(
        parallel_env=functools.partial(mapp_v0.parallel_env, **settings),
        env=functools.partial(mapp_v0.env, **settings),
    )
    official_max_cycles_test(module)


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_observations_reach_their_bounds(kind: str) -> None:
    """No bound of the space is wider than some grid of the pool needs, where values are cells."""
    env = mapp_v0.parallel_env(grid=POOL, n_agents=2, n_landmarks=3, observation=kind)
    space = env.observation_space("agent_0")
    if kind == "planes":
        assert space.shape == (6, 9, 7)
        assert (space.low.min(), space.high.max()) == (0, 1)
    elif kind in ("global", "own_first"):
        assert space.shape == (2 + 3 + 3,)
        assert space.high.tolist() == [48] * 5 + [1] * 3
    elif kind == "distances":
        assert space.shape == (3 + 3 + 9 + 3 + 3,)
        assert not space.low.any()
        assert (space.high[-3:] == 1).all()
    assert env.state_space.high.tolist() == [48] * 5 + [1] * 3


@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_masks_are_what_actions_are_drawn_with(actions: str) -> None:
    """Actions drawn with the masks of all Gymnasium faces are in their spaces, and play on."""
    settings: dict[str, Any] = {"grid": POOL, "actions": actions, "return_home": True}
    for name in ("Central", "Tuple"):
        more = {"central_action": "multi"} if name == "Central" else {}
        env = gymnasium.make(f"mapp_env/{name}-v0", **more, **settings)
        env.action_space.seed(0)
        _, info = env.reset(seed=0)
        for _ in range(60):
            mask = info.get("action_mask")
            mask = env.unwrapped.action_masks if mask is None else mask
            action = env.action_space.sample(tuple(mask))
            assert all(row[one] for row, one in zip(mask, action, strict=True))
            *_, terminated, truncated, info = env.step(action)
            if terminated or truncated:
                _, info = env.reset()


def test_specs_with_a_pool_are_json() -> None:
    """Made anew from its spec's JSON text, an environment on a pool of one's own has that pool."""
    arguments: dict[str, Any] = {"grid": POOL, "n_landmarks": 3, "actions": "landmarks"}
    for name in ("mapp_env/Central-v0", "mapp_env/Tuple-v0"):
        env = gymnasium.make(name, **arguments)
        text = env.spec.to_json()
        json.loads(text)
        twin = gymnasium.make(type(env.spec).from_json(text))
        assert twin.unwrapped.task.grids == env.unwrapped.task.grids == tuple(POOL)


@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_supersuit_vectorises(actions: str) -> None:
    """SuperSuit's vectoriser steps teams on a pool, each with its own reward."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SuperSuit's own imports warn
        supersuit = pytest.importorskip("supersuit")
        env = mapp_v0.parallel_env(grid=POOL, actions=actions, return_home=True, max_cycles=20)
        venv = supersuit.concat_vec_envs_v1(
            supersuit.pettingzoo_env_to_vec_env_v1(env), 2, num_cpus=1, base_class="gymnasium"
        )
        observations, _ = venv.reset(seed=0)
        assert observations.shape == (6, 13)
        for _ in range(60):
            moves = np.array([venv.action_space.sample() for _ in range(6)])
            observations, rewards, *_ = venv.step(moves)
            assert len(set(rewards[:3])) == len(set(rewards[3:])) == 1
        venv.close()


@pytest.mark.parametrize("mode", ["rgb_array", "ansi"])
def test_pictures_are_of_the_episodes_grid(mode: str) -> None:
    """What is shown of an episode on a pool is what its grid alone would show, row by row too."""
    settings: dict[str, Any] = {"n_landmarks": 4, "render_mode": mode, "actions": "landmarks"}
    env = mapp_v0.parallel_env(grid=POOL, **settings)
    envs = mapp_env.make_vec(len(POOL), grid=POOL, **settings)
    envs.reset(seed=0)
    pictures = {}
    for grid in (0, 2, 1, 0):
        single = mapp_v0.parallel_env(grid=POOL[grid], **settings)
        single.reset(seed=4)
        env.reset(seed=4, options={"grid": grid})
        for _ in range(3):
            pictures[grid] = env.render()
            assert np.array_equal(pictures[grid], single.render())
            for each in (env, single):
                each.step(dict.fromkeys(each.agents, 1))
    envs.reset(seed=[4] * len(POOL), options={"grid": range(len(POOL))})
    for _ in range(2):
        envs.step(np.ones((len(POOL), 3), int))
    for grid, picture in enumerate(envs.render()):
        assert np.array_equal(picture, pictures[grid])

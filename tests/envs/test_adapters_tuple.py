"""mapp_env/Tuple-v0: the parallel environment in tuples, as EPyMARL-style trainers take it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.wrappers import TimeLimit
from model import OBSERVATIONS

from mapp_env import mapp_v0
from mapp_env.envs.tuple_env import TupleEnv


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_tuples_play_the_parallel_environment(kind: str, same: Callable[[Any, Any], None]) -> None:
    """Observations, rewards, ends, masks, state and metrics are those of the PettingZoo face."""
    settings: dict[str, Any] = {"n_landmarks": 2, "max_cycles": 30, "observation": kind}
    env, face = TupleEnv(**settings), mapp_v0.parallel_env(**settings)
    rng, ends = np.random.default_rng(0), set()
    for episode in range(12):
        seed = 3 if episode == 0 else None
        views, info = env.reset(seed=seed)
        observations, infos = face.reset(seed=seed)
        assert info == {}
        assert env.observation_space.contains(views)
        while face.agents:
            same(views, tuple(observations.values()))
            masks = np.stack([infos[agent]["action_mask"] for agent in face.possible_agents])
            same((env.action_masks, env.state()), (masks, face.state()))
            actions = rng.integers(4, size=3).tolist()
            views, rewards, terminated, truncated, info = env.step(actions)
            chosen = dict(zip(face.agents, actions, strict=True))
            observations, gains, terminations, truncations, infos = face.step(chosen)
            same(rewards, list(gains.values()))
            assert terminated is terminations["agent_0"]
            assert truncated is truncations["agent_0"]
        same(views, tuple(observations.values()))
        assert env.metrics() == infos["agent_0"]["metrics"]
        assert info == {"success": float(terminated)}
        ends.add(terminated)
    assert ends == {False, True}


class EpymarlStyle:
    """What EPyMARL's wrapper asks of an environment: flat lists, one reward, one flag."""

    def __init__(self, time_limit: int, **arguments: Any) -> None:
        made = gymnasium.make(
            "mapp_env:mapp_env/Tuple-v0", max_episode_steps=time_limit, **arguments
        )
        self.env = TimeLimit(made, max_episode_steps=time_limit)
        self.n_agents = self.env.unwrapped.n_agents
        self.length = max(space.shape[0] for space in self.env.observation_space)
        self.n_actions = max(space.n for space in self.env.action_space)

    def step(self, actions: np.ndarray) -> tuple[list[np.ndarray], float, bool, dict[str, Any]]:
        """Return observations, the summed reward, whether the episode is over, and numbers."""
        views, rewards, terminated, truncated, info = self.env.step([int(a) for a in actions])
        info = {**info, "episode_limit": truncated}
        return list(views), float(sum(rewards)), terminated or truncated, info


def test_epymarls_manner_gets_every_reward() -> None:
    """In EPyMARL's loop the last reward arrives, time-outs are told apart, infos can be summed.

    The time limit is one above the environment's: at the same step Gymnasium's TimeLimit would call
    a problem that is solved at the last moment a time-out.
    """
    settings: dict[str, Any] = {"n_landmarks": 2, "max_cycles": 15}
    env = EpymarlStyle(time_limit=16, **settings)
    face = mapp_v0.parallel_env(observation="own_first", **settings)
    assert (env.n_agents, env.length, env.n_actions) == (3, 7, 4)
    rng = np.random.default_rng(2)
    sums: dict[str, float] = {}
    solved = late = 0
    env.env.reset(seed=8)
    face.reset(seed=8)
    for _ in range(40):
        total, wanted, over = 0.0, 0.0, False
        while not over:
            actions = rng.integers(4, size=3)
            _, reward, over, info = env.step(actions)
            total += reward
            chosen = dict(zip(face.agents, actions.tolist(), strict=True))
            _, gains, terminations, truncations, _ = face.step(chosen)
            wanted += sum(gains.values())
        assert not face.agents
        assert total == wanted
        assert reward == sum(gains.values())
        assert info["episode_limit"] is truncations["agent_0"]
        solved += terminations["agent_0"]
        late += truncations["agent_0"]
        for name, value in info.items():
            sums[name] = sums.get(name, 0) + value
        env.env.reset()
        face.reset()
    assert sums == {"success": solved, "episode_limit": late}
    assert solved >= 3
    assert late >= 3


def test_last_reward_of_a_time_out_is_not_nothing() -> None:
    """The step that runs into the limit has a reward below 0 for each agent."""
    env = gymnasium.make("mapp_env/Tuple-v0", max_cycles=3)
    env.reset(seed=0, options={"landmarks": [0, 6, 20, 42, 48]})
    for _ in range(3):
        _, rewards, terminated, truncated, _ = env.step((0, 0, 0))
    assert (terminated, truncated) == (False, True)
    assert len(rewards) == 3
    assert all(reward < 0 for reward in rewards)


@pytest.mark.parametrize("action", [(0, 1), (0, 1, 4), (0, 1, -1), (0, 1, 2.0), 3, "012", None])
def test_bad_actions_are_refused(action: Any) -> None:
    """What is no action for each agent is a ValueError, and nothing moves."""
    env = TupleEnv()
    env.reset(seed=0)
    before = env.state().tolist()
    with pytest.raises(ValueError, match="action must hold 3 integers"):
        env.step(action)
    assert env.state().tolist() == before
    env.step(np.array([0, 1, 2]))
    assert env.state().tolist() != before


def test_order_of_calls() -> None:
    """Stepping and drawing need an episode; after its end stepping needs a reset."""
    env = TupleEnv(max_cycles=1, render_mode="ansi")
    with pytest.raises(ResetNeeded):
        env.step((0, 0, 0))
    with pytest.raises(ResetNeeded):
        env.render()
    env.reset(seed=0)
    assert isinstance(env.render(), str)
    env.step((0, 0, 0))
    with pytest.raises(ResetNeeded):
        env.step((0, 0, 0))
    env.close()

"""Agents that share parameters: SuperSuit's batch of agents, as Stable-Baselines3 needs it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import supersuit
from numpy.typing import NDArray

from mapp_env.adapters.sb3_rows import RowsVecEnv
from mapp_env.parallel_env import MappParallelEnv
from mapp_env.validation import MAX_SEED, check_count, describe
from mapp_env.vector_env import MAX_ENVS

__all__ = ["SharedVecEnv", "make_sb3_shared"]


class SharedVecEnv(RowsVecEnv):
    """A view of SuperSuit's vector environment in which seeds and time-outs arrive.

    Row ``i * N + a`` is agent ``a`` of environment ``i``: one network that commands every row by
    itself is shared by all agents. Each ended row's info holds ``terminal_observation``; each
    info says by ``TimeLimit.truncated`` whether the step limit has ended the row, which SuperSuit's
    own wrapper for Stable-Baselines3 leaves out (and it fails when it is seeded).

    Parameters
    ----------
    venv : gymnasium.vector.VectorEnv
        What ``supersuit.concat_vec_envs_v1(..., base_class="gymnasium")`` returns.
    n_agents : int
        Agents N of each environment.

    Raises
    ------
    ValueError
        If the rows of ``venv`` are not whole teams.
    """

    def __init__(self, venv: gymnasium.vector.VectorEnv[Any, Any, Any], n_agents: int) -> None:
        if venv.num_envs % check_count("n_agents", n_agents, 1, venv.num_envs):
            raise ValueError(
                f"n_agents must divide the {venv.num_envs} rows of venv, got {n_agents}"
            )
        self.venv = venv
        self.n_agents = n_agents
        self._seed: int | None = None
        self._actions: Any = None
        super().__init__(venv, "venv", venv.observation_space, venv.action_space)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next :meth:`reset`.

        SuperSuit gives environment ``i`` the seed ``base + i``; the base is drawn from ``seed``, so
        that seeds 0 and 1 do not share their environments.

        Returns
        -------
        list of int, length B
            Of each row: the seed that its environment is reset with.

        Raises
        ------
        ValueError
            If it is no seed.
        """
        if seed is not None:
            seed = check_count("seed", seed, 0, MAX_SEED)
        self._seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
        return [self._seed + row // self.n_agents for row in range(self.num_envs)]

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every environment; return the observations, shape (B, ...)."""
        # SuperSuit gives infos as a list, where Gymnasium has a dict of arrays.
        found: Any
        observations, found = self.venv.reset(seed=self._seed)
        self._seed = None
        self.reset_infos = list(found)
        return np.array(observations)

    def step_async(self, actions: NDArray[np.int64]) -> None:
        """Keep the actions, shape (B,), for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Move every agent.

        Returns
        -------
        observations, rewards, dones, infos
            Shapes (B, ...), (B,) float32, (B,) bool, and a list of length B. As SuperSuit leaves
            it, the ``action_mask`` of an ended row's info is that of its next episode.
        """
        found: Any
        observations, rewards, terminations, truncations, found = self.venv.step(self._actions)
        terminations, truncations = terminations.astype(bool), truncations.astype(bool)
        infos: list[dict[str, Any]] = [
            {**info, "TimeLimit.truncated": late}
            for info, late in zip(found, (truncations & ~terminations).tolist(), strict=True)
        ]
        return np.array(observations), np.array(rewards), terminations | truncations, infos


def make_sb3_shared(num_envs: int, num_cpus: int = 0, **arguments: Any) -> SharedVecEnv:
    """Return ``num_envs`` environments whose agents one Stable-Baselines3 policy commands singly.

    Parameters
    ----------
    num_envs : int
        Number of environments, each with N agents: the ``VecEnv`` has ``num_envs * N`` rows.
    num_cpus : int
        Worker processes of SuperSuit, 0 for none: a step is cheap, processes seldom pay.
    **arguments
        Those of :class:`mapp_env.parallel_env.MappParallelEnv`. Agents that start on one cell
        need to see who they are: ``observation="geodesic"`` or ``"own_first"``, not ``"global"``.

    Raises
    ------
    ValueError
        If an argument is not as said.

    Examples
    --------
    >>> from stable_baselines3 import PPO
    >>> from mapp_env.adapters.sb3_shared import make_sb3_shared
    >>> model = PPO("MlpPolicy", make_sb3_shared(16, observation="geodesic"), seed=0)
    """
    check_count("num_envs", num_envs, 1, MAX_ENVS)
    check_count("num_cpus", num_cpus, 0, num_envs)
    if arguments.get("render_mode") is not None:
        raise ValueError(
            "render_mode must be None: rows are agents, not pictures; "
            f"got {describe(arguments['render_mode'])}"
        )
    env = MappParallelEnv(**arguments)
    venv = supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(env), num_envs, num_cpus, base_class="gymnasium"
    )
    return SharedVecEnv(venv, len(env.possible_agents))

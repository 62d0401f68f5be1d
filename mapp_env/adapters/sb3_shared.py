"""Agents that share parameters: SuperSuit's batch of agents, as Stable-Baselines3 needs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
import supersuit
from numpy.typing import NDArray

from mapp_env.adapters.sb3_rows import RowsVecEnv, Stepped
from mapp_env.envs.parallel_env import MappParallelEnv
from mapp_env.envs.vector_env import MAX_ENVS
from mapp_env.validation import MAX_SEED, check_count, describe

__all__ = ["SharedVecEnv", "make_sb3_shared"]


class SharedVecEnv(RowsVecEnv):
    """A view of SuperSuit's vector environment in which seeds and time-outs arrive.

    Row ``i * N + a`` is agent ``a`` of environment ``i``: one network that commands every row by
    itself is shared by all agents. Each ended row's info holds ``terminal_observation`` and
    ``is_success``; each info says by ``TimeLimit.truncated`` whether the step limit has ended the
    row, which SuperSuit's own wrapper for Stable-Baselines3 leaves out (and it fails when it is
    seeded). With a pool, each info has ``grid``, the number of the grid that the step was played
    on, and ``reset_infos`` those of the first episodes.

    Parameters
    ----------
    venv : gymnasium.vector.VectorEnv
        What ``supersuit.concat_vec_envs_v1(..., base_class="gymnasium")`` returns, of this
        process alone: SuperSuit's worker processes seed some environments alike.
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
        self._grids: list[int | None] = []  # of a pool, of each row's present episode
        self.n_agents = n_agents
        super().__init__(venv, "venv", venv.observation_space, venv.action_space)

    @property
    def _limited(self) -> list[MappParallelEnv]:
        """The environments, one a team."""
        return [one.par_env.unwrapped for one in self.venv.vec_envs]  # type: ignore[attr-defined]

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

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Set the options of the next :meth:`reset`, for all environments alike.

        Parameters
        ----------
        options : dict, optional
            ``"landmarks"``, ``"grid"`` or ``"problem"``, as in the PettingZoo face.

        Raises
        ------
        ValueError
            If it is a list: rows are agents, and SuperSuit takes one dict for all environments.
        """
        if options is not None and not isinstance(options, Mapping):
            raise ValueError(
                f"options must be one dict for all environments, got {describe(options)}"
            )
        self._next_options = None if options is None else deepcopy(dict(options))

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every environment; return the observations, shape (B, ...).

        Raises
        ------
        ValueError
            If the options cannot be used.
        """
        # SuperSuit gives infos as a list, where Gymnasium has a dict of arrays.
        found: Any
        observations, found = self.venv.reset(seed=self._seed, options=self._next_options)
        self._seed, self._next_options = None, None
        self.reset_infos = list(found)
        self._keep_moment(found)
        return np.array(observations)

    def step_wait(self) -> Stepped:
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
        dones = terminations | truncations
        played = self._grids
        self._keep_moment(infos)
        for row in np.flatnonzero(dones).tolist():
            infos[row]["is_success"] = bool(terminations[row])
            if "grid" in infos[row]:  # SuperSuit gives the next episode's
                infos[row]["grid"] = played[row]
        return np.array(observations), np.array(rewards), dones, infos

    def _find_masks(self, masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return masks.copy()

    def _keep_moment(self, infos: Sequence[dict[str, Any]]) -> None:
        """Keep the rows' grids and a copy of the masks: infos are the caller's."""
        self._grids = [info.get("grid") for info in infos]
        self._masks = np.stack([info["action_mask"] for info in infos]).astype(np.bool_)


def make_sb3_shared(num_envs: int, **arguments: Any) -> SharedVecEnv:
    """Return ``num_envs`` environments whose agents one Stable-Baselines3 policy commands singly.

    Parameters
    ----------
    num_envs : int
        Number of environments, each with N agents: the ``VecEnv`` has ``num_envs * N`` rows.
    **arguments
        Those of :class:`mapp_env.envs.parallel_env.MappParallelEnv`, but that ``observation`` is
        ``"own_first"`` if it is not given: with ``"global"`` all see the same, and act alike.

    Raises
    ------
    ValueError
        If an argument is invalid.

    Examples
    --------
    >>> from stable_baselines3 import PPO
    >>> from mapp_env.adapters.sb3_shared import make_sb3_shared
    >>> model = PPO("MlpPolicy", make_sb3_shared(16, observation="geodesic"), seed=0)
    """
    check_count("num_envs", num_envs, 1, MAX_ENVS)
    if arguments.get("render_mode") is not None:
        raise ValueError(
            "render_mode must be None: rows are agents, not pictures; "
            f"got {describe(arguments['render_mode'])}"
        )
    env = MappParallelEnv(**{"observation": "own_first", **arguments})
    # In this process: SuperSuit's workers seed environments alike, and a step is cheap.
    venv = supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(env), num_envs, base_class="gymnasium"
    )
    return SharedVecEnv(venv, len(env.possible_agents))

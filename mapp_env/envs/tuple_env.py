"""The agents side by side in tuples: the Gymnasium form that EPyMARL-style trainers take."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mapp_env.envs.arguments import TupleTask, takes
from mapp_env.envs.face import SimulationEnv

Views = tuple[NDArray[np.float32], ...]


class TupleEnv(SimulationEnv):
    """The problem for independent or factored learners, registered as ``mapp_env/Tuple-v0``.

    Observations and actions are tuples with an entry an agent, rewards a list with the team reward
    for each, that of the last step included; ``terminated`` and ``truncated`` are of the team.
    Infos are empty but for the last step's: such trainers sum what they find there, so it holds
    one number, ``success`` (0 or 1). Masks, costs, the state and which grid of a pool the episode
    is on are attributes.

    Parameters
    ----------
    grid, n_agents, n_landmarks, max_cycles, reward, observation, allow_wait, render_mode
    actions, return_home
        As in :class:`mapp_env.envs.parallel_env.MappParallelEnv`.

    Attributes
    ----------
    n_agents : int
        Agents N.
    action_masks : ndarray of int8, shape (N, A)
        Of the present moment: 0 for a move that would bump, or a landmark that is visited.
    grid : int
        Number of the episode's grid in the pool.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """

    @takes(TupleTask)
    def __init__(self, task: TupleTask) -> None:
        super().__init__(task, task.n_agents)
        self.n_agents = task.n_agents
        space = spaces.Box(task.view.low, task.view.high, dtype=np.float32)
        self.observation_space = spaces.Tuple([space] * task.n_agents)
        self.action_space = spaces.Tuple(
            [spaces.Discrete(task.n_actions) for _ in range(task.n_agents)]
        )
        self.action_masks = np.zeros((task.n_agents, task.n_actions), np.int8)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Views, dict[str, Any]]:
        """Start an episode; ``options`` as in the PettingZoo face.

        Raises
        ------
        ValueError
            If seed or options cannot be used.
        """
        views, self.action_masks = self._start(seed, options)
        return tuple(views), {}

    def step(self, action: Sequence[int]) -> tuple[Views, list[float], bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Move all agents at the same instant.

        Parameters
        ----------
        action : sequence of int, length N
            An action for each agent.

        Returns
        -------
        observations, rewards, terminated, truncated, info
            A tuple of arrays and a list of floats, length N; flags of the team.

        Raises
        ------
        ValueError
            If an action is missing or not an action; nothing has moved then.
        gymnasium.error.ResetNeeded
            If there is no episode to step.
        """
        reward, terminated, truncated, views, self.action_masks = self._play(action)
        info = {"success": float(terminated)} if terminated or truncated else {}
        return tuple(views), [reward] * self.n_agents, terminated, truncated, info

    @property
    def grid(self) -> int:
        """Number of the episode's grid in the pool; 0 without one."""
        return self._simulation.grid

    def metrics(self) -> dict[str, bool | float]:
        """Return success, cover_time, makespan and total_distance of the episode so far.

        The costs are inf as long as a landmark is unvisited.
        """
        return self._simulation.metrics()

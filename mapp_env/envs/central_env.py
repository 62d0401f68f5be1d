"""The Gymnasium face of the meta-agent: one learner sees everything and commands every agent."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete, MultiDiscrete
from numpy.typing import NDArray

from mapp_env.engine.loops import fill_joint_mask, fill_joint_masks
from mapp_env.engine.observation import Observation
from mapp_env.envs.arguments import CentralTask, takes
from mapp_env.envs.face import SimulationEnv
from mapp_env.validation import as_integer, describe

MAX_JOINT_AGENTS = 6
"""Largest team whose joint actions are numbered one by one (4**6 = 4096)."""


def central_action_space(
    task: CentralTask,
) -> tuple[Discrete[np.int64] | MultiDiscrete, NDArray[np.int64] | None]:
    """Return the meta-agent's action space and, for numbered joint actions, their table.

    The table, shape (A**N, N), holds each agent's action for each joint action, the first agent
    most significant. Raises a ValueError if joint actions are asked for more than six agents, or
    for landmarks.
    """
    n_agents, n_actions, central_action = task.n_agents, task.n_actions, task.central_action
    if central_action == "joint" and n_agents > MAX_JOINT_AGENTS:
        raise ValueError(
            f"central_action='joint' is for at most {MAX_JOINT_AGENTS} agents, got n_agents="
            f"{n_agents}: use 'multi'"
        )
    if central_action == "joint" and task.actions == "landmarks":
        raise ValueError(
            "central_action='joint' is for actions='moves', got actions='landmarks': use 'multi'"
        )
    if central_action == "multi" or n_agents > MAX_JOINT_AGENTS or task.actions == "landmarks":
        return MultiDiscrete(np.full(n_agents, n_actions)), None
    table = np.indices((n_actions,) * n_agents).reshape(n_agents, -1).T
    return Discrete(n_actions**n_agents), np.ascontiguousarray(table, np.int64)


def central_action_masks(
    masks: NDArray[np.int8], joint_actions: NDArray[np.int64] | None
) -> NDArray[np.bool_]:
    """Return which of the meta-agent's actions bump no agent, by the agents' masks, (B, N, A).

    With the table of :func:`central_action_space`, these are the joint actions, (B, A**N); without
    it, each agent's actions, one agent after the other, (B, N * A).
    """
    if joint_actions is None:
        return masks.astype(np.bool_).reshape(len(masks), -1)
    joint = np.empty((len(masks), len(joint_actions)), np.int8)
    fill_joint_masks(masks, joint)
    return joint.view(np.bool_)


class CentralEnv(SimulationEnv):
    """The problem for one meta-agent (paper, section 5), registered as ``mapp_env/Central-v0``.

    It sees what all agents see: the global observation once, or for the other kinds the agents'
    observations stacked, shape (N, ...). ``info["action_mask"]`` is int8, shape (N, A): 0 for a
    move that would bump; with numbered joint actions ``info["joint_action_mask"]``, shape (A**N,),
    is 0 for those in which an agent would. On the last step ``info["metrics"]`` holds success,
    cover_time, makespan and total_distance.

    To draw an action that bumps nobody: ``action_space.sample(info["joint_action_mask"])``, or with
    ``MultiDiscrete`` actions ``action_space.sample(tuple(info["action_mask"]))``.

    Parameters
    ----------
    central_action : {"auto", "joint", "multi"}
        ``"joint"``: ``Discrete(A**N)``, the first agent most significant; ``"multi"``:
        ``MultiDiscrete``, one action an agent; ``"auto"``: joint up to six agents, unless actions
        are landmarks.
    grid, n_agents, n_landmarks, max_cycles, reward, observation, allow_wait, render_mode
    actions, return_home
        As in :class:`mapp_env.envs.parallel_env.MappParallelEnv`.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """

    @takes(CentralTask)
    def __init__(self, task: CentralTask) -> None:
        self._once = task.observation_kind == Observation.GLOBAL
        super().__init__(task, 1 if self._once else task.n_agents)
        view = task.central_view
        self.observation_space = Box(view.low, view.high, dtype=np.float32)
        self.action_space, self._joint_actions = central_action_space(task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; ``options`` as in the PettingZoo face.

        Raises
        ------
        ValueError
            If seed or options cannot be used.
        """
        views, masks = self._start(seed, options)
        return views[0] if self._once else views, self._find_info(masks)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Carry out a joint action.

        Raises
        ------
        ValueError
            If it is not in the action space; nothing has moved then.
        gymnasium.error.ResetNeeded
            If there is no episode to step.
        """
        reward, terminated, truncated, views, masks = self._play(action)
        info = self._find_info(masks)
        if terminated or truncated:
            info["metrics"] = self._simulation.metrics()
        return views[0] if self._once else views, reward, terminated, truncated, info

    def action_masks(self) -> NDArray[np.bool_]:
        """Return which actions bump no agent, as sb3-contrib's ``MaskablePPO`` asks for it.

        The shape is (A**N,) or, with ``MultiDiscrete`` actions, (N * A,). Raises a ResetNeeded
        before the first reset.
        """
        if not self._started:
            raise ResetNeeded("action_masks() needs an episode: call reset() first")
        _, masks = self._simulation.observe()
        found: NDArray[np.bool_] = central_action_masks(masks[None], self._joint_actions)[0]
        return found

    def _find_info(self, masks: NDArray[np.int8]) -> dict[str, Any]:
        """Return the info of a moment in which the agents have these masks, shape (N, A)."""
        info: dict[str, Any] = {"action_mask": masks}
        if self._joint_actions is not None:
            info["joint_action_mask"] = np.empty(len(self._joint_actions), np.int8)
            fill_joint_mask(masks, info["joint_action_mask"])
        self._name_grid(info)
        return info

    def _read_action(self, action: Any) -> NDArray[np.int64]:
        """Return each agent's action, shape (N,)."""
        if self._joint_actions is not None:
            number = as_integer(action)
            if number is None or not 0 <= number < len(self._joint_actions):
                raise ValueError(
                    f"action must be an integer in 0..{len(self._joint_actions) - 1}, "
                    f"got {describe(action)}"
                )
            joint: NDArray[np.int64] = self._joint_actions[number]
            return joint
        return super()._read_action(action)

"""The PettingZoo face: dictionaries in, arrays through the kernels, dictionaries out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pettingzoo
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from mapp_env.engine.task import Task
from mapp_env.envs.arguments import takes
from mapp_env.envs.face import Face
from mapp_env.validation import as_integer, describe

AgentID = str
Observations = dict[AgentID, NDArray[np.float32]]
Flags = dict[AgentID, bool]
Infos = dict[AgentID, dict[str, Any]]


class MappParallelEnv(Face, pettingzoo.ParallelEnv[AgentID, NDArray[np.float32], int]):
    """Multi-agent path planning on a walled grid: visit every landmark together, in few steps.

    Agents start on the depot and move at the same instant; a landmark is visited for good when an
    agent steps on it; when all are, the episode ends. The rules R1 to R9 are in docs/rules.md,
    after Çetinkaya, arXiv 2110.01460, sections 3 and 5.

    Parameters
    ----------
    grid : str, os.PathLike, Grid or sequence of Grid
        A bundled name, a path to a text or MovingAI ``.map`` file, or a grid. Of several grids, a
        pool, each episode draws one (R10).
    n_agents : int
        1 to 16.
    n_landmarks : int
        1 to 256.
    max_cycles : int
        Step at which an episode is truncated. The attribute may be assigned; an episode keeps the
        limit that it was reset with.
    reward : {"manhattan", "geodesic", "step"}
        Team reward: minus the sum over unvisited landmarks of the nearest agent's distance, by
        Manhattan distance (the paper's) or shortest path; or -1 a step.
    observation : {"global", "own_first", "planes", "geodesic", "distances"}
        See :mod:`mapp_env.engine.observation`.
    allow_wait : bool
        Whether there is a fifth action, to wait.
    render_mode : {None, "human", "rgb_array", "ansi"}
        How :meth:`render` shows the episode; "human" draws at every step by itself.
    actions : {"moves", "landmarks"}
        What an action is: a move, or the number of a landmark to walk one step towards on a
        shortest path, one more than there are landmarks to stay (R11).
    return_home : bool
        Whether the episode goes on until all agents are back on the depot (R12); the last landmark
        action is then to walk home.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo's own attribute; never changed here
        "name": "mapp_v0",
        **Face.metadata,
        "is_parallelizable": True,
    }

    @takes(Task)
    def __init__(self, task: Task) -> None:
        super().__init__(task, task.n_agents)
        self.possible_agents = [f"agent_{index}" for index in range(task.n_agents)]
        self.agents: list[AgentID] = []
        # One space for all agents: on a large grid its bounds are the largest arrays there are.
        space = Box(task.view.low, task.view.high, dtype=np.float32)
        self.observation_spaces = dict.fromkeys(self.possible_agents, space)
        self.action_spaces = {agent: Discrete(task.n_actions) for agent in self.possible_agents}
        self.state_space = Box(task.state_view.low, task.state_view.high, dtype=np.float32)
        self._names = tuple(self.possible_agents)
        self._numbered = tuple(enumerate(self._names))
        self._flags = {flag: dict.fromkeys(self._names, flag) for flag in (False, True)}
        self._n_actions = task.n_actions
        self._is_pool = task.is_pool
        self._actions = np.zeros(task.n_agents, np.int64)

    def observation_space(self, agent: AgentID) -> Box:
        """Return the space of an agent's observations; the same object each time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: AgentID) -> Discrete[np.int64]:
        """Return the space of an agent's actions; the same object each time."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observations, Infos]:
        """Start an episode.

        Parameters
        ----------
        seed : int, optional
            Seeds the environment's generator; without it, the generator goes on (from the
            operating system's entropy at first).
        options : dict, optional
            ``{"landmarks": cells or (row, col) pairs}`` or ``{"problem": Problem}`` fixes the
            problem, and draws nothing from the generator. With a pool, ``"grid"`` is the number of
            the grid that landmarks are on, given or drawn. Other keys are ignored,
            with a warning.

        Returns
        -------
        observations, infos : dict
            By agent; ``infos[agent]["action_mask"]`` is int8, shape (A,): 0 for a move that would
            bump, or a landmark that is visited. The mask is advice: both are allowed. With a pool,
            ``infos[agent]["grid"]`` is the number of the episode's grid.

        Raises
        ------
        ValueError
            If seed or options cannot be used.
        """
        views, masks = self._start(seed, options)
        self.agents = list(self._names)
        return self._by_agent(views, masks)

    def step(
        self, actions: Mapping[AgentID, int]
    ) -> tuple[Observations, dict[AgentID, float], Flags, Flags, Infos]:
        """Move all agents at the same instant.

        Parameters
        ----------
        actions : dict
            An action for each agent: 0 left, 1 right, 2 up, 3 down and, with ``allow_wait``,
            4 wait; or, with ``actions="landmarks"``, 0 to K. After the end of an episode an empty
            dict is accepted and gives empty dicts.

        Returns
        -------
        observations, rewards, terminations, truncations, infos : dict
            By agent. On the last step ``infos[agent]["metrics"]`` holds success, cover_time,
            makespan and total_distance (inf without success).

        Raises
        ------
        ValueError
            If an action is missing, unknown or not an action; nothing has moved then.
        gymnasium.error.ResetNeeded
            If there is no episode to step.
        """
        simulation = self._simulation
        if not simulation.running:
            if not actions and self._started:
                return {}, {}, {}, {}, {}
            raise ResetNeeded("step() needs an episode in progress: call reset() first")
        self._read_actions(actions)
        reward, terminated, truncated, views, masks = simulation.step(self._actions)
        observations, infos = self._by_agent(views, masks)
        if terminated or truncated:
            self.agents = []
            metrics = simulation.metrics()
            for info in infos.values():
                info["metrics"] = metrics.copy()
        if self.render_mode == "human":
            self.render()
        rewards = dict.fromkeys(self._names, reward)
        ends, cuts = self._flags[terminated].copy(), self._flags[truncated].copy()
        return observations, rewards, ends, cuts, infos

    def _by_agent(
        self, views: NDArray[np.float32], masks: NDArray[np.int8]
    ) -> tuple[Observations, Infos]:
        observations: Observations = {}
        infos: Infos = {}
        # By index: to iterate over an array takes three times as long, a tenth of a step.
        for index, name in self._numbered:
            observations[name] = views[index]
            infos[name] = {"action_mask": masks[index]}
        if self._is_pool:
            for info in infos.values():
                self._name_grid(info)
        return observations, infos

    def _read_actions(self, actions: Mapping[AgentID, int]) -> None:
        """Copy the agents' actions into the array that the kernel reads."""
        names, row, n_actions = self._names, self._actions, self._n_actions
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise ValueError(f"actions must be a dict of agents' actions, got {describe(actions)}")
        if len(actions) != len(names):
            self._refuse_agents(actions)
        for index, name in self._numbered:
            try:
                action = actions[name]
            except KeyError:
                self._refuse_agents(actions)
            if type(action) is not int or not 0 <= action < n_actions:
                action = self.check_action(name, action)
            row[index] = action

    def check_action(self, agent: AgentID, action: object) -> int:
        """Return an agent's action as an ``int``, or raise a ValueError if it is not one."""
        number = as_integer(action)
        if number is None or not 0 <= number < self._n_actions:
            raise ValueError(
                f"actions[{agent!r}] must be an integer in 0..{self._n_actions - 1}, "
                f"got {describe(action)}"
            )
        return number

    def _refuse_agents(self, actions: Mapping[AgentID, int]) -> None:
        missing = [name for name in self._names if name not in actions]
        unknown = [name for name in actions if name not in self._names]
        raise ValueError(
            f"actions must hold one action for each of {', '.join(self._names)}; "
            f"missing: {describe(missing)}, unknown: {describe(unknown)}"
        )

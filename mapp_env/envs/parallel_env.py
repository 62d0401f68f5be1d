"""The PettingZoo face: dictionaries in, arrays through the kernels, dictionaries out."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import pettingzoo
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Discrete
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mapp_env.engine.simulation import Simulation
from mapp_env.engine.sources import check_options
from mapp_env.engine.task import RENDER_MODES, Task
from mapp_env.grid import Grid
from mapp_env.grids import find_grid
from mapp_env.problem import MAX_CYCLES
from mapp_env.rendering.display import Display
from mapp_env.validation import MAX_SEED, as_integer, check_count, describe

__all__ = ["MappParallelEnv"]

AgentID = str
Infos = dict[AgentID, dict[str, Any]]


class MappParallelEnv(pettingzoo.ParallelEnv[AgentID, NDArray[np.float32], int]):
    """Multi-agent path planning on a walled grid: visit every landmark together, in few steps.

    Agents start on the depot and move at the same instant; a landmark is visited for good when an
    agent steps on it; when all are, the episode ends. The rules R1 to R9 are in docs/rules.md,
    after Çetinkaya, arXiv 2110.01460, sections 3 and 5.

    Parameters
    ----------
    grid : str, os.PathLike or Grid
        A bundled name, a path to a text or MovingAI ``.map`` file, or a grid.
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
    observation : {"global", "own_first", "planes", "geodesic"}
        See :mod:`mapp_env.engine.observation`.
    allow_wait : bool
        Whether there is a fifth action, to wait.
    render_mode : {None, "human", "rgb_array", "ansi"}
        How :meth:`render` shows the episode; "human" draws at every step by itself.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - PettingZoo's own attribute; never changed here
        "name": "mapp_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": 5,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        grid: str | os.PathLike[str] | Grid = "paper-7x7",
        n_agents: int = 3,
        n_landmarks: int = 5,
        max_cycles: int = 50,
        reward: str = "manhattan",
        observation: str = "global",
        allow_wait: bool = False,
        render_mode: str | None = None,
    ) -> None:
        task = Task(
            find_grid(grid),
            n_agents,
            n_landmarks,
            max_cycles,
            reward,
            observation,
            allow_wait,
            render_mode,
        )
        self.task = task
        self.render_mode = task.render_mode
        self.possible_agents = [f"agent_{index}" for index in range(task.n_agents)]
        self.agents: list[AgentID] = []
        # One space for all agents: on a large grid its bounds are the largest arrays there are.
        space = Box(task.view.low, task.view.high, dtype=np.float32)
        self.observation_spaces = dict.fromkeys(self.possible_agents, space)
        self.action_spaces = {agent: Discrete(task.n_actions) for agent in self.possible_agents}
        self.state_space = Box(task.state_view.low, task.state_view.high, dtype=np.float32)
        self._names = tuple(self.possible_agents)
        self._n_actions = task.n_actions
        self._actions = np.zeros(task.n_agents, np.int64)
        self._simulation = Simulation(task, task.n_agents)
        self._np_random: np.random.Generator | None = None
        self._started = False
        self._display = Display(task.render_mode, self.metadata["render_fps"])

    # -- what agents have --------------------------------------------------------------

    def observation_space(self, agent: AgentID) -> Box:
        """Return the space of an agent's observations; the same object each time."""
        return self.observation_spaces[agent]

    def action_space(self, agent: AgentID) -> Discrete[np.int64]:
        """Return the space of an agent's actions; the same object each time."""
        return self.action_spaces[agent]

    @property
    def max_cycles(self) -> int:
        """Step at which an episode is truncated (R7)."""
        return self._simulation.max_cycles

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        self._simulation.max_cycles = check_count("max_cycles", value, 1, MAX_CYCLES)

    def state(self) -> NDArray[np.float32]:
        """Return the global observation (R9), shape (N + 2K,) float32, whatever agents see."""
        return self._simulation.state()

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that problems are drawn from, as Gymnasium environments have it."""
        if self._np_random is None:
            self._np_random, _ = seeding.np_random()
        return self._np_random

    # -- episodes ----------------------------------------------------------------------

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[AgentID, NDArray[np.float32]], Infos]:
        """Start an episode.

        Parameters
        ----------
        seed : int, optional
            Seeds the environment's generator; without it, the generator goes on (from the
            operating system's entropy at first).
        options : dict, optional
            ``{"landmarks": cells or (row, col) pairs}`` or ``{"problem": Problem}`` fixes the
            problem, and draws nothing from the generator. Other keys are ignored.

        Returns
        -------
        observations, infos : dict
            By agent; ``infos[agent]["action_mask"]`` is int8, shape (A,): 0 for a move that would
            bump. A bump is allowed: the mask is advice.

        Raises
        ------
        ValueError
            If seed or options cannot be used.
        """
        if seed is not None:
            seed = check_count("seed", seed, 0, MAX_SEED)
        problem = check_options(self.task, options)
        if seed is not None:
            self._np_random, _ = seeding.np_random(seed)
        self._simulation.reset(problem, self.np_random)
        self._started = True
        self.agents = list(self._names)
        observations, infos = self._by_agent(*self._simulation.observe())
        if self.render_mode == "human":
            self.render()
        return observations, infos

    def step(
        self, actions: Mapping[AgentID, int]
    ) -> tuple[
        dict[AgentID, NDArray[np.float32]],
        dict[AgentID, float],
        dict[AgentID, bool],
        dict[AgentID, bool],
        Infos,
    ]:
        """Move all agents at the same instant.

        Parameters
        ----------
        actions : dict
            An action for each agent: 0 left, 1 right, 2 up, 3 down and, with ``allow_wait``,
            4 wait. After the end of an episode an empty dict is accepted and gives empty dicts.

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
        names = self._names
        if terminated or truncated:
            self.agents = []
            for info in infos.values():
                info["metrics"] = simulation.metrics()
        if self.render_mode == "human":
            self.render()
        return (
            observations,
            dict.fromkeys(names, reward),
            dict.fromkeys(names, terminated),
            dict.fromkeys(names, truncated),
            infos,
        )

    def _by_agent(
        self, views: NDArray[np.float32], masks: NDArray[np.int8]
    ) -> tuple[dict[AgentID, NDArray[np.float32]], Infos]:
        observations: dict[AgentID, NDArray[np.float32]] = {}
        infos: Infos = {}
        # By index: to iterate over an array takes three times as long, a tenth of a step.
        for index, name in enumerate(self._names):
            observations[name] = views[index]
            infos[name] = {"action_mask": masks[index]}
        return observations, infos

    def _read_actions(self, actions: Mapping[AgentID, int]) -> None:
        """Copy the agents' actions into the array that the kernel reads."""
        names, row, n_actions = self._names, self._actions, self._n_actions
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise ValueError(f"actions must be a dict of agents' actions, got {describe(actions)}")
        if len(actions) != len(names):
            self._refuse_agents(actions)
        for index, name in enumerate(names):
            try:
                action = actions[name]
            except KeyError:
                self._refuse_agents(actions)
            if type(action) is not int or not 0 <= action < n_actions:
                action = self.check_action(name, action)
            row[index] = action

    def check_action(self, agent: AgentID, action: object) -> int:
        """Return an agent's action as an ``int``.

        Raises
        ------
        ValueError
            If it is not one of the agent's actions.
        """
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

    # -- pictures ----------------------------------------------------------------------

    def render(self) -> NDArray[np.uint8] | str | None:
        """Show the episode as ``render_mode`` says.

        Returns
        -------
        ndarray of uint8, shape (H, W, 3), or str, or None
            For "rgb_array", "ansi" and "human".

        Raises
        ------
        gymnasium.error.ResetNeeded
            Before the first reset.
        """
        if not self._started:
            raise ResetNeeded("render() needs an episode: call reset() first")
        if self.render_mode is None:
            logger.warn("render() shows nothing: make the environment with a render_mode")
        return self._display.show(self._simulation.scene())

    def close(self) -> None:
        """Close the window, if there is one; may be called again."""
        self._display.close()

"""What the faces of one problem at a time have in common: episodes, step limit and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mapp_env.engine.options import OPTIONS, warn_of_unknown
from mapp_env.engine.simulation import Simulation
from mapp_env.engine.task import RENDER_MODES, Task
from mapp_env.problem import MAX_CYCLES
from mapp_env.rendering.display import Display
from mapp_env.validation import MAX_SEED, as_integer, check_count, describe


class Face:
    """An environment over one simulation; ``task`` and ``n_views`` are the simulation's."""

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 5}  # noqa: RUF012
    _np_random: np.random.Generator | None = None
    _np_random_seed: int | None = None

    def __init__(self, task: Task, n_views: int) -> None:
        self.task = task
        self.render_mode = task.render_mode
        self._simulation = Simulation(task, n_views)
        self._started = False
        self._display = Display(task.render_mode, self.metadata["render_fps"])

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that problems are drawn from, as Gymnasium environments have it."""
        if self._np_random is None:
            self._np_random, self._np_random_seed = seeding.np_random()
        return self._np_random

    @np_random.setter
    def np_random(self, value: np.random.Generator) -> None:
        self._np_random, self._np_random_seed = value, -1  # as Gymnasium says "unknown"

    @property
    def max_cycles(self) -> int:
        """Step at which an episode is truncated (R7); may be assigned, from the next reset on."""
        return self._simulation.max_cycles

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        self._simulation.max_cycles = check_count("max_cycles", value, 1, MAX_CYCLES)

    def state(self) -> NDArray[np.float32]:
        """Return the global observation (R9), shape (N + 2K,) float32, whatever agents see."""
        return self._simulation.state()

    def _start(
        self, seed: int | None, options: Mapping[str, Any] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Start an episode; return views, shape (V, ...), and action masks, shape (N, A)."""
        if seed is not None:
            seed = check_count("seed", seed, 0, MAX_SEED)
        asked = self._simulation.check_options(options)
        warn_of_unknown(options, OPTIONS)
        if seed is not None:
            self._np_random, self._np_random_seed = seeding.np_random(seed)
        self._simulation.reset(asked, self.np_random)
        self._started = True
        if self.render_mode == "human":
            self.render()
        return self._simulation.observe()

    def _name_grid(self, info: dict[str, Any]) -> None:
        """Add to an info, in an environment with a pool, which of its grids the episode is on."""
        if self.task.is_pool:
            info["grid"] = self._simulation.grid

    def render(self) -> Any:
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


class SimulationEnv(Face, gymnasium.Env[Any, Any]):
    """The same for Gymnasium; its subclasses say what is observed."""

    def _play(self, action: Any) -> tuple[float, bool, bool, NDArray[np.float32], NDArray[np.int8]]:
        """Carry out an action; return what :meth:`Simulation.step` does."""
        if not self._simulation.running:
            raise ResetNeeded("step() needs an episode in progress: call reset() first")
        found = self._simulation.step(self._read_action(action))
        if self.render_mode == "human":
            self.render()
        return found

    def _read_action(self, action: Any) -> NDArray[np.int64]:
        """Return each agent's action, shape (N,), of one action an agent, or raise a ValueError."""
        n_agents, highest = self.task.n_agents, self.task.n_actions - 1
        several = isinstance(action, Sequence) or np.ndim(action) == 1
        numbers = [as_integer(one) for one in action] if several else []
        if len(numbers) != n_agents or not all(
            number is not None and 0 <= number <= highest for number in numbers
        ):
            raise ValueError(
                f"action must hold {n_agents} integers in 0..{highest}, one per agent, "
                f"got {describe(action)}"
            )
        return np.array(numbers, np.int64)

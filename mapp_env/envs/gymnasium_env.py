"""What the Gymnasium faces of one problem at a time have in common: episodes and pictures."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import gymnasium
import numpy as np
from gymnasium import logger
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from mapp_env.engine.simulation import Simulation
from mapp_env.engine.sources import check_options
from mapp_env.engine.task import RENDER_MODES, Task
from mapp_env.problem import MAX_CYCLES
from mapp_env.rendering.display import Display
from mapp_env.validation import MAX_SEED, check_count

__all__ = ["SimulationEnv"]


class SimulationEnv(gymnasium.Env[Any, Any]):
    """A Gymnasium environment over one simulation; its faces say what is seen and how one acts.

    Parameters
    ----------
    task : Task
        What is simulated.
    n_views : int
        Observations V a step: the number of agents, or 1 for the global one once.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 5}  # noqa: RUF012

    def __init__(self, task: Task, n_views: int) -> None:
        self.task = task
        self.render_mode = task.render_mode
        self._simulation = Simulation(task, n_views)
        self._started = False
        self._display = Display(task.render_mode, self.metadata["render_fps"])

    @property
    def max_cycles(self) -> int:
        """Step at which an episode is truncated (R7); may be assigned, from the next reset on."""
        return self._simulation.max_cycles

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        self._simulation.max_cycles = check_count("max_cycles", value, 1, MAX_CYCLES)

    def _start(
        self, seed: int | None, options: dict[str, Any] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Start an episode; return views, shape (V, ...), and action masks, shape (N, A)."""
        if seed is not None:
            seed = check_count("seed", seed, 0, MAX_SEED)
        problem = check_options(self.task, options)
        super().reset(seed=seed)
        self._simulation.reset(problem, self.np_random)
        self._started = True
        if self.render_mode == "human":
            self.render()
        return self._simulation.observe()

    def _play(self, action: Any) -> tuple[float, bool, bool, NDArray[np.float32], NDArray[np.int8]]:
        """Carry out an action; return what :meth:`Simulation.step` does."""
        if not self._simulation.running:
            raise ResetNeeded("step() needs an episode in progress: call reset() first")
        found = self._simulation.step(self._read_action(action))
        if self.render_mode == "human":
            self.render()
        return found

    @abstractmethod
    def _read_action(self, action: Any) -> NDArray[np.int64]:
        """Return each agent's action, shape (N,), or raise a ValueError."""

    def render(self) -> Any:
        """Show the episode as ``render_mode`` says; see the PettingZoo face.

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

"""One problem at a time: the state behind the scalar faces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.loops import step_and_observe
from mapp_env.engine.options import Asked, check_options
from mapp_env.engine.rows import Rows
from mapp_env.engine.scene import Scene
from mapp_env.engine.sources import Source
from mapp_env.engine.task import Task

FIRST_ROW = np.zeros(1, np.int64)
VIEWS, MASKS = np.dtype(np.float32), np.dtype(np.int8)  # faster to pass than types


class Simulation:
    """A single row, from reset to the end of its episode.

    A step has V observations: ``n_views`` is N, or 1 to write the global one once.
    """

    def __init__(self, task: Task, n_views: int) -> None:
        self.task = task
        self.running = False  # whether step() may be called
        self._source = Source(task)
        self._rows = Rows(task, 1, n_views)
        self._limit = task.max_cycles
        self._views_shape, self._masks_shape = self._rows.views_shape, self._rows.masks_shape
        self._shape = (n_views, *task.view.shape)
        self._records = task.render_mode is not None
        self._bind()

    @property
    def max_cycles(self) -> int:
        """Step limit of the episodes to come that do not bring their own."""
        return self._rows.max_cycles

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        self._rows.max_cycles = value

    def _bind(self) -> None:
        """Gather what a step reads: to look it up would take longer than the step."""
        self._row, self._world = self._rows.array[0], self._rows.world

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy; the row must be a view of the copied rows, not a copy of the view."""
        self.__dict__.update(state)
        self._bind()

    def check_options(self, options: Mapping[str, Any] | None) -> Asked:
        """Return what options ask for."""
        return check_options(self._source, self.task, options)

    def reset(self, asked: Asked, np_random: np.random.Generator) -> None:
        """Start an episode as asked; what is drawn takes a single word of ``np_random``."""
        problems = asked.problems
        if problems is None:
            word = np_random.integers(2**64, dtype=np.uint64)
            problems = self._source.draw(np.array([word], np.uint64), asked.grids)
        self._rows.start(FIRST_ROW, problems)
        self._limit = int(self._rows.limits[0])
        self.running = True

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[float, bool, bool, NDArray[np.float32], NDArray[np.int8]]:
        """Carry out a joint action, shape (N,).

        Returns the team's reward, terminated and truncated (R6, R7), and fresh observations, shape
        (V, ...), and action masks, shape (N, A). Raises a ValueError if an action is not valid;
        nothing has moved then.
        """
        views = np.empty(self._views_shape, VIEWS)
        masks = np.empty(self._masks_shape, MASKS)
        reward, terminated, truncated = step_and_observe(
            self._row, actions, self._limit, views, masks, self._world
        )
        if terminated or truncated:
            self.running = False
        if self._records:
            self._rows.extend_trails(FIRST_ROW)
        if len(self._shape) > 2:
            views = views.reshape(self._shape)
        return reward, terminated, truncated, views, masks

    def observe(self) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Return fresh observations, shape (V, ...), and action masks, shape (N, A)."""
        views, masks = self._rows.observe()
        return views.reshape(self._shape), masks[0]

    def state(self) -> NDArray[np.float32]:
        """Return the global observation (R9), shape (N + 2K,)."""
        state: NDArray[np.float32] = self._rows.state.head[0].astype(np.float32)
        return state

    @property
    def grid(self) -> int:
        """Which of the task's grids the episode is on."""
        return int(self._rows.grids[0])

    def metrics(self) -> dict[str, bool | float]:
        """Return success and the three costs of the episode (R8), inf if it was not solved."""
        return metrics_of(self._rows.measure(FIRST_ROW)[0])

    def scene(self) -> Scene:
        """Return what a picture of this moment shows."""
        return self._rows.scene(0)


def metrics_of(costs: NDArray[np.float64]) -> dict[str, bool | float]:
    """Return by name cover time, makespan and total distance, inf if not solved, shape (3,)."""
    cover_time, makespan, total_distance = costs.tolist()
    return {
        "success": cover_time != np.inf,
        "cover_time": cover_time,
        "makespan": makespan,
        "total_distance": total_distance,
    }

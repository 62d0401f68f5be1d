"""One problem at a time: the state behind the scalar faces, stepped by the kernels of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.dynamics import action_masks, fill_fields, measure_rows, reset_rows, step_row
from mapp_env.observation import Observation, observe_rows
from mapp_env.problem import Problem
from mapp_env.rendering.scene import Scene
from mapp_env.task import Task

__all__ = ["Simulation", "metrics_of", "scene_of"]

FIRST_ROW = np.zeros(1, np.int64)


class Simulation:
    """One row, from reset to the end of its episode.

    Parameters
    ----------
    task : Task
        What is simulated.

    Attributes
    ----------
    max_cycles : int
        Step limit of the episodes that do not bring their own.
    running : bool
        Whether :meth:`step` may be called.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self.max_cycles = task.max_cycles
        self.running = False
        self._limit = task.max_cycles
        self._rows = np.zeros((1, task.row_length), np.int32)
        self._distances = task.new_distances(1)
        self._trail: list[tuple[int, ...]] | None = None if task.render_mode is None else []
        # What the kernel of a step takes besides the actions, gathered once: attribute look-ups
        # would take a tenth of a step.
        self._row = self._rows[0]
        self._sizes = (task.n_agents, task.n_landmarks)
        self._rules = (int(task.reward_kind), task.table, self._distances, task.first_field)

    def reset(self, problem: Problem | None, np_random: np.random.Generator) -> None:
        """Start an episode on ``problem``, or on one drawn with a single word of ``np_random``."""
        task = self.task
        word = np.zeros(1, np.uint64)
        if problem is None:
            word[0] = np_random.integers(2**64, dtype=np.uint64)
        reset_rows(
            self._rows, FIRST_ROW, word, task.grid.reachable, task.grid.depot, *self._sizes
        )
        self._limit = self.max_cycles
        if problem is not None:
            self._row[task.n_agents : task.n_agents + task.n_landmarks] = problem.landmarks
            if problem.max_cycles is not None:
                self._limit = problem.max_cycles
        if task.needs_fields:
            queue = np.empty(task.grid.n_cells, np.int32)
            fill_fields(self._rows, FIRST_ROW, task.table, *self._sizes, self._distances, queue)
        if self._trail is not None:
            self._trail = [self.cells()]
        self.running = True

    def step(self, actions: NDArray[np.int64]) -> tuple[float, bool, bool]:
        """Carry out a valid joint action, shape (N,); return reward, terminated, truncated."""
        result = step_row(self._row, actions, *self._sizes, self._limit, *self._rules)
        self.running = not (result[1] or result[2])
        if self._trail is not None:
            self._trail.append(self.cells())
        return result

    def observe(self, n_views: int) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Return fresh observations, shape (V, ...), and action masks, shape (N, A).

        ``n_views`` is the number of agents, or 1 for the global observation once.
        """
        task = self.task
        shape = task.view.shape
        out = np.empty((1, n_views, task.view.low.size), np.float32)
        masks = np.empty((1, task.n_agents, task.n_actions), np.int8)
        kind = int(task.observation_kind)
        observe_rows(
            self._rows, kind, *self._sizes, task.table, self._distances, task.first_field, out
        )
        action_masks(self._rows, task.n_agents, task.table, masks)
        return out.reshape(n_views, *shape), masks[0]

    def state(self) -> NDArray[np.float32]:
        """Return the global observation (R9), shape (N + 2K,)."""
        return self._row[: self.task.state_length].astype(np.float32)

    def cells(self) -> tuple[int, ...]:
        """Return the cells that the agents stand on."""
        return tuple(self._row[: self.task.n_agents].tolist())

    def metrics(self) -> dict[str, bool | float]:
        """Return success and the three costs of the episode (R8), inf if it was not solved."""
        costs = np.empty((1, 3))
        measure_rows(self._rows, FIRST_ROW, *self._sizes, self.task.table, costs)
        return metrics_of(costs[0])

    def scene(self) -> Scene:
        """Return what a picture of this moment shows."""
        return scene_of(self.task, self._row, self._trail or [self.cells()], self._limit)


def scene_of(
    task: Task, row: NDArray[np.int32], trail: list[tuple[int, ...]], max_cycles: int
) -> Scene:
    """Return what a picture of a row shows.

    Parameters
    ----------
    task : Task
        What is simulated.
    row : ndarray of int32, shape (row_length,)
        The moment.
    trail : list of tuple of int
        The agents' cells at each step so far.
    max_cycles : int
        The episode's step limit.
    """
    numbers = row.tolist()
    visited = task.n_agents + task.n_landmarks
    return Scene(
        grid=task.grid,
        landmarks=tuple(numbers[task.n_agents : visited]),
        visited=tuple(bool(flag) for flag in numbers[visited : task.state_length]),
        cells=tuple(numbers[: task.n_agents]),
        trails=tuple(zip(*trail, strict=True)),
        step=numbers[task.state_length],
        max_cycles=max_cycles,
    )


def metrics_of(costs: NDArray[np.float64]) -> dict[str, bool | float]:
    """Return the metrics of an episode by name.

    Parameters
    ----------
    costs : ndarray of float64, shape (3,)
        Cover time, makespan and total distance, inf if not every landmark was visited.
    """
    cover_time, makespan, total_distance = costs.tolist()
    return {
        "success": cover_time != np.inf,
        "cover_time": cover_time,
        "makespan": makespan,
        "total_distance": total_distance,
    }

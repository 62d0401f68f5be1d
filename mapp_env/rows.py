"""Problems in progress: the state of B rows, and the loops that run the rules over them."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.dynamics import measure_row, reset_row, row_length, step_row
from mapp_env.grid import fill_distances
from mapp_env.observation import observe_row
from mapp_env.problem import draw_landmarks
from mapp_env.scene import TRAIL_MOVES, Scene
from mapp_env.task import Task

__all__ = ["Rows", "find_bad_action", "step_and_observe"]


class Rows:
    """The state of B problems of one task.

    Parameters
    ----------
    task : Task
        What is played.
    n_rows : int
        Number of problems B.
    n_views : int
        Observations V of a row: the number of agents, or 1 for the global one once.

    Attributes
    ----------
    state : ndarray of int32, shape (B, row_length)
        See :mod:`mapp_env.dynamics`.
    limits : ndarray of int64, shape (B,)
        Step limit of each row's episode.
    """

    def __init__(self, task: Task, n_rows: int, n_views: int) -> None:
        self.task = task
        self.n_rows = n_rows
        self.state = np.zeros((n_rows, row_length(task.n_agents, task.n_landmarks)), np.int32)
        self.limits = np.full(n_rows, task.max_cycles, np.int64)
        self._every_row = np.arange(n_rows)
        # What the kernels take at every call, gathered once: for a single row, looking it up would
        # take longer than a step.
        n_fields = n_rows * task.n_landmarks if task.needs_fields else 0
        self._fields = np.empty((n_fields, task.grid.n_cells), np.int32)
        self.sizes = (task.n_agents, task.n_landmarks)
        self.reward = int(task.reward_kind)
        self.kind = int(task.observation_kind)
        self.tables = self._find_tables()
        self.views_shape = (n_views, task.view.low.size)
        self.masks_shape = (task.n_agents, task.n_actions)
        # Pictures show where agents have been: their cells at each step, for each row.
        self._trails: list[deque[tuple[int, ...]]] | None = None
        if task.render_mode is not None:
            self._trails = [deque(maxlen=TRAIL_MOVES + 1) for _ in range(n_rows)]

    def _find_tables(self) -> tuple[Any, ...]:
        """Return the table and the distances of reward and views that the kernels read."""
        task, fields = self.task, self._fields
        return (task.table, *task.reward_distances(fields), *task.view_distances(fields))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy; what the kernels read must be views of it, not copies of views."""
        self.__dict__.update(state)
        self.tables = self._find_tables()

    def start(
        self,
        indices: NDArray[np.int64],
        words: NDArray[np.uint64] | None,
        landmarks: NDArray[np.int32] | None = None,
        limit: int | None = None,
    ) -> None:
        """Start an episode in some rows.

        Parameters
        ----------
        indices : ndarray of int64, shape (M,)
            The rows.
        words : ndarray of uint64, shape (M,), or None
            Random words that the landmarks are drawn from.
        landmarks : ndarray of int32, shape (M, K), optional
            The landmarks, if they are not to be drawn.
        limit : int, optional
            Step limit of these episodes; by default the task's.
        """
        task = self.task
        if landmarks is None:
            landmarks = np.empty((len(indices), task.n_landmarks), np.int32)
        else:
            words = None
        _reset_rows(
            self.state,
            indices,
            np.empty(0, np.uint64) if words is None else words,
            landmarks,
            task.grid.reachable,
            task.grid.depot,
            *self.sizes,
        )
        if task.needs_fields:
            queue = np.empty(task.grid.n_cells, np.int32)
            _fill_fields(self.state, indices, task.table, *self.sizes, self._fields, queue)
        self.limits[indices] = task.max_cycles if limit is None else limit
        if self._trails is not None:
            for index in indices:
                self._trails[index].clear()
            self.extend_trails(indices)

    def step(
        self, actions: NDArray[np.int64], skip: NDArray[np.bool_]
    ) -> tuple[
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        NDArray[np.float32],
        NDArray[np.int8],
    ]:
        """Carry out a valid joint action in each row but those to skip, and look at all.

        Parameters
        ----------
        actions : ndarray of int64, shape (B, N)
            One action an agent.
        skip : ndarray of bool, shape (B,)
            Rows that stay as they are; their reward is 0 and their flags are down.

        Returns
        -------
        rewards, terminations, truncations : ndarray, shape (B,)
            float64, bool, bool.
        views, masks : ndarray of float32, shape (B, V, F), and of int8, shape (B, N, A)
            Fresh observations, flat, and action masks.
        """
        rewards = np.empty(self.n_rows)
        terminations = np.empty(self.n_rows, np.bool_)
        truncations = np.empty(self.n_rows, np.bool_)
        views = np.empty((self.n_rows, *self.views_shape), np.float32)
        masks = np.empty((self.n_rows, *self.masks_shape), np.int8)
        _step_rows(
            self.state,
            actions,
            skip,
            self.limits,
            *self.sizes,
            self.reward,
            self.kind,
            *self.tables,
            rewards,
            terminations,
            truncations,
            views,
            masks,
        )
        if self._trails is not None:
            self.extend_trails(np.flatnonzero(~skip))
        return rewards, terminations, truncations, views, masks

    def observe(
        self, indices: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Return fresh views, shape (M, V, F), and masks, shape (M, N, A), of some or all rows."""
        indices = self._every_row if indices is None else indices
        views = np.empty((len(indices), *self.views_shape), np.float32)
        masks = np.empty((len(indices), *self.masks_shape), np.int8)
        _observe_rows(
            self.state,
            indices,
            *self.sizes,
            self.kind,
            self.tables[0],
            *self.tables[3:],
            views,
            masks,
        )
        return views, masks

    def measure(self, indices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return cover time, makespan and total distance (R8), inf if unsolved, shape (M, 3)."""
        costs = np.empty((len(indices), 3))
        _measure_rows(self.state, indices, *self.sizes, self.task.table, costs)
        return costs

    def extend_trails(self, indices: NDArray[np.int64]) -> None:
        """Note where the agents of some rows are, for pictures; nothing without a render mode."""
        if self._trails is not None:
            for index in indices:
                cells = self.state[index, : self.task.n_agents].tolist()
                self._trails[index].append(tuple(cells))

    def scene(self, index: int) -> Scene:
        """Return what a picture of a row shows."""
        task = self.task
        row = self.state[index].tolist()
        visited = task.n_agents + task.n_landmarks
        cells = tuple(row[: task.n_agents])
        trail = [cells] if self._trails is None else self._trails[index]
        return Scene(
            grid=task.grid,
            landmarks=tuple(row[task.n_agents : visited]),
            visited=tuple(bool(flag) for flag in row[visited : task.state_length]),
            cells=cells,
            trails=tuple(zip(*trail, strict=True)),
            step=row[task.state_length],
            max_cycles=int(self.limits[index]),
        )


@kernel
def step_and_observe(
    row: NDArray[np.int32],
    actions: NDArray[np.int64],
    max_cycles: int,
    n_agents: int,
    n_landmarks: int,
    reward: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    view_distances: NDArray[np.int32],
    first_view_field: int,
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> tuple[float, bool, bool]:
    """Step a row and look at it; parameters as in ``step_row`` and ``observe_row``."""
    result: tuple[float, bool, bool] = step_row(
        row,
        actions,
        n_agents,
        n_landmarks,
        max_cycles,
        reward,
        table,
        distances,
        first_field,
    )
    observe_row(
        row,
        n_agents,
        n_landmarks,
        kind,
        table,
        view_distances,
        first_view_field,
        views,
        masks,
    )
    return result


@kernel
def _step_rows(
    rows: NDArray[np.int32],
    actions: NDArray[np.int64],
    skip: NDArray[np.bool_],
    limits: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    reward: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    view_distances: NDArray[np.int32],
    first_view_field: int,
    rewards: NDArray[np.float64],
    terminations: NDArray[np.bool_],
    truncations: NDArray[np.bool_],
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> None:
    for index in range(rows.shape[0]):
        field = _field_of(index, first_field, n_landmarks)
        view_field = _field_of(index, first_view_field, n_landmarks)
        if skip[index]:
            rewards[index] = 0.0
            terminations[index] = False
            truncations[index] = False
            observe_row(
                rows[index],
                n_agents,
                n_landmarks,
                kind,
                table,
                view_distances,
                view_field,
                views[index],
                masks[index],
            )
        else:
            rewards[index], terminations[index], truncations[index] = step_and_observe(
                rows[index],
                actions[index],
                limits[index],
                n_agents,
                n_landmarks,
                reward,
                kind,
                table,
                distances,
                field,
                view_distances,
                view_field,
                views[index],
                masks[index],
            )


@kernel
def _observe_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> None:
    for place, index in enumerate(indices):
        field = _field_of(index, first_field, n_landmarks)
        observe_row(
            rows[index],
            n_agents,
            n_landmarks,
            kind,
            table,
            distances,
            field,
            views[place],
            masks[place],
        )


@kernel
def _field_of(index: int, first_field: int, n_landmarks: int) -> int:
    """Return what a row takes for ``first_field``: a line of its own if there are fields."""
    return first_field if first_field < 0 else index * n_landmarks


@kernel
def _reset_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    words: NDArray[np.uint64],
    landmarks: NDArray[np.int32],
    candidates: NDArray[np.int32],
    depot: int,
    n_agents: int,
    n_landmarks: int,
) -> None:
    """Reset rows on given landmarks, or, where there are words, on landmarks drawn with them."""
    for place, index in enumerate(indices):
        if words.shape[0] > 0:
            draw_landmarks(words[place], candidates, landmarks[place])
        reset_row(rows[index], landmarks[place], depot, n_agents, n_landmarks)


@kernel
def _measure_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    table: NDArray[np.int32],
    costs: NDArray[np.float64],
) -> None:
    for place, index in enumerate(indices):
        cover_time, makespan, distance = measure_row(rows[index], n_agents, n_landmarks, table)
        costs[place, 0] = cover_time
        costs[place, 1] = makespan
        costs[place, 2] = distance


@kernel
def _fill_fields(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    table: NDArray[np.int32],
    n_agents: int,
    n_landmarks: int,
    fields: NDArray[np.int32],
    queue: NDArray[np.int32],
) -> None:
    """Write the steps from every landmark of some rows: how grids too large for all pairs do it.

    Shapes: ``rows`` (B, row_length), ``indices`` (M,), ``fields`` (B * K, C), ``queue`` (C,).
    """
    for index in indices:
        for landmark in range(n_landmarks):
            start = rows[index, n_agents + landmark]
            fill_distances(table, start, fields[index * n_landmarks + landmark], queue)


@kernel
def find_bad_action(actions: NDArray[np.uint64], n_actions: int) -> int:
    """Return the position of the first action outside ``0..n_actions - 1``, or -1.

    Shape: ``actions`` (M,), int64 seen as uint64, so that a negative action is a huge one.
    """
    limit = np.uint64(n_actions)
    highest = np.uint64(0)
    for action in actions:
        # No early exit: the loop without one is vectorised, and bad actions are rare.
        highest = max(highest, action)
    if highest >= limit:
        for position, action in enumerate(actions):
            if action >= limit:
                return position
    return -1

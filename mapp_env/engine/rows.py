"""Problems in progress: B rows of one task."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.loops import (
    fill_fields,
    find_bad_action,
    measure_rows,
    observe_rows,
    reset_rows,
    step_and_observe_rows,
    step_rows,
)
from mapp_env.engine.scene import TRAIL_MOVES, Scene
from mapp_env.engine.sources import Problems
from mapp_env.engine.state import is_plain, new_rows, pack, split
from mapp_env.engine.task import Task
from mapp_env.problem import MAX_CYCLES


class Rows:
    """The state of B problems of one task.

    A row has V observations: ``n_views`` is N, or 1 to write the global one once.
    ``array``, (B, L) int32, holds the rows, ``state`` names its parts.
    """

    def __init__(self, task: Task, n_rows: int, n_views: int) -> None:
        self.task = task
        self.n_rows = n_rows
        self.array = new_rows(n_rows, task.n_agents, task.n_landmarks, len(task.grids))
        self.limits = np.full(n_rows, task.max_cycles, np.int64)  # of each row's episode
        self.max_cycles = task.max_cycles  # of the episodes to come that do not bring their own
        self.longest = MAX_CYCLES  # upper bound of every step limit, whoever sets it
        self.views_shape = (n_views, task.view.low.size)
        self.masks_shape = (task.n_agents, task.n_actions)
        needed = task.needs_fields
        self._fields = np.empty((n_rows * task.largest * needed, task.n_landmarks), np.int32)
        self._moves = np.concatenate([grid.moves for grid in task.grids]) if needed else None
        self._every_row = np.arange(n_rows)
        self._checked: NDArray[np.int64] | None = None
        # Pictures show where agents have been: their cells at each step, for each row.
        self._trails: list[deque[tuple[int, ...]]] | None = None
        if task.render_mode is not None:
            self._trails = [deque(maxlen=TRAIL_MOVES + 1) for _ in range(n_rows)]
        self._bind()

    def _bind(self) -> None:
        """Gather what is read at every step: for a single row, to look it up would take longer."""
        self.state = split(self.array, self.task.n_agents, self.task.n_landmarks)
        world = self.task.world(self._fields)
        self.world, self._plain = pack(world), is_plain(world)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy; what the kernels read must be views of it, not copies of views."""
        self.__dict__.update(state)
        self._bind()

    def start(self, indices: NDArray[np.int64], problems: Problems) -> None:
        """Start an episode in the rows of ``indices``, (M,), on as many problems.

        A problem that does not bring a step limit has ``max_cycles``.
        """
        limits = self.limits, self.max_cycles, self.longest
        reset_rows(self.array, indices, *problems, *limits, self.world)
        if self._moves is not None:
            scratch = np.empty((self.task.n_landmarks + 1, self.task.largest), np.int32)
            fill_fields(self.array, indices, self._moves, self._fields, scratch, self.world)
        if self._trails is not None:
            for index in indices:
                self._trails[index].clear()
            self.extend_trails(indices)

    @property
    def grids(self) -> NDArray[np.int64]:
        """The number of the grid that each row's episode is on, fresh, shape (B,)."""
        column = self.state.grid.astype(np.int64)
        return column[:, 0] if column.size else np.zeros(self.n_rows, np.int64)

    def find_bad_action(self, actions: NDArray[np.int64]) -> int:
        """Return the position of the first action, shape (B, N), that is none, or -1.

        If there is none, :meth:`step` does not check the same array again.
        """
        position: int = find_bad_action(actions.reshape(-1).view(np.uint64), self.task.n_actions)
        self._checked = actions if position < 0 else None
        return position

    def step(
        self, actions: NDArray[np.int64], skip: NDArray[np.bool_]
    ) -> tuple[
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        NDArray[np.float32],
        NDArray[np.int8],
    ]:
        """Carry out valid joint actions, (B, N), in each row but those to ``skip``; observe all.

        Rows of ``skip``, (B,), stay as they are: their reward is 0, their flags are down. Returned
        are fresh rewards, terminations and truncations, (B,), observations, flat, (B, V, F), and
        action masks, (B, N, A).

        Raises
        ------
        ValueError
            If an action is not valid; nothing has moved then. The rules index a table with actions:
            what no face has stopped would leave its memory.
        """
        if actions is not self._checked and (
            actions.shape != (self.n_rows, self.task.n_agents) or self.find_bad_action(actions) >= 0
        ):
            raise ValueError(
                f"actions must be in 0..{self.task.n_actions - 1}, one for each of "
                f"{self.task.n_agents} agents in each of {self.n_rows} rows"
            )
        self._checked = None
        rewards = np.empty(self.n_rows)
        terminations = np.empty(self.n_rows, np.bool_)
        truncations = np.empty(self.n_rows, np.bool_)
        views = np.empty((self.n_rows, *self.views_shape), np.float32)
        masks = np.empty((self.n_rows, *self.masks_shape), np.int8)
        found = rewards, terminations, truncations, views, masks
        given = self.array, actions, skip, self.limits
        if self._plain:
            step_and_observe_rows(*given, *found, self.world)
        else:
            step_rows(*given, *found[:3], self.world)
            self.observe_again(self._every_row, views, masks)
        if self._trails is not None:
            self.extend_trails(np.flatnonzero(~skip))
        return found

    def observe(self) -> tuple[NDArray[np.float32], NDArray[np.int8]]:
        """Return fresh views, shape (B, V, F), and masks, shape (B, N, A), of all rows."""
        views = np.empty((self.n_rows, *self.views_shape), np.float32)
        masks = np.empty((self.n_rows, *self.masks_shape), np.int8)
        self.observe_again(self._every_row, views, masks)
        return views, masks

    def observe_again(
        self, indices: NDArray[np.int64], views: NDArray[np.float32], masks: NDArray[np.int8]
    ) -> None:
        """Write the views and masks of some rows, shape (M,), among those of all."""
        observe_rows(self.array, indices, views, masks, self.world)

    def measure(self, indices: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return cover time, makespan and total distance (R8), inf if unsolved, shape (M, 3)."""
        costs = np.empty((len(indices), 3))
        measure_rows(self.array, indices, costs, self.world)
        return costs

    def extend_trails(self, indices: NDArray[np.int64]) -> None:
        """Note where the agents of some rows are, for pictures; nothing without a render mode."""
        if self._trails is not None:
            for index in indices:
                self._trails[index].append(tuple(self.state.cells[index].tolist()))

    def scene(self, index: int) -> Scene:
        """Return what a picture of a row shows."""
        state = self.state
        cells = tuple(state.cells[index].tolist())
        trail = [cells] if self._trails is None else self._trails[index]
        return Scene(
            grid=self.task.grids[self.grids[index]],
            landmarks=tuple(state.landmarks[index].tolist()),
            visited=tuple(state.visited[index].astype(bool).tolist()),
            cells=cells,
            trails=tuple(zip(*trail, strict=True)),
            step=int(state.step[index, 0]),
            max_cycles=int(self.limits[index]),
        )

"""Where the next problem comes from if nobody gives one: it is drawn on the task's grids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.draws import draw_grid, draw_landmarks
from mapp_env.engine.task import Task

OWN_LIMIT = -1  # of an episode that has the environment's step limit
NO_GRIDS = np.zeros(0, np.int64)  # wanted: they are drawn


class Problems(NamedTuple):
    """What M rows are started on."""

    grids: NDArray[np.int64]  # (M,), numbers of the task's grids
    landmarks: NDArray[np.int32]  # (M, K)
    cells: NDArray[np.int32]  # (M, N), where the agents start
    limits: NDArray[np.int64]  # (M,), step limits, or OWN_LIMIT

    def take(self, rows: NDArray[np.int64]) -> Problems:
        """Return those of some rows."""
        grids, landmarks, cells, limits = self
        return Problems(grids[rows], landmarks[rows], cells[rows], limits[rows])


class Source:
    """Draws the problems of a task."""

    def __init__(self, task: Task) -> None:
        self._task = task
        rooms = [grid.reachable for grid in task.grids]
        self._candidates = np.concatenate(rooms)
        self._firsts = np.cumsum([0, *(len(room) for room in rooms)])
        self._depots = np.array([grid.depot for grid in task.grids], np.int32)

    def draw(self, words: NDArray[np.uint64], grids: NDArray[np.int64] = NO_GRIDS) -> Problems:
        """Return a problem for each random word, (M,), on a grid drawn with it, or on ``grids``."""
        task, n_rows = self._task, len(words)
        problems = Problems(
            np.empty(n_rows, np.int64),
            np.empty((n_rows, task.n_landmarks), np.int32),
            np.empty((n_rows, task.n_agents), np.int32),
            np.empty(n_rows, np.int64),
        )
        _draw_rows(words, grids, self._firsts, self._candidates, self._depots, *problems)
        return problems

    def place(self, grids: NDArray[np.int64], landmarks: NDArray[np.int32]) -> Problems:
        """Return problems on landmarks, (M, K), of grids, (M,), in which all start on the depot."""
        cells = np.repeat(self._depots[grids][:, None], self._task.n_agents, axis=1)
        return Problems(grids, landmarks, cells, np.full(len(grids), OWN_LIMIT))


@kernel
def _draw_rows(
    words: NDArray[np.uint64],
    wanted: NDArray[np.int64],
    firsts: NDArray[np.int64],
    candidates: NDArray[np.int32],
    depots: NDArray[np.int32],
    grids: NDArray[np.int64],
    landmarks: NDArray[np.int32],
    cells: NDArray[np.int32],
    limits: NDArray[np.int64],
) -> None:
    """Fill in problems, on the ``wanted`` grids, (M,), or if there are none on grids drawn.

    ``firsts``, (G + 1,), part the ``candidates`` of all grids; ``depots`` are (G,).
    """
    for row, word in enumerate(words):
        grid = wanted[row] if wanted.shape[0] else draw_grid(word, depots.shape[0])
        draw_landmarks(word, candidates[firsts[grid] : firsts[grid + 1]], landmarks[row])
        grids[row] = grid
        for agent in range(cells.shape[1]):
            cells[row, agent] = depots[grid]
        limits[row] = OWN_LIMIT

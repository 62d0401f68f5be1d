"""Where the next problem comes from if nobody gives one: it is drawn on the task's grids."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.task import Task
from mapp_env.problem import LOW_32_BITS, draw_landmarks, scramble

OWN_LIMIT = -1  # of an episode that has the environment's step limit


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

    def draw(self, words: NDArray[np.uint64], grids: NDArray[np.int64] | None = None) -> Problems:
        """Return a problem for each random word, (M,), on a grid drawn with it, or on ``grids``."""
        task, n_rows = self._task, len(words)
        landmarks = np.empty((n_rows, task.n_landmarks), np.int32)
        grids = np.full(n_rows, -1) if grids is None else grids.copy()
        _draw_rows(words, self._firsts, self._candidates, grids, landmarks)
        return self.place(grids, landmarks)

    def place(self, grids: NDArray[np.int64], landmarks: NDArray[np.int32]) -> Problems:
        """Return problems on landmarks, (M, K), of grids, (M,), in which all start on the depot."""
        cells = np.repeat(self._depots[grids][:, None], self._task.n_agents, axis=1)
        return Problems(grids, landmarks, cells, np.full(len(grids), OWN_LIMIT))


@kernel
def _draw_rows(
    words: NDArray[np.uint64],
    firsts: NDArray[np.int64],
    candidates: NDArray[np.int32],
    grids: NDArray[np.int64],
    landmarks: NDArray[np.int32],
) -> None:
    """Draw a grid where it is negative, and landmarks; ``firsts`` (G + 1,) part the candidates."""
    for row, word in enumerate(words):
        if grids[row] < 0:
            grids[row] = draw_grid(word, firsts.shape[0] - 1)
        first, end = firsts[grids[row]], firsts[grids[row] + 1]
        draw_landmarks(word, candidates[first:end], landmarks[row])


@kernel
def draw_grid(word: np.uint64, n_grids: int) -> int:
    """Return one of ``n_grids`` numbers, each equally likely, by a random word (R10).

    The word is scrambled as :func:`~mapp_env.problem.draw_landmarks` does it, which counts up from
    0; here the count goes down from -1, so that the landmarks are what they are without a draw.
    """
    high = np.int64(word >> np.uint64(32))
    low = np.int64(word & np.uint64(LOW_32_BITS))
    used = 0
    pick, multiple = 0, LOW_32_BITS
    while multiple > LOW_32_BITS + 1 - n_grids:
        used -= 1
        bits = scramble(scramble((low + used * 0x9E3779B9) & LOW_32_BITS) ^ high)
        pick = bits % n_grids
        multiple = bits - pick
    return int(pick)

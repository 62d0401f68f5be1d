"""Shortest paths, compiled: a map becomes a table of moves; a search walks on the table alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel


@kernel
def fill_moves(walls: NDArray[np.bool_], moves: NDArray[np.int32]) -> None:
    """Write the cell that each move leads to, (C, 4 or more), on a grid with these walls."""
    rows, cols = walls.shape
    for row in range(rows):
        for col in range(cols):
            cell = row * cols + col
            free = not walls[row, col]
            moves[cell, 0] = cell - 1 if free and col > 0 and not walls[row, col - 1] else cell
            moves[cell, 1] = (
                cell + 1 if free and col + 1 < cols and not walls[row, col + 1] else cell
            )
            moves[cell, 2] = cell - cols if free and row > 0 and not walls[row - 1, col] else cell
            moves[cell, 3] = (
                cell + cols if free and row + 1 < rows and not walls[row + 1, col] else cell
            )


@kernel
def fill_distances(
    moves: NDArray[np.int32],
    start: int,
    steps: NDArray[np.int32],
    queue: NDArray[np.int32],
    stop: int = -1,
) -> None:
    """Breadth-first search: write the steps from a free cell to every cell, shape (C,).

    They are -1 where unreachable. ``moves``, (C, 4 or more), is a table whose first four columns
    are the moves; ``queue``, (C,), is scratch space. Beyond ``stop`` no distances are needed; those
    of all nearer cells are complete.
    """
    steps[:] = -1
    steps[start] = 0
    # The start itself is never in the queue, so that a place is left behind the last cell found:
    # each cell looked at is written there, and counted if it is new. Whether it is, is as good as
    # random, and to guess it wrong would cost more than all the rest.
    cell = np.uint32(start)
    head = np.uint32(0)
    tail = np.uint32(0)
    while cell != stop:
        ahead = np.uint32(steps[cell]) + np.uint32(1)
        for action in range(4):
            to = np.uint32(moves[cell, action])
            known = np.uint32(steps[to])  # -1 becomes more than any number of steps
            queue[tail] = to
            tail += np.uint32(known > ahead)
            steps[to] = min(known, ahead)
        if head == tail:
            return
        cell = np.uint32(queue[head])
        head += np.uint32(1)


@kernel
def trace_path(moves: NDArray[np.int32], steps: NDArray[np.int32], path: NDArray[np.int32]) -> None:
    """Fill in a path from its first cell on, to where ``steps`` is 0: one step less each time."""
    for place in range(1, path.shape[0]):
        cell = path[place - 1]
        for action in range(4):
            to = moves[cell, action]
            if steps[to] == steps[cell] - 1:
                path[place] = to
                break

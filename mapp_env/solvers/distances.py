"""Distances between the depot and landmarks: all that solvers know of a grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.grid import Grid, fill_distances
from mapp_env.problem import Problem

__all__ = ["cell_distances", "landmark_distances"]


def landmark_distances(problem: Problem) -> NDArray[np.int32]:
    """Return the shortest-path steps between the depot and the landmarks.

    One breadth-first search a cell: never all pairs of a grid's cells.

    Parameters
    ----------
    problem : Problem
        Its landmarks keep their order.

    Returns
    -------
    ndarray of int32, shape (K + 1, K + 1)
        Line and column 0 belong to the depot, ``k + 1`` to landmark ``k``. Symmetric.
    """
    cells = np.array([problem.grid.depot, *problem.landmarks], np.int64)
    return cell_distances(problem.grid, cells)


def cell_distances(grid: Grid, cells: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Return the shortest-path steps between cells that can all be reached, shape (S, S) int32."""
    distances = np.empty((len(cells), len(cells)), np.int32)
    field = np.empty(grid.n_cells, np.int32)
    queue = np.empty(grid.n_cells, np.int32)
    for line, cell in zip(distances, cells, strict=True):
        fill_distances(grid.moves, cell, field, queue)
        line[:] = field[cells]
    return distances

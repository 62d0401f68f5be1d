"""What agents see: four kinds of observation, all float32, written from rows (see ``dynamics``).

=============  ============================  ========================================================
kind           shape, per agent              what it holds
=============  ============================  ========================================================
``global``     (N + 2K,)                     R9, the paper's 13 numbers: all agents' cells, all
                                             landmarks' cells, visited flags; the same for all agents
``own_first``  (N + 2K,)                     the same with the agent's own cell first, then the others'
``planes``     (6, rows, cols)               planes: wall; depot; the agent itself; share of the other
                                             agents on the cell; unvisited landmarks; visited landmarks
``geodesic``   (8K,)                         for each landmark: 1 if unvisited; own shortest path to
                                             it; the nearest other agent's (the upper bound if there
                                             is none); share of the other agents that are nearer, or
                                             as near with a lower index; and for left, right, up, down
                                             the change of the own shortest path (-1, 0 or 1)
=============  ============================  ========================================================

Shortest paths are in steps divided by ``rows + cols``. The paper describes only ``global``
(section 5).
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapp_env.dynamics import COL, FAR, HOME, N_ACTIONS, ROW, WALL, landmark_source
from mapp_env.grid import Grid

__all__ = ["Observation", "View", "observe_rows", "view"]

N_PLANES = 6
N_FEATURES = 4 + N_ACTIONS


class Observation(IntEnum):
    """The kinds of observation; :func:`observe_rows` takes their numbers."""

    GLOBAL = 0
    OWN_FIRST = 1
    PLANES = 2
    GEODESIC = 3


class View(NamedTuple):
    """Shape and bounds of one agent's observation."""

    shape: tuple[int, ...]
    low: NDArray[np.float32]  # shape
    high: NDArray[np.float32]  # shape


def view(kind: Observation, grid: Grid, n_agents: int, n_landmarks: int) -> View:
    """Return shape and bounds of an observation kind."""
    if kind == Observation.PLANES:
        shape: tuple[int, ...] = (N_PLANES, grid.rows, grid.cols)
        return View(shape, np.zeros(shape, np.float32), np.ones(shape, np.float32))
    if kind == Observation.GEODESIC:
        farthest = grid.n_cells / (grid.rows + grid.cols)
        low = np.array([0, 0, 0, 0, *[-1] * N_ACTIONS], np.float32)
        high = np.array([1, farthest, farthest, 1, *[1] * N_ACTIONS], np.float32)
        return View((N_FEATURES * n_landmarks,), np.tile(low, n_landmarks), np.tile(high, n_landmarks))
    size = n_agents + 2 * n_landmarks
    high = np.full(size, grid.n_cells - 1, np.float32)
    high[n_agents + n_landmarks :] = 1
    return View((size,), np.zeros(size, np.float32), high)


@njit(cache=True)
def observe_rows(
    rows: NDArray[np.int32],
    kind: int,
    n_agents: int,
    n_landmarks: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    out: NDArray[np.float32],
) -> None:
    """Write the observations of all agents in all rows.

    Parameters
    ----------
    rows : ndarray of int32, shape (B, row_length)
        The rows.
    kind : int
        An :class:`Observation`.
    n_agents, n_landmarks : int
        Sizes of the problem.
    table, distances, first_field
        As in :func:`mapp_env.dynamics.step_rows`; distances are read for ``GEODESIC`` only.
    out : ndarray of float32, shape (B, V, F)
        Observations, flat. V is N, or 1 to write ``GLOBAL`` once and not for each agent.
    """
    for index in range(rows.shape[0]):
        row = rows[index]
        for agent in range(out.shape[1]):
            if kind == Observation.GLOBAL:
                for place in range(n_agents + 2 * n_landmarks):
                    out[index, agent, place] = row[place]
            elif kind == Observation.OWN_FIRST:
                _write_own_first(row, agent, n_agents, n_landmarks, out[index, agent])
            elif kind == Observation.PLANES:
                _write_planes(row, agent, n_agents, n_landmarks, table, out[index, agent])
            else:
                field = first_field if first_field < 0 else index * n_landmarks
                _write_geodesic(
                    row, agent, n_agents, n_landmarks, table, distances, field, out[index, agent]
                )


@njit(cache=True)
def _write_own_first(
    row: NDArray[np.int32],
    agent: int,
    n_agents: int,
    n_landmarks: int,
    out: NDArray[np.float32],
) -> None:
    out[0] = row[agent]
    for other in range(agent):
        out[other + 1] = row[other]
    for place in range(agent + 1, n_agents + 2 * n_landmarks):
        out[place] = row[place]


@njit(cache=True)
def _write_planes(
    row: NDArray[np.int32],
    agent: int,
    n_agents: int,
    n_landmarks: int,
    table: NDArray[np.int32],
    out: NDArray[np.float32],
) -> None:
    n_cells = table.shape[0]
    own, others, unvisited, visited = 2 * n_cells, 3 * n_cells, 4 * n_cells, 5 * n_cells
    out[own:] = 0
    for cell in range(n_cells):
        out[cell] = table[cell, WALL]
        out[n_cells + cell] = table[cell, HOME] == 0
    out[own + row[agent]] = 1
    for other in range(n_agents):
        if other != agent:
            together = 0
            for another in range(n_agents):
                together += another != agent and row[another] == row[other]
            out[others + row[other]] = together / (n_agents - 1)
    for landmark in range(n_landmarks):
        plane = visited if row[n_agents + n_landmarks + landmark] else unvisited
        out[plane + row[n_agents + landmark]] = 1


@njit(cache=True)
def _write_geodesic(
    row: NDArray[np.int32],
    agent: int,
    n_agents: int,
    n_landmarks: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    out: NDArray[np.float32],
) -> None:
    n_cells = table.shape[0]
    scale = table[n_cells - 1, ROW] + 1 + table[n_cells - 1, COL] + 1  # rows + cols
    cell = row[agent]
    for landmark in range(n_landmarks):
        source = landmark_source(row, n_agents, landmark, first_field)
        own = distances[source, cell]
        nearest = FAR
        before = 0
        for other in range(n_agents):
            if other != agent:
                distance = distances[source, row[other]]
                nearest = min(nearest, distance)
                before += distance < own or (distance == own and other < agent)
        place = N_FEATURES * landmark
        out[place] = 1 - row[n_agents + n_landmarks + landmark]
        out[place + 1] = own / scale
        out[place + 2] = min(nearest, n_cells) / scale
        out[place + 3] = before / max(n_agents - 1, 1)
        for action in range(N_ACTIONS):
            out[place + 4 + action] = distances[source, table[cell, action]] - own

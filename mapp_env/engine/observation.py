"""What agents see: four kinds of observation, all float32, written from rows (see ``dynamics``).

``global``, shape (N + 2K,)
    R9, the paper's 13 numbers: all agents' cells, all landmarks' cells, visited flags; the same
    for all agents.
``own_first``, shape (N + 2K,)
    The same with the agent's own cell first, then the others'.
``planes``, shape (6, rows, cols)
    Walls; depot; the agent itself; the share of the other agents that is on the cell; unvisited
    landmarks; visited landmarks.
``geodesic``, shape (8K,)
    For each landmark: 1 if unvisited; own shortest path to it; the nearest other agent's (the upper
    bound if there is none); the share of the other agents that are nearer, or as near with a lower
    index; and for left, right, up, down the change of the own shortest path (-1, 0 or 1). Paths are
    in steps divided by ``rows + cols``, so that the kind does not depend on the grid's size.

The paper describes ``global`` alone (section 5).
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.rules import COL, FAR, HOME, N_ACTIONS, ROW, WAIT, WALL, landmark_source
from mapp_env.grid import Grid

__all__ = ["Observation", "View", "observe_row", "view"]

N_PLANES = 6
N_FEATURES = 4 + N_ACTIONS


class Observation(IntEnum):
    """The kinds of observation; :func:`observe_row` takes their numbers."""

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
        return View(
            (N_FEATURES * n_landmarks,), np.tile(low, n_landmarks), np.tile(high, n_landmarks)
        )
    size = n_agents + 2 * n_landmarks
    high = np.full(size, grid.n_cells - 1, np.float32)
    high[n_agents + n_landmarks :] = 1
    return View((size,), np.zeros(size, np.float32), high)


@kernel
def observe_row(
    row: NDArray[np.int32],
    n_agents: int,
    n_landmarks: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> None:
    """Write the observations and action masks of all agents.

    Parameters
    ----------
    row : ndarray of int32, shape (row_length,)
        What is looked at.
    n_agents, n_landmarks, kind : int
        Sizes of the problem and an :class:`Observation`.
    table, distances, first_field
        As in :func:`mapp_env.engine.rules.step_row`; distances are read for ``GEODESIC`` only.
    views : ndarray of float32, shape (V, F)
        Observations, flat. V is N, or 1 to write ``GLOBAL`` once and not for each agent.
    masks : ndarray of int8, shape (N, A)
        Action masks: 0 for a move that would bump, 1 for any other and for waiting.
    """
    for agent in range(n_agents):
        cell = row[agent]
        for action in range(N_ACTIONS):
            masks[agent, action] = table[np.uint32(cell), action] != cell
        if masks.shape[1] > WAIT:
            masks[agent, WAIT] = 1
    for agent in range(views.shape[0]):
        if kind == Observation.GLOBAL:
            for place in range(n_agents + 2 * n_landmarks):
                views[agent, place] = row[place]
        elif kind == Observation.OWN_FIRST:
            _write_own_first(row, agent, n_agents, n_landmarks, views[agent])
        elif kind == Observation.PLANES:
            _write_planes(row, agent, n_agents, n_landmarks, table, views[agent])
        else:
            _write_geodesic(
                row, agent, n_agents, n_landmarks, table, distances, first_field, views[agent]
            )


@kernel
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


@kernel
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


@kernel
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

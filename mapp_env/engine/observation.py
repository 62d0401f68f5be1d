"""What agents see: five kinds of observation, all float32, written from rows (see ``state``).

``global``, shape (N + 2K,)
    R9, the paper's 13 numbers: all agents' cells, all landmarks' cells, visited flags; the same
    for all agents.
``own_first``, shape (N + 2K,)
    The same with the agent's own cell first, then the others'.
``planes``, shape (6, rows, cols)
    Walls; depot; the agent itself; the share of the other agents that is on the cell; unvisited
    landmarks; visited landmarks. With a pool, ``rows`` and ``cols`` are those of the largest grids,
    and what is beyond a smaller one is wall.
``geodesic``, shape (8K,)
    For each landmark: 1 if unvisited; own shortest path to it; the nearest other agent's (the upper
    bound if there is none); the share of the other agents that are nearer, or as near with a lower
    index; and for left, right, up, down the change of the own shortest path (-1, 0 or 1). Paths are
    in steps divided by ``rows + cols``, so that the kind does not depend on the grid's size.
``distances``, shape (NK + K² + 2K,)
    Shortest paths, in steps divided by ``rows + cols``: own to each landmark (K); each other
    agent's, lowest index first ((N - 1) K); between landmarks, from each to each (K²); from each
    landmark to the depot (K). Then 1 for each unvisited landmark, else 0 (K).

With a pool, ``global`` and ``own_first`` hold cells of the episode's own grid, which they do not
tell; ``geodesic`` and ``distances`` do without. The paper describes ``global`` alone (section 5).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.state import (
    COL,
    DEPOT,
    HOME,
    LANDMARKS,
    MASK,
    N_ACTIONS,
    ROW,
    WAIT,
    WALL,
    WIDTH,
    State,
    World,
    landmark_source,
    split,
    split_row,
    state_length,
)
from mapp_env.grid import FAR, Grid

N_PLANES = 6
N_FEATURES = 4 + N_ACTIONS


class Observation(IntEnum):
    """The kinds of observation."""

    GLOBAL = 0
    OWN_FIRST = 1
    PLANES = 2
    GEODESIC = 3
    DISTANCES = 4


# Those that look up shortest paths
PATH_OBSERVATIONS = (Observation.GEODESIC, Observation.DISTANCES)


class View(NamedTuple):
    """Shape and bounds of one agent's observation."""

    shape: tuple[int, ...]
    low: NDArray[np.float32]  # shape
    high: NDArray[np.float32]  # shape


def view(kind: Observation, grids: Sequence[Grid], n_agents: int, n_landmarks: int) -> View:
    """Return shape and bounds of an observation kind on any of some grids."""
    if kind == Observation.PLANES:
        shape = (N_PLANES, max(grid.rows for grid in grids), max(grid.cols for grid in grids))
        return View(shape, np.zeros(shape, np.float32), np.ones(shape, np.float32))
    if kind in PATH_OBSERVATIONS:
        farthest = max(grid.n_cells / (grid.rows + grid.cols) for grid in grids)
        if kind == Observation.GEODESIC:
            low = np.array([0, 0, 0, 0, *[-1] * N_ACTIONS] * n_landmarks, np.float32)
            high = np.array([1, farthest, farthest, 1, *[1] * N_ACTIONS] * n_landmarks, np.float32)
            return View(low.shape, low, high)
        n_ways = (n_agents + n_landmarks + 1) * n_landmarks
        high = np.array([farthest] * n_ways + [1] * n_landmarks, np.float32)
        return View(high.shape, np.zeros_like(high), high)
    size = state_length(n_agents, n_landmarks)
    high = np.full(size, max(grid.n_cells for grid in grids) - 1, np.float32)
    split(high, n_agents, n_landmarks).visited[:] = 1
    return View((size,), np.zeros(size, np.float32), high)


@kernel
def observe_row(
    row: NDArray[np.int32], world: World, views: NDArray[np.float32], masks: NDArray[np.int8]
) -> None:
    """Write the observations, flat, and the action masks of all agents.

    ``views`` is (V, F), V being N, or 1 to write ``GLOBAL`` once and not for each agent;
    ``masks``, (N, A), become 0 for a move that would bump, 1 for any other and for waiting; of
    landmarks to walk towards, 0 for those that are visited.
    """
    state = split_row(row, world.n_agents, world.n_landmarks)
    if world.actions == LANDMARKS:
        for agent in range(world.n_agents):
            for landmark in range(world.n_landmarks):
                masks[agent, landmark] = 1 - state.visited[landmark]
            masks[agent, world.n_landmarks] = 1
    else:
        _write_masks(state, world, masks)
    for agent in range(views.shape[0]):
        if world.observation == Observation.GLOBAL:
            for place in range(state.head.shape[0]):
                views[agent, place] = state.head[place]
        elif world.observation == Observation.OWN_FIRST:
            _write_own_first(state, agent, views[agent])
        elif world.observation == Observation.PLANES:
            _write_planes(state, world, agent, views[agent])
        elif world.observation == Observation.GEODESIC:
            _write_geodesic(state, world, agent, views[agent])
        else:
            _write_distances(state, world, agent, views[agent])


@kernel
def _write_masks(state: State, world: World, masks: NDArray[np.int8]) -> None:
    if masks.shape[1] == N_ACTIONS:
        words = masks.view(np.int32)  # one by one they would be a tenth of a batched step
        for agent in range(world.n_agents):
            words[agent, 0] = world.table[np.uint32(state.cells[agent]), MASK]
        return
    for agent in range(world.n_agents):
        cell = state.cells[agent]
        for action in range(N_ACTIONS):
            masks[agent, action] = world.table[np.uint32(cell), action] != cell
        masks[agent, WAIT] = 1


@kernel
def _write_own_first(state: State, agent: int, out: NDArray[np.float32]) -> None:
    out[0] = state.cells[agent]
    for other in range(agent):
        out[other + 1] = state.cells[other]
    for place in range(agent + 1, state.head.shape[0]):
        out[place] = state.head[place]


@kernel
def _write_planes(state: State, world: World, agent: int, out: NDArray[np.float32]) -> None:
    n_agents, table, width = world.n_agents, world.table, world.grids[0, WIDTH]
    size = out.shape[0] // N_PLANES
    own, others, unvisited, visited = 2 * size, 3 * size, 4 * size, 5 * size
    out[:size] = 1
    out[size:] = 0
    for cell in range(table.shape[0]):
        out[_place(table, cell, width)] = table[cell, WALL]
    out[size + _place(table, world.grids[0, DEPOT], width)] = 1
    out[own + _place(table, state.cells[agent], width)] = 1
    for other in range(n_agents):
        if other != agent:
            together = 0
            for another in range(n_agents):
                together += another != agent and state.cells[another] == state.cells[other]
            out[others + _place(table, state.cells[other], width)] = together / (n_agents - 1)
    for landmark in range(world.n_landmarks):
        plane = visited if state.visited[landmark] else unvisited
        out[plane + _place(table, state.landmarks[landmark], width)] = 1


@kernel
def _place(table: NDArray[np.int32], cell: int, width: int) -> int:
    """Return where a cell stands in a plane with rows of this width."""
    return int(table[cell, ROW] * width + table[cell, COL])


@kernel
def _write_geodesic(state: State, world: World, agent: int, out: NDArray[np.float32]) -> None:
    n_agents, table, distances = world.n_agents, world.table, world.paths
    n_cells = table.shape[0]
    scale = _half_perimeter(table)
    cell = state.cells[agent]
    for landmark in range(world.n_landmarks):
        source = landmark_source(state, landmark, world.first_path)
        own = distances[source, cell]
        nearest = FAR
        before = 0
        for other in range(n_agents):
            if other != agent:
                distance = distances[source, state.cells[other]]
                nearest = min(nearest, distance)
                before += distance < own or (distance == own and other < agent)
        place = N_FEATURES * landmark
        out[place] = 1 - state.visited[landmark]
        out[place + 1] = own / scale
        out[place + 2] = min(nearest, n_cells) / scale
        out[place + 3] = before / max(n_agents - 1, 1)
        for action in range(N_ACTIONS):
            out[place + 4 + action] = distances[source, table[cell, action]] - own


@kernel
def _write_distances(state: State, world: World, agent: int, out: NDArray[np.float32]) -> None:
    n_agents, n_landmarks, table = world.n_agents, world.n_landmarks, world.table
    scale = _half_perimeter(table)
    between = n_agents * n_landmarks
    home = between + n_landmarks * n_landmarks
    for landmark in range(n_landmarks):
        steps = world.paths[landmark_source(state, landmark, world.first_path)]
        out[landmark] = steps[state.cells[agent]] / scale
        place = n_landmarks + landmark
        for other in range(n_agents):
            if other != agent:
                out[place] = steps[state.cells[other]] / scale
                place += n_landmarks
        for other in range(n_landmarks):
            out[between + landmark * n_landmarks + other] = steps[state.landmarks[other]] / scale
        out[home + landmark] = table[state.landmarks[landmark], HOME] / scale
        out[home + n_landmarks + landmark] = 1 - state.visited[landmark]


@kernel
def _half_perimeter(table: NDArray[np.int32]) -> int:
    """Return rows + cols of a grid with this table."""
    last = table.shape[0] - 1
    return int(table[last, ROW] + 1 + table[last, COL] + 1)

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
    COLS,
    DEPOT,
    MOVES,
    N_ACTIONS,
    N_CELLS,
    ROWS,
    WIDTH,
    State,
    World,
    next_cell,
    path_steps,
    row_and_col,
    split,
    split_row,
    state_length,
    steps_home,
    ways_from,
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
    if world.actions == MOVES and masks.shape[1] == N_ACTIONS:
        words = masks.view(np.int32)  # one by one they would be a tenth of a batched step
        for agent in range(world.n_agents):
            # The four bits, each to the lowest of a byte.
            bits = np.int32(ways_from(world, state.cells[agent])) & np.int32(15)
            words[agent, 0] = bits * np.int32(0x00204081) & np.int32(0x01010101)
        return
    for agent in range(world.n_agents):
        for action in range(masks.shape[1]):
            if world.actions == MOVES:
                masks[agent, action] = ways_from(world, state.cells[agent]) >> action & 1
            else:
                masks[agent, action] = action == world.n_landmarks or state.visited[action] == 0


@kernel
def _write_own_first(state: State, agent: int, out: NDArray[np.float32]) -> None:
    out[0] = state.cells[agent]
    for other in range(agent):
        out[other + 1] = state.cells[other]
    for place in range(agent + 1, state.head.shape[0]):
        out[place] = state.head[place]


@kernel
def _write_planes(state: State, world: World, agent: int, out: NDArray[np.float32]) -> None:
    n_agents = world.n_agents
    size = out.shape[0] // N_PLANES
    own, others, unvisited, visited = 2 * size, 3 * size, 4 * size, 5 * size
    out[:size] = 1
    out[size:] = 0
    for cell in range(world.grids[world.grid, N_CELLS]):
        out[_place(world, cell)] = ways_from(world, cell) == 0
    out[size + _place(world, world.grids[world.grid, DEPOT])] = 1
    out[own + _place(world, state.cells[agent])] = 1
    for other in range(n_agents):
        if other != agent:
            together = 0
            for another in range(n_agents):
                together += another != agent and state.cells[another] == state.cells[other]
            out[others + _place(world, state.cells[other])] = together / (n_agents - 1)
    for landmark in range(world.n_landmarks):
        plane = visited if state.visited[landmark] else unvisited
        out[plane + _place(world, state.landmarks[landmark])] = 1


@kernel
def _place(world: World, cell: int) -> int:
    """Return where a cell stands in a plane."""
    row, col = row_and_col(world, cell)
    return int(row * world.grids[world.grid, WIDTH] + col)


@kernel
def _write_geodesic(state: State, world: World, agent: int, out: NDArray[np.float32]) -> None:
    n_agents, n_cells = world.n_agents, world.grids[world.grid, N_CELLS]
    scale = world.grids[world.grid, ROWS] + world.grids[world.grid, COLS]
    cell = state.cells[agent]
    for landmark in range(world.n_landmarks):
        own = path_steps(state, world, landmark, cell)
        nearest = FAR
        before = 0
        for other in range(n_agents):
            if other != agent:
                distance = path_steps(state, world, landmark, state.cells[other])
                nearest = min(nearest, np.int32(distance))
                before += distance < own or (distance == own and other < agent)
        place = N_FEATURES * landmark
        out[place] = 1 - state.visited[landmark]
        out[place + 1] = own / scale
        out[place + 2] = min(nearest, n_cells) / scale
        out[place + 3] = before / max(n_agents - 1, 1)
        for action in range(N_ACTIONS):
            to = next_cell(world, cell, action)
            out[place + 4 + action] = path_steps(state, world, landmark, to) - own


@kernel
def _write_distances(state: State, world: World, agent: int, out: NDArray[np.float32]) -> None:
    n_agents, n_landmarks = world.n_agents, world.n_landmarks
    scale = world.grids[world.grid, ROWS] + world.grids[world.grid, COLS]
    between = n_agents * n_landmarks
    home = between + n_landmarks * n_landmarks
    flags = home + n_landmarks
    place = 0
    for rank in range(n_agents):
        # Oneself first, then the others, lowest index first.
        other = agent if rank == 0 else rank - 1 + (rank > agent)
        for landmark in range(n_landmarks):
            out[place] = path_steps(state, world, landmark, state.cells[other]) / scale
            place += 1
    for landmark in range(n_landmarks):
        cell = state.landmarks[landmark]
        for other in range(n_landmarks):
            steps = path_steps(state, world, other, cell)
            out[between + landmark * n_landmarks + other] = steps / scale
        out[home + landmark] = steps_home(world, cell) / scale
        out[flags + landmark] = 1 - state.visited[landmark]

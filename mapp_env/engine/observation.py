"""What agents see: four kinds of observation, all float32, written from rows (see ``state``).

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
from mapp_env.engine.state import (
    ALL_PAIRS,
    COL,
    HOME,
    MASK,
    N_ACTIONS,
    NO_DISTANCES,
    ROW,
    WAIT,
    WALL,
    State,
    World,
    landmark_source,
    path_distances,
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


PATH_OBSERVATIONS = (Observation.GEODESIC,)  # those that look up shortest paths


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
        low = np.array([0, 0, 0, 0, *[-1] * N_ACTIONS] * n_landmarks, np.float32)
        high = np.array([1, farthest, farthest, 1, *[1] * N_ACTIONS] * n_landmarks, np.float32)
        return View(low.shape, low, high)
    size = state_length(n_agents, n_landmarks)
    high = np.full(size, grid.n_cells - 1, np.float32)
    split(high, n_agents, n_landmarks).visited[:] = 1
    return View((size,), np.zeros(size, np.float32), high)


def view_distances(
    kind: Observation, grid: Grid, fields: NDArray[np.int32]
) -> tuple[NDArray[np.int32], int]:
    """Return the distances that an observation looks up, as ``rules.reward_distances`` does."""
    if kind in PATH_OBSERVATIONS:
        return path_distances(grid, fields)
    return NO_DISTANCES, ALL_PAIRS


@kernel
def observe_row(
    row: NDArray[np.int32], world: World, views: NDArray[np.float32], masks: NDArray[np.int8]
) -> None:
    """Write the observations, flat, and the action masks of all agents.

    ``views`` is (V, F), V being N, or 1 to write ``GLOBAL`` once and not for each agent;
    ``masks``, (N, A), become 0 for a move that would bump, 1 for any other and for waiting.
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
        else:
            _write_geodesic(state, world, agent, views[agent])


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
    n_agents, table = world.n_agents, world.table
    n_cells = table.shape[0]
    own, others, unvisited, visited = 2 * n_cells, 3 * n_cells, 4 * n_cells, 5 * n_cells
    out[own:] = 0
    for cell in range(n_cells):
        out[cell] = table[cell, WALL]
        out[n_cells + cell] = table[cell, HOME] == 0
    out[own + state.cells[agent]] = 1
    for other in range(n_agents):
        if other != agent:
            together = 0
            for another in range(n_agents):
                together += another != agent and state.cells[another] == state.cells[other]
            out[others + state.cells[other]] = together / (n_agents - 1)
    for landmark in range(world.n_landmarks):
        plane = visited if state.visited[landmark] else unvisited
        out[plane + state.landmarks[landmark]] = 1


@kernel
def _write_geodesic(state: State, world: World, agent: int, out: NDArray[np.float32]) -> None:
    n_agents, table, distances = world.n_agents, world.table, world.view_distances
    n_cells = table.shape[0]
    scale = table[n_cells - 1, ROW] + 1 + table[n_cells - 1, COL] + 1  # rows + cols
    cell = state.cells[agent]
    for landmark in range(world.n_landmarks):
        source = landmark_source(state, landmark, world.first_view_field)
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

"""The rules of version 0 (R2 to R8), written once, as kernels over one row (see ``state``).

With ``NUMBA_DISABLE_JIT=1`` the same source runs as plain Python. The rules of a second game would
stand in a file beside this one, over a row of their own, and share :func:`move_row`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.state import (
    ALL_PAIRS,
    COORDINATES,
    DEPOT,
    MOVES,
    N_ACTIONS,
    NO_DISTANCES,
    WAIT,
    State,
    World,
    direct_steps,
    next_cell,
    path_distances,
    path_steps,
    split_row,
    steps_home,
    steps_to,
)
from mapp_env.grid import FAR, Grid

MAX_TABLE_CELLS = 256  # of a grid with a table of Manhattan distances: it should stay in the cache


class Reward(IntEnum):
    """The kinds of team reward (R6)."""

    MANHATTAN = 0
    GEODESIC = 1
    STEP = 2


PATH_REWARDS = (Reward.GEODESIC,)  # those that look up shortest paths


def reward_distances(
    kind: Reward, grids: Sequence[Grid], fields: NDArray[np.int32]
) -> tuple[NDArray[np.int32], int]:
    """Return the distances that a reward looks up, and by what.

    Parameters are those of :func:`mapp_env.engine.world.make_world`.
    """
    if kind in PATH_REWARDS:
        return path_distances(grids, fields)
    # Grids of one shape have one table.
    if grids[0].n_cells > MAX_TABLE_CELLS or len({grid.walls.shape for grid in grids}) > 1:
        return NO_DISTANCES, COORDINATES
    table = grids[0].manhattan_from(range(grids[0].n_cells))
    table.flags.writeable = False
    return table, ALL_PAIRS


@kernel
def reset_row(
    row: NDArray[np.int32],
    landmarks: NDArray[np.int32],
    cells: NDArray[np.int32],
    world: World,
    grid: int = 0,
) -> None:
    """Start an episode (R2, R10) on landmarks, shape (K,), with the agents on cells, shape (N,).

    Both satisfy the conditions of R2 and R10 on the world's grid of this number.
    """
    row[:] = 0
    state = split_row(row, world.n_agents, world.n_landmarks)
    state.grid[:] = grid
    for agent in range(world.n_agents):
        state.cells[agent] = cells[agent]
    for landmark in range(world.n_landmarks):
        state.landmarks[landmark] = landmarks[landmark]


@kernel
def step_row(
    row: NDArray[np.int32], actions: NDArray[np.int64], max_cycles: int, world: World
) -> tuple[float, bool, bool]:
    """Carry out a valid joint action, shape (N,), in a row that is changed in place.

    Returns the team reward (R6), terminated and truncated, the step limit being ``max_cycles``
    (R7).
    """
    state = split_row(row, world.n_agents, world.n_landmarks)
    move_row(state, actions, world)
    return settle_row(state, max_cycles, world)  # type: ignore[no-any-return]


@kernel
def settle_row(state: State, max_cycles: int, world: World) -> tuple[float, bool, bool]:
    """Do what comes after the move (R5 to R7); return what ``step_row`` does."""
    reward, terminated = visit_row(state, world)
    return reward, terminated, bool(not terminated and state.step[0] >= max_cycles)


@kernel
def move_row(state: State, actions: NDArray[np.int64], world: World) -> None:
    """Move all agents at once (R3, R4, R11)."""
    state.step[0] += 1
    # A loop for each kind of action: to ask within one would take a tenth of a batched step.
    if world.actions == MOVES:
        for agent in range(world.n_agents):
            _move_agent(state, world, agent, actions[agent])
    else:
        for agent in range(world.n_agents):
            move = _move_towards(state, world, state.cells[agent], actions[agent])
            _move_agent(state, world, agent, move)


@kernel
def _move_agent(state: State, world: World, agent: int, move: int) -> None:
    cell = state.cells[agent]
    to = next_cell(world, cell, move)
    state.cells[agent] = to
    state.moved[agent] += to != cell


@kernel
def _move_towards(state: State, world: World, cell: int, landmark: int) -> int:
    """Return the first move on a shortest path to a landmark, or home for one more; else to wait.

    Without ``return_home`` one more landmark means to stay (R11).
    """
    if landmark < world.n_landmarks:
        steps = path_steps(state, world, landmark, cell)
        for move in range(N_ACTIONS):
            if path_steps(state, world, landmark, next_cell(world, cell, move)) < steps:
                return move
    elif world.return_home:
        for move in range(N_ACTIONS):
            if steps_home(world, next_cell(world, cell, move)) < steps_home(world, cell):
                return move
    return WAIT


@kernel
def visit_row(state: State, world: World) -> tuple[float, bool]:
    """Visit the landmarks under agents (R5); return the team reward (R6, R12) and if it is over."""
    if world.distances_at == COORDINATES:
        unvisited, distance = _visit(state, world, direct_steps_to)
    else:
        unvisited, distance = _visit(state, world, looked_up_steps_to)
    if unvisited == 0:
        if world.return_home:
            distance = _steps_home(state, world)
        if distance == 0:
            return 0.0, True
    if world.reward == Reward.STEP:
        distance = 1
    return -float(distance), False


@kernel
def direct_steps_to(state: State, world: World, landmark: int, cell: int) -> int:
    """Return the Manhattan distance from a cell to a landmark, computed."""
    return int(direct_steps(world, cell, state.landmarks[landmark]))


@kernel
def looked_up_steps_to(state: State, world: World, landmark: int, cell: int) -> int:
    """Return the distance of the reward's kind from a cell to a landmark, looked up."""
    return int(steps_to(state, landmark, cell, world.distances, world.distances_at))


@kernel
def _visit(
    state: State, world: World, distance_of: Callable[[State, World, int, int], int]
) -> tuple[int, int]:
    """Return how many landmarks are left, and the sum of their distances from the nearest agent."""
    unvisited = 0
    total = 0
    for landmark in range(world.n_landmarks):
        # All landmarks alike, visited or not: whether one is visited is as good as random to the
        # processor, and a branch on it would cost more than a distance.
        flag = state.visited[landmark]
        distance = FAR
        for agent in range(world.n_agents):
            steps = distance_of(state, world, landmark, state.cells[agent])
            distance = min(distance, np.int32(steps))
        if (distance == 0) & (flag == 0):
            _claim(state, landmark)
            flag = np.int32(1)
        left = 1 - flag
        unvisited += left
        total += left * distance
    return unvisited, total


@kernel
def _steps_home(state: State, world: World) -> int:
    """Return the sum of the agents' ways home, of the reward's kind; 0 only if all are there."""
    total = 0
    for agent in range(world.n_agents):
        cell = state.cells[agent]
        if world.reward == Reward.MANHATTAN:
            total += direct_steps(world, cell, world.grids[world.grid, DEPOT])
        else:
            total += steps_home(world, cell)
    return total


@kernel
def _claim(state: State, landmark: int) -> None:
    """Mark a landmark as visited for good, and note what R8 needs of the agent that claims it.

    That is the agent of the lowest index on it.
    """
    cell = state.landmarks[landmark]
    agent = 0
    while state.cells[agent] != cell:
        agent += 1
    state.visited[landmark] = 1
    state.claim_cells[agent] = cell
    state.claim_moved[agent] = state.moved[agent]
    state.claim_steps[agent] = state.step[0]


@kernel
def measure_row(row: NDArray[np.int32], world: World) -> tuple[float, float, float]:
    """Return cover time, makespan and total distance (R8), inf if the episode is not solved.

    An agent's route is cut at its last claim and closed by a shortest path home; without a claim
    it is empty. If the team walks home itself (R12), its steps are counted as they were.
    """
    state = split_row(row, world.n_agents, world.n_landmarks)
    for landmark in range(world.n_landmarks):
        if state.visited[landmark] == 0:
            return np.inf, np.inf, np.inf
    cover_time = 0
    makespan = 0
    distance = 0
    for agent in range(world.n_agents):
        step = state.claim_steps[agent]
        cover_time = max(cover_time, step)
        if world.return_home:
            if steps_home(world, state.cells[agent]) > 0:
                return np.inf, np.inf, np.inf
            makespan = state.step[0]
            distance += state.moved[agent]
        elif step > 0:
            home = steps_home(world, state.claim_cells[agent])
            makespan = max(makespan, step + home)
            distance += state.claim_moved[agent] + home
    return float(cover_time), float(makespan), float(distance)

"""The loops that run the rules over rows, compiled.

Python hands them the world as a plain tuple (see :data:`mapp_env.engine.state.Packed`), and arrays
to write to: kernels allocate nothing. Below, B rows have N agents and K landmarks on C cells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.observation import observe_row
from mapp_env.engine.rules import (
    measure_row,
    move_row,
    reset_row,
    settle_row,
    step_row,
    visit_row,
)
from mapp_env.engine.state import (
    N_CELLS,
    Packed,
    World,
    new_rows,
    pack,
    split,
    split_row,
    unpack,
    world_at,
)
from mapp_env.paths import fill_distances

# Arrays, for signatures of one line.
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Int8s = NDArray[np.int8]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Bools = NDArray[np.bool_]


@kernel
def step_and_observe(
    row: Int32s, actions: Int64s, max_cycles: int, views: Float32s, masks: Int8s, world: Packed
) -> tuple[float, bool, bool]:
    """Step a single row and observe it; parameters as in ``step_row`` and ``observe_row``.

    Raises a ValueError unless there is exactly one valid action per agent; nothing has moved then.
    (The rules index a table with actions: an invalid one would read outside of it.)
    """
    own = world_at(unpack(world), row, 0)
    if actions.shape[0] != own.n_agents:
        raise ValueError("actions must hold one action per agent")
    for agent in range(own.n_agents):
        if not 0 <= actions[agent] < masks.shape[1]:
            raise ValueError("actions must be in 0..A-1, A the number of an agent's actions")
    result: tuple[float, bool, bool] = step_row(row, actions, max_cycles, own)
    observe_row(row, own, views, masks)
    return result


@kernel
def step_and_observe_rows(
    rows: Int32s,
    actions: Int64s,
    skip: Bools,
    limits: Int64s,
    rewards: Float64s,
    terminations: Bools,
    truncations: Bools,
    views: Float32s,
    masks: Int8s,
    world: Packed,
) -> None:
    """Step all rows but those of ``skip``, with checked actions, in a plain world; observe all.

    Shapes: (B, ...) of what ``step_row`` and ``observe_row`` take.
    """
    common = unpack(world)
    for index in range(rows.shape[0]):
        own, row = world_at(common, rows[index], index, True), rows[index]
        if skip[index]:
            rewards[index], terminations[index], truncations[index] = 0.0, False, False
        else:
            rewards[index], terminations[index], truncations[index] = step_row(
                row, actions[index], limits[index], own
            )
        observe_row(row, own, views[index], masks[index])


@kernel
def step_rows(
    rows: Int32s,
    actions: Int64s,
    skip: Bools,
    limits: Int64s,
    rewards: Float64s,
    terminations: Bools,
    truncations: Bools,
    world: Packed,
) -> None:
    """Step all rows but those of ``skip``, with checked actions, in any world.

    Shapes: (B, ...) of what ``step_row`` takes.
    """
    common = unpack(world)
    # All rows move before the first is looked at again: what is looked up for them in tables too
    # large for the cache is waited for together.
    for index in range(rows.shape[0]):
        if not skip[index]:
            own = world_at(common, rows[index], index)
            move_row(split_row(rows[index], own.n_agents, own.n_landmarks), actions[index], own)
    for index in range(rows.shape[0]):
        if skip[index]:
            rewards[index], terminations[index], truncations[index] = 0.0, False, False
        else:
            own = world_at(common, rows[index], index)
            rewards[index], terminations[index], truncations[index] = settle_row(
                split_row(rows[index], own.n_agents, own.n_landmarks), limits[index], own
            )


@kernel
def observe_rows(
    rows: Int32s, indices: Int64s, views: Float32s, masks: Int8s, world: Packed
) -> None:
    """Observe the rows of ``indices``, (M,): theirs in ``views`` (B, V, F), ``masks`` (B, N, A)."""
    common = unpack(world)
    for index in indices:
        own = world_at(common, rows[index], index)
        observe_row(rows[index], own, views[index], masks[index])


@kernel
def reset_rows(
    rows: Int32s,
    indices: Int64s,
    grids: Int64s,
    landmarks: Int32s,
    cells: Int32s,
    limits: Int64s,
    row_limits: Int64s,
    max_cycles: int,
    longest: int,
    world: Packed,
) -> None:
    """Start an episode in the rows of ``indices``, (M,).

    It is on the grids of these numbers, (M,), and on ``landmarks``, (M, K), with the agents on
    ``cells``, (M, N). Its step limit, of ``row_limits``, (B,), is that of ``limits``, (M,), or
    ``max_cycles`` for a negative one, and never more than ``longest``.
    """
    common = unpack(world)
    for place, index in enumerate(indices):
        reset_row(rows[index], landmarks[place], cells[place], common, grids[place])
        limit = limits[place] if limits[place] >= 0 else max_cycles
        row_limits[index] = min(limit, longest)


@kernel
def measure_rows(rows: Int32s, indices: Int64s, costs: Float64s, world: Packed) -> None:
    """Write the costs of some rows, (M, 3): cover time, makespan, total distance (R8)."""
    common = unpack(world)
    for place, index in enumerate(indices):
        own = world_at(common, rows[index], index)
        cover_time, makespan, distance = measure_row(rows[index], own)
        costs[place, 0] = cover_time
        costs[place, 1] = makespan
        costs[place, 2] = distance


def visit_rows(
    world: World, cells: NDArray[np.integer], landmarks: NDArray[np.integer], visited: Bools
) -> tuple[Bools, Float64s, Bools]:
    """Return what the rules make of agents that have moved, whatever brought them there.

    They stand on ``cells``, (B, N), and of ``landmarks``, (B, K), some were ``visited`` before,
    (B, K), bool or 0 and 1. Returned are those visited now, (B, K) (R5), the team rewards, (B,)
    (R6), and whether all are visited, (B,) (R7).
    """
    rows = new_rows(len(cells), world.n_agents, world.n_landmarks)
    state = split(rows, world.n_agents, world.n_landmarks)
    state.cells[:], state.landmarks[:], state.visited[:] = cells, landmarks, visited
    rewards, terminated = np.empty(len(rows)), np.empty(len(rows), np.bool_)
    _visit_rows(rows, rewards, terminated, pack(world))
    return state.visited.astype(np.bool_), rewards, terminated


@kernel
def _visit_rows(rows: Int32s, rewards: Float64s, terminated: Bools, world: Packed) -> None:
    common = unpack(world)
    for index in range(rows.shape[0]):
        state = split_row(rows[index], common.n_agents, common.n_landmarks)
        own = world_at(common, rows[index], index)
        rewards[index], terminated[index] = visit_row(state, own)


@kernel
def fill_fields(
    rows: Int32s, indices: Int64s, moves: Int32s, fields: Int32s, scratch: Int32s, world: Packed
) -> None:
    """Write the steps to every landmark of some rows, where there are no distances of all pairs.

    Shapes: ``indices`` (M,), ``moves`` (sum of C, 4) of all grids, ``fields`` (B * C, K) and
    ``scratch`` (K + 1, C), C of the largest grid.
    """
    common = unpack(world)
    size = scratch.shape[1]
    for index in indices:
        own = world_at(common, rows[index], index)
        state = split_row(rows[index], own.n_agents, own.n_landmarks)
        first, n_cells = own.cells_at, own.grids[own.grid, N_CELLS]
        for landmark in range(own.n_landmarks):
            fill_distances(
                moves[first : first + n_cells],
                state.landmarks[landmark],
                scratch[landmark, :n_cells],
                scratch[own.n_landmarks, :n_cells],
            )
        # Turned, so that what a cell's neighbourhood needs lies close together.
        field = fields[index * size : index * size + n_cells]
        for cell in range(n_cells):
            for landmark in range(own.n_landmarks):
                field[cell, landmark] = scratch[landmark, cell]


@kernel
def fill_joint_mask(masks: Int8s, joint: Int8s) -> None:
    """Write which numbered joint actions bump no agent, (A**N,), of the agents' masks, (N, A)."""
    n_agents, n_actions = masks.shape
    for action in range(n_actions):
        joint[action] = masks[n_agents - 1, action]
    size = n_actions
    for agent in range(n_agents - 2, -1, -1):
        # What the agents behind this one may do, once for each of its actions; last for action 0,
        # whose block is the one that is read.
        for action in range(n_actions - 1, -1, -1):
            allowed = masks[agent, action]
            block = np.uint32(action * size)
            for place in range(np.uint32(size)):
                joint[block + place] = joint[place] & allowed
        size *= n_actions


@kernel
def fill_joint_masks(masks: Int8s, joint: Int8s) -> None:
    """Do :func:`fill_joint_mask` for every row: ``masks`` (M, N, A) and ``joint`` (M, A**N)."""
    for row in range(masks.shape[0]):
        fill_joint_mask(masks[row], joint[row])


@kernel
def find_bad_action(actions: NDArray[np.uint64], n_actions: int) -> int:
    """Return the position of the first action outside ``0..n_actions - 1``, or -1.

    Shape: ``actions`` (M,), int64 read as uint64, so that a negative action is a huge one.
    """
    limit = np.uint64(n_actions)
    highest = np.uint64(0)
    for action in actions:
        # No early exit: the loop without one is vectorised, and bad actions are rare.
        highest = max(highest, action)
    if highest >= limit:
        for position, action in enumerate(actions):
            if action >= limit:
                return position
    return -1

"""What the rules read and write, as arrays with names: a *world* and the *rows* played in it.

A row is one problem in progress, an int32 vector; its head is the paper's observation (R9), its
tail what the metrics (R8) need. :class:`State` names its parts, and no other file knows where in
the row they are. A world is what all rows have in common: sizes, kinds, and the tables of the
grids, one after the other; :func:`world_at` is what a single row sees of it.

Cells and actions are used as ``uint32`` indices: a signed index costs a test for a negative one,
which took a quarter of a batched step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import Grid

N_ACTIONS = 4  # left, right, up, down: the paper's order (R3)
WAIT = 4
MOVES, LANDMARKS = 0, 1  # what actions are: moves, or landmarks to walk towards (R11)

# Columns of a world's grids: the first cell in open and home, how many there are, which of them is
# the depot, rows, columns, columns of the widest grid, what turns a cell into its row, and the
# first line in strides.
FIRST, N_CELLS, DEPOT, ROWS, COLS, WIDTH, RECIPROCAL, STRIDES = range(8)
WAYS = 1 << (N_ACTIONS + 1)  # sets of actions that bump nothing: lines of strides for a width

# `cell // cols` is `cell * RECIPROCAL >> SHIFT`, exactly for 2048 x 2048 cells, without a division.
SHIFT = 36

# What distances are looked up by:
COORDINATES = -2  # nothing, if Manhattan distances are computed from rows and columns
ALL_PAIRS = -1  # the two cells
# or, from 0 on, the cell and the landmark, in as many lines for each row of a batch

# Distances are read-only arrays without exception: numba would compile a second version of every
# kernel for others.
NO_DISTANCES = np.zeros((1, 1), np.int32)
NO_DISTANCES.flags.writeable = False


Packed = tuple[Any, ...]
"""A world as Python hands it to kernels, made by :func:`pack`: numba recognises a plain tuple in a
fifth of the time that a NamedTuple takes, and one array sooner than numbers. Kernels begin
with :func:`unpack`."""


class World(NamedTuple):
    """What the rules look up; :func:`mapp_env.engine.world.make_world` makes one of G grids.

    :func:`world_at` says where in its tables the grid and the lines of a single row begin.
    """

    n_agents: int  # N
    n_landmarks: int  # K
    reward: int  # a Reward
    observation: int  # an Observation
    actions: int  # MOVES or LANDMARKS
    return_home: int  # 1 if the team walks home (R12), else 0
    distances_at: int  # lines of distances for each row, ALL_PAIRS or COORDINATES; a row's first
    paths_at: int  # lines of paths for each row, or ALL_PAIRS; a row's first
    grid: int  # a row's line of grids
    cells_at: int  # a row's first cell of open and home
    strides_at: int  # a row's first line of strides
    grids: NDArray[np.int64]  # (G, 8), see FIRST to STRIDES; cells are local
    open: NDArray[np.uint8]  # (sum of C,), grid after grid; from open_actions
    strides: NDArray[np.int32]  # (W * 32, 5), of each width of a grid; from strides_of
    home: NDArray[np.int32]  # (sum of C,), steps to the depot
    distances: NDArray[np.int32]  # (C, C) or (B * C, K), the reward's
    paths: NDArray[np.int32]  # the same, shortest paths: the observation's and the actions'


def pack(world: World) -> Packed:
    """Return a world as kernels take it, its numbers in the line before those of its grids."""
    return (np.vstack((world[:8], world.grids)), *world[12:])


@kernel
def unpack(packed: Packed) -> World:
    """Return the world that was packed."""
    lines, open_, strides, home, distances, paths = packed
    return World(
        lines[0, 0],
        lines[0, 1],
        lines[0, 2],
        lines[0, 3],
        lines[0, 4],
        lines[0, 5],
        lines[0, 6],
        lines[0, 7],
        0,
        0,
        0,
        lines[1:],
        open_,
        strides,
        home,
        distances,
        paths,
    )


class State(NamedTuple):
    """Views of a row, or of B rows with shapes (B, ...)."""

    cells: NDArray[np.int32]  # (N,), of the agents
    landmarks: NDArray[np.int32]  # (K,), their cells
    visited: NDArray[np.int32]  # (K,), 0 or 1
    head: NDArray[np.int32]  # (N + 2K,), the three together: the global observation (R9)
    step: NDArray[np.int32]  # (1,), steps since the reset
    moved: NDArray[np.int32]  # (N,), cells moved by each agent
    claim_cells: NDArray[np.int32]  # (N,), where each agent made its last claim
    claim_moved: NDArray[np.int32]  # (N,), cells it had moved by then
    claim_steps: NDArray[np.int32]  # (N,), at which step; 0 without a claim
    grid: NDArray[np.int32]  # (1,), which of several grids the episode is on; (0,) if there is one


def state_length(n_agents: int, n_landmarks: int) -> int:
    """Return the number of entries of the global observation, N + 2K."""
    return n_agents + 2 * n_landmarks


def new_rows(n_rows: int, n_agents: int, n_landmarks: int, n_grids: int = 1) -> NDArray[np.int32]:
    """Return B rows of zeros, shape (B, N + 2K + 1 + 4N), or one more if there are several grids.

    (An entry more in each row would cost a batch on one grid a thirtieth of its speed.)
    """
    length = state_length(n_agents, n_landmarks) + 1 + 4 * n_agents + (n_grids > 1)
    return np.zeros((n_rows, length), np.int32)


def split(rows: NDArray[Any], n_agents: int, n_landmarks: int) -> State:
    """Return the parts of a row, or of many rows, last axis first to last entry."""
    visited = n_agents + n_landmarks
    step = visited + n_landmarks
    moved = step + 1
    claim_cells = moved + n_agents
    claim_moved = claim_cells + n_agents
    claim_steps = claim_moved + n_agents
    grid = claim_steps + n_agents
    return State(
        cells=rows[..., :n_agents],
        landmarks=rows[..., n_agents:visited],
        visited=rows[..., visited:step],
        head=rows[..., :step],
        step=rows[..., step:moved],
        moved=rows[..., moved:claim_cells],
        claim_cells=rows[..., claim_cells:claim_moved],
        claim_moved=rows[..., claim_moved:claim_steps],
        claim_steps=rows[..., claim_steps:grid],
        grid=rows[..., grid:],
    )


split_row = kernel(split)
"""The same within kernels, of one row."""


def is_plain(world: World) -> bool:
    """Return whether a world has one grid and neither R11 nor R12: the game of the paper."""
    return len(world.grids) == 1 and world.actions == MOVES and not world.return_home


@kernel
def world_at(world: World, row: NDArray[np.int32], index: int, plain: bool = False) -> World:
    """Return the world as a row sees it: where its own grid and lines of distances begin.

    ``index`` is the row's number among those that lines are kept for. Where a caller writes True
    for ``plain``, of a world that is, the compiler leaves out of its loop what else there may be.
    """
    actions, return_home = world.actions, world.return_home
    grid, cells_at, strides_at = 0, 0, 0
    if plain:
        actions, return_home = MOVES, 0
    elif world.grids.shape[0] > 1:
        grid = int(split_row(row, world.n_agents, world.n_landmarks).grid[0])
        cells_at, strides_at = world.grids[grid, FIRST], world.grids[grid, STRIDES]
    distances_at, paths_at = world.distances_at, world.paths_at
    return World(
        world.n_agents,
        world.n_landmarks,
        world.reward,
        world.observation,
        actions,
        return_home,
        distances_at if distances_at < 0 else distances_at * index,
        paths_at if paths_at < 0 else paths_at * index,
        grid,
        cells_at,
        strides_at,
        world.grids,
        world.open,
        world.strides,
        world.home,
        world.distances,
        world.paths,
    )


# -- looking up ------------------------------------------------------------------------


@kernel
def ways_from(world: World, cell: int) -> int:
    """Return the actions that bump nothing in a cell, a bit each; 0 for a wall."""
    return int(world.open[np.uint32(world.cells_at + cell)])


@kernel
def next_cell(world: World, cell: int, action: int) -> int:
    """Return where an action leads: to the cell itself, if it is to wait or bumps."""
    ways = np.uint32(world.strides_at + ways_from(world, cell))
    return int(cell + world.strides[ways, np.uint32(action)])


@kernel
def steps_home(world: World, cell: int) -> int:
    """Return the steps of a shortest path from a cell to the depot."""
    return int(world.home[np.uint32(world.cells_at + cell)])


@kernel
def row_and_col(world: World, cell: int) -> tuple[int, int]:
    """Return a cell's row and column."""
    row = (cell * world.grids[world.grid, RECIPROCAL]) >> SHIFT
    return row, cell - row * world.grids[world.grid, COLS]


@kernel
def direct_steps(world: World, start: int, end: int) -> int:
    """Return the Manhattan distance between two cells."""
    row, col = row_and_col(world, start)
    other_row, other_col = row_and_col(world, end)
    return int(abs(row - other_row) + abs(col - other_col))


@kernel
def steps_to(
    state: State, landmark: int, cell: int, distances: NDArray[np.int32], distances_at: int
) -> int:
    """Return the distance from a cell to a landmark, looked up."""
    if distances_at == ALL_PAIRS:
        return int(distances[np.uint32(state.landmarks[landmark]), np.uint32(cell)])
    return int(distances[np.uint32(distances_at + cell), np.uint32(landmark)])


@kernel
def path_steps(state: State, world: World, landmark: int, cell: int) -> int:
    """Return the steps of a shortest path from a cell to a landmark."""
    return int(steps_to(state, landmark, cell, world.paths, world.paths_at))


# -- making tables ---------------------------------------------------------------------


def path_distances(
    grids: Sequence[Grid], fields: NDArray[np.int32]
) -> tuple[NDArray[np.int32], int]:
    """Return shortest paths as a world holds them, and by what they are looked up.

    They are those of all pairs, or the rows' ``fields`` if there are any, see ``make_world``.

    Raises a ValueError if there are no fields and the grid, which must be a single one then, is too
    large for all pairs.
    """
    if not fields.size:
        (grid,) = grids
        return grid.distances, ALL_PAIRS
    lines = fields.view()
    lines.flags.writeable = False
    return lines, max(grid.n_cells for grid in grids)


def open_actions(grid: Grid) -> NDArray[np.uint8]:
    """Return which actions bump nothing in each cell, a bit each, shape (C,); 0 for a wall.

    Borders and walls vanish from the rules so. A byte a cell keeps thousands of grids in the cache.
    """
    free = (~grid.walls).view(np.uint8)
    ways = np.full_like(free, 1 << WAIT)
    ways[:, 1:] |= free[:, :-1]
    ways[:, :-1] |= free[:, 1:] << 1
    ways[1:] |= free[:-1] << 2
    ways[:-1] |= free[1:] << 3
    return (ways * free).ravel()


def strides_of(cols: int) -> NDArray[np.int32]:
    """Return what each action adds to a cell, by the actions that bump nothing there, (32, 5).

    To look it up takes a third of the time that it takes to work it out.
    """
    ways = np.arange(WAYS)[:, None] >> np.arange(WAIT + 1) & 1
    return (ways * [-1, 1, -cols, cols, 0]).astype(np.int32)

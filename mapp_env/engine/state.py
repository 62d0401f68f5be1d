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
ROW, COL, HOME, WALL, MASK = 5, 6, 7, 8, 9  # columns of a table, after the five moves

FIRST, N_CELLS, DEPOT, WIDTH = 0, 1, 2, 3  # columns of a world's grids

# Where the distances of a row's landmarks stand: from this line of `distances` on, or
ALL_PAIRS = -1  # in `distances`, in the line of each landmark's cell
BY_COORDINATES = -2  # nowhere: Manhattan distances are computed from rows and columns

# Distances are read-only arrays without exception: numba would compile a second version of every
# kernel for others.
NO_DISTANCES = np.zeros((1, 1), np.int32)
NO_DISTANCES.flags.writeable = False


Packed = tuple[Any, ...]
"""A world as Python hands it to kernels, made by :func:`pack`: numba recognises a plain tuple in a
fifth of the time that a NamedTuple takes, and one array sooner than eight numbers. Kernels begin
with :func:`unpack`."""


class World(NamedTuple):
    """What the rules look up; :func:`mapp_env.engine.world.make_world` makes one of G grids."""

    n_agents: int  # N
    n_landmarks: int  # K
    reward: int  # a Reward
    observation: int  # an Observation
    actions: int  # MOVES or LANDMARKS
    return_home: int  # 1 if the team walks home (R12), else 0
    first_field: int  # line of the first landmark in distances, ALL_PAIRS or BY_COORDINATES
    first_path: int  # line of the first landmark in paths, or ALL_PAIRS
    grids: NDArray[np.int32]  # (G, 4): first line in table, cells C, depot, columns of the widest
    table: NDArray[np.int32]  # (sum of C, 10), from cell_table, grid after grid; cells are local
    distances: NDArray[np.int32]  # (S, C), from sources to cells: the reward's
    paths: NDArray[np.int32]  # (S, C), shortest paths: the observation's and the actions'


def pack(world: World) -> Packed:
    """Return a world as kernels take it."""
    return (np.array(world[:8], np.int64), *world[8:])


@kernel
def unpack(packed: Packed) -> World:
    """Return the world that was packed."""
    numbers, grids, table, distances, paths = packed
    return World(
        numbers[0],
        numbers[1],
        numbers[2],
        numbers[3],
        numbers[4],
        numbers[5],
        numbers[6],
        numbers[7],
        grids,
        table,
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


@kernel
def is_plain(world: World) -> bool:
    """Return whether a world has one grid and neither R11 nor R12: the game of the paper."""
    return world.grids.shape[0] == 1 and world.actions == MOVES and world.return_home == 0


@kernel
def world_at(world: World, row: NDArray[np.int32], index: int, plain: bool = False) -> World:
    """Return the world as a row sees it: its own grid alone, and its own K lines of fields.

    ``index`` is the row's number among those that fields are kept for. Where a caller writes True
    for ``plain``, of a world that is, the compiler leaves out of its loop what else there may be.
    """
    actions, return_home = world.actions, world.return_home
    grids, table = world.grids, world.table
    if plain:
        actions, return_home = MOVES, 0
    elif grids.shape[0] > 1:
        which = split_row(row, world.n_agents, world.n_landmarks).grid[0]
        grids = grids[which : which + 1]
        table = table[grids[0, FIRST] : grids[0, FIRST] + grids[0, N_CELLS]]
    first, first_path = world.first_field, world.first_path
    return World(
        world.n_agents,
        world.n_landmarks,
        world.reward,
        world.observation,
        actions,
        return_home,
        first if first < 0 else index * world.n_landmarks,
        first_path if first_path < 0 else index * world.n_landmarks,
        grids,
        table,
        world.distances,
        world.paths,
    )


@kernel
def landmark_source(state: State, landmark: int, first_field: int) -> int:
    """Return the line of distances with the steps from a landmark."""
    if first_field == ALL_PAIRS:
        return int(state.landmarks[landmark])
    return first_field + landmark


@kernel
def direct_steps(table: NDArray[np.int32], start: int, end: int) -> int:
    """Return the Manhattan distance between two cells of a grid with this table."""
    a, b = np.uint32(start), np.uint32(end)
    return int(abs(table[a, ROW] - table[b, ROW]) + abs(table[a, COL] - table[b, COL]))


def path_distances(
    grids: Sequence[Grid], fields: NDArray[np.int32]
) -> tuple[NDArray[np.int32], int]:
    """Return shortest paths as a world holds them: of all pairs, or the rows' fields if it has any.

    Raises a ValueError if there are no fields and the grid, which must be a single one then, is too
    large for all pairs.
    """
    if not fields.size:
        (grid,) = grids
        return grid.distances, ALL_PAIRS
    lines = fields.view()
    lines.flags.writeable = False
    return lines, 0


def cell_table(grid: Grid) -> NDArray[np.int32]:
    """Return the grid as the kernels read it, shape (C, 10) int32, one line a cell.

    ``[ next cell for left, right, up, down, wait | row, col | steps home | 1 for a wall | mask ]``,
    so that borders and walls vanish from the rules. The mask is four int8 in one word: 0 for a move
    that bumps, else 1.
    """
    cells = np.arange(grid.n_cells, dtype=np.int32)
    table = np.empty((grid.n_cells, MASK + 1), np.int32)
    table[:, :WAIT], table[:, WAIT] = grid.moves, cells
    table[:, ROW], table[:, COL] = np.divmod(cells, np.int32(grid.cols))
    table[:, HOME], table[:, WALL] = grid.home, grid.walls.ravel()
    table[:, MASK] = (grid.moves != cells[:, None]).view(np.int32)[:, 0]
    table.flags.writeable = False
    return table

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
"""``tuple(world)``: numba recognises it in a fifth of the time that a NamedTuple takes, so that is
what Python hands to kernels; they begin with ``World(*world)``."""


class World(NamedTuple):
    """What the rules look up; :func:`mapp_env.engine.world.make_world` makes one of G grids."""

    n_agents: int  # N
    n_landmarks: int  # K
    reward: int  # a Reward
    observation: int  # an Observation
    actions: int  # MOVES or LANDMARKS
    return_home: int  # 1 if the team walks home (R12), else 0
    grids: NDArray[np.int32]  # (G, 4): first line in table, cells C, depot, columns of the widest
    table: NDArray[np.int32]  # (sum of C, 10), from cell_table, grid after grid; cells are local
    distances: NDArray[np.int32]  # (S, C), from sources to cells: the reward's
    first_field: int  # line of the first landmark, ALL_PAIRS or BY_COORDINATES
    paths: NDArray[np.int32]  # (S, C), shortest paths: the observation's and the actions'
    first_path: int  # line of the first landmark, or ALL_PAIRS


class State(NamedTuple):
    """Views of a row, or of B rows with shapes (B, ...)."""

    cells: NDArray[np.int32]  # (N,), of the agents
    landmarks: NDArray[np.int32]  # (K,), their cells
    visited: NDArray[np.int32]  # (K,), 0 or 1
    head: NDArray[np.int32]  # (N + 2K,), the three together: the global observation (R9)
    step: NDArray[np.int32]  # (1,), steps since the reset
    grid: NDArray[np.int32]  # (1,), which of the world's grids the episode is on
    moved: NDArray[np.int32]  # (N,), cells moved by each agent
    claim_cells: NDArray[np.int32]  # (N,), where each agent made its last claim
    claim_moved: NDArray[np.int32]  # (N,), cells it had moved by then
    claim_steps: NDArray[np.int32]  # (N,), at which step; 0 without a claim


def state_length(n_agents: int, n_landmarks: int) -> int:
    """Return the number of entries of the global observation, N + 2K."""
    return n_agents + 2 * n_landmarks


def new_rows(n_rows: int, n_agents: int, n_landmarks: int) -> NDArray[np.int32]:
    """Return B rows of zeros, shape (B, N + 2K + 2 + 4N)."""
    return np.zeros((n_rows, state_length(n_agents, n_landmarks) + 2 + 4 * n_agents), np.int32)


def split(rows: NDArray[Any], n_agents: int, n_landmarks: int) -> State:
    """Return the parts of a row, or of many rows, last axis first to last entry."""
    visited = n_agents + n_landmarks
    step = visited + n_landmarks
    grid = step + 1
    moved = grid + 1
    claim_cells = moved + n_agents
    claim_moved = claim_cells + n_agents
    claim_steps = claim_moved + n_agents
    return State(
        cells=rows[..., :n_agents],
        landmarks=rows[..., n_agents:visited],
        visited=rows[..., visited:step],
        head=rows[..., :step],
        step=rows[..., step:grid],
        grid=rows[..., grid:moved],
        moved=rows[..., moved:claim_cells],
        claim_cells=rows[..., claim_cells:claim_moved],
        claim_moved=rows[..., claim_moved:claim_steps],
        claim_steps=rows[..., claim_steps:],
    )


split_row = kernel(split)
"""The same within kernels, of one row."""


@kernel
def world_at(world: World, row: NDArray[np.int32], index: int) -> World:
    """Return the world as a row sees it: its own grid alone, and its own K lines of fields.

    ``index`` is the row's number among those that fields are kept for.
    """
    grids, table = world.grids, world.table
    if grids.shape[0] > 1:
        which = split_row(row, world.n_agents, world.n_landmarks).grid[0]
        grids = grids[which : which + 1]
        table = table[grids[0, FIRST] : grids[0, FIRST] + grids[0, N_CELLS]]
    first, first_path = world.first_field, world.first_path
    return World(
        world.n_agents,
        world.n_landmarks,
        world.reward,
        world.observation,
        world.actions,
        world.return_home,
        grids,
        table,
        world.distances,
        first if first < 0 else index * world.n_landmarks,
        world.paths,
        first_path if first_path < 0 else index * world.n_landmarks,
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
    cells = np.arange(grid.n_cells)
    row, col = np.divmod(cells, grid.cols)
    mask = (grid.moves != cells[:, None]).view(np.int32)
    columns: list[NDArray[Any]] = [grid.moves, cells, row, col, grid.home, grid.walls.ravel(), mask]
    table = np.column_stack(columns).astype(np.int32)
    table.flags.writeable = False
    return table

"""Grids made to measure: random obstacles, rooms, a maze, a warehouse.

In all of them every free cell can be reached from the depot, and the same arguments give the same
grid. All randomness is ``Generator.random``, whose stream NumPy has never changed.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.grid import Grid
from mapp_env.map_format import MAX_SIDE
from mapp_env.validation import MAX_SEED, check_count, check_number

MAX_DENSITY = 0.4
"""Largest share of walls in ``random``: with about 0.407 a large grid falls apart (the site
percolation threshold of the square lattice)."""

TRIES = 20  # a strip that falls apart so often is refused within a second
LEAST_SIDES = {"maze": 3, "random": 2, "rooms": 3, "warehouse": 6}


class Option(NamedTuple):
    """An option of a generator, from ``low`` to ``high``."""

    low: float
    high: float
    usual: tuple[float, float]  # the range that grids of a pool are drawn from
    step: int = 1  # whole numbers; or 0 for real ones

    def check(self, name: str, value: object) -> Any:
        """Return a value if it is allowed, else raise a ValueError."""
        if self.step:
            return check_count(name, value, int(self.low), int(self.high))
        return check_number(name, value, self.low, self.high)


OPTIONS = {
    "density": Option(0, MAX_DENSITY, (0.0, 0.35), 0),
    "room": Option(2, MAX_SIDE // 2, (2, 5)),
    "loops": Option(0, 1, (0.02, 0.5), 0),
    "shelf_length": Option(2, MAX_SIDE // 2, (2, 8)),
    "aisle": Option(1, 8, (1, 2)),
    "gaps": Option(0, 1, (0.0, 0.2), 0),
}
"""All options but sides and seed, which every generator takes."""

PARTS = 32  # a part with half of the free cells is rarely far from the centre


def random_grid(*, rows: int = 32, cols: int = 32, seed: int = 0, density: float = 0.2) -> Grid:
    """Return a grid with walls strewn at random, and the depot at the centre.

    Free cells that cannot be reached become walls, so there may be more walls than asked for: few
    up to a density of 0.3, a third of the grid at 0.4.

    Parameters
    ----------
    rows, cols : int
        2 to 2048.
    seed : int
        Which of them.
    density : float
        Share of cells that are walls, 0 to 0.4.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """
    rng = _start("random", rows, cols, seed)
    density = OPTIONS["density"].check("density", density)
    for _ in range(TRIES):
        walls = np.zeros((rows, cols), np.bool_)
        order = np.argsort(rng.random(rows * cols), kind="stable")
        walls.flat[order[: round(density * rows * cols)]] = True
        if (found := _main_part(walls)) is not None:
            return found
    raise ValueError(
        f"density {density} leaves no connected {rows} x {cols} grid with seed {seed}: "
        "use a smaller density or another seed"
    )


def rooms_grid(*, rows: int = 32, cols: int = 32, seed: int = 0, room: int = 5) -> Grid:
    """Return a floor of rectangular rooms with doors one cell wide, the depot at the centre.

    The floor is halved by a wall again and again, until the rooms are small enough.

    Parameters
    ----------
    rows, cols : int
        3 to 2048.
    seed : int
        Which of them.
    room : int
        Shortest side of a room, 2 to 1024; no room is longer than three times that, except where a
        wall would block a door.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """
    rng = _start("rooms", rows, cols, seed)
    room = OPTIONS["room"].check("room", room)
    walls = np.zeros((rows, cols), np.bool_)
    parts = [(0, 0, rows, cols)]
    while parts:
        top, left, bottom, right = parts.pop()
        upright = right - left > bottom - top or (
            right - left == bottom - top and rng.random() < 0.5
        )
        # Seen along the wall to be built, whichever way it runs: a view, so writes go through.
        floor = walls.T if upright else walls
        first, last, begin, end = (
            (left, right, top, bottom) if upright else (top, bottom, left, right)
        )
        side = last - first
        if side < 2 * room + 1 or (side <= 3 * room and rng.random() < 0.25):
            continue
        lines = [
            line
            for line in range(first + room, last - room)
            # Neither end of the wall may stand before a door.
            if (begin == 0 or floor[line, begin - 1])
            and (end == floor.shape[1] or floor[line, end])
        ]
        if not lines:
            continue
        line = lines[_below(rng, len(lines))]
        floor[line, begin:end] = True
        # Later walls keep clear of doors, so one door joins both halves for good; more of them,
        # each in its own stretch, make loops.
        n_doors = max(1, (end - begin) // (2 * room))
        for door in range(n_doors):
            low = begin + (end - begin) * door // n_doors
            high = begin + (end - begin) * (door + 1) // n_doors
            # Never its last cell: two doors side by side would be a gate.
            floor[line, low + _below(rng, max(1, high - low - 1))] = False
        if upright:
            parts += [(top, left, bottom, line), (top, line + 1, bottom, right)]
        else:
            parts += [(top, left, line, right), (line + 1, left, bottom, right)]
    return Grid(walls)


def maze_grid(*, rows: int = 33, cols: int = 33, seed: int = 0, loops: float = 0.05) -> Grid:
    """Return a maze with corridors and walls one cell wide, the depot at the centre.

    Corridors run on even rows and columns, so odd sides fit; of an even side the last line is wall.

    Parameters
    ----------
    rows, cols : int
        3 to 2048.
    seed : int
        Which of them.
    loops : float
        Share of the walls between two corridors that are opened again: with 0 there is one way
        between any two cells, with 1 no wall is left but pillars.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """
    rng = _start("maze", rows, cols, seed)
    loops = OPTIONS["loops"].check("loops", loops)
    walls = np.ones((rows, cols), np.bool_)
    rows, cols = (rows + 1) // 2, (cols + 1) // 2
    walls[::2, ::2] = False
    # Depth first: from the end of the way to a neighbour that is not on it, else one step back.
    start = (_below(rng, rows), _below(rng, cols))
    reached = np.zeros((rows, cols), np.bool_).tolist()
    reached[start[0]][start[1]] = True
    way = [start]
    words = iter(rng.random(rows * cols).tolist())
    while way:
        row, col = way[-1]
        ahead = [
            (r, c)
            for r, c in ((row, col - 1), (row, col + 1), (row - 1, col), (row + 1, col))
            if 0 <= r < rows and 0 <= c < cols and not reached[r][c]
        ]
        if not ahead:
            way.pop()
            continue
        r, c = ahead[int(next(words) * len(ahead))]
        reached[r][c] = True
        walls[row + r, col + c] = False
        way.append((r, c))
    # Opened last, so that more loops only take walls away.
    chances = rng.random(walls.shape)
    between = np.zeros(walls.shape, np.bool_)
    between[: 2 * rows - 1 : 2, 1 : 2 * cols - 1 : 2] = True
    between[1 : 2 * rows - 1 : 2, : 2 * cols - 1 : 2] = True
    return Grid(walls & ~(between & (chances < loops)))


def warehouse_grid(
    *,
    rows: int = 33,
    cols: int = 48,
    seed: int = 0,
    shelf_length: int = 8,
    aisle: int = 1,
    gaps: float = 0.1,
) -> Grid:
    """Return shelves two cells deep with aisles between, the depot in the middle of the last row.

    Parameters
    ----------
    rows, cols : int
        6 to 2048.
    seed : int
        Which shelves are missing.
    shelf_length : int
        Cells along a shelf, 2 to 1024; a shelf is shorter where the grid is.
    aisle : int
        Width of aisles, 1 to 8; less at the edges of a narrow grid.
    gaps : float
        Chance that a shelf is missing, 0 to 1.

    Raises
    ------
    ValueError
        If an argument is invalid.
    """
    rng = _start("warehouse", rows, cols, seed)
    length = OPTIONS["shelf_length"].check("shelf_length", shelf_length)
    aisle = OPTIONS["aisle"].check("aisle", aisle)
    gaps = OPTIONS["gaps"].check("gaps", gaps)
    walls = np.zeros((rows, cols), np.bool_)
    for top, bottom in _shelves(rows - 1, 2, aisle):  # one more free row for the depot
        for left, right in _shelves(cols, length, aisle):
            walls[top:bottom, left:right] = rng.random() >= gaps
    return Grid(walls, depot=(rows - 1, cols // 2))


GENERATORS: dict[str, Callable[..., Grid]] = {
    "maze": maze_grid,
    "random": random_grid,
    "rooms": rooms_grid,
    "warehouse": warehouse_grid,
}
"""The generators by the name that ``make_grid`` knows."""


@cache
def option_names(kind: str) -> tuple[str, ...]:
    """Return which options a generator takes besides sides and seed; a bundled grid has none."""
    taken = inspect.signature(GENERATORS[kind]).parameters if kind in GENERATORS else {}
    return tuple(name for name in taken if name in OPTIONS)


def _start(kind: str, rows: object, cols: object, seed: object) -> np.random.Generator:
    """Check what all generators take and return their source of randomness."""
    check_count("rows", rows, LEAST_SIDES[kind], MAX_SIDE)
    check_count("cols", cols, LEAST_SIDES[kind], MAX_SIDE)
    return np.random.default_rng(check_count("seed", seed, 0, MAX_SEED))


def _below(rng: np.random.Generator, n: int) -> int:
    """Return a random integer in 0..n-1."""
    return int(rng.random() * n)


def _main_part(walls: NDArray[np.bool_]) -> Grid | None:
    """Return a grid of the connected part that holds at least half of the free cells, if any.

    Its depot is the part's cell nearest to the centre; the other parts become walls.
    """
    n_free = int(walls.size - walls.sum())
    closed = walls.copy()
    for _ in range(PARTS):
        if closed.all():
            break
        # The depot is the free cell nearest to the centre.
        grid = Grid(closed)
        part = (grid.home >= 0).reshape(walls.shape)
        if part.sum() > 1 and 2 * part.sum() >= n_free:
            return Grid(~part, grid.depot)
        closed |= part
    return None


def _shelves(side: int, length: int, aisle: int) -> list[tuple[int, int]]:
    """Return where shelves begin and end along a side, centred, with an aisle at either end."""
    edge = min(aisle, (side - 2) // 2)
    count = max(1, math.floor((side - 2 * edge + aisle) / (length + aisle)))
    length = min(length, side - 2 * edge)
    first = (side - count * length - (count - 1) * aisle) // 2
    return [
        (first + index * (length + aisle), first + index * (length + aisle) + length)
        for index in range(count)
    ]

"""The grid: walls and a depot, turned once into tables so that the rules never look at a wall."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapp_env.map_format import (
    MAX_FILE_BYTES,
    MAX_SIDE,
    MapError,
    ParsedMap,
    check_letters,
    parse_map,
    read_map,
)
from mapp_env.paths import fill_distances, fill_moves, trace_path
from mapp_env.validation import as_array, as_integer, describe

MAX_ALL_PAIRS_CELLS = 4096
"""Largest number of cells for which all pairs of distances are kept (64 MiB at 4096)."""

MAX_LINES_BYTES = 8 << 30
"""Largest size of the distances from some cells to all: those from 512 cells at 2048 x 2048."""

FAR = np.int32(1 << 29)
"""More than any route of an agent, and twice it is still an int32."""

UNREACHABLE = -1


@dataclass(frozen=True, init=False, repr=False)
class Grid:
    """A walled grid with a depot.

    A cell is its row-major index ``row * cols + col`` (paper, section 5: "enumerated in [0, 48]").

    Parameters
    ----------
    walls : array_like of bool, shape (rows, cols)
        ``True`` where no agent can stand; 1 to 2048 rows and columns.
    depot : int or (int, int), optional
        The free cell, or its row and column, where all agents start. By default the free cell
        nearest to the centre (smallest index among equals).

    Attributes
    ----------
    walls : ndarray of bool, shape (rows, cols)
        Read-only.
    depot : int
        The depot's cell.
    text : str
        Both, as rows of ``#``, ``.`` and ``D``, which :meth:`from_text` reads back.

    Raises
    ------
    ValueError
        If ``walls`` is not a two-dimensional boolean array of allowed size with a free cell, or
        ``depot`` is not a free cell.
    """

    # The only field: what dataclasses.asdict, and so Gymnasium's EnvSpec.to_json, makes of a grid
    # has to be text.
    text: str
    if TYPE_CHECKING:
        walls: NDArray[np.bool_]
        depot: int

    def __init__(self, walls: ArrayLike, depot: object = None) -> None:
        array = as_array(walls if isinstance(walls, np.ndarray | list | tuple) else None)
        if array.ndim != 2 or array.dtype != np.bool_:
            raise ValueError(
                f"walls must be a two-dimensional array of bool, got {describe(walls)}"
            )
        if not all(1 <= side <= MAX_SIDE for side in array.shape):
            raise ValueError(
                f"walls must have 1..{MAX_SIDE} rows and columns, got shape {array.shape}"
            )
        if array.all():
            raise ValueError("walls must leave at least one free cell, got walls everywhere")
        array = array.copy()
        array.flags.writeable = False
        object.__setattr__(self, "walls", array)
        cell = self._centre() if depot is None else self.cell("depot", depot)
        if array.flat[cell]:
            raise ValueError(f"depot must be a free cell, got {describe(depot)}, which is a wall")
        object.__setattr__(self, "depot", cell)
        letters = np.full((self.rows, self.cols + 1), ord("\n"), np.uint8)
        letters[:, :-1] = np.where(array, ord("#"), ord("."))
        letters[divmod(cell, self.cols)] = ord("D")
        object.__setattr__(self, "text", letters.tobytes()[:-1].decode("ascii"))

    # -- reading and writing -----------------------------------------------------------

    @classmethod
    def from_text(
        cls, text: str, depot: object = None, free: object = None, walls: object = None
    ) -> Grid:
        """Build a grid from rows of characters, plain or with a MovingAI header.

        Parameters
        ----------
        text : str
            ``#``, ``@``, ``T``, ``O`` are walls; ``.``, ``G`` free cells; ``D`` the depot. Below a
            header ``W`` is a wall, too, and ``S`` and ``E`` are free. Where the text starts with a
            line break, as a triple-quoted string may, all lines may be indented alike.
        depot : int or (int, int), optional
            Overrides the text's depot; without either, the free cell nearest to the centre.
        free, walls : str or set of str, optional
            Letters that mean a free cell, or a wall, in this text, whatever they mean otherwise;
            all others keep their meaning. ``walls="E"`` closes a map's ``E`` cells.

        Raises
        ------
        ValueError
            If the text is malformed, the message names the line; or if ``free`` or ``walls`` holds
            anything but single ASCII letters, or a letter is in both.
        """
        letters = check_letters(free, walls)
        if not isinstance(text, str):
            raise ValueError(f"text must be a str of map rows, got {describe(text)}")
        if text.startswith("\n") and len(text) <= MAX_FILE_BYTES:
            text = textwrap.dedent(text)
        return cls._from_parsed(parse_map(text, letters=letters), depot, "text")

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        depot: object = None,
        free: object = None,
        walls: object = None,
    ) -> Grid:
        """Read a grid from a file of at most 8 MiB: rows of characters, or a MovingAI ``.map``.

        Parameters
        ----------
        path : str or os.PathLike
            The file.
        depot : int or (int, int), optional
            As for :meth:`from_text`.
        free, walls : str or set of str, optional
            What other letters mean, as for :meth:`from_text`.

        Raises
        ------
        ValueError
            If the file cannot be opened, is not a regular file, is too large or is malformed; the
            message names path and line.
        """
        letters = check_letters(free, walls)
        source = os.fspath(path) if isinstance(path, str | os.PathLike) else None
        if not isinstance(source, str):
            raise ValueError(f"path must be a str or os.PathLike of one, got {describe(path)}")
        return cls._from_parsed(read_map(source, letters), depot, source)

    @classmethod
    def _from_parsed(cls, parsed: ParsedMap, depot: object, source: str) -> Grid:
        try:
            return cls(parsed.walls, parsed.depot if depot is None else depot)
        except ValueError as error:
            raise MapError(f"{source}: {error}") from error

    def to_text(self) -> str:
        """Return :attr:`text`."""
        return self.text

    # -- shape and cells ---------------------------------------------------------------

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.walls.shape[0])

    @property
    def cols(self) -> int:
        """Number of columns."""
        return int(self.walls.shape[1])

    @property
    def n_cells(self) -> int:
        """Number of cells, walls included."""
        return int(self.walls.size)

    def cell(self, name: str, value: object) -> int:
        """Return the cell meant by an index or a (row, col) pair; ``name`` is for messages.

        Raises
        ------
        ValueError
            If ``value`` is neither, or off the grid.
        """
        index = as_integer(value)
        if index is not None and 0 <= index < self.n_cells:
            return index
        if isinstance(value, np.ndarray) and value.ndim == 1:
            value = value.tolist()
        if isinstance(value, tuple | list) and len(value) == 2:
            row, col = as_integer(value[0]), as_integer(value[1])
            on_grid = row in range(self.rows) and col in range(self.cols)
            if row is not None and col is not None and on_grid:
                return row * self.cols + col
        raise ValueError(
            f"{name} must be a cell in 0..{self.n_cells - 1} or a (row, col) pair within "
            f"{self.rows} x {self.cols}, got {describe(value)}"
        )

    def _cells(self, cells: Iterable[int]) -> NDArray[np.int32]:
        if not isinstance(cells, Iterable):
            raise ValueError(f"cells must be a sequence of cells, got {describe(cells)}")
        if isinstance(cells, range) and cells == range(self.n_cells):
            starts = np.arange(self.n_cells, dtype=np.int32)
        else:
            starts = np.array([self.cell("cells", cell) for cell in cells], dtype=np.int32)
        size = 4 * len(starts) * self.n_cells
        if size > MAX_LINES_BYTES:
            raise ValueError(
                f"cells: distances from {len(starts)} to all {self.n_cells} would take {size} "
                f"bytes, allowed are {MAX_LINES_BYTES}"
            )
        return starts

    def _centre(self) -> int:
        """Return the free cell nearest to the middle of the grid."""
        # Doubled coordinates keep the centre of an even side whole.
        row, col = (np.arange(1 - side, side, 2) ** 2 for side in self.walls.shape)
        # More than any offset: walls are never nearest.
        return int(np.argmin(np.where(self.walls, 4 * MAX_SIDE**2, row[:, None] + col)))

    # -- tables ------------------------------------------------------------------------

    @cached_property
    def moves(self) -> NDArray[np.int32]:
        """The cell that each move leads to, shape (C, 4) int32, in the order left, right, up, down.

        A move into a wall or off the grid leads to the cell itself; so does every move of a wall.
        """
        moves = np.empty((self.n_cells, 4), np.int32)
        fill_moves(self.walls, moves)
        return _frozen(moves)

    @cached_property
    def home(self) -> NDArray[np.int32]:
        """Steps of a shortest path from each cell to the depot, shape (C,), -1 unreachable."""
        return _frozen(self.distances_from([self.depot])[0])

    @cached_property
    def reachable(self) -> NDArray[np.int32]:
        """Cells where a landmark may stand, ascending, shape (F,) int32 (rule R2)."""
        return _frozen(np.flatnonzero(self.home > 0).astype(np.int32))

    @cached_property
    def distances(self) -> NDArray[np.int32]:
        """Steps of a shortest path between all pairs of cells, shape (C, C) int32, -1 unreachable.

        Raises
        ------
        ValueError
            If the grid has more than 4096 cells; use :meth:`distances_from` then.
        """
        if self.n_cells > MAX_ALL_PAIRS_CELLS:
            raise ValueError(
                f"distances between all pairs are kept for at most {MAX_ALL_PAIRS_CELLS} cells, "
                f"this grid has {self.n_cells}: use distances_from(cells)"
            )
        return _frozen(self.distances_from(range(self.n_cells)))

    def distances_from(self, cells: Iterable[int]) -> NDArray[np.int32]:
        """Return the steps of a shortest path from each of ``cells`` to every cell.

        Shape (S, C) int32; -1 where there is no path, so in all of a wall's line.

        Raises
        ------
        ValueError
            If a cell is off the grid, or they would take more than 8 GiB.
        """
        starts = self._cells(cells)
        fields = np.empty((len(starts), self.n_cells), dtype=np.int32)
        queue = np.empty(self.n_cells, dtype=np.int32)
        walls = self.walls.ravel()
        for index, start in enumerate(starts):
            if walls[start]:
                fields[index] = UNREACHABLE
            else:
                fill_distances(self.moves, start, fields[index], queue)
        return fields

    def manhattan_from(self, cells: Iterable[int]) -> NDArray[np.int32]:
        """Return the Manhattan distances from each of ``cells`` to every cell, shape (S, C) int32.

        Raises
        ------
        ValueError
            If a cell is off the grid, or they would take more than 8 GiB.
        """
        starts = self._cells(cells)
        row, col = np.divmod(np.arange(self.n_cells, dtype=np.int32), self.cols)
        return abs(row[starts, None] - row) + abs(col[starts, None] - col)

    def path(self, start: int, end: int) -> tuple[int, ...]:
        """Return a shortest path, both ends included; among equals the first in action order.

        Raises
        ------
        ValueError
            If a cell is off the grid or there is no path.
        """
        cell, last = self.cell("start", start), self.cell("end", end)
        if last == self.depot:
            steps = self.home
        else:
            steps = np.full(self.n_cells, UNREACHABLE, np.int32)
            if not self.walls.flat[last]:
                # No farther than needed: on a large grid, ends are mostly close together.
                fill_distances(self.moves, last, steps, np.empty_like(steps), cell)
            _frozen(steps)
        if steps[cell] == UNREACHABLE:
            raise ValueError(f"there is no path from start {start} to end {end}")
        path = np.full(steps[cell] + 1, cell, np.int32)
        trace_path(self.moves, steps, path)
        return tuple(path.tolist())

    # -- identity ----------------------------------------------------------------------

    def __reduce__(self) -> tuple[type[Grid], tuple[NDArray[np.bool_], int]]:
        """Copy by building anew, as copies of read-only arrays would not be read-only."""
        return Grid, (self.walls, self.depot)

    def __repr__(self) -> str:
        return (
            f"Grid(rows={self.rows}, cols={self.cols}, depot={self.depot}, "
            f"walls={int(self.walls.sum())})"
        )


def pairs_of(grid: Grid, cells: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
    """Return cells, shape (...), as (row, col) pairs, shape (..., 2)."""
    return np.stack(np.divmod(cells, grid.cols), axis=-1)


def tell_apart(grid: Grid, other: Grid) -> str:
    """Describe how two unequal grids differ."""
    if grid.walls.shape != other.walls.shape:
        return f"{grid.rows} x {grid.cols} cells, not {other.rows} x {other.cols}"
    if grid.depot != other.depot:
        return f"the depot is cell {grid.depot}, not {other.depot}"
    cells = np.flatnonzero(grid.walls != other.walls)
    words = ("free", "a wall")
    first = bool(grid.walls.flat[cells[0]])
    more = f", and {len(cells) - 1} more differ" if len(cells) > 1 else ""
    return f"cell {cells[0]} is {words[first]}, not {words[not first]}{more}"


def _frozen(array: NDArray[np.int32]) -> NDArray[np.int32]:
    array.flags.writeable = False
    return array

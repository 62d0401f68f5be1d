"""Tours as cells, moves and joint actions, and how a team walks them by the rules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.grid import FAR, Grid
from mapp_env.plans.walks import Cells, first_visits, trace_tours, walk_team
from mapp_env.problem import Problem
from mapp_env.validation import as_array, as_integer, describe


def walk_routes(problem: Problem, routes: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return the joint actions, shape (T, N), of a team that walks its routes on shortest paths.

    Routes are landmarks' cells in order, one for each agent: from its start through them to the
    depot, as :func:`walk_tours` says.
    """
    grid, sizes = problem.grid, _lengths(routes)
    padded = _padded(routes, sizes)
    starts, lengths = np.array(problem.start_cells, np.int32), np.empty_like(sizes)
    search = np.empty((2, grid.n_cells), np.int32)
    longest = 256
    width = 0
    while width < longest:
        width = longest
        tours = np.empty((len(sizes), width), np.int32)
        longest = trace_tours(grid.moves, grid.home, starts, padded, sizes, search, tours, lengths)
    return _walk(problem, tours, lengths)


def walk_tours(problem: Problem, tours: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return the joint actions, shape (T, N), of a team that walks its tours without a pause.

    They end when every landmark is visited, or all tours are walked. An agent that is home earlier,
    or has no tour and stays at its start, bumps into a wall, if the cell has one beside it; else it
    steps to and fro, never first on an unvisited landmark: the environment may have no action to
    wait, and nobody should claim more than its tour. Where every neighbour of its cell is an
    unvisited landmark, it follows the first step of an agent before it that has the same start (so
    idle agents should come last), and else waits, action 4, until one is visited.

    Tours are cells from an agent's start to the depot, neighbours in turn, or nothing. The
    problem's step limit is ignored.
    """
    lengths = _lengths(tours)
    return _walk(problem, _padded(tours, lengths), lengths)


def _walk(problem: Problem, tours: Cells, lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    landmarks = np.array(problem.landmarks, np.int32)
    places = np.full(problem.grid.n_cells, -1, np.int32)
    places[landmarks] = np.arange(len(landmarks))
    visits = np.empty((len(landmarks), 2), np.int64)
    n_steps = first_visits(tours, lengths, places, visits)
    if n_steps == FAR:
        n_steps = max(0, int(lengths.max()) - 1)
    actions = np.empty((n_steps, problem.n_agents), np.int64)
    starts = np.array(problem.start_cells, np.int32)
    walk_team(problem.grid.moves, starts, tours, lengths, places, visits, actions)
    return actions


def _lengths(lines: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    return np.array([len(line) for line in lines])


def _padded(lines: Sequence[Sequence[int]], lengths: NDArray[np.int64]) -> Cells:
    """Return lines of cells as an array as wide as the longest."""
    padded = np.empty((len(lines), max(1, int(lengths.max()))), np.int32)
    for row, line in zip(padded, lines, strict=True):
        row[: len(line)] = line
    return padded


def moves_of(grid: Grid, tour: Sequence[int]) -> str:
    """Return the moves of a tour, a digit each: 0 left, 1 right, 2 up, 3 down."""
    cells = np.array(tour, np.int64)
    moves = (grid.moves[cells[:-1]] == cells[1:, None]).argmax(axis=1)
    letters: bytes = (moves + ord("0")).astype(np.uint8).tobytes()
    return letters.decode("ascii")


def tour_of(grid: Grid, start: int, moves: str) -> tuple[int, ...]:
    """Return the cells from a start on that moves lead to, walls and borders unheeded."""
    if not moves:
        return ()
    ways = np.array([-1, 1, -grid.cols, grid.cols])
    digits = np.frombuffer(moves.encode("ascii"), np.uint8) - ord("0")
    cells = np.cumsum(np.append(start, ways[digits]))
    return tuple(cells.tolist())


def check_tours(problem: Problem, tours: Sequence[Sequence[int]]) -> None:
    """Check that each tour is a walk from the agent's start to the depot, or empty.

    Raises a ValueError if one enters a wall, does not start and end there, jumps or stands still.
    """
    grid = problem.grid
    for agent, (tour, start) in enumerate(zip(tours, problem.start_cells, strict=True)):
        if not tour:
            continue
        cells = _as_cells(grid.n_cells, f"plan: tours[{agent}]: cell", tour)
        for cell in cells[grid.walls.ravel()[cells]]:
            raise ValueError(f"plan: tours[{agent}] enters cell {cell}, which is a wall")
        if tour[0] != start or tour[-1] != grid.depot:
            ends = "start and end at the depot"
            if start != grid.depot:
                ends = f"start at cell {start} and end at the depot"
            raise ValueError(
                f"plan: tours[{agent}] must {ends}, cell {grid.depot}; "
                f"it goes from {tour[0]} to {tour[-1]}"
            )
        before, after = cells[:-1], cells[1:]
        steps = (grid.moves[before] == after[:, None]).any(axis=1) & (before != after)
        for place in np.flatnonzero(~steps):
            raise ValueError(
                f"plan: tours[{agent}] jumps from cell {before[place]} to {after[place]}"
            )


def _as_cells(n_cells: int, name: str, tour: Sequence[int]) -> NDArray[np.int64]:
    """Return a tour as an array; tours may be long."""
    cells = as_array(tour)
    if cells.ndim == 1 and cells.dtype.kind in "iu" and 0 <= cells.min() <= cells.max() < n_cells:
        return cells.astype(np.int64)
    wrong = next((cell for cell in tour if as_integer(cell) not in range(n_cells)), tour)
    raise ValueError(f"{name} must be a cell in 0..{n_cells - 1}, got {describe(wrong)}")

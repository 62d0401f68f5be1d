"""Tours as cells, moves and joint actions, and how a team walks them by the rules."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.state import WAIT
from mapp_env.grid import Grid
from mapp_env.problem import Problem
from mapp_env.validation import as_array, as_integer, describe


def tour_through(grid: Grid, landmarks: Iterable[int]) -> tuple[int, ...]:
    """Return the cells of shortest paths depot -> landmarks in order -> depot, or ``()``."""
    cells = [grid.depot]
    for landmark in landmarks:
        cells.extend(grid.path(cells[-1], landmark)[1:])
    if len(cells) == 1:
        return ()
    return (*cells, *grid.path(cells[-1], grid.depot)[1:])


def walk_tours(problem: Problem, tours: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return the joint actions of a team that walks its tours without a pause.

    They end when every landmark is visited, or all tours are walked. An agent that is home earlier
    bumps into a wall, if the depot has one beside it; else it steps to and fro, never first on an
    unvisited landmark: the environment may have no action to wait, and nobody should claim more
    than its tour. Where every neighbour of the depot is an unvisited landmark, an agent without a
    tour follows the first step of one before it that has one (without such an agent it waits,
    action 4), so idle agents should come last.

    Tours are cells from depot to depot, neighbours in turn, or nothing; the result has shape
    (T, N). The problem's step limit is ignored.
    """
    grid = problem.grid
    # Who comes by each landmark first, and when; in one step, the agent of the lowest index.
    claims: dict[int, tuple[float, int]] = dict.fromkeys(problem.landmarks, (math.inf, 0))
    for agent, tour in enumerate(tours):
        for step, cell in enumerate(tour):
            if cell in claims and (step, agent) < claims[cell]:
                claims[cell] = (step, agent)
    n_steps = max(step for step, _ in claims.values())
    if n_steps == math.inf:
        n_steps = max(0, *(len(tour) - 1 for tour in tours))
    actions = np.empty((int(n_steps), len(tours)), np.int64)
    for agent, tour in enumerate(tours):
        cells = np.array(tour[: len(actions) + 1], np.int64)
        walked = max(len(cells) - 1, 0)
        actions[:walked, agent] = _moves(grid, cells)
        actions[walked:, agent] = _idle_actions(grid, claims, agent, walked, len(actions))
    return actions


def _moves(grid: Grid, cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the moves between cells, neighbours in turn."""
    ways = grid.moves[cells[:-1]]
    moves: NDArray[np.int64] = (ways == cells[1:, None]).argmax(axis=1)
    return moves


def moves_of(grid: Grid, tour: Sequence[int]) -> str:
    """Return the moves of a tour, a digit each: 0 left, 1 right, 2 up, 3 down."""
    moves = _moves(grid, np.array(tour, np.int64))
    return (moves + ord("0")).astype(np.uint8).tobytes().decode("ascii")


def tour_of(grid: Grid, moves: str) -> tuple[int, ...]:
    """Return the cells from the depot on that moves lead to, walls and borders unheeded."""
    if not moves:
        return ()
    ways = np.array([-1, 1, -grid.cols, grid.cols])
    digits = np.frombuffer(moves.encode("ascii"), np.uint8) - ord("0")
    cells = np.cumsum(np.append(grid.depot, ways[digits]))
    return tuple(cells.tolist())


def _idle_actions(
    grid: Grid, claims: dict[int, tuple[float, int]], agent: int, start: int, end: int
) -> list[int]:
    """Return the actions of an agent on the depot, after step ``start``, that claim nothing."""
    ways = grid.moves[grid.depot].tolist()
    if grid.depot in ways:
        return [ways.index(grid.depot)] * (end - start)
    for step in range(start, end):
        for action, to in enumerate(ways):
            # Agents claim in the order of their index, so who comes later may follow.
            if claims.get(to, (0, 0)) < (step + 1, agent):
                back = grid.moves[to].tolist().index(grid.depot)
                to_and_fro = [action, back] * (end - step)
                return [WAIT] * (step - start) + to_and_fro[: end - step]
    return [WAIT] * (end - start)


def check_tours(problem: Problem, tours: Sequence[Sequence[int]]) -> None:
    """Check that each tour is a closed walk from the depot, or empty.

    Raises a ValueError if one enters a wall, does not start and end at the depot, jumps or stands
    still.
    """
    grid = problem.grid
    for agent, tour in enumerate(tours):
        if not tour:
            continue
        cells = _as_cells(grid.n_cells, f"plan: tours[{agent}]: cell", tour)
        for cell in cells[grid.walls.ravel()[cells]]:
            raise ValueError(f"plan: tours[{agent}] enters cell {cell}, which is a wall")
        if tour[0] != grid.depot or tour[-1] != grid.depot:
            raise ValueError(
                f"plan: tours[{agent}] must start and end at the depot, cell {grid.depot}; "
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

"""Shortest paths on a grid, against a search that knows nothing of tables."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
from numpy.typing import NDArray

from mapp_env import Grid
from mapp_env.paths import fill_distances


def steps_from(walls: NDArray[np.bool_], start: int) -> list[int]:
    """Return the steps from a free cell to all cells, by a queue of rows and columns."""
    steps = np.full(walls.shape, -1)
    queue = deque([divmod(start, walls.shape[1])])
    steps[queue[0]] = 0
    while queue:
        row, col = queue.popleft()
        for r, c in ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)):
            inside = 0 <= r < walls.shape[0] and 0 <= c < walls.shape[1]
            if inside and not walls[r, c] and steps[r, c] < 0:
                steps[r, c] = steps[row, col] + 1
                queue.append((r, c))
    return steps.ravel().tolist()


def random_walls(rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return walls of any density, from none to nearly everywhere, on 1..12 rows and columns."""
    rows, cols = rng.integers(1, 13, 2)
    walls = rng.random((rows, cols)) < rng.choice([0.0, 0.2, 0.4, 0.9])
    walls.flat[rng.integers(walls.size)] = False
    return walls


def test_distances_are_those_of_a_plain_search() -> None:
    """From every cell of 150 random grids, by both tables, and -1 in all of a wall's line."""
    rng = np.random.default_rng(11)
    for _ in range(150):
        grid = Grid(random_walls(rng))
        wide = np.column_stack([grid.moves, grid.moves[:, :2]])
        walls = grid.walls.ravel()
        nowhere = [-1] * grid.n_cells
        for start, line in enumerate(grid.distances.tolist()):
            assert line == (nowhere if walls[start] else steps_from(grid.walls, start))
            if not walls[start]:
                found, queue = np.empty((2, grid.n_cells), np.int32)
                fill_distances(wide, start, found, queue)
                assert found.tolist() == line
        assert grid.home.tolist() == grid.distances[grid.depot].tolist()
        assert grid.reachable.tolist() == np.flatnonzero(grid.home > 0).tolist()


def test_a_search_that_stops_knows_all_nearer_cells() -> None:
    """Up to the cell where it stops distances are the full search's; beyond, those or none."""
    rng = np.random.default_rng(12)
    for _ in range(300):
        grid = Grid(random_walls(rng))
        free = np.flatnonzero(~grid.walls.ravel())
        start, stop = rng.choice(free, 2).tolist()
        full = np.array(steps_from(grid.walls, start))
        found, queue = np.empty((2, grid.n_cells), np.int32)
        fill_distances(grid.moves, start, found, queue, stop)
        near = full <= full[stop] if full[stop] >= 0 else np.ones_like(full, np.bool_)
        assert (found[near] == full[near]).all()
        assert ((found == full) | (found == -1)).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (30, 30)])
def test_the_queue_holds_a_grid_without_walls(shape: tuple[int, int]) -> None:
    """With every cell free the search writes no further than the queue's end."""
    grid = Grid(np.zeros(shape, np.bool_))
    for start in range(grid.n_cells):
        steps = np.empty(grid.n_cells, np.int32)
        room = np.full(grid.n_cells + 1, -7, np.int32)
        fill_distances(grid.moves, start, steps, room[:-1])
        assert room[-1] == -7
        assert steps.tolist() == grid.manhattan_from([start])[0].tolist()


def test_paths_are_shortest_and_the_first_in_action_order() -> None:
    """Each step of a path is the first move that comes one step nearer to its end."""
    rng = np.random.default_rng(13)
    for _ in range(200):
        grid = Grid(random_walls(rng))
        start, end = rng.choice(np.flatnonzero(~grid.walls.ravel()), 2).tolist()
        steps = steps_from(grid.walls, end)
        if steps[start] < 0:
            with pytest.raises(ValueError, match="there is no path"):
                grid.path(start, end)
            continue
        path = [start]
        while path[-1] != end:
            nearer = steps[path[-1]] - 1
            path.append(next(int(to) for to in grid.moves[path[-1]] if steps[to] == nearer))
        assert grid.path(start, end) == tuple(path)

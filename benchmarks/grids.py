"""Measure how fast grids are made, read and searched, on one core.

"pool" is the time a map of `make_grids` with all four generators; "tables" what an environment adds
to it: the table of moves and the steps to the depot. "fields" is what a reset of one row costs on a
grid that is too large for the distances of all pairs, or in a pool: a breadth-first search for each
of its 20 landmarks, as the engine does it. "text" is the reading of the largest map. Everything is
compiled beforehand, and each figure is the best of five; times vary with the machine.

    python benchmarks/grids.py                          # a quarter of a minute
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from mapp_env import Grid, make_grid, make_grids, sample_problems
from mapp_env.engine.loops import fill_fields
from mapp_env.engine.state import new_rows, open_actions, pack, split
from mapp_env.engine.world import make_world

NAMES = ("random", "rooms", "maze", "warehouse")
N_LANDMARKS = 20
ROWS = 100
LARGEST = 2048


def best(function: Callable[[], object], count: int = 1) -> float:
    """Return the least seconds of five runs, divided by what one run makes."""
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - start)
    return min(seconds) / count


def fields_of(grid: Grid) -> Callable[[], None]:
    """Return the filling of the fields of some rows, each with a problem of its own."""
    rows = new_rows(ROWS, 1, N_LANDMARKS)
    split(rows, 1, N_LANDMARKS).landmarks[:] = sample_problems(grid, ROWS, N_LANDMARKS, seed=1)
    fields = np.empty((ROWS * grid.n_cells, N_LANDMARKS), np.int32)
    scratch = np.empty((N_LANDMARKS + 1, grid.n_cells), np.int32)
    world, indices = pack(make_world(grid, 1, N_LANDMARKS)), np.arange(ROWS)
    return lambda: fill_fields(rows, indices, grid.moves, fields, scratch, world)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--maps", type=int, default=1_000, help="of a pool")
    args = parser.parse_args()
    make_grids(NAMES, 20)
    rows = []
    for label, names, sides in (
        ("16 x 16, all four", NAMES, {"rows": 16, "cols": 16}),
        *((f"16 x 16, {name}", name, {"rows": 16, "cols": 16}) for name in NAMES),
        ("7..24 x 7..24, all four", NAMES, {}),
    ):
        seconds = best(lambda names=names, sides=sides: make_grids(names, args.maps, **sides))
        rows.append((f"pool, {label}", 1e3 * seconds / args.maps, "ms a map"))
    grids = make_grids(NAMES, args.maps, rows=16, cols=16)
    start = time.perf_counter()  # once: they are kept
    for grid in grids:
        open_actions(grid)
        _ = grid.moves, grid.home
    rows.append(("tables, 16 x 16", 1e3 * (time.perf_counter() - start) / args.maps, "ms a map"))
    for name in NAMES:
        fill = fields_of(make_grid(name, rows=32, cols=32, seed=1))
        fill()
        rows.append((f"fields, 32 x 32 {name}", 1e6 * best(fill, ROWS), "us a row"))
    largest = Grid(np.random.default_rng(0).random((LARGEST, LARGEST)) < 0.2)
    text = largest.to_text()
    seconds = best(lambda: Grid.from_text(text))
    rows.append((f"text, {LARGEST} x {LARGEST}", 1e3 * seconds, "ms"))
    for label, value, unit in rows:
        print(f"{label:<36} {value:>8.2f} {unit}")


if __name__ == "__main__":
    main()

"""Grids by name: bundled ones, and generators of further ones; and many at once."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

from mapp_env.grid import Grid
from mapp_env.grids.bundled import bundled_grid, grid_names
from mapp_env.grids.generators import GENERATORS, option_names
from mapp_env.grids.pools import load_grids, make_grids
from mapp_env.validation import check_choice, describe

__all__ = [
    "find_grid",
    "find_grids",
    "generator_names",
    "grid_names",
    "load_grids",
    "make_grid",
    "make_grids",
]


def generator_names() -> tuple[str, ...]:
    """Return the names of the generators, sorted."""
    return tuple(sorted(GENERATORS))


def make_grid(name: str = "paper-7x7", **options: Any) -> Grid:
    """Return a bundled grid, or a generated one.

    Parameters
    ----------
    name : str
        A bundled grid, which takes no options:

        - ``"paper-7x7"``: 7 x 7, depot in the centre, eight walls (rule R1; paper, section 3);

        or a generator:

        - ``"random"``: walls strewn at random (:func:`~mapp_env.grids.generators.random_grid`);
        - ``"rooms"``: rooms with doors (:func:`~mapp_env.grids.generators.rooms_grid`);
        - ``"maze"``: a maze (:func:`~mapp_env.grids.generators.maze_grid`);
        - ``"warehouse"``: shelves and aisles (:func:`~mapp_env.grids.generators.warehouse_grid`).
    **options
        Of a generator: ``rows`` and ``cols`` up to 2048, ``seed``, and ``density`` of "random",
        ``room`` of "rooms", ``loops`` of "maze", ``shelf_length``, ``aisle`` and ``gaps`` of
        "warehouse". Every free cell of a generated grid can be reached from its depot.

    Raises
    ------
    ValueError
        If there is no such grid or option, the message lists what there is; or if an option's
        value is not allowed.
    """
    check_choice("name", name, (*grid_names(), *generator_names()))
    allowed = ("rows", "cols", "seed", *option_names(name)) if name in GENERATORS else ()
    for option in options:
        if option not in allowed:
            listed = ", ".join(allowed) or "no options"
            raise ValueError(f"make_grid({name!r}) takes {listed}; got {option!r}")
    return GENERATORS[name](**options) if name in GENERATORS else bundled_grid(name)


def find_grid(grid: object) -> Grid:
    """Return the grid meant by a grid, a bundled name or a path to a map file.

    A dict of a grid's text is one, too: what is left of a grid in the JSON of an environment's
    spec. Raises a ValueError if ``grid`` is none of them, or the file cannot be used.
    """
    if isinstance(grid, Grid):
        return grid
    if isinstance(grid, Mapping) and set(grid) == {"text"}:
        try:
            return Grid.from_text(grid["text"])
        except ValueError as error:
            raise ValueError(f"grid: {error}") from error
    if isinstance(grid, str) and grid in grid_names():
        return make_grid(grid)
    if isinstance(grid, os.PathLike) or (isinstance(grid, str) and os.path.lexists(grid)):
        return Grid.load(grid)
    if isinstance(grid, str) and grid in generator_names():
        raise ValueError(
            f"grid must be a mapp_env.Grid, a bundled name or a map file: "
            f"mapp_env.make_grid({grid!r}) generates one; got {grid!r}"
        )
    missing = ", and there is no such file" if isinstance(grid, str) else ""
    raise ValueError(
        f"grid must be a mapp_env.Grid, a bundled name ({', '.join(grid_names())}) or a path to a "
        f"map file; got {describe(grid, 320)}{missing}"
    )


def find_grids(grid: object) -> Grid | tuple[Grid, ...]:
    """Return the grid meant as in :func:`find_grid`, or the grids of a pool, a sequence of them.

    Raises a ValueError if ``grid`` is neither, or a pool has no grids or something else among them.
    """
    if not isinstance(grid, Sequence) or isinstance(grid, str | bytes):
        return find_grid(grid)
    if not grid:
        raise ValueError("grid must be a grid, or a sequence of at least one, got none")
    for index, each in enumerate(grid):
        # As text, in a dict, a grid is in the JSON of an environment's spec.
        if not isinstance(each, Grid | Mapping):
            raise ValueError(
                f"grid[{index}] must be a mapp_env.Grid, as make_grid(), make_grids(), "
                f"load_grids() and Grid.load() return it; got {describe(each)}"
            )
    return tuple(map(find_grid, grid))

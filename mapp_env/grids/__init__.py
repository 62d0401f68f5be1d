"""Grids by name: bundled ones, and generators of further ones."""

from __future__ import annotations

import inspect
from functools import cache
from importlib import resources
from typing import Any

from mapp_env.grid import Grid
from mapp_env.grids.generators import GENERATORS
from mapp_env.validation import check_choice

__all__ = ["generator_names", "grid_names", "make_grid"]


@cache
def grid_names() -> tuple[str, ...]:
    """Return the names of the bundled grids, sorted."""
    files = resources.files(__name__).iterdir()
    return tuple(sorted(file.name[:-4] for file in files if file.name.endswith(".txt")))


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
        Of a generator: ``rows`` and ``cols`` up to 512, ``seed``, and ``density`` of "random",
        ``room`` of "rooms", ``loops`` of "maze", ``shelf_length``, ``aisle`` and ``gaps`` of
        "warehouse". Every free cell of a generated grid can be reached from its depot.

    Raises
    ------
    ValueError
        If there is no such grid or option, the message lists what there is; or if an option's
        value is not allowed.
    """
    check_choice("name", name, (*grid_names(), *generator_names()))
    allowed = inspect.signature(GENERATORS[name]).parameters if name in GENERATORS else {}
    for option in options:
        if option not in allowed:
            listed = ", ".join(allowed) if allowed else "no options"
            raise ValueError(f"make_grid({name!r}) takes {listed}; got {option!r}")
    return GENERATORS[name](**options) if name in GENERATORS else _load(name)


@cache
def _load(name: str) -> Grid:
    """Read a bundled grid once: grids are frozen, so that all users can share one."""
    return Grid.from_text(resources.files(__name__).joinpath(f"{name}.txt").read_text("ascii"))

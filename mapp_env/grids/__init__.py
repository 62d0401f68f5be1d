"""Bundled grids, by name."""

from __future__ import annotations

from functools import cache
from importlib import resources

from mapp_env.grid import Grid
from mapp_env.validation import check_choice

__all__ = ["grid_names", "make_grid"]


@cache
def grid_names() -> tuple[str, ...]:
    """Return the names of the bundled grids, sorted."""
    files = resources.files(__name__).iterdir()
    return tuple(sorted(file.name[:-4] for file in files if file.name.endswith(".txt")))


def make_grid(name: str = "paper-7x7") -> Grid:
    """Return a bundled grid.

    Parameters
    ----------
    name : str
        ``"paper-7x7"``: 7 x 7, depot in the centre, eight walls (rule R1; paper, section 3).

    Raises
    ------
    ValueError
        If there is no such grid; the message lists the names.
    """
    return _load(check_choice("name", name, grid_names()))


@cache
def _load(name: str) -> Grid:
    """Read a bundled grid once: grids are frozen, so that all users can share one."""
    return Grid.from_text(resources.files(__name__).joinpath(f"{name}.txt").read_text("ascii"))

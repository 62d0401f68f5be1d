"""The grids that come with the package, each a text file beside this one."""

from __future__ import annotations

from functools import cache
from importlib import resources

from mapp_env.grid import Grid

FOLDER = "mapp_env.grids"


@cache
def grid_names() -> tuple[str, ...]:
    """Return the names of the bundled grids, sorted."""
    files = resources.files(FOLDER).iterdir()
    return tuple(sorted(file.name[:-4] for file in files if file.name.endswith(".txt")))


@cache
def bundled_grid(name: str) -> Grid:
    """Read a bundled grid once: grids are frozen, so that all users can share one."""
    return Grid.from_text(resources.files(FOLDER).joinpath(f"{name}.txt").read_text("ascii"))

"""Many grids at once: drawn from generators, or read from files."""

from __future__ import annotations

import bisect
import glob
import os
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from mapp_env.grid import Grid
from mapp_env.grids.bundled import bundled_grid, grid_names
from mapp_env.grids.generators import GENERATORS, LEAST_SIDES, OPTIONS, option_names
from mapp_env.map_format import MAX_SIDE
from mapp_env.validation import MAX_SEED, check_choice, check_count, check_number, describe

MAX_GRIDS = 1_000_000
TRIES = 100  # draws for one grid, until it has room for its landmarks
MAX_WEIGHT = 1e9


def make_grids(
    names: str | Sequence[str] | Mapping[str, float],
    n: int,
    rows: int | tuple[int, int] = (7, 24),
    cols: int | tuple[int, int] = (7, 24),
    seed: int = 0,
    min_landmarks: int = 1,
    **options: Any,
) -> tuple[Grid, ...]:
    """Draw many grids, of one kind or of several: a pool of maps to train on, or to be tested on.

    Everything about a grid is drawn on its own: first its name, then its sides, the options of its
    generator, and what the generator itself draws. Grid ``i`` depends on the seed and on ``i``
    alone, so that the first ten of a thousand are the ten that ``n=10`` makes.

    Parameters
    ----------
    names : str, sequence of str, or mapping of str to float
        A generator's or a bundled grid's name, as for :func:`mapp_env.make_grid`; several, of which
        each grid has one, all equally likely; or several with weights: ``{"maze": 1, "rooms": 3}``.
    n : int
        How many grids, 1 to 1,000,000.
    rows, cols : int or (int, int)
        Sides, or their range, both ends included, within 1 to 2048. A generator draws from those of
        the range that it takes ("random" from 2, "maze" and "rooms" from 3, "warehouse" from 6);
        "maze" from the odd ones, if there are any, as corridors run on every other line.
    seed : int
        Which grids; others share none, but by chance.
    min_landmarks : int
        Cells that a landmark can stand on, at least, in every grid: with fewer it is drawn again.
        With the default sides and options there are always 15.
    **options
        Of the generators, each one value for all grids or a range (low, high), both ends included;
        it is heeded by the generators that take it. By default each grid has its own:

        - ``density`` of "random" from 0 to 0.35;
        - ``room`` of "rooms" from 2 to 5;
        - ``loops`` of "maze" from 0.02 to 0.5;
        - ``shelf_length`` of "warehouse" from 2 to 8, ``aisle`` 1 or 2, ``gaps`` from 0 to 0.2.

    Returns
    -------
    tuple of Grid
        ``n`` grids. Bundled ones are as they are, whatever the sides and options.

    Raises
    ------
    ValueError
        If a name or an option is unknown, a value or a range is not allowed, no side of a range is
        one that a generator takes, or there is no room for so many landmarks.
    """
    kinds, weights = _check_names(names)
    n = check_count("n", n, 1, MAX_GRIDS)
    sides = {side: _check_range(side, value) for side, value in (("rows", rows), ("cols", cols))}
    seed = check_count("seed", seed, 0, MAX_SEED)
    min_landmarks = check_count("min_landmarks", min_landmarks, 1, MAX_SIDE**2 - 1)
    taken = dict.fromkeys(name for kind in kinds for name in option_names(kind))
    for name in options:
        if name not in taken:
            listed = ", ".join(("rows", "cols", "seed", "min_landmarks", *taken))
            raise ValueError(f"make_grids({describe(names)}) takes {listed}; got {name!r}")
    ranges = {name: _check_range(name, options.get(name, OPTIONS[name].usual)) for name in taken}
    recipes = [_recipe(kind, sides, ranges, min_landmarks) for kind in kinds]
    marks = list(accumulate(weights))
    grids = []
    for index in range(n):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
        place = bisect.bisect_right(marks[:-1], rng.random() * marks[-1])
        grids.append(_draw(recipes[place], rng, min_landmarks))
    return tuple(grids)


class _Range(NamedTuple):
    """Values from ``low`` to ``high``, both included: whole numbers ``step`` apart, or real."""

    low: float
    high: float
    step: int  # 0 for real numbers

    def draw(self, rng: np.random.Generator) -> float:
        """Return one of them, each equally likely."""
        if self.step:
            count = (self.high - self.low) // self.step + 1
            return self.low + self.step * int(rng.random() * count)
        return min(self.low + (self.high - self.low) * rng.random(), self.high)


class _Recipe(NamedTuple):
    """What a generator's grids are made from; a bundled grid's name has no arguments."""

    kind: str
    arguments: dict[str, _Range]


def _draw(recipe: _Recipe, rng: np.random.Generator, min_landmarks: int) -> Grid:
    """Return a grid with room for so many landmarks."""
    if recipe.kind not in GENERATORS:
        return bundled_grid(recipe.kind)
    for _ in range(TRIES):
        drawn = {name: values.draw(rng) for name, values in recipe.arguments.items()}
        seed = int(rng.random() * 2**53)
        try:
            grid = GENERATORS[recipe.kind](seed=seed, **drawn)
        except ValueError:  # so many walls that nothing is connected
            continue
        # Generators leave no free cell that the depot is cut off from.
        if np.count_nonzero(grid.walls) < grid.n_cells - min_landmarks:
            return grid
    raise ValueError(
        f"rows and cols must leave room for min_landmarks={min_landmarks}: {TRIES} draws of "
        f"{recipe.kind!r} did not, the last with {drawn}"
    )


def _check_names(names: object) -> tuple[tuple[str, ...], list[float]]:
    """Return the names of a mixture and their weights."""
    given = (names,) if isinstance(names, str) else names
    if not isinstance(given, Mapping | list | tuple) or not given:
        raise ValueError(
            "names must be the name of a grid, a sequence of names or a mapping of names to "
            f"weights, got {describe(names)}"
        )
    for name in given:
        check_choice("names", name, (*grid_names(), *GENERATORS))
    if not isinstance(given, Mapping):
        return tuple(given), [1.0] * len(given)
    weights = [check_number(f"names[{name!r}]", w, 0, MAX_WEIGHT) for name, w in given.items()]
    if not sum(weights):
        raise ValueError(f"names must have a weight above 0, got {describe(names)}")
    return tuple(given), weights


def _check_range(name: str, value: object) -> _Range:
    """Return the range meant by one value, or by its two ends."""
    ends = value if isinstance(value, tuple | list) else (value, value)
    if len(ends) != 2:
        raise ValueError(f"{name} must be one value or a range (low, high), got {describe(value)}")
    if name in OPTIONS:
        low, high = (OPTIONS[name].check(name, end) for end in ends)
        step = OPTIONS[name].step
    else:
        low, high = (check_count(name, end, 1, MAX_SIDE) for end in ends)
        step = 1
    if low > high:
        raise ValueError(f"{name} must be a range (low, high) with low <= high, got {value}")
    return _Range(low, high, step)


def _recipe(
    kind: str, sides: Mapping[str, _Range], ranges: Mapping[str, _Range], min_landmarks: int
) -> _Recipe:
    """Return what of the ranges a generator takes."""
    if kind not in GENERATORS:
        room = bundled_grid(kind).reachable.size
        if room < min_landmarks:
            raise ValueError(
                f"min_landmarks must be at most {room}, the cells of {kind!r} that may hold one; "
                f"got {min_landmarks}"
            )
        return _Recipe(kind, {})
    arguments = {}
    for side, (low, high, step) in sides.items():
        least = LEAST_SIDES[kind]
        if high < least:
            raise ValueError(f"{side} must reach {least}, the least of {kind!r}; got {high}")
        low = max(low, least)
        if kind == "maze" and low + 1 - low % 2 <= high:
            low, step = low + 1 - low % 2, 2
        arguments[side] = _Range(low, high, step)
    return _Recipe(kind, arguments | {name: ranges[name] for name in option_names(kind)})


def load_grids(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    depot: object = None,
    free: object = None,
    walls: object = None,
) -> tuple[Grid, ...]:
    """Read many map files, as :meth:`mapp_env.Grid.load` reads each.

    Parameters
    ----------
    paths : str, os.PathLike, or sequence of them
        A folder, of which all ``.map`` files are read; a pattern such as ``"maps/*.map"``, in which
        ``**`` stands for folders of any depth; or the paths of files, in that order. What a folder
        holds and a pattern matches is read in the order of the paths' letters.
    depot : int or (int, int), optional
        Of all of them; by default each map's own, or its free cell nearest to the centre.
    free, walls : str or set of str, optional
        Letters that mean a free cell, or a wall, in these maps (see :meth:`mapp_env.Grid.load`).

    Returns
    -------
    tuple of Grid
        One for each file.

    Raises
    ------
    ValueError
        If there is no such file, or one cannot be used; the message names its path.
    """
    if isinstance(paths, str | os.PathLike):
        found = _find(os.fspath(paths))
    elif isinstance(paths, list | tuple):
        found = list(paths)
    else:
        found = []
    if not found:
        raise ValueError(
            "paths must be a folder with .map files, a pattern that matches some, or a list of "
            f"files; got {describe(paths, 320)}"
        )
    return tuple(Grid.load(path, depot, free, walls) for path in found)


def _find(path: str) -> list[str]:
    """Return the files that a folder or a pattern stands for, sorted."""
    if os.path.isdir(path):
        return sorted(glob.glob(os.path.join(glob.escape(path), "*.map")))
    if os.path.lexists(path):  # whatever letters its name has
        return [path]
    found = glob.glob(path, recursive=True)
    return sorted(name for name in found if not os.path.isdir(name))

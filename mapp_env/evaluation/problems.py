"""What is played: problems, in whatever form they are given, in groups that a batch can hold."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.grid import Grid
from mapp_env.grids import find_grid, find_grids
from mapp_env.problem import MAX_AGENTS, MAX_CYCLES, Problem, check_landmarks
from mapp_env.validation import as_array, check_count, describe

SUFFIX = ".json"  # of problem files in a folder
DEFAULT_AGENTS = 3
MAX_POOL_CELLS = 1 << 22  # of all grids of a group: tables of 160 MiB

FORMS = (
    "mapp_env.Problems, problem files, a folder of these, or landmarks of shape (P, K) with grid="
)


class Group(NamedTuple):
    """P problems with N agents and K landmarks each."""

    places: NDArray[np.int64]  # (P,), among all that are judged
    grids: tuple[Grid, ...]
    which: NDArray[np.int64]  # (P,), the index of each one's grid
    landmarks: NDArray[np.int32]  # (P, K)
    starts: NDArray[np.int32]  # (P, N)
    limits: NDArray[np.int64]  # (P,), steps

    @property
    def n_agents(self) -> int:
        """How many agents each has."""
        return int(self.starts.shape[1])

    @property
    def from_depots(self) -> NDArray[np.bool_]:
        """Which problems have all agents on the depot at first, (P,)."""
        depots = np.array([grid.depot for grid in self.grids])[self.which]
        found: NDArray[np.bool_] = (self.starts == depots[:, None]).all(axis=1)
        return found

    @property
    def cols(self) -> NDArray[np.int64]:
        """Columns of each one's grid, (P,)."""
        found: NDArray[np.int64] = np.array([grid.cols for grid in self.grids])[self.which]
        return found

    @property
    def pool(self) -> Grid | tuple[Grid, ...]:
        """The grid of an environment for them."""
        return self.grids[0] if len(self.grids) == 1 else self.grids

    def part(self, rows: NDArray[np.int64]) -> Group:
        """Return some of them."""
        return Group(
            self.places[rows],
            self.grids,
            self.which[rows],
            self.landmarks[rows],
            self.starts[rows],
            self.limits[rows],
        )

    def problem(self, row: int) -> Problem:
        """Return one of them."""
        sizes = self.n_agents, int(self.limits[row])
        starts = tuple(self.starts[row].tolist())
        landmarks = tuple(self.landmarks[row].tolist())
        return Problem(self.grids[self.which[row]], landmarks, *sizes, starts)


def enough_steps(grid: Grid, n_landmarks: int, return_home: bool = False) -> int:
    """Return as many steps as one agent needs that walks from each landmark to the next."""
    return min(2 * int(grid.home.max()) * (n_landmarks + return_home), MAX_CYCLES)


def group_rows(
    grid: Grid, landmarks: NDArray[np.integer[Any]], n_agents: int, max_cycles: int
) -> Group:
    """Return problems of one grid, their landmarks a row each, (P, K), as a group."""
    count = len(landmarks)
    return Group(
        np.arange(count),
        (grid,),
        np.zeros(count, np.int64),
        landmarks.astype(np.int32),
        np.full((count, n_agents), grid.depot, np.int32),
        np.full(count, max_cycles),
    )


def group_problems(
    problems: Sequence[Problem],
    limits: Sequence[int],
    by_shape: bool = False,
    pool: Sequence[Grid] = (),
) -> list[Group]:
    """Return problems of any grids and sizes in groups of equal N and K, the first one's first.

    ``limits`` are their step limits; ``by_shape`` keeps grids of different sides apart. A ``pool``
    that holds all their grids is that of each group; without it each has its own problems' grids.
    """
    alike: dict[tuple[object, ...], list[int]] = {}
    for place, problem in enumerate(problems):
        shape = problem.grid.walls.shape if by_shape and not pool else None
        alike.setdefault((problem.n_agents, len(problem.landmarks), shape), []).append(place)
    groups = []
    for places in alike.values():
        grids = dict.fromkeys(pool)
        room, first = MAX_POOL_CELLS, 0
        for last, place in enumerate(places):
            grid = problems[place].grid
            if grid not in grids and grids and grid.n_cells > room:
                groups.append(_group(problems, limits, places[first:last], list(grids)))
                grids, room, first = {}, MAX_POOL_CELLS, last
            if grid not in grids:
                grids[grid] = None
                room -= grid.n_cells
        groups.append(_group(problems, limits, places[first:], list(grids)))
    return groups


def _group(
    problems: Sequence[Problem], limits: Sequence[int], places: list[int], grids: list[Grid]
) -> Group:
    numbers = {grid: number for number, grid in enumerate(grids)}
    return Group(
        np.array(places),
        tuple(grids),
        np.array([numbers[problems[place].grid] for place in places]),
        np.array([problems[place].landmarks for place in places], np.int32),
        np.array([problems[place].start_cells for place in places], np.int32),
        np.array([limits[place] for place in places]),
    )


def read_groups(
    problems: object,
    grid: object = None,
    n_agents: int | None = None,
    max_cycles: int | None = None,
    return_home: bool = False,
    by_shape: bool = False,
) -> list[Group]:
    """Return what :func:`mapp_env.evaluate` is given as groups; the arguments are its own.

    ``by_shape`` is as in :func:`group_problems`.

    Raises a ValueError if there is no problem, or one is invalid.
    """
    if max_cycles is not None:
        check_count("max_cycles", max_cycles, 1, MAX_CYCLES)
    found = read_problems(problems)
    if found is None:
        rows, own = _read_rows(problems, grid)
        agents = DEFAULT_AGENTS if n_agents is None else n_agents
        check_count("n_agents", agents, 1, MAX_AGENTS)
        limit = max_cycles or enough_steps(own, rows.shape[1], return_home)
        return [group_rows(own, rows, agents, limit)]
    if n_agents is not None:
        raise ValueError(
            f"n_agents must be left out with problems that bring theirs, got {describe(n_agents)}"
        )
    pool: tuple[Grid, ...] = ()
    if grid is not None:
        whole = find_grids(grid)
        pool = whole if isinstance(whole, tuple) else (whole,)
    known = set(pool)
    for place, problem in enumerate(found if pool else []):
        if problem.grid not in known:
            raise ValueError(
                f"problems[{place}] must be on a grid of grid=, which has {len(pool)}, got "
                f"{problem!r}"
            )
    limits = [
        max_cycles or each.max_cycles or enough_steps(each.grid, len(each.landmarks), return_home)
        for each in found
    ]
    return group_problems(found, limits, by_shape, pool)


def read_problems(problems: object) -> list[Problem] | None:
    """Return problems, from files if need be; None if they are neither."""
    if isinstance(problems, str | os.PathLike):
        return load_problems(problems)
    if isinstance(problems, np.ndarray) or not isinstance(problems, Sequence) or not problems:
        return None
    if all(isinstance(each, Problem) for each in problems):
        return list(problems)
    if all(isinstance(each, str | os.PathLike) for each in problems):
        return [problem for path in problems for problem in load_problems(path)]
    return None


def load_problems(path: str | os.PathLike[str]) -> list[Problem]:
    """Return the problem of a file, or those of all problem files in a folder, by name.

    Raises a ValueError if there is none, or a file cannot be read.
    """
    folder = Path(path)
    files = [folder]
    if folder.is_dir():
        files = sorted(file for file in folder.iterdir() if file.suffix == SUFFIX)
        if not files:
            raise ValueError(f"problems must be in files *{SUFFIX}, there is none in {folder}")
    found = []
    for file in files:
        try:
            found.append(Problem.load(file))
        except ValueError as error:
            raise ValueError(f"problems: {error}") from error
    return found


def _read_rows(problems: object, grid: Any) -> tuple[NDArray[np.int64], Grid]:
    """Return rows of landmarks (P, K) that satisfy rule R2 on a grid."""
    rows = as_array(problems)
    if rows.ndim != 2 or 0 in rows.shape or rows.dtype.kind not in "iu":
        raise ValueError(f"problems must be {FORMS}, got {describe(problems)}")
    if grid is None:
        raise ValueError("grid must be given with landmarks, as a name, a path or a Grid; got None")
    whole = find_grid(grid)
    ordered = np.sort(rows, axis=1)
    fine = np.isin(rows, whole.reachable).all(axis=1)
    fine &= (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
    for row in np.flatnonzero(~fine):
        check_landmarks(whole, rows[row], name=f"problems[{row}]")
    return rows.astype(np.int64), whole

"""Whether tours and claims are ones of a problem, before anything is carried out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.problem import Problem
from mapp_env.validation import as_integer, describe

__all__ = ["check_claims", "check_tours"]


def check_tours(problem: Problem, tours: Sequence[Sequence[int]]) -> None:
    """Check that each tour is a closed walk from the depot, or empty.

    Raises
    ------
    ValueError
        If one enters a wall, does not start and end at the depot, jumps or stands still.
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
    try:
        cells = np.asarray(tour)
    except ValueError:
        cells = np.array(None)  # ragged
    if cells.ndim == 1 and cells.dtype.kind in "iu" and 0 <= cells.min() <= cells.max() < n_cells:
        return cells.astype(np.int64)
    wrong = next((cell for cell in tour if as_integer(cell) not in range(n_cells)), tour)
    raise ValueError(f"{name} must be a cell in 0..{n_cells - 1}, got {describe(wrong)}")


def check_claims(
    problem: Problem, tours: Sequence[Sequence[int]], claims: Sequence[Sequence[int]], whole: bool
) -> None:
    """Check that claims are landmarks, each once, visited in order, with the shortest way home.

    Parameters
    ----------
    problem : Problem
        What the plan is for.
    tours : sequence of sequence of int
        That :func:`check_tours` has passed.
    claims : sequence of sequence of int
        For each agent.
    whole : bool
        Whether every landmark must be claimed.

    Raises
    ------
    ValueError
        If they are not.
    """
    claimed = [cell for cells in claims for cell in cells]
    if len(set(claimed)) < len(claimed) or not set(claimed) <= set(problem.landmarks):
        raise ValueError(f"plan: claims must be landmarks, each once, got {describe(claims)}")
    missing = sorted(set(problem.landmarks) - set(claimed))
    if whole and missing:
        raise ValueError(f"plan: nobody claims the landmark on cell {missing[0]}")
    for agent, (tour, cells) in enumerate(zip(tours, claims, strict=True)):
        if bool(tour) != bool(cells):
            raise ValueError(
                f"plan: agent {agent} has {len(cells)} claims and a tour of {len(tour)} cells"
            )
        if not _in_order(tour, cells):
            raise ValueError(f"plan: tours[{agent}] does not visit its claims in their order")
        if cells and tour[::-1].index(cells[-1]) != problem.grid.home[cells[-1]]:
            raise ValueError(
                f"plan: tours[{agent}] must take a shortest path home from its last claim"
            )


def _in_order(tour: Sequence[int], cells: Sequence[int]) -> bool:
    """Return whether a tour comes by some cells in their order."""
    rest = iter(tour)
    return all(cell in rest for cell in cells)

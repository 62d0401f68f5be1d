"""What a solver is given, distances, and what it hands back: routes, and what is proven of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import Grid
from mapp_env.paths import fill_distances
from mapp_env.problem import Problem

UNBOUNDED = 1 << 60  # more than any cost, weighted or scaled; twice it is still an int64

Routes = tuple[tuple[int, ...], ...]
"""For each agent the landmark cells that it visits, in order; an agent may have none."""


@dataclass(frozen=True)
class Solution:
    """A solver's answer; :func:`mapp_env.solve` turns it into a plan.

    Attributes
    ----------
    routes : tuple of tuple of int
        For each agent its landmark cells in order; every landmark of the problem once.
    bound : int
        A proven lower bound of the objective: no plan of the problem costs less.
    optimal : bool
        Whether the routes cost exactly ``bound``.
    """

    routes: Routes
    bound: int
    optimal: bool


def solution_of(
    problem: Problem, routes: Iterable[Iterable[int]], cost: int, bound: int
) -> Solution:
    """Return routes through nodes, ``k + 1`` for the problem's landmark ``k``, as a solution.

    There may be fewer routes than agents. ``cost`` is theirs in the objective, ``bound`` a proven
    lower bound of it.
    """
    found = [tuple(problem.landmarks[node - 1] for node in route) for route in routes]
    idle = problem.n_agents - len(found)
    return Solution((*found, *[()] * idle), bound, cost == bound)


class Solver(Protocol):
    """What every solver's function looks like; further keyword arguments have defaults."""

    def __call__(
        self, problem: Problem, objective: str, *, time_limit: float | None = None, seed: int = 0
    ) -> Solution:
        """Return routes for a problem, short in ``objective``."""
        ...


def team_of(objective: str, n_agents: int, n_landmarks: int) -> tuple[int, bool]:
    """Return how many agents are of use in an objective, and whether their ways home count.

    No team walks less in all than one agent, by the triangle inequality.
    """
    teams = 1 if objective == "total_distance" else min(n_agents, n_landmarks)
    return teams, objective != "cover_time"


class Distances(NamedTuple):
    """Steps of shortest paths in a problem: node 0 is the depot, node k + 1 landmark k."""

    between: NDArray[np.int32]  # (K + 1, K + 1), symmetric
    starts: NDArray[np.int32]  # (N, K + 1), from where each agent starts


def problem_distances(problem: Problem) -> Distances:
    """Return the distances of a problem, its agents starting anywhere.

    One breadth-first search a landmark.
    """
    grid = problem.grid
    landmarks = np.array(problem.landmarks, np.int32)
    cells = np.array(problem.start_cells, np.int32)
    n_nodes = len(landmarks) + 1
    found = Distances(
        np.empty((n_nodes, n_nodes), np.int32), np.empty((len(cells), n_nodes), np.int32)
    )
    search = np.empty((2, grid.n_cells), np.int32)
    fill_problem(grid.moves, grid.home, landmarks, cells, search, found.between, found.starts)
    return found


@kernel
def fill_problem(
    moves: NDArray[np.int32],
    home: NDArray[np.int32],
    landmarks: NDArray[np.int32],
    cells: NDArray[np.int32],
    search: NDArray[np.int32],
    between: NDArray[np.int32],
    starts: NDArray[np.int32],
) -> None:
    """Fill in :class:`Distances` of landmarks, (K,), and the agents' first cells, (N,).

    ``moves`` and ``home`` are the grid's, ``search``, shape (2, C), is scratch space.
    """
    between[0, 0] = 0
    for landmark in range(landmarks.shape[0]):
        node = landmark + 1
        steps = search[0]
        fill_distances(moves, landmarks[landmark], steps, search[1])
        between[0, node] = between[node, 0] = home[landmarks[landmark]]
        for other in range(landmarks.shape[0]):
            between[node, other + 1] = steps[landmarks[other]]
        for agent in range(cells.shape[0]):
            starts[agent, node] = steps[cells[agent]]
    for agent in range(cells.shape[0]):
        starts[agent, 0] = home[cells[agent]]


def landmark_distances(problem: Problem) -> NDArray[np.int32]:
    """Return the shortest-path steps between the depot and the landmarks, shape (K + 1, K + 1).

    Symmetric; line and column 0 belong to the depot, ``k + 1`` to landmark ``k``.
    """
    return cell_distances(problem.grid, np.array([problem.grid.depot, *problem.landmarks]))


def cell_distances(grid: Grid, cells: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Return the shortest-path steps between cells that can all be reached, shape (S, S).

    One breadth-first search a cell: never all pairs of a grid's cells.
    """
    distances = np.empty((len(cells), len(cells)), np.int32)
    field = np.empty(grid.n_cells, np.int32)
    queue = np.empty(grid.n_cells, np.int32)
    for line, cell in zip(distances, cells, strict=True):
        fill_distances(grid.moves, cell, field, queue)
        line[:] = field[cells]
    return distances

"""Distances between landmarks, and lower bounds: what no plan of a problem can beat."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import Grid, fill_distances
from mapp_env.plan import OBJECTIVES
from mapp_env.problem import Problem
from mapp_env.validation import check_choice

__all__ = ["cell_distances", "landmark_distances", "lower_bound"]

ROUNDS = 200
SCALE = 1 << 10
"""Penalties are whole multiples of 1 / SCALE of a step, so that a bound has no rounding error."""

FAR = 1 << 60


def landmark_distances(problem: Problem) -> NDArray[np.int32]:
    """Return the shortest-path steps between the depot and the landmarks.

    One breadth-first search a cell: never all pairs of a grid's cells.

    Parameters
    ----------
    problem : Problem
        Its landmarks keep their order.

    Returns
    -------
    ndarray of int32, shape (K + 1, K + 1)
        Line and column 0 belong to the depot, ``k + 1`` to landmark ``k``. Symmetric.
    """
    cells = np.array([problem.grid.depot, *problem.landmarks], np.int64)
    return cell_distances(problem.grid, cells)


def cell_distances(grid: Grid, cells: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Return the shortest-path steps between cells that can all be reached, shape (S, S) int32."""
    distances = np.empty((len(cells), len(cells)), np.int32)
    field = np.empty(grid.n_cells, np.int32)
    queue = np.empty(grid.n_cells, np.int32)
    for line, cell in zip(distances, cells, strict=True):
        fill_distances(grid.moves, cell, field, queue)
        line[:] = field[cells]
    return distances


def lower_bound(problem: Problem, objective: str, distances: NDArray[np.int32]) -> int:
    """Return a cost that no plan of a problem can beat.

    It is the largest of

    - the farthest landmark, for closed tours there and back;
    - for closed tours: the tour of one agent is no longer than all tours together (triangle
      inequality), and no shorter than the best 1-tree under any node penalties (Held and Karp
      1970, doi:10.1287/opre.18.6.1138); the makespan is at least the share of one of N agents;
    - for cover time: the routes form a spanning tree in which a landmark has at most two
      neighbours and the depot at most N, again under node penalties; one agent walks at least an
      N-th of it.

    Closed tours on a grid have even length, so their bounds are rounded up to even numbers.

    Parameters
    ----------
    problem : Problem
        The problem.
    objective : {"cover_time", "makespan", "total_distance"}
        What is bounded.
    distances : ndarray of int32, shape (K + 1, K + 1)
        From :func:`landmark_distances`.
    """
    check_choice("objective", objective, OBJECTIVES)
    n_nodes = len(distances)
    closed = objective != "cover_time"
    shares = 1 if objective == "total_distance" else problem.n_agents
    farthest = int(distances[0].max()) * (2 if closed else 1)
    if n_nodes == 2:
        return farthest
    scaled = ascend(
        distances,
        closed,
        problem.n_agents,
        np.zeros(n_nodes, np.int64),
        np.empty(n_nodes, np.int64),
        np.empty(n_nodes, np.int64),
        np.empty(n_nodes, np.int64),
    )
    spread = -(-int(scaled) // (SCALE * shares))
    if closed:
        spread += spread % 2
    return max(farthest, spread)


@kernel
def ascend(
    distances: NDArray[np.int32],
    closed: bool,
    n_agents: int,
    penalties: NDArray[np.int64],
    reach: NDArray[np.int64],
    links: NDArray[np.int64],
    degrees: NDArray[np.int64],
) -> int:
    """Raise node penalties by subgradient steps; return the best bound seen, times ``SCALE``.

    Parameters
    ----------
    distances : ndarray of int32, shape (n, n), n >= 3
        Node 0 is the depot.
    closed : bool
        Bound one closed tour (1-trees: every degree is 2), or the open routes of a team (trees:
        no degree above 2, the depot's not above ``n_agents``).
    n_agents : int
        Number of agents.
    penalties : ndarray of int64, shape (n,)
        Zero on entry.
    reach, links, degrees : ndarray of int64, shape (n,)
        Scratch space.
    """
    n_nodes = distances.shape[0]
    best = 0
    stride = 0
    for turn in range(ROUNDS):
        weight = span(distances, closed, penalties, reach, links, degrees)
        for node in range(n_nodes):
            limit = 2 if closed or node > 0 else n_agents
            weight -= limit * penalties[node]
        best = max(best, weight)
        if turn == 0:
            stride = max(weight // (2 * n_nodes), 1)
        step = max(stride * (ROUNDS - turn) // ROUNDS, 1)
        for node in range(n_nodes):
            limit = 2 if closed or node > 0 else n_agents
            penalties[node] += step * (degrees[node] - limit)
            # "At most" may only be punished where it is broken.
            if not closed and penalties[node] < 0:
                penalties[node] = 0
    return best


@kernel
def span(
    distances: NDArray[np.int32],
    closed: bool,
    penalties: NDArray[np.int64],
    reach: NDArray[np.int64],
    links: NDArray[np.int64],
    degrees: NDArray[np.int64],
) -> int:
    """Return the weight of a smallest spanning tree (Prim) under penalties, and its degrees.

    For a closed tour the tree spans the landmarks, and the depot joins it by its two best edges.
    """
    n_nodes = distances.shape[0]
    root = 1 if closed else 0
    total = 0
    degrees[:] = 0
    for node in range(root, n_nodes):
        reach[node] = FAR
    reach[root] = 0
    links[root] = root
    for _ in range(root, n_nodes):
        nearest = -1
        least = FAR
        for node in range(root, n_nodes):
            if reach[node] < least:
                nearest = node
                least = reach[node]
        total += least
        # Joined nodes are beyond FAR.
        reach[nearest] = 2 * FAR
        if nearest != root:
            degrees[nearest] += 1
            degrees[links[nearest]] += 1
        for node in range(root, n_nodes):
            weight = SCALE * distances[nearest, node] + penalties[nearest] + penalties[node]
            if reach[node] <= FAR and weight < reach[node]:
                reach[node] = weight
                links[node] = nearest
    if closed:
        first = FAR
        second = FAR
        for node in range(1, n_nodes):
            weight = SCALE * distances[0, node] + penalties[0] + penalties[node]
            if weight < first:
                second = first
                first = weight
                links[0] = node
            elif weight < second:
                second = weight
        total += first + second
        degrees[0] = 2
        for node in range(1, n_nodes):
            weight = SCALE * distances[0, node] + penalties[0] + penalties[node]
            # The two best edges, the second being the first of its weight.
            if node == links[0]:
                degrees[node] += 1
            elif weight == second:
                degrees[node] += 1
                second = -FAR
    return total

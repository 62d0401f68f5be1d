"""The best spanning trees under node penalties: lower bounds for any number of landmarks.

An agent's route is a tree, and so are the routes of a team together: a smallest spanning tree is
never longer. Penalties on nodes, which change the trees but no tour, raise the bound (Held and Karp
1970, doi:10.1287/opre.18.6.1138).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel

__all__ = ["SCALE", "ascend"]

ROUNDS = 200
SCALE = 1 << 10
"""Penalties are whole multiples of 1 / SCALE of a step, so that a bound has no rounding error."""

FAR = 1 << 60


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

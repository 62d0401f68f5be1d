"""Lower bounds: what no plan of a problem can beat."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.problem import Problem
from mapp_env.solvers.exact import least_total
from mapp_env.solvers.families import smallest_limit, smallest_limit_from
from mapp_env.solvers.held_karp import Steps, route_tables
from mapp_env.solvers.solution import UNBOUNDED, Distances, team_of
from mapp_env.validation import check_choice

SUBSET = 12  # landmarks that subset_bound() looks at: about a millisecond
ROUNDS = 200
SCALE = 1 << 10
"""Penalties are whole multiples of 1 / SCALE of a step, so that a bound has no rounding error."""


def lower_bound(problem: Problem, objective: str, distances: Distances) -> int:
    """Return a cost that no plan of a problem can beat; up to 12 landmarks it is the optimum.

    ``distances`` are the problem's, of agents that start anywhere. Raises a ValueError if the
    objective is unknown.
    """
    check_choice("objective", objective, OBJECTIVES)
    return subset_bound(distances, objective, tree_bound(distances, objective))


def tree_bound(distances: Distances, objective: str) -> int:
    """Return a lower bound of the longest route of a team, or of the sum of its tours.

    It is the largest of

    - the landmark that takes longest to visit, for closed tours and go home from;
    - for closed tours from the depot: the tour of one agent is no longer than all tours together
      (triangle inequality), and no shorter than the best 1-tree under any node penalties; the
      longest is at least the share of one of N agents;
    - for open routes: they form a spanning tree, all starts being one node, in which a landmark has
      at most two neighbours and the starts together at most N, again under node penalties; one
      agent walks at least an N-th of it;
    - for closed tours from elsewhere: that, and the shortest way home from a landmark.

    Closed tours on a grid from the depot have even length, as have those from all cells at an even
    distance from it, so their bounds are rounded up to even numbers.
    """
    between, starts = distances
    teams, closed = team_of(objective, len(starts), len(between) - 1)
    nearest = starts.min(axis=0)
    back = between[0] if closed else np.zeros_like(nearest)
    farthest = int((nearest + back)[1:].max())
    n_nodes = len(between)
    if n_nodes == 2:
        return farthest
    room = np.zeros((4, n_nodes), np.int64)
    if starts[:, 0].any():
        between = between.copy()
        between[0] = between[:, 0] = nearest
        sum_of_all = int(ascend(between, False, min(len(starts), n_nodes - 1), room))
        sum_of_all += SCALE * int(back[1:].min())
    else:
        sum_of_all = int(ascend(between, closed, teams, room))
    spread = -(-sum_of_all // (SCALE * teams))
    if closed and not (starts[:, 0] % 2).any():
        spread += spread % 2
    return max(farthest, spread)


def subset_bound(distances: Distances, objective: str, low: int) -> int:
    """Return the optimum of 12 landmarks, or ``low`` if that is larger.

    Leaving landmarks out keeps a plan valid, so another landmark never lowers the optimum. The
    farthest from all starts comes first, then always the one for which the distance to the nearest
    chosen landmark and the distance to the nearest start have the largest sum.
    """
    between, starts = distances
    reach = starts.min(axis=0)
    nodes = [0, int(reach[1:].argmax()) + 1]
    nearest = between[nodes[-1]].copy()
    for _ in range(1, min(SUBSET, len(between) - 1)):
        # Chosen ones are 0 from themselves, but may be far from the starts.
        nodes.append(int(np.where(nearest > 0, nearest + reach, 0)[1:].argmax()) + 1)
        np.minimum(nearest, between[nodes[-1]], out=nearest)
    ways = np.ascontiguousarray(between[np.ix_(nodes, nodes)])
    teams, closed = team_of(objective, len(starts), len(nodes) - 1)
    if not starts[:, 0].any():
        return smallest_limit(route_tables(ways, closed)[1], teams, low)
    part = Distances(ways, np.ascontiguousarray(starts[:, nodes]))
    if objective == "total_distance":
        return max(low, least_total(part)[0])
    return smallest_limit_from(part, closed, low)


# -- spanning trees ------------------------------------------------------

# An agent's route is a tree, and so are the routes of a team together: a smallest spanning tree is
# never longer. Penalties on nodes, which change the trees but no tour, raise the bound (Held and
# Karp 1970, doi:10.1287/opre.18.6.1138).


@kernel
def ascend(distances: Steps, closed: bool, n_agents: int, nodes: NDArray[np.int64]) -> int:
    """Raise node penalties by subgradient steps; return the best bound found, times ``SCALE``.

    ``distances`` are of at least 3 nodes, the depot first; ``closed`` bounds one closed tour
    (1-trees: every degree is 2), else the open routes of a team (trees: no degree above 2, the
    depot's not above ``n_agents``). ``nodes``, shape (4, n), holds the penalties, zero on entry,
    and what :func:`span` works with.
    """
    penalties, degrees = nodes[0], nodes[3]
    n_nodes = distances.shape[0]
    at_depot = 2 if closed else n_agents
    best = 0
    stride = 0
    for turn in range(ROUNDS):
        weight = span(distances, closed, nodes)
        weight -= 2 * penalties[1:].sum() + at_depot * penalties[0]
        best = max(best, weight)
        if turn == 0:
            stride = max(weight // (2 * n_nodes), 1)
        step = max(stride * (ROUNDS - turn) // ROUNDS, 1)
        for node in range(n_nodes):
            limit = 2 if node > 0 else at_depot
            penalties[node] += step * (degrees[node] - limit)
            # "At most" may only be punished where it is broken.
            if not closed and penalties[node] < 0:
                penalties[node] = 0
    return best


@kernel
def span(distances: Steps, closed: bool, nodes: NDArray[np.int64]) -> int:
    """Return the weight of a smallest spanning tree (Prim) under penalties, and its degrees.

    For a closed tour the tree spans the landmarks, and the depot joins it by its two best edges.
    """
    penalties, reach, links, degrees = nodes[0], nodes[1], nodes[2], nodes[3]
    n_nodes = distances.shape[0]
    root = 1 if closed else 0
    total = 0
    degrees[:] = 0
    reach[root:] = UNBOUNDED
    reach[root] = 0
    links[root] = root
    for _ in range(root, n_nodes):
        nearest = root + reach[root:].argmin()
        total += reach[nearest]
        # Joined nodes are beyond UNBOUNDED.
        reach[nearest] = 2 * UNBOUNDED
        if nearest != root:
            degrees[nearest] += 1
            degrees[links[nearest]] += 1
        for node in range(root, n_nodes):
            weight = SCALE * distances[nearest, node] + penalties[nearest] + penalties[node]
            if reach[node] <= UNBOUNDED and weight < reach[node]:
                reach[node] = weight
                links[node] = nearest
    if closed:
        degrees[0] = 2
        for node in range(1, n_nodes):
            reach[node] = SCALE * distances[0, node] + penalties[0] + penalties[node]
        for _ in range(2):
            nearest = 1 + reach[1:].argmin()
            total += reach[nearest]
            degrees[nearest] += 1
            reach[nearest] = UNBOUNDED
    return total

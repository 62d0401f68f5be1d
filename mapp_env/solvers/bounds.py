"""Lower bounds: what no plan of a problem can beat."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.plans.plan import OBJECTIVES
from mapp_env.problem import Problem
from mapp_env.solvers.families import smallest_limit
from mapp_env.solvers.held_karp import route_tables
from mapp_env.solvers.spanning_trees import SCALE, ascend
from mapp_env.validation import check_choice

__all__ = ["lower_bound", "subset_bound", "tree_bound"]

SUBSET = 12
"""Landmarks that :func:`subset_bound` looks at: about a millisecond."""


def lower_bound(problem: Problem, objective: str, distances: NDArray[np.int32]) -> int:
    """Return a cost that no plan of a problem can beat.

    It is the larger of :func:`tree_bound` and :func:`subset_bound`; up to 12 landmarks it is the
    optimum.

    Parameters
    ----------
    problem : Problem
        The problem.
    objective : {"cover_time", "makespan", "total_distance"}
        What is bounded.
    distances : ndarray of int32, shape (K + 1, K + 1)
        From :func:`~mapp_env.solvers.distances.landmark_distances`.
    """
    check_choice("objective", objective, OBJECTIVES)
    closed = objective != "cover_time"
    teams = 1 if objective == "total_distance" else min(problem.n_agents, len(distances) - 1)
    return subset_bound(distances, teams, closed, tree_bound(distances, teams, closed))


def tree_bound(distances: NDArray[np.int32], teams: int, closed: bool) -> int:
    """Return a lower bound of the longest route of a team.

    It is the largest of

    - the farthest landmark, for closed tours there and back;
    - for closed tours: the tour of one agent is no longer than all tours together (triangle
      inequality), and no shorter than the best 1-tree under any node penalties; the longest is at
      least the share of one of N agents;
    - for open routes: they form a spanning tree in which a landmark has at most two neighbours and
      the depot at most N, again under node penalties; one agent walks at least an N-th of it.

    Closed tours on a grid have even length, so their bounds are rounded up to even numbers.

    Parameters
    ----------
    distances : ndarray of int32, shape (K + 1, K + 1)
        Between the depot (node 0) and the landmarks.
    teams : int
        Number of agents.
    closed : bool
        Whether the way home counts.
    """
    n_nodes = len(distances)
    farthest = int(distances[0].max()) * (2 if closed else 1)
    if n_nodes == 2:
        return farthest
    scaled = ascend(
        distances,
        closed,
        teams,
        np.zeros(n_nodes, np.int64),
        np.empty(n_nodes, np.int64),
        np.empty(n_nodes, np.int64),
        np.empty(n_nodes, np.int64),
    )
    spread = -(-int(scaled) // (SCALE * teams))
    if closed:
        spread += spread % 2
    return max(farthest, spread)


def subset_bound(distances: NDArray[np.int32], teams: int, closed: bool, low: int) -> int:
    """Return the optimum of 12 landmarks, or ``low`` if that is larger.

    With landmarks left out a plan is a plan still: no optimum falls with a landmark more. The
    farthest from the depot comes first, then always the one for which the distance to the nearest
    chosen landmark and the distance to the depot have the largest sum.

    Parameters
    ----------
    distances : ndarray of int32, shape (K + 1, K + 1)
        Between the depot (node 0) and the landmarks.
    teams : int
        Number of agents.
    closed : bool
        Whether the way home counts.
    low : int
        A lower bound of the whole problem.
    """
    home = distances[0]
    nodes = [0, int(home.argmax())]
    nearest = distances[nodes[-1]].copy()
    for _ in range(1, min(SUBSET, len(distances) - 1)):
        # Chosen ones are 0 from themselves, but may be far from the depot.
        nodes.append(int(np.where(nearest > 0, nearest + home, 0)[1:].argmax()) + 1)
        np.minimum(nearest, distances[nodes[-1]], out=nearest)
    _, costs = route_tables(np.ascontiguousarray(distances[np.ix_(nodes, nodes)]), closed)
    return smallest_limit(costs, min(teams, len(nodes) - 1), low)

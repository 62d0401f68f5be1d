"""The exact solver: Held-Karp over every set of landmarks, then the best partition over agents.

What is proven, for ``1 <= K <= 20`` landmarks and any number of agents:

- ``total_distance``: the shortest closed tour of one agent (``held_karp``). By the triangle
  inequality no team walks less.
- ``cover_time``, ``makespan``: the smallest T such that every landmark is in one of N sets that one
  agent each can visit within T, and, for the makespan, be home (``families``).
- Among the plans of smallest cover time or makespan one of the smallest total distance: of all
  partitions within T, one whose closed tours are shortest in sum, by dynamic programming over
  sets (``partition``).

Every joint action sequence splits the landmarks among the agents by who claims what, and each
agent walks at least the shortest way through its own: so these are also the optima of the rules,
over all policies, with or without the action to wait.
"""

from __future__ import annotations

import numpy as np

from mapp_env.problem import Problem
from mapp_env.solvers.bounds import tree_bound
from mapp_env.solvers.distances import landmark_distances
from mapp_env.solvers.families import Families, smallest_limit
from mapp_env.solvers.held_karp import route_tables, tours_within, trace_route
from mapp_env.solvers.partition import split
from mapp_env.solvers.solution import Solution, solution_of

__all__ = ["MAX_EXACT_LANDMARKS", "solve_exact"]

MAX_EXACT_LANDMARKS = 20
"""Largest number of landmarks: the table of routes takes 80 MiB then."""


def check_exact(problem: Problem) -> None:
    """Refuse problems that are too large to be proven.

    Raises
    ------
    ValueError
        If it has more than 20 landmarks.
    """
    n_landmarks = len(problem.landmarks)
    if n_landmarks > MAX_EXACT_LANDMARKS:
        raise ValueError(
            f"method 'exact' takes at most {MAX_EXACT_LANDMARKS} landmarks, this problem has "
            f"{n_landmarks}: use method='search'"
        )


def solve_exact(
    problem: Problem, objective: str, *, time_limit: float | None = None, seed: int = 0
) -> Solution:
    """Return optimal routes.

    Parameters
    ----------
    problem : Problem
        At most 20 landmarks; any grid, any number of agents.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised; see the top of this file for what is proven.
    time_limit, seed
        Not used: the work is bounded by the size, and nothing is random.

    Returns
    -------
    Solution
        The same for any order of the landmarks.

    Raises
    ------
    ValueError
        If there are more landmarks; nothing has been allocated then.
    """
    check_exact(problem)
    n_landmarks = len(problem.landmarks)
    order = np.argsort(problem.landmarks)
    nodes = np.concatenate(([0], order + 1))
    distances = np.ascontiguousarray(landmark_distances(problem)[np.ix_(nodes, nodes)])
    closed = objective != "cover_time"
    teams = 1 if objective == "total_distance" else min(problem.n_agents, n_landmarks)
    routes, costs = route_tables(distances, closed)
    optimum = smallest_limit(costs, teams, tree_bound(distances, teams, closed))
    tours = np.empty(1 << n_landmarks, np.int32)
    tours_within(distances, routes, closed, optimum, tours)
    parts = split(tours, Families(costs <= optimum), teams)
    found = []
    for part in parts:
        route = np.empty(n_landmarks, np.int32)
        count = trace_route(distances, routes, closed, optimum, part, route)
        found.append((order[route[:count]] + 1).tolist())
    return solution_of(problem, found, optimum, optimum)

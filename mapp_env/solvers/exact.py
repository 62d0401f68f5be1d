"""The exact solver: Held-Karp over every set of landmarks, then the best partition over agents.

What is proven, for ``1 <= K <= 20`` landmarks and any number of agents:

- ``total_distance``: the shortest closed tour of one agent (Held and Karp 1962,
  doi:10.1137/0110015). By the triangle inequality no team walks less.
- ``cover_time``, ``makespan``: the smallest T such that every landmark is in one of N sets that one
  agent each can visit within T (and, for the makespan, be home). Whether N sets suffice is
  decided by counting: the pairs of sets whose union is a given set, for all sets at once, by zeta
  and Moebius transforms over the subset lattice (inclusion-exclusion, as in Bjorklund, Husfeldt
  and Koivisto 2009, doi:10.1137/070683933). Counts stay below 4**20, so whole 64-bit numbers are
  exact and nothing is left to chance.
- Among the plans of smallest cover time or makespan one of the smallest total distance: of all
  partitions within T, one whose closed tours are shortest in sum, by dynamic programming over sets.

Every joint action sequence splits the landmarks among the agents by who claims what, and each
agent walks at least the shortest way through its own: so these are also the optima of the rules,
over all policies, with or without the action to wait.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.problem import Problem
from mapp_env.solvers.bounds import landmark_distances, lower_bound
from mapp_env.solvers.solution import Solution

__all__ = [
    "MAX_EXACT_LANDMARKS",
    "route_costs",
    "shortest_routes",
    "solve_exact",
]

MAX_EXACT_LANDMARKS = 20
"""Largest number of landmarks: the table of routes takes 80 MiB then."""

FEW_AGENTS = 5  # up to which a table an agent, of wanted sets only, is faster than one of all

FAR = 1 << 29  # more than any route, and twice it is still an int32


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
    n_landmarks = len(problem.landmarks)
    if n_landmarks > MAX_EXACT_LANDMARKS:
        raise ValueError(
            f"method 'exact' takes at most {MAX_EXACT_LANDMARKS} landmarks, this problem has "
            f"{n_landmarks}: use method='search'"
        )
    order = np.argsort(problem.landmarks)
    nodes = np.concatenate(([0], order + 1))
    distances = np.ascontiguousarray(landmark_distances(problem)[np.ix_(nodes, nodes)])
    routes = np.empty((1 << n_landmarks, n_landmarks), np.int32)
    shortest_routes(distances, routes)
    # Per set: the objective's cost of one agent, and its closed tour within a limit of it.
    costs = np.empty(1 << n_landmarks, np.int32)
    closed = objective != "cover_time"
    route_costs(distances, routes, closed, costs)
    teams = min(problem.n_agents, n_landmarks)
    if objective == "total_distance":
        teams = 1
    low = lower_bound(problem, objective, distances)
    optimum = _smallest_limit(costs, teams, low)
    tours = np.empty(1 << n_landmarks, np.int32)
    tours_within(distances, routes, closed, optimum, tours)
    parts = _split(tours, _Families(costs <= optimum), teams)
    found = []
    for part in parts:
        route = np.empty(n_landmarks, np.int32)
        count = trace_route(distances, routes, closed, optimum, part, route)
        found.append(tuple(problem.landmarks[order[k]] for k in route[:count].tolist()))
    found += [()] * (problem.n_agents - len(found))
    return Solution(tuple(found), optimum, True)


# -- one agent -----------------------------------------------------------


@kernel
def shortest_routes(distances: NDArray[np.int32], routes: NDArray[np.int32]) -> None:
    """Fill in the steps of the shortest way from the depot through each set of landmarks.

    Parameters
    ----------
    distances : ndarray of int32, shape (K + 1, K + 1)
        Symmetric; node 0 is the depot.
    routes : ndarray of int32, shape (2 ** K, K)
        ``routes[S, k]``: through all of S, ending on k; at least ``FAR`` if k is not in S.
    """
    n_landmarks = routes.shape[1]
    routes[0] = FAR
    for members in range(1, routes.shape[0]):
        for last in range(n_landmarks):
            bit = 1 << last
            if members & bit == 0:
                routes[members, last] = FAR
            elif members == bit:
                routes[members, last] = distances[0, last + 1]
            else:
                # Over all landmarks alike: those not in the set are far, and without a branch the
                # loop takes eight at a time.
                shorter = routes[members ^ bit]
                steps = distances[last + 1]
                least = np.int32(FAR)
                for before in range(n_landmarks):
                    least = min(least, np.int32(shorter[before] + steps[before + 1]))
                routes[members, last] = least


@kernel
def route_costs(
    distances: NDArray[np.int32],
    routes: NDArray[np.int32],
    closed: bool,
    costs: NDArray[np.int32],
) -> None:
    """Fill in, for each set, the steps of one agent's shortest route, or closed tour, (2 ** K,)."""
    costs[0] = 0
    for members in range(1, costs.shape[0]):
        least = np.int32(FAR)
        for last in range(routes.shape[1]):
            steps = routes[members, last]
            if closed:
                steps += distances[0, last + 1]
            least = min(least, np.int32(steps))
        costs[members] = least


@kernel
def tours_within(
    distances: NDArray[np.int32],
    routes: NDArray[np.int32],
    closed: bool,
    limit: int,
    tours: NDArray[np.int32],
) -> None:
    """Fill in, for each set, the shortest closed tour within a limit, (2 ** K,), else ``FAR``.

    The limit holds for the closed tour, or for the way to its last landmark only.
    """
    tours[0] = 0
    for members in range(1, tours.shape[0]):
        least = np.int32(FAR)
        for last in range(routes.shape[1]):
            steps = routes[members, last]
            tour = steps + distances[0, last + 1]
            if (tour if closed else steps) <= limit:
                least = min(least, np.int32(tour))
        tours[members] = least


@kernel
def trace_route(
    distances: NDArray[np.int32],
    routes: NDArray[np.int32],
    closed: bool,
    limit: int,
    members: int,
    route: NDArray[np.int32],
) -> int:
    """Write the landmarks of a set's shortest closed tour within a limit; return how many.

    Among equals the tour that is first on its last landmark, then the lowest landmarks, from the
    end backwards.
    """
    n_landmarks = routes.shape[1]
    count = 0
    for landmark in range(n_landmarks):
        count += members >> landmark & 1
    least = 2 * FAR
    end = -1
    for last in range(n_landmarks):
        steps = routes[members, last]
        tour = steps + distances[0, last + 1]
        if (tour if closed else steps) <= limit:
            shorter = tour < least or (tour == least and steps < routes[members, end])
            if shorter:
                least = tour
                end = last
    for place in range(count - 1, -1, -1):
        route[place] = end
        steps = routes[members, end]
        members ^= 1 << end
        for before in range(n_landmarks):
            if (
                members >> before & 1
                and routes[members, before] + distances[before + 1, end + 1] == steps
            ):
                end = before
                break
    return count


# -- how many agents are enough -----------------------------------------


def _smallest_limit(costs: NDArray[np.int32], teams: int, low: int) -> int:
    """Return the least limit, from ``low`` on, within which so many agents visit everything."""
    high = int(costs[-1])
    while low < high:
        middle = (low + high) // 2
        if _Families(costs <= middle).cover(teams):
            high = middle
        else:
            low = middle + 1
    return low


class _Families:
    """The sets of landmarks that 1, 2, 3, ... agents can visit within a limit.

    Parameters
    ----------
    one : ndarray of bool, shape (2 ** K,)
        The sets that one agent can visit; with a set, all its subsets.
    """

    def __init__(self, one: NDArray[np.bool_]) -> None:
        self._families = {1: one}

    def __getitem__(self, teams: int) -> NDArray[np.bool_]:
        """Return the family of so many agents, (2 ** K,) bool."""
        if teams not in self._families:
            half = teams // 2
            self._families[teams] = _unions(self[half], self[teams - half])
        return self._families[teams]

    def cover(self, teams: int) -> bool:
        """Return whether so many agents can visit everything."""
        if teams == 1:
            return bool(self[1][-1])
        # What the first half of them visits, the second may leave out: families hold all subsets.
        first, second = self[teams // 2], self[teams - teams // 2]
        return bool((first & second[::-1]).any())


def _unions(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the family of all unions of a set of one family and a set of another."""
    if first[-1] or second[-1]:
        return np.ones_like(first)
    # Of each set, how many pairs of its subsets there are; then, of how many it is the union.
    counts = first.astype(np.int64)
    add_subsets(counts)
    if first is second:
        counts *= counts
    else:
        others = second.astype(np.int64)
        add_subsets(others)
        counts *= others
    remove_subsets(counts)
    return counts > 0


@kernel
def add_subsets(counts: NDArray[np.int64]) -> None:
    """Replace each set's number by the sum over its subsets, (2 ** K,): the zeta transform."""
    step = 1
    while step < counts.shape[0]:
        for base in range(0, counts.shape[0], 2 * step):
            for index in range(base, base + step):
                counts[index + step] += counts[index]
        step *= 2


@kernel
def remove_subsets(counts: NDArray[np.int64]) -> None:
    """Undo :func:`add_subsets`: the Moebius transform."""
    step = 1
    while step < counts.shape[0]:
        for base in range(0, counts.shape[0], 2 * step):
            for index in range(base, base + step):
                counts[index + step] -= counts[index]
        step *= 2


# -- who visits what -----------------------------------------------------


def _split(tours: NDArray[np.int32], families: _Families, teams: int) -> list[int]:
    """Return disjoint sets, one an agent, that hold everything with the least sum of tours.

    Parameters
    ----------
    tours : ndarray of int32, shape (2 ** K,)
        What each set costs one agent, at least ``FAR`` if it cannot visit it.
    families : _Families
        The sets that so many agents can visit.
    teams : int
        Number of agents; they can visit everything.
    """
    half = len(tours) // 2
    if teams > FEW_AGENTS:
        # With no limit on the agents one table does, which fills itself in; mostly it needs few.
        sums = np.empty(half, np.int32)
        add_agent(tours, sums, np.ones(half, np.bool_), sums)
        parts = _trace_parts(tours, [sums] * len(tours))
        if len(parts) <= teams:
            return parts
    # tables[n][S]: the least sum for n agents and S, where they can visit S and the other agents
    # the rest. The highest landmark belongs to the first agent, so that S is never with it.
    nobody = np.full(half, FAR, np.int32)
    nobody[0] = 0
    tables = [nobody, tours[:half]][:teams]
    for n_agents in range(2, teams):
        rest = families[teams - n_agents][::-1]
        tables.append(np.empty(half, np.int32))
        add_agent(tours, tables[-2], families[n_agents][:half] & rest[:half], tables[-1])
    return _trace_parts(tours, tables)


def _trace_parts(tours: NDArray[np.int32], tables: Sequence[NDArray[np.int32]]) -> list[int]:
    """Return the disjoint sets, one an agent, whose sum is the least by tables of sums."""
    left = len(tours) - 1
    parts = []
    for sums in reversed(tables):
        if left == 0:
            break
        parts.append(int(first_part(tours, sums, left)))
        left ^= parts[-1]
    return parts


@kernel
def add_agent(
    tours: NDArray[np.int32],
    sums: NDArray[np.int32],
    wanted: NDArray[np.bool_],
    more: NDArray[np.int32],
) -> None:
    """Fill in the least sums of tours for one agent more, ``FAR`` where not wanted.

    Parameters
    ----------
    tours : ndarray of int32, shape (2 ** K,)
        What each set costs one agent.
    sums : ndarray of int32, shape (2 ** (K - 1),)
        The least sums so far. May be ``more``: then the agents are as many as it takes.
    wanted : ndarray of bool, shape (2 ** (K - 1),)
        Which sets matter.
    more : ndarray of int32, shape (2 ** (K - 1),)
        The result.
    """
    more[0] = 0
    top = 1
    for left in range(1, more.shape[0]):
        if left == 2 * top:
            top = left
        more[left] = FAR
        if not wanted[left]:
            continue
        # Who visits the highest landmark is the agent that is added.
        others = left ^ top
        least = np.int32(FAR)
        part = others
        while True:
            least = min(least, np.int32(tours[top | part] + sums[others ^ part]))
            if part == 0:
                break
            part = (part - 1) & others
        more[left] = least


@kernel
def first_part(tours: NDArray[np.int32], sums: NDArray[np.int32], left: int) -> int:
    """Return the set of the agent that visits the highest landmark left; among equals the last."""
    top = 1
    while 2 * top <= left:
        top *= 2
    others = left ^ top
    least = 2 * FAR
    best = left
    part = others
    while True:
        steps = tours[top | part] + sums[others ^ part]
        if steps < least:
            least = steps
            best = top | part
        if part == 0:
            break
        part = (part - 1) & others
    return best

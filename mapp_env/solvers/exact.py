"""The exact solver: Held-Karp over every set of landmarks, then the best partition over agents.

What is proven, for ``1 <= K <= 20`` landmarks and any number of agents:

- ``total_distance``: the shortest closed tour of one agent (``held_karp``). By the triangle
  inequality no team walks less.
- ``cover_time``, ``makespan``: the smallest T such that every landmark is in one of N sets that one
  agent each can visit within T, and, for the makespan, be home.
- Among the plans of smallest cover time or makespan one of the smallest total distance: of all
  partitions within T, one whose closed tours are shortest in sum.

Every joint action sequence splits the landmarks among the agents by who claims what, and each
agent walks at least the shortest way through its own: so these are also the optima of the rules,
over all policies, with or without the action to wait.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR
from mapp_env.problem import Problem
from mapp_env.solvers.held_karp import Steps, route_tables, tours_within, trace_route
from mapp_env.solvers.solution import Solution, landmark_distances, solution_of, team_of

MAX_EXACT_LANDMARKS = 20  # the table of routes takes 80 MiB then
FEW_AGENTS = 5  # up to here, a table per agent of the sets it needs is faster than one of all sets


def solve_exact(
    problem: Problem, objective: str, *, time_limit: float | None = None, seed: int = 0
) -> Solution:
    """Return optimal routes for up to 20 landmarks, the same for any order of them.

    ``time_limit`` and ``seed`` are not used: the size bounds the work, and nothing is random.

    Raises a ValueError if there are more landmarks; nothing has been allocated then.
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
    teams, closed = team_of(objective, problem.n_agents, n_landmarks)
    routes, costs = route_tables(distances, closed)
    optimum = smallest_limit(costs, teams)
    tours = np.empty(1 << n_landmarks, np.int32)
    tours_within(distances, routes, closed, optimum, tours)
    found = []
    for part in _split(tours, Families(costs <= optimum), teams):
        route = np.empty(n_landmarks, np.int32)
        count = trace_route(distances, routes, closed, optimum, part, route)
        found.append((order[route[:count]] + 1).tolist())
    return solution_of(problem, found, optimum, optimum)


# -- how many agents are enough ------------------------------------------


def smallest_limit(costs: Steps, teams: int, low: int = 0) -> int:
    """Return the least limit, from ``low`` on, within which so many agents visit everything.

    ``costs``, shape (2 ** K,), is what each set costs one agent; ``low`` a known lower bound.
    """
    high = int(costs[-1])
    # An agent alone could walk the others' routes there and back, and its own last.
    alone = -(-high // (2 * teams - 1))
    farthest = costs[1 << np.arange(len(costs).bit_length() - 1)].max()
    low = max(low, alone, int(farthest))
    while low < high:
        middle = (low + high) // 2
        if Families(costs <= middle).cover(teams):
            high = middle
        else:
            low = middle + 1
    return low


class Families:
    """The sets of landmarks that 1, 2, 3, ... agents can visit within a limit.

    Whether N sets, one per agent, cover all landmarks is decided by counting: the pairs
    of sets whose union is a given set, for all sets at once, by zeta and Moebius transforms over
    the subset lattice (inclusion-exclusion, as in Bjorklund, Husfeldt and Koivisto 2009,
    doi:10.1137/070683933). Counts stay below 4**20, so whole 64-bit numbers are exact.

    ``one``, shape (2 ** K,), are the sets that one agent can visit; with a set, all its subsets.
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
    sum_subsets(counts, 1)
    if first is second:
        counts *= counts
    else:
        others = second.astype(np.int64)
        sum_subsets(others, 1)
        counts *= others
    sum_subsets(counts, -1)
    return counts > 0


@kernel
def sum_subsets(counts: NDArray[np.int64], sign: int) -> None:
    """Replace each set's number by the sum over its subsets, (2 ** K,): the zeta transform.

    With the sign -1 undo that: the Moebius transform.
    """
    step = 1
    while step < counts.shape[0]:
        for base in range(0, counts.shape[0], 2 * step):
            for index in range(base, base + step):
                counts[index + step] += sign * counts[index]
        step *= 2


# -- who visits what -----------------------------------------------------


def _split(tours: Steps, families: Families, teams: int) -> list[int]:
    """Return disjoint sets, one per agent, that cover all landmarks with the least sum of tours.

    ``tours``, shape (2 ** K,), is what each set costs one agent, at least ``FAR`` if it cannot
    visit it; ``teams`` agents can visit everything.
    """
    half = len(tours) // 2
    if teams > FEW_AGENTS:
        # Without a limit one table serves all agents; it is filled on demand.
        sums = np.empty(half, np.int32)
        add_agent(tours, sums, np.ones(half, np.bool_), sums)
        parts = _trace_parts(tours, [sums] * len(tours).bit_length())
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


def _trace_parts(tours: Steps, tables: Sequence[Steps]) -> list[int]:
    """Return the disjoint sets, one per agent, whose sum is the least by tables of sums."""
    left = len(tours) - 1
    parts = []
    for sums in reversed(tables):
        if left == 0:
            break
        parts.append(int(first_part(tours, sums, left)))
        left ^= parts[-1]
    return parts


@kernel
def add_agent(tours: Steps, sums: Steps, wanted: NDArray[np.bool_], more: Steps) -> None:
    """Fill in ``more``, the least sums of tours for one agent more, ``FAR`` where not wanted.

    ``sums`` are those so far, shape (2 ** (K - 1),) like all but ``tours``. They may be ``more``
    itself: then the agents are as many as it takes.
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
def first_part(tours: Steps, sums: Steps, left: int) -> int:
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

"""Within which limit a team can visit all landmarks.

Agents that start together are alike, and so is what a set of landmarks costs them; agents that
start elsewhere have costs of their own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR
from mapp_env.solvers.held_karp import Steps
from mapp_env.solvers.solution import Distances


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


# -- from several starts -------------------------------------------------

# Where agents are not alike, they take their landmarks one agent after another. Of all ways in
# which a set can be visited up to its last landmark one is the best: that of the fewest agents,
# and of these the one with the shortest route of the last agent. For whatever another way goes on
# with, the agent that does it could also start afresh, and be there no later (triangle inequality).

STEP_BITS = 26  # for the steps of one route; above them stands the agent


def smallest_limit_from(
    distances: Distances, closed: bool, low: int = 0, high: int | None = None
) -> int:
    """Return the least limit within which agents that start anywhere visit everything.

    Nothing below ``low`` is tried; ``high``, if it is given, is known to be enough.
    """
    between, starts = distances

    def enough(limit: int) -> bool:
        return bool(fewest_agents(distances, closed, limit)[-1] <= len(starts))

    back = between[0, 1:] * np.int32(closed)
    low = max(low, int((starts[:, 1:].min(axis=0) + back).max()))
    if high is None:
        # The smaller a limit, the sooner it is refuted.
        high, step = low, max(1, low // 8)
        while not enough(high):
            low, high, step = high + 1, high + step, 2 * step
    while low < high:
        middle = (low + high) // 2
        if enough(middle):
            high = middle
        else:
            low = middle + 1
    return low


def fewest_agents(distances: Distances, closed: bool, limit: int) -> Steps:
    """Return how many of the agents, the first ones, visit each set within a limit, (2 ** K,).

    It is one more than there are where all of them together cannot.
    """
    between, starts = distances
    n_agents, n_landmarks = len(starts), len(between) - 1
    room = limit - between[0, 1:] * np.int32(closed)
    # next_able[n, k]: the first agent from n on that can visit landmark k at all.
    next_able = np.full((n_agents + 1, n_landmarks), n_agents, np.int32)
    for agent in reversed(range(n_agents)):
        able = starts[agent, 1:] <= room
        next_able[agent] = np.where(able, agent, next_able[agent + 1])
    routes = np.empty((1 << n_landmarks, n_landmarks), np.int32)
    fewest = np.empty(len(routes), np.int32)
    count_agents(between, starts, next_able, room.astype(np.int32), routes, fewest)
    return fewest


@kernel
def count_agents(
    between: Steps, starts: Steps, next_able: Steps, room: Steps, routes: Steps, fewest: Steps
) -> None:
    """Fill in ``fewest`` for :func:`fewest_agents`.

    ``room``, (K,), are the steps that a route up to each landmark may have; ``routes``,
    (2 ** K, K), the best way to visit a set up to a landmark: its last agent and that one's steps.
    """
    n_agents, n_landmarks = starts.shape[0], routes.shape[1]
    nobody = np.int32(n_agents << STEP_BITS)
    routes[0] = nobody
    fewest[0] = 0
    for members in range(1, fewest.shape[0]):
        fewest[members] = n_agents + 1
        if not holds_parts(fewest, members, n_landmarks, n_agents):
            continue
        best = nobody
        for last in range(n_landmarks):
            bit = 1 << last
            least = nobody
            if members & bit != 0:
                agent = next_able[fewest[members ^ bit], last]
                if agent < n_agents:
                    least = np.int32((agent << STEP_BITS) + starts[agent, last + 1])
                shorter = routes[members ^ bit]
                steps = between[last + 1]
                for before in range(n_landmarks):
                    longer = np.int32(shorter[before] + steps[before + 1])
                    fits = longer & np.int32((1 << STEP_BITS) - 1) <= room[last]
                    least = min(least, longer if fits else nobody)
            routes[members, last] = least
            best = min(best, least)
        fewest[members] = 1 + (best >> STEP_BITS)


@kernel
def holds_parts(values: Steps, members: int, n_landmarks: int, most: int) -> bool:
    """Return whether a set without any one of its landmarks has a value of at most ``most``."""
    for landmark in range(n_landmarks):
        bit = 1 << landmark
        if members & bit != 0 and values[members ^ bit] > most:
            return False
    return True


@kernel
def tours_from(
    between: Steps, start: Steps, closed: bool, limit: int, routes: Steps, tours: Steps
) -> None:
    """Fill in each set's shortest closed tour of an agent within a limit, else ``FAR``, (2 ** K,).

    As :func:`~mapp_env.solvers.held_karp.tours_within`, for an agent that starts ``start``,
    (K + 1,), steps away; ``routes`` is room for (2 ** K, K) routes.
    """
    n_landmarks = routes.shape[1]
    tours[0] = 0
    routes[0] = FAR
    for members in range(1, tours.shape[0]):
        tours[members] = FAR
        if not holds_parts(tours, members, n_landmarks, FAR - 1):
            continue
        tour = np.int32(FAR)
        for last in range(n_landmarks):
            bit = 1 << last
            least = np.int32(FAR)
            if members == bit:
                least = start[last + 1]
            elif members & bit != 0:
                shorter = routes[members ^ bit]
                steps = between[last + 1]
                for before in range(n_landmarks):
                    least = min(least, np.int32(shorter[before] + steps[before + 1]))
            routes[members, last] = least
            home = np.int32(least + between[0, last + 1])
            if (home if closed else least) <= limit:
                tour = min(tour, home)
        tours[members] = tour

"""The shortest way of one agent through every set of landmarks, by dynamic programming.

Held and Karp 1962, doi:10.1137/0110015. A set is a number whose bit ``k`` stands for landmark
``k``; so tables have ``2 ** K`` lines.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR

Steps: TypeAlias = NDArray[np.int32]


def route_tables(distances: Steps, closed: bool) -> tuple[Steps, Steps]:
    """Return the tables that :func:`shortest_routes` and :func:`route_costs` fill in."""
    n_landmarks = len(distances) - 1
    routes = np.empty((1 << n_landmarks, n_landmarks), np.int32)
    costs = np.empty(1 << n_landmarks, np.int32)
    shortest_routes(distances, routes)
    route_costs(distances, routes, closed, costs)
    return routes, costs


@kernel
def shortest_routes(distances: Steps, routes: Steps) -> None:
    """Fill in the steps of the shortest way from the depot through each set of landmarks.

    ``routes[S, k]``, shape (2 ** K, K), goes through all of S and ends on k; it is at least ``FAR``
    if k is not in S. ``distances``, shape (K + 1, K + 1), are symmetric; node 0 is the depot.
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
                least = FAR
                for before in range(n_landmarks):
                    least = min(least, np.int32(shorter[before] + steps[before + 1]))
                routes[members, last] = least


@kernel
def route_costs(distances: Steps, routes: Steps, closed: bool, costs: Steps) -> None:
    """Fill in, for each set, the steps of one agent's shortest route, or closed tour, (2 ** K,)."""
    costs[0] = 0
    for members in range(1, costs.shape[0]):
        least = FAR
        for last in range(routes.shape[1]):
            steps = routes[members, last]
            if closed:
                steps += distances[0, last + 1]
            least = min(least, np.int32(steps))
        costs[members] = least


@kernel
def tours_within(distances: Steps, routes: Steps, closed: bool, limit: int, tours: Steps) -> None:
    """Fill in, for each set, the shortest closed tour within a limit, (2 ** K,), else ``FAR``.

    The limit holds for the closed tour, or for the way to its last landmark only.
    """
    tours[0] = 0
    for members in range(1, tours.shape[0]):
        least = FAR
        for last in range(routes.shape[1]):
            steps = routes[members, last]
            tour = steps + distances[0, last + 1]
            if (tour if closed else steps) <= limit:
                least = min(least, np.int32(tour))
        tours[members] = least


@kernel
def trace_route(
    distances: Steps, routes: Steps, closed: bool, limit: int, members: int, route: Steps
) -> int:
    """Write the landmarks of a set's shortest closed tour within a limit; return how many.

    Ties go to the tour that reaches its last landmark first, then to the lowest landmarks, from the
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
        if (tour if closed else steps) <= limit and (
            tour < least or (tour == least and steps < routes[members, end])
        ):
            least = tour
            end = last
    for place in range(count - 1, -1, -1):
        route[place] = end
        steps = routes[members, end]
        members ^= 1 << end
        for before in range(n_landmarks):
            # Those that are not in the set are far.
            if routes[members, before] + distances[before + 1, end + 1] == steps:
                end = before
                break
    return count


# -- from several starts -------------------------------------------------


def joined_sums(between: Steps, starts: Steps) -> list[Steps]:
    """Return the least sums of closed tours through each set for the first 0, 1, ... agents.

    N + 1 tables, (2 ** K,). Agents that are of no use to those before share their table.
    """
    routes = np.empty((1 << (len(between) - 1), len(between) - 1), np.int32)
    tables = [np.full(len(routes), FAR, np.int32)]
    tables[0][0] = 0
    for agent, start in enumerate(starts):
        more = tables[-1]
        # One more like the last, who was of no use, is of none either.
        if agent == 0 or tables[-1] is not tables[-2] or (start != starts[agent - 1]).any():
            more = np.empty_like(more)
            join_agent(between, start, tables[-1], routes, more)
        tables.append(tables[-1] if np.array_equal(more, tables[-1]) else more)
    return tables


@kernel
def join_agent(between: Steps, start: Steps, sums: Steps, routes: Steps, more: Steps) -> None:
    """Fill in ``more``, the least sums of closed tours through each set with one agent more.

    ``sums`` are those so far, (2 ** K,); ``start``, (K + 1,), the steps from where it starts.
    ``routes[S, k]``, (2 ** K, K), is the least for all of S where the agent's own route, through
    any part of S, ends on k: one table for all agents before it spares one of all pairs of sets.
    """
    n_landmarks = routes.shape[1]
    routes[0] = FAR
    more[0] = 0
    for members in range(1, routes.shape[0]):
        fewest = sums[members]
        for last in range(n_landmarks):
            bit = 1 << last
            least = np.int32(FAR)
            if members & bit != 0:
                least = min(least, np.int32(sums[members ^ bit] + start[last + 1]))
                shorter = routes[members ^ bit]
                steps = between[last + 1]
                for before in range(n_landmarks):
                    least = min(least, np.int32(shorter[before] + steps[before + 1]))
                fewest = min(fewest, np.int32(least + between[0, last + 1]))
            routes[members, last] = least
        more[members] = fewest

"""The exact solver: Held-Karp over every set of landmarks, then the best partition over agents.

What is proven, for ``1 <= K <= 20`` landmarks and any number of agents that start anywhere:

- ``total_distance``: the least sum of closed tours start -> ... -> depot of agents that claim
  something. From the depot that is one agent's tour: by the triangle inequality no team walks less.
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
from mapp_env.solvers.families import (
    Families,
    smallest_limit,
    smallest_limit_from,
    tours_from,
)
from mapp_env.solvers.held_karp import (
    Steps,
    join_agent,
    joined_sums,
    route_tables,
    shortest_routes,
    tours_within,
    trace_route,
)
from mapp_env.solvers.partition import split_among
from mapp_env.solvers.solution import Distances, Solution, problem_distances, solution_of, team_of

MAX_EXACT_LANDMARKS = 20  # the table of routes takes 80 MiB then
FEW_AGENTS = 5  # up to here, a table per agent of the sets it needs is faster than one of all sets


def solve_exact(
    problem: Problem, objective: str, *, time_limit: float | None = None, seed: int = 0
) -> Solution:
    """Return optimal routes for up to 20 landmarks, the same for any order of them.

    ``time_limit`` and ``seed`` are not used: the size bounds the work, and nothing is random. From
    the depot 16 landmarks take some hundredths of a second, 18 some tenths and 20 up to two or
    three seconds; from up to 16 different starts a third of a second, a second and five. There are
    problems that take longer: with one landmark so far off that all others fit into the time to it,
    20 landmarks take 20 seconds for 16 agents.

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
    between, starts = problem_distances(problem)
    distances = Distances(between[np.ix_(nodes, nodes)].copy(), starts[:, nodes].copy())
    if distances.starts[:, 0].any():
        if objective == "total_distance":
            optimum, routes = least_total(distances)
        else:
            optimum, routes = least_longest(distances, objective == "makespan")
    else:
        teams, closed = team_of(objective, problem.n_agents, n_landmarks)
        optimum, routes = _solve_alike(distances.between, teams, closed)
    found = [(order[route] + 1).tolist() for route in routes]
    return solution_of(problem, found, optimum, optimum)


Answer = tuple[int, list[NDArray[np.int32]]]
"""The optimum, and the landmarks of each agent's route, in the order of the tables."""


def _solve_alike(distances: Steps, teams: int, closed: bool) -> Answer:
    """Solve for agents that all start on the depot; only the first ones have routes."""
    routes, costs = route_tables(distances, closed)
    optimum = smallest_limit(costs, teams)
    tours = np.empty(len(costs), np.int32)
    tours_within(distances, routes, closed, optimum, tours)
    parts = _split(tours, Families(costs <= optimum), teams)
    return optimum, [_trace(distances, routes, closed, optimum, part) for part in parts]


def _trace(
    distances: Steps, routes: Steps, closed: bool, limit: int, part: int
) -> NDArray[np.int32]:
    route = np.empty(routes.shape[1], np.int32)
    return route[: trace_route(distances, routes, closed, limit, part, route)]


# -- from several starts -------------------------------------------------


def least_longest(distances: Distances, closed: bool) -> Answer:
    """Solve for the smallest longest route of agents that start anywhere."""
    between, starts = distances
    optimum = smallest_limit_from(distances, closed)
    routes = np.empty((1 << (len(between) - 1), len(between) - 1), np.int32)
    tables: dict[bytes, Steps] = {}
    for start in starts:
        if start.tobytes() not in tables:
            table = tables[start.tobytes()] = np.empty(len(routes), np.int32)
            tours_from(between, start, closed, optimum, routes, table)
    parts = split_among(distances, closed, optimum, [tables[start.tobytes()] for start in starts])
    found: list[NDArray[np.int32]] = []
    for start, part in zip(starts, parts, strict=True):
        members = np.flatnonzero(part >> np.arange(len(between) - 1) & 1)
        nodes = np.concatenate(([0], members + 1))
        ways = np.ascontiguousarray(between[np.ix_(nodes, nodes)])
        leaving = ways.copy()
        leaving[0] = start[nodes]
        own = np.empty((1 << len(members), len(members)), np.int32)
        shortest_routes(leaving, own)
        route = _trace(ways, own, closed, optimum, len(own) - 1)
        found.append(members[route].astype(np.int32))
    return optimum, found


def least_total(distances: Distances) -> Answer:
    """Solve for the least sum of closed tours of agents that start anywhere."""
    between, starts = distances
    order = np.lexsort(starts.T)
    tables = joined_sums(between, starts[order])
    routes = np.empty((len(tables[0]), len(between) - 1), np.int32)
    found = [np.empty(0, np.int32)] * len(starts)
    left = len(routes) - 1
    for agent, more, fewer in reversed(list(zip(order, tables[1:], tables[:-1], strict=True))):
        if more[left] < fewer[left]:
            join_agent(between, starts[agent], fewer, routes, np.empty_like(fewer))
            found[agent], left = _trace_joined(between, starts[agent], fewer, routes, left)
    return int(tables[-1][-1]), found


def _trace_joined(
    between: Steps, start: Steps, sums: Steps, routes: Steps, left: int
) -> tuple[NDArray[np.int32], int]:
    """Return the route of the agent that was joined last, and what is left to those before."""
    last = int((routes[left] + between[0, 1:]).argmin())
    route = [last]
    while True:
        steps = routes[left, last]
        left ^= 1 << last
        if sums[left] + start[last + 1] == steps:
            return np.array(route[::-1], np.int32), left
        last = int((routes[left] + between[last + 1, 1:] == steps).argmax())
        route.append(last)


# -- who visits what, from the depot -------------------------------------


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

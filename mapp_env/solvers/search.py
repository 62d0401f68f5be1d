"""An anytime search for problems of any size: ruin and recreate under simulated annealing.

Slack Induction by String Removals (Christiaens and Vanden Berghe 2020,
doi:10.1287/trsc.2019.0914) with the longest route in its sights: an iteration takes strings of
landmarks that lie close together out of the routes, and inserts each landmark again where it costs
least. Differences from that paper:

- cost is ``weight * longest route + sum of routes``; with plain greedy insertion under it, routes
  level out;
- the ruin starts from a landmark of the longest route three times out of four;
- the temperature falls in cycles, each twice as long as the one before, so that neither a time nor
  a number of iterations has to be known in advance, and more of them never make it worse.

Nothing but the seed and the number of iterations decides what is found.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import Grid
from mapp_env.plan import OBJECTIVES
from mapp_env.problem import Problem
from mapp_env.solvers.bounds import landmark_distances, lower_bound
from mapp_env.solvers.solution import Routes, Solution
from mapp_env.validation import check_choice, check_count

__all__ = ["DEFAULT_ITERATIONS", "Search", "solve_search"]

DEFAULT_ITERATIONS = 200_000
"""Iterations without a time limit: well under a second for 50 landmarks, and the same anywhere."""

MAX_ITERATIONS = 10**12

PATIENCE = 5_000
"""Iterations without a smaller total distance before a search ends whose cost is proven optimal."""

CHUNK = 500  # iterations between two looks at the clock: some milliseconds

# In units of the mean distance between landmarks over the square root of their number: roughly
# from one landmark to the next.
HOT = 20.0
COLD = 0.2
FIRST_CYCLE = 5_000

MEAN_REMOVED = 10
MAX_STRING = 10
LONGEST_PERCENT = 75
MEAN_BLINK = 100  # places tried between two that are skipped

LOW_32_BITS = 0xFFFFFFFF
FAR = 1 << 60

# Places in `Search.memory`.
WORD, COST, BEST, BEST_TOTAL, DONE, IMPROVED, CYCLE_END, CYCLE = range(8)
# Places in `Search.heat`.
NOW, FALL, WARMEST, COLDEST = range(4)


class Layout(NamedTuple):
    """What is searched: distances between nodes, the depot being node 0, a landmark 1 to K."""

    distances: NDArray[np.int32]  # (K + 1, K + 1)
    back: NDArray[np.int32]  # (K + 1,), what going home from a node counts: nothing on open routes
    near: NDArray[np.int32]  # (K + 1, K), landmarks by distance from each node
    weight: int  # of the longest route


class Team(NamedTuple):
    """One route per agent."""

    routes: NDArray[np.int32]  # (N, K)
    sizes: NDArray[np.int64]  # (N,)
    lengths: NDArray[np.int64]  # (N,)


class Scratch(NamedTuple):
    """What one iteration needs."""

    holder: NDArray[np.int64]  # (K + 1,), the agent that visits a node, -1 if none
    removed: NDArray[np.int64]  # (K,)
    keys: NDArray[np.int64]  # (K,)
    touched: NDArray[np.bool_]  # (N,), whether a route differs from the one before


def solve_search(
    problem: Problem,
    objective: str,
    *,
    time_limit: float | None = None,
    seed: int = 0,
    iterations: int | None = None,
    on_better: Callable[[int], None] | None = None,
) -> Solution:
    """Return short routes, proven optimal where they meet a lower bound.

    Parameters
    ----------
    problem : Problem
        Of any size.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised; of routes with equal cover time or makespan the search keeps those of
        smaller total distance.
    time_limit : float, optional
        Seconds. At least one plan is made, however few they are.
    seed : int
        The same seed and number of iterations give the same routes.
    iterations : int, optional
        Most iterations to carry out; without it 200,000, or as many as the time limit lets.
    on_better : callable, optional
        Called with each smaller cost.

    Returns
    -------
    Solution
        The search ends early when the cost meets the bound.

    Raises
    ------
    ValueError
        If ``objective`` is unknown or ``iterations`` not a positive integer.
    """
    check_choice("objective", objective, OBJECTIVES)
    if iterations is None:
        iterations = DEFAULT_ITERATIONS if time_limit is None else MAX_ITERATIONS
    check_count("iterations", iterations, 1, MAX_ITERATIONS)
    _warm_up()
    return _solve(problem, objective, time_limit, seed, iterations, on_better)


def _solve(
    problem: Problem,
    objective: str,
    time_limit: float | None,
    seed: int,
    iterations: int,
    on_better: Callable[[int], None] | None,
) -> Solution:
    deadline = math.inf if time_limit is None else time.perf_counter() + time_limit
    distances = landmark_distances(problem)
    bound = lower_bound(problem, objective, distances)
    search = Search(distances, problem.n_agents, objective, seed)
    best = FAR
    chunk = 1
    while search.iterations < iterations:
        going = search.run(min(chunk, iterations - search.iterations), bound)
        if search.cost < best and on_better is not None:
            on_better(search.cost)
        best = search.cost
        if not going or time.perf_counter() >= deadline:
            break
        chunk = CHUNK
    routes = tuple(
        tuple(problem.landmarks[node - 1] for node in route) for route in search.routes()
    )
    return Solution(routes, bound, search.cost == bound)


@cache
def _warm_up() -> None:
    """Load or compile all kernels, so that this is no part of anybody's time limit."""
    corridor = Problem(Grid(np.zeros((1, 4), np.bool_)), (2, 3), 1)
    _solve(corridor, "cover_time", None, 0, 1, None)


class Search:
    """A search that can be carried on.

    Parameters
    ----------
    distances : ndarray of int32, shape (K + 1, K + 1)
        Between the depot (node 0) and the landmarks; K is at least 1.
    n_agents : int
        Number of agents.
    objective : {"cover_time", "makespan", "total_distance"}
        What is minimised.
    seed : int
        Not negative.
    """

    def __init__(
        self, distances: NDArray[np.int32], n_agents: int, objective: str, seed: int = 0
    ) -> None:
        distances = np.ascontiguousarray(distances, np.int32)
        n_landmarks = len(distances) - 1
        self._n_agents = n_agents
        # No team walks less than one agent, by the triangle inequality.
        n_routes = 1 if objective == "total_distance" else n_agents
        home = distances[0].copy()
        self._layout = Layout(
            distances,
            np.zeros_like(home) if objective == "cover_time" else home,
            (np.argsort(distances[:, 1:], axis=1, kind="stable") + 1).astype(np.int32),
            0 if objective == "total_distance" else 2 * n_agents,
        )
        self._now = _empty_team(n_routes, n_landmarks)
        self._trial = _empty_team(n_routes, n_landmarks)
        self._best = _empty_team(n_routes, n_landmarks)
        self._scratch = Scratch(
            np.full(n_landmarks + 1, -1),
            np.zeros(n_landmarks, np.int64),
            np.zeros(n_landmarks, np.int64),
            np.zeros(n_routes, np.bool_),
        )
        self._memory = np.zeros(8, np.int64)
        self._memory[WORD] = np.random.SeedSequence(seed).generate_state(1)[0]
        self._memory[[COST, BEST, BEST_TOTAL]] = FAR
        self._memory[CYCLE] = FIRST_CYCLE
        leg = max(float(distances[1:, 1:].mean()) / math.sqrt(n_landmarks), 0.5)
        self._heat = np.array([COLD * leg, 1.0, HOT * leg, COLD * leg])

    def run(self, iterations: int, bound: int = -1) -> bool:
        """Carry out some iterations.

        Parameters
        ----------
        iterations : int
            How many, at most.
        bound : int
            A cost that cannot be beaten: once it is reached, only the total distance is left to
            improve.

        Returns
        -------
        bool
            Whether more iterations could do better: False once ``bound`` is reached and the total
            distance has not fallen for a while.
        """
        return bool(
            improve(
                iterations,
                bound,
                self._layout,
                self._now,
                self._trial,
                self._best,
                self._scratch,
                self._memory,
                self._heat,
            )
        )

    @property
    def cost(self) -> int:
        """The smallest cost so far."""
        return int(self._memory[BEST])

    @property
    def iterations(self) -> int:
        """Iterations carried out."""
        return int(self._memory[DONE])

    def routes(self) -> Routes:
        """Return the best routes so far, as nodes 1 to K, one for each agent."""
        found = [
            tuple(route[:size].tolist())
            for route, size in zip(self._best.routes, self._best.sizes, strict=True)
        ]
        return (*found, *[()] * (self._n_agents - len(found)))


def _empty_team(n_routes: int, n_landmarks: int) -> Team:
    return Team(
        np.zeros((n_routes, n_landmarks), np.int32),
        np.zeros(n_routes, np.int64),
        np.zeros(n_routes, np.int64),
    )


# -- kernels -------------------------------------------------------------


@kernel
def improve(
    iterations: int,
    bound: int,
    layout: Layout,
    now: Team,
    trial: Team,
    best: Team,
    scratch: Scratch,
    memory: NDArray[np.int64],
    heat: NDArray[np.float64],
) -> bool:
    """Carry out iterations; return False if there is nothing left to improve.

    ``trial`` equals ``now`` between iterations.
    """
    n_routes = now.sizes.shape[0]
    for _ in range(iterations):
        if memory[BEST] <= bound and (
            layout.weight == 0 or memory[DONE] - memory[IMPROVED] >= PATIENCE
        ):
            return False
        if memory[DONE] == memory[CYCLE_END]:
            # From hot to cold, in twice as many iterations as last time.
            memory[CYCLE_END] += memory[CYCLE]
            heat[NOW] = heat[WARMEST]
            heat[FALL] = math.exp(math.log(heat[COLDEST] / heat[WARMEST]) / memory[CYCLE])
            memory[CYCLE] *= 2
        if memory[DONE] == 0:
            count = layout.near.shape[1]
            for index in range(count):
                scratch.removed[index] = index + 1
        else:
            count = ruin(layout, trial, scratch, memory)
        sort_removed(count, layout, scratch, memory)
        recreate(count, layout, trial, scratch, memory)
        cost = cost_of(layout, trial)
        chance = (1 + draw(memory, 1 << 30)) / ((1 << 30) + 1)
        if cost < memory[COST] - heat[NOW] * math.log(chance):
            memory[COST] = cost
            copy_touched(trial, now, scratch.touched)
            record(layout, now, best, memory)
        else:
            copy_touched(now, trial, scratch.touched)
            for agent in range(n_routes):
                if scratch.touched[agent]:
                    for place in range(now.sizes[agent]):
                        scratch.holder[now.routes[agent, place]] = agent
        scratch.touched[:] = False
        heat[NOW] *= heat[FALL]
        memory[DONE] += 1
    return True


@kernel
def draw(memory: NDArray[np.int64], span: int) -> int:
    """Return a random integer in 0..span-1, for a span of at most 2**30.

    A 32-bit PCG RXS-M-XS (O'Neill 2014, HMC-CS-2014-0905) in 64-bit signed arithmetic that never
    overflows, so that it means the same with and without compilation.
    """
    state = (memory[WORD] * 747796405 + 2891336453) & LOW_32_BITS
    memory[WORD] = state
    state = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & LOW_32_BITS
    return int((((state >> 22) ^ state) * span) >> 32)


@kernel
def ruin(layout: Layout, team: Team, scratch: Scratch, memory: NDArray[np.int64]) -> int:
    """Take strings of landmarks near a random one out of their routes; return how many."""
    n_landmarks = layout.near.shape[1]
    wanted = min(1 + draw(memory, 2 * MEAN_REMOVED), n_landmarks)
    if layout.weight > 0 and draw(memory, 100) < LONGEST_PERCENT:
        longest = 0
        for agent in range(team.sizes.shape[0]):
            if team.lengths[agent] > team.lengths[longest]:
                longest = agent
        middle = int(team.routes[longest, draw(memory, team.sizes[longest])])
    else:
        middle = 1 + draw(memory, n_landmarks)
    count = 0
    for rank in range(n_landmarks):
        if count >= wanted:
            break
        node = layout.near[middle, rank]
        agent = scratch.holder[node]
        if agent < 0:
            continue
        route = team.routes[agent]
        size = team.sizes[agent]
        string = 1 + draw(memory, min(MAX_STRING, size))
        string = min(string, wanted - count)
        place = 0
        while route[place] != node:
            place += 1
        # The string holds the node anywhere.
        low = max(place - string + 1, 0)
        high = min(place, size - string)
        start = low + draw(memory, high - low + 1)
        for index in range(start, start + string):
            scratch.removed[count] = route[index]
            scratch.holder[route[index]] = -1
            count += 1
        for index in range(start + string, size):
            route[index - string] = route[index]
        team.sizes[agent] = size - string
        length = 0
        last = 0
        for index in range(size - string):
            length += layout.distances[last, route[index]]
            last = route[index]
        team.lengths[agent] = length + layout.back[last]
        scratch.touched[agent] = True
    return count


@kernel
def sort_removed(count: int, layout: Layout, scratch: Scratch, memory: NDArray[np.int64]) -> None:
    """Put what was removed in the order in which it will be inserted."""
    # By chance, far from the depot first (twice as rarely), near first, or as removed (rarer yet).
    mode = draw(memory, 8)
    if mode == 7:
        return
    removed = scratch.removed
    keys = scratch.keys
    for index in range(count):
        if mode < 4:
            keys[index] = draw(memory, 1 << 30)
        elif mode < 6:
            keys[index] = -layout.distances[0, removed[index]]
        else:
            keys[index] = layout.distances[0, removed[index]]
    for index in range(1, count):
        node = removed[index]
        key = keys[index]
        place = index
        while place > 0 and keys[place - 1] > key:
            keys[place] = keys[place - 1]
            removed[place] = removed[place - 1]
            place -= 1
        keys[place] = key
        removed[place] = node


@kernel
def recreate(
    count: int, layout: Layout, team: Team, scratch: Scratch, memory: NDArray[np.int64]
) -> None:
    """Insert what was removed, each where it costs least, a few places being overlooked."""
    n_routes = team.sizes.shape[0]
    distances = layout.distances
    top = 0
    for agent in range(n_routes):
        top = max(top, team.lengths[agent])
    blink = 1 + draw(memory, 2 * MEAN_BLINK)
    for index in range(count):
        node = scratch.removed[index]
        least = FAR
        chosen = 0
        chosen_place = 0
        for agent in range(n_routes):
            size = team.sizes[agent]
            before = 0
            for place in range(size + 1):
                detour = distances[node, before]
                if place < size:
                    after = team.routes[agent, place]
                    detour += distances[node, after] - distances[before, after]
                    before = after
                else:
                    detour += layout.back[node] - layout.back[before]
                blink -= 1
                if blink <= 0 and least < FAR:
                    blink = 1 + draw(memory, 2 * MEAN_BLINK)
                    continue
                excess = max(team.lengths[agent] + detour - top, 0)
                cost = detour + layout.weight * excess
                if cost < least:
                    least = cost
                    chosen = agent
                    chosen_place = place
            if size == 0:
                break  # all empty routes are alike
        route = team.routes[chosen]
        size = team.sizes[chosen]
        before = route[chosen_place - 1] if chosen_place > 0 else 0
        detour = distances[node, before]
        if chosen_place < size:
            after = route[chosen_place]
            detour += distances[node, after] - distances[before, after]
        else:
            detour += layout.back[node] - layout.back[before]
        for place in range(size, chosen_place, -1):
            route[place] = route[place - 1]
        route[chosen_place] = node
        team.sizes[chosen] = size + 1
        team.lengths[chosen] += detour
        top = max(top, team.lengths[chosen])
        scratch.holder[node] = chosen
        scratch.touched[chosen] = True


@kernel
def cost_of(layout: Layout, team: Team) -> int:
    """Return what the search minimises."""
    top = 0
    total = 0
    for agent in range(team.sizes.shape[0]):
        top = max(top, team.lengths[agent])
        total += team.lengths[agent]
    return int(layout.weight * top + total)


@kernel
def record(layout: Layout, team: Team, best: Team, memory: NDArray[np.int64]) -> None:
    """Keep a team that is better in the objective, or as good and shorter in all."""
    top = 0
    total = 0
    for agent in range(team.sizes.shape[0]):
        size = team.sizes[agent]
        top = max(top, team.lengths[agent])
        if size > 0:
            last = team.routes[agent, size - 1]
            total += team.lengths[agent] - layout.back[last] + layout.distances[0, last]
    primary = top if layout.weight > 0 else total
    if primary < memory[BEST] or (primary == memory[BEST] and total < memory[BEST_TOTAL]):
        memory[BEST] = primary
        memory[BEST_TOTAL] = total
        memory[IMPROVED] = memory[DONE]
        for agent in range(team.sizes.shape[0]):
            copy_route(team, best, agent)


@kernel
def copy_touched(source: Team, target: Team, touched: NDArray[np.bool_]) -> None:
    """Copy the routes that differ."""
    for agent in range(touched.shape[0]):
        if touched[agent]:
            copy_route(source, target, agent)


@kernel
def copy_route(source: Team, target: Team, agent: int) -> None:
    """Copy one agent's route."""
    for place in range(source.sizes[agent]):
        target.routes[agent, place] = source.routes[agent, place]
    target.sizes[agent] = source.sizes[agent]
    target.lengths[agent] = source.lengths[agent]

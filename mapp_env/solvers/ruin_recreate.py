"""Ruin and recreate: the iterations of the search, as kernels.

Slack Induction by String Removals (Christiaens and Vanden Berghe 2020,
doi:10.1287/trsc.2019.0914) with the longest route in its sights: an iteration takes strings of
landmarks that lie close together out of the routes, and inserts each landmark again where it costs
least. Differences from that paper:

- cost is ``weight * longest route + sum of routes``; with plain greedy insertion under it, routes
  level out;
- each agent begins at a start of its own, and empty routes are alike only if their starts are;
- the ruin starts from a landmark of the longest route three times out of four;
- the temperature falls in cycles, each twice as long as the one before, so that neither a time nor
  a number of iterations has to be known in advance, and more of them never make it worse.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.draws import next_word, scramble
from mapp_env.solvers.solution import UNBOUNDED

PATIENCE = 5_000
"""Iterations without a smaller total distance before a search ends whose cost is proven optimal."""

MEAN_REMOVED = 10
MAX_STRING = 10
LONGEST_PERCENT = 75
MEAN_BLINK = 100  # places tried between two that are skipped

# Places in `Search.memory`.
WORD, COST, BEST, BEST_TOTAL, DONE, IMPROVED, CYCLE_END, CYCLE = range(8)
# Places in `Search.heat`.
NOW, FALL, WARMEST, COLDEST = range(4)


class Layout(NamedTuple):
    """What is searched: nodes and the steps between them.

    Node 0 is the depot, 1 to K are landmarks, K + 1 + n is where agent n starts.
    """

    distances: NDArray[np.int32]  # (K + 1, K + 1 + N), from depot and landmarks to all nodes
    back: NDArray[np.int32]  # (K + 1 + N,), what going home from a landmark counts, else 0
    reach: NDArray[np.int32]  # (K + 1,), steps to a landmark from the nearest start
    near: NDArray[
        np.int32
    ]  # (K + 1, K), landmarks by distance; lines that begin with 0 are to come
    alike: NDArray[np.int64]  # (N,), the first agent with the same way to every landmark
    weight: int  # of the longest route


class Team(NamedTuple):
    """One route per agent."""

    routes: NDArray[np.int32]  # (N, K)
    sizes: NDArray[np.int64]  # (N,)
    lengths: NDArray[np.int64]  # (N,)


class Scratch(NamedTuple):
    """What one iteration needs."""

    holder: NDArray[np.int64]  # (K + 1,), the agent that visits a node, -1 if none
    removed: NDArray[np.int64]  # (K,), at first every landmark
    keys: NDArray[np.int64]  # (K,)
    touched: NDArray[np.bool_]  # (N,), whether a route differs from the one before


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
        count = layout.near.shape[1]
        if memory[DONE] > 0:
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
            for agent in range(now.sizes.shape[0]):
                if scratch.touched[agent]:
                    for place in range(now.sizes[agent]):
                        scratch.holder[now.routes[agent, place]] = agent
        scratch.touched[:] = False
        heat[NOW] *= heat[FALL]
        memory[DONE] += 1
    return True


@kernel
def draw(memory: NDArray[np.int64], span: int) -> int:
    """Return a random integer in 0..span-1, for a span of at most 2**30."""
    word = memory[WORD]
    memory[WORD] = next_word(word)
    return int((scramble(word) * span) >> 32)


@kernel
def ruin(layout: Layout, team: Team, scratch: Scratch, memory: NDArray[np.int64]) -> int:
    """Take strings of landmarks near a random one out of their routes; return how many."""
    n_landmarks = layout.near.shape[1]
    wanted = min(1 + draw(memory, 2 * MEAN_REMOVED), n_landmarks)
    if layout.weight > 0 and draw(memory, 100) < LONGEST_PERCENT:
        longest = team.lengths.argmax()
        middle = int(team.routes[longest, draw(memory, team.sizes[longest])])
    else:
        middle = 1 + draw(memory, n_landmarks)
    near = layout.near[middle]
    if near[0] == 0:
        sort_near(layout.distances[middle], near)
    count = 0
    for rank in range(n_landmarks):
        if count >= wanted:
            break
        node = near[rank]
        agent = scratch.holder[node]
        if agent < 0:
            continue
        route = team.routes[agent]
        size = team.sizes[agent]
        string = min(1 + draw(memory, min(MAX_STRING, size)), wanted - count)
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
        last = n_landmarks + 1 + agent
        for index in range(size - string):
            length += layout.distances[route[index], last]
            last = route[index]
        team.lengths[agent] = length + layout.back[last]
        scratch.touched[agent] = True
    return count


@kernel
def sort_near(distances: NDArray[np.int32], near: NDArray[np.int32]) -> None:
    """Write the landmarks, shape (K,), by their ``distances``, shape (K + 1 + N,); ties by number.

    Shell's sort: a line is sorted when it is asked for, and nothing is allocated here.
    """
    n_landmarks = near.shape[0]
    for index in range(n_landmarks):
        near[index] = index + 1
    for gap in (57, 23, 10, 4, 1):
        for index in range(gap, n_landmarks):
            node = near[index]
            place = index
            while place >= gap:
                other = near[place - gap]
                apart = distances[other] - distances[node]
                if apart < 0 or (apart == 0 and other < node):
                    break
                near[place] = other
                place -= gap
            near[place] = node


@kernel
def sort_removed(count: int, layout: Layout, scratch: Scratch, memory: NDArray[np.int64]) -> None:
    """Put what was removed in the order in which it will be inserted."""
    # By chance, far from all starts first (twice as rarely), near first, or as removed (rarer yet).
    mode = draw(memory, 8)
    if mode == 7:
        return
    removed = scratch.removed
    keys = scratch.keys
    for index in range(count):
        if mode < 4:
            keys[index] = draw(memory, 1 << 30)
        else:
            keys[index] = layout.reach[removed[index]] * (-1 if mode < 6 else 1)
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
    first_start = layout.near.shape[1] + 1
    top = team.lengths[team.lengths.argmax()]
    blink = 1 + draw(memory, 2 * MEAN_BLINK)
    for index in range(count):
        node = scratch.removed[index]
        distances = layout.distances[node]
        least = UNBOUNDED
        chosen = 0
        chosen_place = 0
        chosen_detour = 0
        empty = 0  # bits of the starts from which an empty route was tried
        for agent in range(n_routes):
            size = team.sizes[agent]
            if size == 0:
                bit = 1 << layout.alike[agent]
                if empty & bit:
                    continue  # empty routes from one start are alike
                empty |= bit
            before = first_start + agent
            for place in range(size + 1):
                detour = distances[before]
                if place < size:
                    after = team.routes[agent, place]
                    detour += distances[after] - layout.distances[after, before]
                    before = after
                else:
                    detour += layout.back[node] - layout.back[before]
                blink -= 1
                if blink <= 0 and least < UNBOUNDED:
                    blink = 1 + draw(memory, 2 * MEAN_BLINK)
                    continue
                excess = max(team.lengths[agent] + detour - top, 0)
                cost = detour + layout.weight * excess
                if cost < least:
                    least = cost
                    chosen = agent
                    chosen_place = place
                    chosen_detour = detour
        route = team.routes[chosen]
        for place in range(team.sizes[chosen], chosen_place, -1):
            route[place] = route[place - 1]
        route[chosen_place] = node
        team.sizes[chosen] += 1
        team.lengths[chosen] += chosen_detour
        top = max(top, team.lengths[chosen])
        scratch.holder[node] = chosen
        scratch.touched[chosen] = True


@kernel
def cost_of(layout: Layout, team: Team) -> int:
    """Return what the search minimises."""
    longest = team.lengths[team.lengths.argmax()]
    return int(layout.weight * longest + team.lengths.sum())


@kernel
def record(layout: Layout, team: Team, best: Team, memory: NDArray[np.int64]) -> None:
    """Keep a team that is better in the objective, or as good and shorter in all."""
    total = team.lengths.sum()
    for agent in range(team.sizes.shape[0]):
        if team.sizes[agent] > 0:
            last = team.routes[agent, team.sizes[agent] - 1]
            total += layout.distances[0, last] - layout.back[last]
    primary = team.lengths[team.lengths.argmax()] if layout.weight > 0 else total
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

"""Within which limit a team can visit all landmarks, and who then visits which of them.

Agents that start together are alike, and so is what a set of landmarks costs them; agents that
start elsewhere have costs of their own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import reduce
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR
from mapp_env.solvers.held_karp import Steps


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


def smallest_limit_of(costs: Sequence[Steps], low: int = 0, high: int | None = None) -> int:
    """Return the same for agents with a table of costs each; those that are alike share one.

    Nothing below ``low`` is tried; ``high``, if it is given, is known to be enough.
    """
    tables = {id(table): table for table in costs}
    agents = Counter(map(id, costs))
    if high is None:
        high = min(int(table[-1]) for table in tables.values())
    single = 1 << np.arange(len(costs[0]).bit_length() - 1)
    low = max(low, int(np.min([table[single] for table in tables.values()], axis=0).max()))
    while low < high:
        middle = (low + high) // 2
        groups = [(Families(table <= middle), agents[key]) for key, table in tables.items()]
        if _groups_cover(groups):
            high = middle
        else:
            low = middle + 1
    return low


def _groups_cover(groups: Sequence[tuple[Families, int]]) -> bool:
    """Return whether groups of agents, each alike, can visit everything."""
    if len(groups) == 1:
        families, agents = groups[0]
        return families.cover(agents)
    reach = [families[agents] for families, agents in groups]
    half = len(reach) // 2
    first, second = reduce(unions, reach[:half]), reduce(unions, reach[half:])
    return bool((first & second[::-1]).any())


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
            self._families[teams] = unions(self[half], self[teams - half])
        return self._families[teams]

    def cover(self, teams: int) -> bool:
        """Return whether so many agents can visit everything."""
        if teams == 1:
            return bool(self[1][-1])
        # What the first half of them visits, the second may leave out: families hold all subsets.
        first, second = self[teams // 2], self[teams - teams // 2]
        return bool((first & second[::-1]).any())


def unions(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> NDArray[np.bool_]:
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


def split_among(tours: Sequence[Steps]) -> list[int]:
    """Return for each agent its set: disjoint, all landmarks together, the least sum of tours.

    ``tours``, (2 ** K,) each, are what each set costs an agent, ``FAR`` if it cannot visit it;
    together they can visit everything.
    """
    if len(tours) == 1:
        return [len(tours[0]) - 1]
    families = [table < FAR for table in tours]
    sizes = np.zeros(1, np.int64)
    while len(sizes) < len(tours[0]):
        sizes = np.concatenate((sizes, sizes + 1))
    # For each set how many sets it may be joined to. The first agent and the last have no table of
    # pairs to fill in, so these are the two with most.
    shares = (len(sizes) >> sizes).astype(np.float64)
    order = np.argsort([-shares[family].sum() for family in families])
    order = np.append(np.delete(order, 1), order[1])
    before = list(accumulate((families[agent] for agent in order), unions))
    after = list(accumulate((families[agent] for agent in order[::-1]), unions))[::-1]
    tables = [tours[order[0]]]
    for place in range(1, len(order) - 1):
        agent = order[place]
        wanted = before[place] & after[place + 1][::-1]
        more = np.where(wanted, tables[-1], FAR)
        if (1 << sizes[wanted]).sum() < shares[families[agent]].sum():
            add_any_part(tours[agent], tables[-1], wanted, more)
        else:
            parts = np.flatnonzero(families[agent])
            add_each_part(tours[agent], parts, tables[-1], wanted, more)
        tables.append(more)
    left = len(sizes) - 1
    found = [0] * len(tours)
    for agent, sums in zip(order[:0:-1], tables[::-1], strict=True):
        found[agent] = int(best_part(tours[agent], sums, left))
        left ^= found[agent]
    found[order[0]] = left
    return found


@kernel
def add_any_part(tours: Steps, sums: Steps, wanted: NDArray[np.bool_], more: Steps) -> None:
    """Lower ``more``, the least sums of tours with one agent more, from each wanted set down."""
    for left in range(1, more.shape[0]):
        if not wanted[left]:
            continue
        least = more[left]
        part = left
        while part != 0:
            least = min(least, np.int32(tours[part] + sums[left ^ part]))
            part = (part - 1) & left
        more[left] = least


@kernel
def add_each_part(
    tours: Steps, parts: NDArray[np.int64], sums: Steps, wanted: NDArray[np.bool_], more: Steps
) -> None:
    """Lower ``more`` as :func:`add_any_part` does, from each of the agent's sets up."""
    everything = more.shape[0] - 1
    for part in parts:
        others = everything ^ part
        rest = others
        while True:
            if wanted[part | rest]:
                more[part | rest] = min(more[part | rest], np.int32(tours[part] + sums[rest]))
            if rest == 0:
                break
            rest = (rest - 1) & others


@kernel
def best_part(tours: Steps, sums: Steps, left: int) -> int:
    """Return the part of a set that an agent added last visits; among equals the smallest."""
    least = 2 * FAR
    best = 0
    part = left
    while True:
        steps = tours[part] + sums[left ^ part]
        if steps <= least:
            least = steps
            best = part
        if part == 0:
            break
        part = (part - 1) & left
    return best

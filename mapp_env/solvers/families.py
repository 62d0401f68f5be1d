"""How many agents are enough: the sets of landmarks that a team can visit within a limit.

Whether N sets that one agent each can visit hold everything is decided by counting: the pairs of
sets whose union is a given set, for all sets at once, by zeta and Moebius transforms over the
subset lattice (inclusion-exclusion, as in Bjorklund, Husfeldt and Koivisto 2009,
doi:10.1137/070683933). Counts stay below 4**20, so whole 64-bit numbers are exact and nothing is
left to chance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel

__all__ = ["Families", "smallest_limit"]


def smallest_limit(costs: NDArray[np.int32], teams: int, low: int) -> int:
    """Return the least limit, from ``low`` on, within which so many agents visit everything."""
    high = int(costs[-1])
    while low < high:
        middle = (low + high) // 2
        if Families(costs <= middle).cover(teams):
            high = middle
        else:
            low = middle + 1
    return low


class Families:
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

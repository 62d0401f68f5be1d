"""Who visits what: the partition of all landmarks over a team whose tours are shortest in sum."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.solvers.families import Families
from mapp_env.solvers.held_karp import FAR

__all__ = ["split"]

FEW_AGENTS = 5  # up to which a table an agent, of wanted sets only, is faster than one of all


def split(tours: NDArray[np.int32], families: Families, teams: int) -> list[int]:
    """Return disjoint sets, one an agent, that hold everything with the least sum of tours.

    Parameters
    ----------
    tours : ndarray of int32, shape (2 ** K,)
        What each set costs one agent, at least ``FAR`` if it cannot visit it.
    families : Families
        The sets that so many agents can visit.
    teams : int
        Number of agents; they can visit everything.
    """
    half = len(tours) // 2
    if teams > FEW_AGENTS:
        # With no limit on the agents one table does, which fills itself in; mostly it needs few.
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

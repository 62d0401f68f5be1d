"""Which agent visits what: the partition whose tours have the least sum, from several starts.

Agents that are not alike are joined one after another: the least sum of the first ones for a set is
that of the best part of it for the last of them, and the rest for those before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR
from mapp_env.solvers.families import fewest_agents
from mapp_env.solvers.held_karp import Steps, joined_sums
from mapp_env.solvers.solution import Distances

MANY_PAIRS = 200_000_000  # of sets: some tenths of a second
SLACKS = (0, 4, 16, 64)  # steps above the sum without a limit that are tried before any sum


def split_among(
    distances: Distances, closed: bool, limit: int, tours: Sequence[Steps]
) -> list[int]:
    """Return for each agent its set: disjoint, all landmarks together, the least sum of tours.

    ``tours``, (2 ** K,) each, are what each set costs an agent, ``FAR`` if it cannot visit it
    within the limit, within which all together visit everything.
    """
    if len(tours) == 1:
        return [len(tours[0]) - 1]
    sizes = np.zeros(1, np.int64)
    while len(sizes) < len(tours[0]):
        sizes = np.concatenate((sizes, sizes + 1))
    # For each set how many sets it may be joined to. The first agent and the last have no table of
    # pairs to fill in, so these are the two with most.
    shares = (len(sizes) >> sizes).astype(np.float64)
    pairs = np.array([shares[table < FAR].sum() for table in tours])
    order = np.argsort(-pairs)
    order = np.append(np.delete(order, 1), order[1])
    own, pairs = [tours[agent] for agent in order], pairs[order]
    between, starts = distances
    before = fewest_agents(Distances(between, starts[order]), closed, limit)
    after = fewest_agents(Distances(between, starts[order[::-1]]), closed, limit)[::-1]
    inner = range(1, len(order) - 1)
    wanted = [(before <= place + 1) & (after <= len(order) - 1 - place) for place in inner]

    def effort(wanted: Sequence[NDArray[np.bool_]]) -> float:
        whole = ((1 << sizes[sets]).sum() for sets in wanted)
        return float(sum(map(min, whole, pairs[1:-1])))

    if effort(wanted) > MANY_PAIRS:
        # Only sets of which the sums without a limit, for these agents and for the others, leave
        # hope for a small sum: if there is none so small, it may be larger.
        first = joined_sums(between, starts[order])
        last = joined_sums(between, starts[order[::-1]])
        least = [first[place + 1] + last[len(order) - 1 - place][::-1] for place in inner]
        for slack in SLACKS:
            bound = int(first[-1][-1]) + slack
            hopeful = [sets & (sums <= bound) for sets, sums in zip(wanted, least, strict=True)]
            if effort(hopeful) > effort(wanted) / 2:
                break
            found, total = _join(own, hopeful, sizes, pairs)
            if total <= bound:
                return _in_order(found, order)
    return _in_order(_join(own, wanted, sizes, pairs)[0], order)


def _in_order(found: list[int], order: NDArray[np.int64]) -> list[int]:
    return [found[place] for place in np.argsort(order)]


def _join(
    tours: Sequence[Steps],
    wanted: Sequence[NDArray[np.bool_]],
    sizes: NDArray[np.int64],
    pairs: NDArray[np.float64],
) -> tuple[list[int], int]:
    """Return the agents' sets, and the sum of their tours: ``FAR`` or more if there are none.

    ``wanted`` are the sets, (2 ** K,), that are looked at for the agents between the first and the
    last, together with those before; ``sizes`` their numbers of landmarks.
    """
    tables = [tours[0]]
    for table, sets, each in zip(tours[1:-1], wanted, pairs[1:-1], strict=True):
        more = np.where(sets, tables[-1], FAR)
        if (1 << sizes[sets]).sum() < each:
            add_any_part(table, tables[-1], sets, more)
        else:
            add_each_part(table, np.flatnonzero(table < FAR), tables[-1], sets, more)
        tables.append(more)
    left = len(sizes) - 1
    found: list[int] = []
    total = 0
    for table, sums in zip(tours[:0:-1], tables[::-1], strict=True):
        found.append(int(best_part(table, sums, left)))
        total += int(table[found[-1]])
        left ^= found[-1]
    found.append(left)
    return found[::-1], total + int(tours[0][left])


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

"""States of episodes, many at once, and the kernels that solve one after another."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.grid import FAR, MAX_ALL_PAIRS_CELLS, Grid
from mapp_env.solvers.held_karp import Steps, join_agent, route_costs, shortest_routes
from mapp_env.solvers.solution import cell_distances

MAX_BATCH_LANDMARKS = 12  # of each state
CHUNK_WORK = 4_000_000  # between two chances to interrupt: some milliseconds
NEVER = np.iinfo(np.int32).max  # the cost of what no plan does


class States(NamedTuple):
    """B states of N agents and K landmarks, in steps."""

    between: Steps  # (B, K, K), from landmark to landmark
    home: Steps  # (B, K), from landmark to depot; 0 where the way home does not count
    starts: Steps  # (B, N, K), from agent to landmark
    left: NDArray[np.bool_]  # (B, K), which are unvisited


class Room(NamedTuple):
    """What one state after another is solved in; only what belongs to landmarks left is used."""

    nodes: Steps  # (K,), the landmarks that are left
    ways: Steps  # (K + 1, K + 1), between them, and home
    start: Steps  # (1, K + 1), from one agent
    routes: Steps  # (2 ** K, K)
    costs: Steps  # (N, 2 ** K), of each agent alone
    before: Steps  # (N, 2 ** K), of the agents up to one together
    after: Steps  # (N, 2 ** K), from one on
    others: Steps  # (2 ** K,), of all but one
    best: Steps  # (K,)

    @classmethod
    def of(cls, n_agents: int, n_landmarks: int) -> Room:
        """Allocate it."""
        n_nodes, size = n_landmarks + 1, 1 << n_landmarks
        each = (n_agents, size)
        shapes: tuple[tuple[int, ...], ...] = (
            *((n_landmarks,), (n_nodes, n_nodes), (1, n_nodes), (size, n_landmarks)),
            *(each, each, each, (size,), (n_landmarks,)),
        )
        # Beyond the landmarks that are left no number matters, but it must not overflow.
        return cls(*(np.zeros(shape, np.int32) for shape in shapes))


def list_states(
    grid: Grid,
    landmarks: NDArray[np.integer[Any]],
    starts: NDArray[np.integer[Any]],
    closed: bool = False,
) -> Iterator[tuple[slice, States]]:
    """Yield the states of problems of one grid, cells (P, K) and (P, N), in parts.

    A part is small enough to be solved between two chances to interrupt. ``closed`` says whether
    the ways home count.
    """
    n_agents, n_landmarks = starts.shape[1], landmarks.shape[1]
    cells = np.concatenate((landmarks, starts), axis=1)
    all_pairs = grid.n_cells <= MAX_ALL_PAIRS_CELLS and cells.size >= grid.n_cells
    # Else so few rows at a time that their cells' distances fit.
    together = len(cells) if all_pairs else MAX_ALL_PAIRS_CELLS // cells.shape[1]
    for first in range(0, len(cells), max(1, together)):
        part = cells[first : first + together]
        if all_pairs:
            distances, places = grid.distances, part
        else:
            nodes, flat = np.unique(part, return_inverse=True)
            distances, places = cell_distances(grid, nodes), flat.reshape(part.shape)
        for some in chunks(len(part), n_agents, n_landmarks):
            ends, stands = places[some, :n_landmarks], places[some, n_landmarks:]
            states = States(
                distances[ends[:, :, None], ends[:, None, :]],
                grid.home[part[some, :n_landmarks]] * np.int32(closed),
                distances[stands[:, :, None], ends[:, None, :]],
                np.ones(ends.shape, np.bool_),
            )
            yield slice(first + some.start, first + some.start + len(ends)), states


def chunks(n_states: int, n_agents: int, n_landmarks: int) -> Iterator[slice]:
    """Yield parts of states that are solved between two chances to interrupt."""
    chunk = max(1, CHUNK_WORK // (n_agents * 3**n_landmarks))
    for first in range(0, n_states, chunk):
        yield slice(first, first + chunk)


def part_of(states: States, part: slice) -> States:
    """Return some of the states."""
    between, home, starts, left = states
    return States(between[part], home[part], starts[part], left[part])


# -- kernels -------------------------------------------------------------


@kernel
def fill_next_costs(states: States, room: Room, out: Steps) -> None:
    """Fill in the costs of each agent's next landmark, (B, N, K + 1)."""
    n_agents = out.shape[1]
    for row in range(out.shape[0]):
        count = gather(states, row, room)
        size = 1 << count
        fill_costs(states, row, count, room)
        before, after, others, best = room.before, room.after, room.others, room.best
        copy(room.costs[0, :size], before[0])
        copy(room.costs[n_agents - 1, :size], after[n_agents - 1])
        for agent in range(1, n_agents - 1):
            join_worst(room.costs[agent, :size], before[agent - 1, :size], before[agent, :size])
            back = n_agents - 1 - agent
            join_worst(room.costs[back, :size], after[back + 1, :size], after[back, :size])
        for agent in range(n_agents):
            if n_agents == 1:
                others[:size] = FAR
                others[0] = 0
            elif agent == 0:
                copy(after[1, :size], others)
            elif agent == n_agents - 1:
                copy(before[agent - 1, :size], others)
            else:
                join_worst(before[agent - 1, :size], after[agent + 1, :size], others[:size])
            best[:] = FAR
            for members in range(1, size):
                rest = others[size - 1 - members]
                for place in range(best.shape[0]):
                    # From there through all of the set; far if it is not in it.
                    steps = room.routes[members, place]
                    if place < count:
                        steps += states.starts[row, agent, room.nodes[place]]
                    best[place] = min(best[place], max(steps, rest))
            out[row, agent] = NEVER
            for place in range(count):
                out[row, agent, room.nodes[place]] = best[place]
            if others[size - 1] < FAR:
                out[row, agent, out.shape[2] - 1] = others[size - 1]


@kernel
def fill_optima(states: States, total: bool, room: Room, out: Steps) -> None:
    """Fill in the optimum of each state, (B,): the sum of all tours, or the longest route."""
    n_agents = states.starts.shape[1]
    for row in range(out.shape[0]):
        count = gather(states, row, room)
        size = 1 << count
        if total:
            sums, more = room.others[:size], room.after[0, :size]
            sums[:] = FAR
            sums[0] = 0
            for agent in range(n_agents):
                stand(states, row, agent, count, room)
                join_agent(room.ways, room.start[0], sums, room.routes[:size], more)
                copy(more, sums)
            out[row] = sums[size - 1]
            continue
        fill_costs(states, row, count, room)
        copy(room.costs[0, :size], room.before[0])
        for agent in range(1, n_agents - 1):
            join_worst(
                room.costs[agent, :size], room.before[agent - 1, :size], room.before[agent, :size]
            )
        out[row] = room.costs[0, size - 1]
        if n_agents > 1:
            out[row] = meet(room.costs[n_agents - 1, :size], room.before[n_agents - 2, :size])


@kernel
def fill_action_costs(states: States, n_actions: int, room: Room, out: Steps) -> None:
    """Fill in the costs after each joint action, (B, A ** N).

    The states are of N * A agents: one where each action of each agent leads.
    """
    n_agents = states.starts.shape[1] // n_actions
    for row in range(out.shape[0]):
        count = gather(states, row, room)
        size = 1 << count
        fill_costs(states, row, count, room)
        for joint in range(out.shape[1]):
            # Only the agents whose action differs from the joint action before.
            first, rest = n_agents - 1, joint
            while first > 0 and rest % n_actions == 0:
                rest //= n_actions
                first -= 1
            for agent in range(first, n_agents):
                action = joint // n_actions ** (n_agents - 1 - agent) % n_actions
                mine = room.costs[agent * n_actions + action, :size]
                if agent == 0:
                    copy(mine, room.before[0])
                elif agent < n_agents - 1:
                    join_worst(mine, room.before[agent - 1, :size], room.before[agent, :size])
            out[row, joint] = room.before[0, size - 1]
            if n_agents > 1:
                out[row, joint] = meet(mine, room.before[n_agents - 2, :size])


@kernel
def gather(states: States, row: int, room: Room) -> int:
    """Note the landmarks of a state that are left, and the ways between them; return how many."""
    count = 0
    for landmark in range(states.left.shape[1]):
        if states.left[row, landmark]:
            room.nodes[count] = landmark
            count += 1
    for place in range(count):
        node = room.nodes[place]
        room.ways[0, place + 1] = room.ways[place + 1, 0] = states.home[row, node]
        for other in range(count):
            steps = states.between[row, node, room.nodes[other]]
            room.ways[place + 1, other + 1] = steps
    return count


@kernel
def stand(states: States, row: int, agent: int, count: int, room: Room) -> None:
    """Note how far an agent is from the landmarks that are left."""
    for place in range(count):
        room.start[0, place + 1] = states.starts[row, agent, room.nodes[place]]


@kernel
def fill_costs(states: States, row: int, count: int, room: Room) -> None:
    """Fill in the routes onward from each landmark through each set, and each agent's costs.

    Ways are equally long in both directions, so these are routes that come from the depot (or from
    nowhere, if the way home does not count) and end on that landmark.
    """
    size = 1 << count
    shortest_routes(room.ways, room.routes[:size])
    for agent in range(states.starts.shape[1]):
        stand(states, row, agent, count, room)
        route_costs(room.start, room.routes[:size], True, room.costs[agent, :size])


@kernel
def copy(source: Steps, target: Steps) -> None:
    """Copy an array: compiled, an assignment to a slice would allocate."""
    for index in range(source.shape[0]):
        target[index] = source[index]


@kernel
def join_worst(costs: Steps, fewer: Steps, more: Steps) -> None:
    """Fill in the least cost of the costlier part of each set, between an agent and those before.

    All are of shape (2 ** K,).
    """
    for members in range(more.shape[0]):
        least = FAR
        part = members
        while True:
            least = min(least, max(costs[part], fewer[members ^ part]))
            if part == 0:
                break
            part = (part - 1) & members
        more[members] = least


@kernel
def meet(costs: Steps, fewer: Steps) -> int:
    """Return what :func:`join_worst` gives for the set of all landmarks."""
    least = FAR
    everything = costs.shape[0] - 1
    for part in range(costs.shape[0]):
        least = min(least, max(costs[part], fewer[everything - part]))
    return int(least)

"""How a team walks, compiled: routes become tours, tours joint actions; N agents, K landmarks.

``moves``, shape (C, 4), and ``home``, (C,), are a grid's; ``tours``, shape (N, W), and ``lengths``,
(N,), the cells of each agent's tour, depot last, and how many there are; 0 for an empty one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.state import N_ACTIONS, WAIT
from mapp_env.grid import FAR
from mapp_env.paths import fill_distances, trace_path

Cells = NDArray[np.int32]


@kernel
def trace_tours(
    moves: Cells,
    home: Cells,
    starts: Cells,
    routes: Cells,
    sizes: NDArray[np.int64],
    search: Cells,
    tours: Cells,
    lengths: NDArray[np.int64],
) -> int:
    """Write shortest paths start -> landmarks in order -> depot; return the longest's cells.

    ``routes``, shape (N, R), are landmarks' cells, ``sizes``, (N,), of them an agent's; ``search``,
    (2, C), is scratch space. What is returned may be more than W: then the tours are not complete.
    """
    longest = 0
    steps, queue = search[0], search[1]
    for agent in range(starts.shape[0]):
        lengths[agent] = 0
        if sizes[agent] == 0:
            continue
        cell = starts[agent]
        tours[agent, 0] = cell
        length = 1
        for place in range(sizes[agent]):
            to = routes[agent, place]
            # No farther than needed: on a large grid, ends are mostly close together.
            fill_distances(moves, to, steps, queue, cell)
            end = length + steps[cell]
            if end <= tours.shape[1]:
                trace_path(moves, steps, tours[agent, length - 1 : end])
            length = end
            cell = to
        end = length + home[cell]
        if end <= tours.shape[1]:
            trace_path(moves, home, tours[agent, length - 1 : end])
        lengths[agent] = end
        longest = max(longest, end)
    return longest


@kernel
def close_tours(
    moves: Cells,
    home: Cells,
    cells: Cells,
    last: NDArray[np.int64],
    tours: Cells,
    lengths: NDArray[np.int64],
) -> None:
    """Cut walks at the last claims and close them by shortest paths to the depot (R8).

    ``cells``, shape (T + 1, N), are where agents are after each step; ``last``, (N,), is the step
    of each one's last claim, 0 if there is none. A tour leaves pauses out.
    """
    for agent in range(last.shape[0]):
        lengths[agent] = 0
        if last[agent] == 0:
            continue
        tours[agent, 0] = cells[0, agent]
        length = 1
        for step in range(1, last[agent] + 1):
            if cells[step, agent] != cells[step - 1, agent]:
                tours[agent, length] = cells[step, agent]
                length += 1
        end = length + home[cells[last[agent], agent]]
        trace_path(moves, home, tours[agent, length - 1 : end])
        lengths[agent] = end


@kernel
def first_visits(
    tours: Cells, lengths: NDArray[np.int64], places: Cells, visits: NDArray[np.int64]
) -> int:
    """Write who comes by each landmark first, and when; return the last of these steps.

    In one step it is the agent of the lowest index. ``places``, shape (C,), is a landmark's number
    on its cell, else -1; ``visits``, (K, 2), step and agent, the step ``FAR`` without one.
    """
    visits[:, 0] = FAR
    visits[:, 1] = 0
    for agent in range(lengths.shape[0]):
        for step in range(lengths[agent]):
            landmark = places[tours[agent, step]]
            if landmark >= 0 and step < visits[landmark, 0]:
                visits[landmark, 0] = step
                visits[landmark, 1] = agent
    latest = 0
    for landmark in range(visits.shape[0]):
        latest = max(latest, visits[landmark, 0])
    return latest


@kernel
def walk_team(
    moves: Cells,
    starts: Cells,
    tours: Cells,
    lengths: NDArray[np.int64],
    places: Cells,
    visits: NDArray[np.int64],
    actions: NDArray[np.int64],
) -> None:
    """Write the joint actions, shape (T, N), of a team that walks its tours without a pause.

    ``places`` and ``visits`` are those of :func:`first_visits`.
    """
    n_steps = actions.shape[0]
    for agent in range(starts.shape[0]):
        cell = starts[agent]
        walked = min(max(lengths[agent] - 1, 0), n_steps)
        for step in range(walked):
            to = tours[agent, step + 1]
            move = 0
            while move < N_ACTIONS - 1 and moves[cell, move] != to:
                move += 1
            actions[step, agent] = move
            cell = to
        if walked < n_steps:
            _idle(moves, cell, agent, walked, places, visits, actions)


@kernel
def _idle(
    moves: Cells,
    cell: int,
    agent: int,
    start: int,
    places: Cells,
    visits: NDArray[np.int64],
    actions: NDArray[np.int64],
) -> None:
    """Write the actions of an agent that claims nothing from a step on, beginning on no landmark.

    It bumps into a wall; else it steps to and fro, on landmarks only once they are visited.
    """
    n_steps = actions.shape[0]
    for move in range(N_ACTIONS):
        if moves[cell, move] == cell:
            for step in range(start, n_steps):
                actions[step, agent] = move
            return
    for step in range(start, n_steps):
        actions[step, agent] = WAIT
        for move in range(N_ACTIONS):
            to = moves[cell, move]
            landmark = places[to]
            # Agents claim in the order of their index, so who comes later may follow.
            if landmark >= 0 and not (
                visits[landmark, 0] <= step
                or (visits[landmark, 0] == step + 1 and visits[landmark, 1] < agent)
            ):
                continue
            back = 0
            while moves[to, back] != cell:
                back += 1
            for later in range(step, n_steps):
                actions[later, agent] = move if (later - step) % 2 == 0 else back
            return

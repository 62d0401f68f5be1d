"""From tours to joint actions: how a team walks its tours so that the rules see nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.dynamics import WAIT
from mapp_env.grid import Grid
from mapp_env.problem import Problem

__all__ = ["tour_through", "walk_tours"]


def tour_through(grid: Grid, landmarks: Iterable[int]) -> tuple[int, ...]:
    """Return the cells of shortest paths depot -> landmarks in order -> depot, or ``()``."""
    cells = [grid.depot]
    for landmark in landmarks:
        cells.extend(grid.path(cells[-1], landmark)[1:])
    if len(cells) == 1:
        return ()
    return (*cells, *grid.path(cells[-1], grid.depot)[1:])


def walk_tours(problem: Problem, tours: Sequence[Sequence[int]]) -> NDArray[np.int64]:
    """Return the joint actions of a team that walks its tours without a pause.

    They end when every landmark is visited, or all tours are walked. An agent that is home earlier
    bumps into a wall, if the depot has one beside it; else it steps to and fro, never first on an
    unvisited landmark: the environment may have no action to wait, and nobody should claim more
    than its tour.

    Parameters
    ----------
    problem : Problem
        What is played; its step limit is ignored.
    tours : sequence of sequence of int
        For each agent its cells from depot to depot, or nothing; neighbours in turn. Together they
        visit every landmark. An agent without a tour should come after one that has one: where
        every neighbour of the depot is an unvisited landmark, it follows that agent's first step
        (without such an agent it waits, action 4).

    Returns
    -------
    ndarray of int64, shape (T, N)
        Actions 0 to 3, but for the exception above.
    """
    grid = problem.grid
    moves = grid.moves
    cells = [grid.depot] * problem.n_agents
    left = set(problem.landmarks)
    actions: list[list[int]] = []
    step = 0
    while left and step < max(map(len, tours)):
        step += 1
        joint_action = []
        for agent, tour in enumerate(tours):
            ways = moves[cells[agent]].tolist()
            if step < len(tour):
                action = ways.index(tour[step])
            else:
                action = _idle_action(ways, cells[agent], grid.depot, left)
            joint_action.append(action)
            if action != WAIT:
                cells[agent] = ways[action]
            # Agents claim in the order of their index, so who comes later may follow.
            left.discard(cells[agent])
        actions.append(joint_action)
    return np.array(actions, np.int64).reshape(-1, problem.n_agents)


def _idle_action(ways: list[int], cell: int, depot: int, left: set[int]) -> int:
    """Return an action that claims nothing: home, else a bump, else to a visited neighbour."""
    if cell != depot:
        return ways.index(depot)
    if cell in ways:
        return ways.index(cell)
    return next((action for action, to in enumerate(ways) if to not in left), WAIT)

"""What the rules make of a list of joint actions: tours, claims and costs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.rules import measure_row, reset_row, step_row
from mapp_env.engine.state import Packed, World, new_rows, split_row
from mapp_env.engine.world import make_world
from mapp_env.grid import Grid
from mapp_env.problem import Problem


class Episode(NamedTuple):
    """What was played; :class:`~mapp_env.plans.plan.Plan` says what its fields are."""

    tours: tuple[tuple[int, ...], ...]
    claims: tuple[tuple[int, ...], ...]
    claim_steps: tuple[tuple[int, ...], ...]
    actions: tuple[tuple[int, ...], ...]
    cover_time: float
    makespan: float
    total_distance: float


def play_episode(problem: Problem, actions: NDArray[np.int64]) -> Episode:
    """Carry out joint actions, shape (T, N), until every landmark is visited or the step limit.

    The limit is the problem's, if it has one; actions are checked. The last episode is kept:
    checking, saving and drawing a plan play the same actions.
    """
    return _play(problem, actions.tobytes())


@lru_cache(maxsize=1)
def _play(problem: Problem, data: bytes) -> Episode:
    # Copied, as numba would compile a second version of the kernel for read-only actions.
    actions = np.frombuffer(data, np.int64).reshape(-1, problem.n_agents)[: problem.max_cycles]
    actions = actions.copy()
    n_agents, n_landmarks = problem.n_agents, len(problem.landmarks)
    world = make_world(problem.grid, n_agents, n_landmarks)
    row = new_rows(1, n_agents, n_landmarks)[0]
    cells = np.empty((len(actions) + 1, n_agents), np.int32)
    cells[0] = problem.start_cells
    reset_row(row, np.array(problem.landmarks, np.int32), cells[0], world)
    visits = np.zeros(n_landmarks, np.int64)
    steps = play_row(row, actions, cells, visits, tuple(world))
    claims: list[list[int]] = [[] for _ in range(n_agents)]
    claim_steps: list[list[int]] = [[] for _ in range(n_agents)]
    for landmark in np.argsort(visits, kind="stable"):
        cell, step = problem.landmarks[landmark], int(visits[landmark])
        if step > 0:
            agent = int(np.argmax(cells[step] == cell))
            claims[agent].append(cell)
            claim_steps[agent].append(step)
    costs = measure_row(row, world)
    tours = (_tour(problem.grid, cells[:, n], claim_steps[n]) for n in range(n_agents))
    return Episode(
        tuple(tours),
        tuple(map(tuple, claims)),
        tuple(map(tuple, claim_steps)),
        tuple(map(tuple, actions[:steps].tolist())),
        *(int(cost) if cost < math.inf else math.inf for cost in costs),
    )


def _tour(grid: Grid, cells: NDArray[np.int32], claim_steps: list[int]) -> tuple[int, ...]:
    """Return an agent's cells without pauses, cut at its last claim and closed (R8)."""
    if not claim_steps:
        return ()
    cells = cells[: claim_steps[-1] + 1]
    moved = np.append(True, cells[1:] != cells[:-1])
    return (*cells[moved].tolist(), *grid.path(int(cells[-1]), grid.depot)[1:])


@kernel
def play_row(
    row: NDArray[np.int32],
    actions: NDArray[np.int64],
    cells: NDArray[np.int32],
    visits: NDArray[np.int64],
    world: Packed,
) -> int:
    """Step a row that was reset through joint actions (T, N); return how many were carried out.

    Written are where the agents are after each step, ``cells`` (T + 1, N), and the step at which
    each landmark is visited, ``visits`` (K,), zero on entry.
    """
    own = World(*world)
    state = split_row(row, own.n_agents, own.n_landmarks)
    for step in range(1, actions.shape[0] + 1):
        _, terminated, _ = step_row(row, actions[step - 1], actions.shape[0], own)
        for agent in range(own.n_agents):
            cells[step, agent] = state.cells[agent]
        for landmark in range(own.n_landmarks):
            if state.visited[landmark] == 1 and visits[landmark] == 0:
                visits[landmark] = step
        if terminated:
            return step
    return len(actions)

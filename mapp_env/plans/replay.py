"""What the rules make of a list of joint actions: tours, claims and costs."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.rules import measure_row, reset_row, step_row
from mapp_env.engine.state import Packed, new_rows, pack, split_row, unpack
from mapp_env.engine.world import make_world
from mapp_env.grid import Grid
from mapp_env.plans.walks import close_tours
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
    grid = problem.grid
    world = _world(grid, n_agents, n_landmarks)
    row = new_rows(1, n_agents, n_landmarks)[0]
    cells = np.empty((len(actions) + 1, n_agents), np.int32)
    cells[0] = problem.start_cells
    visits = np.zeros((n_landmarks, 2), np.int64)
    costs = np.empty(3)
    steps = play_row(
        row, np.array(problem.landmarks, np.int32), actions, cells, visits, costs, world
    )
    claims: list[list[int]] = [[] for _ in range(n_agents)]
    claim_steps: list[list[int]] = [[] for _ in range(n_agents)]
    order = np.argsort(visits[:, 0], kind="stable").tolist()
    flat = visits.tolist()
    last, home = np.zeros(n_agents, np.int64), 0
    for landmark in order:
        step, agent = flat[landmark]
        if step > 0:
            claims[agent].append(problem.landmarks[landmark])
            claim_steps[agent].append(step)
            last[agent] = step
            home = max(home, grid.home.item(problem.landmarks[landmark]))
    tours, lengths = np.empty((n_agents, steps + 1 + home), np.int32), np.empty_like(last)
    close_tours(grid.moves, grid.home, cells, last, tours, lengths)
    return Episode(
        tuple(tuple(tour[:n].tolist()) for tour, n in zip(tours, lengths.tolist(), strict=True)),
        tuple(map(tuple, claims)),
        tuple(map(tuple, claim_steps)),
        tuple(map(tuple, actions[:steps].tolist())),
        *(int(cost) if cost < math.inf else math.inf for cost in costs.tolist()),
    )


@lru_cache(maxsize=2)
def _world(grid: Grid, n_agents: int, n_landmarks: int) -> Packed:
    return pack(make_world(grid, n_agents, n_landmarks))


@kernel
def play_row(
    row: NDArray[np.int32],
    landmarks: NDArray[np.int32],
    actions: NDArray[np.int64],
    cells: NDArray[np.int32],
    visits: NDArray[np.int64],
    costs: NDArray[np.float64],
    world: Packed,
) -> int:
    """Play joint actions (T, N) in a row on landmarks (K,); return how many were carried out.

    Written are where the agents are after each step, ``cells`` (T + 1, N), of which the first line
    says where they start; the step at which each landmark is visited and by whom, ``visits``
    (K, 2), zero on entry; and the costs (R8), (3,).
    """
    own = unpack(world)
    state = split_row(row, own.n_agents, own.n_landmarks)
    reset_row(row, landmarks, cells[0], own)
    steps: int = actions.shape[0]
    for step in range(1, steps + 1):
        _, terminated, _ = step_row(row, actions[step - 1], steps, own)
        for agent in range(own.n_agents):
            cells[step, agent] = state.cells[agent]
        for landmark in range(own.n_landmarks):
            if state.visited[landmark] == 1 and visits[landmark, 0] == 0:
                visits[landmark, 0] = step
                agent = 0
                while state.cells[agent] != state.landmarks[landmark]:
                    agent += 1
                visits[landmark, 1] = agent
        if terminated:
            steps = step
            break
    costs[0], costs[1], costs[2] = measure_row(row, own)
    return steps

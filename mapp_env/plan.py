"""Plans: one tour per agent, what they cost, and what the rules make of a list of joint actions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapp_env.dynamics import (
    BY_COORDINATES,
    NO_DISTANCES,
    WAIT,
    Reward,
    cell_table,
    measure_row,
    reset_row,
    row_length,
    step_row,
)
from mapp_env.problem import Problem
from mapp_env.validation import check_choice, describe

__all__ = ["OBJECTIVES", "Plan", "replay"]

OBJECTIVES = ("cover_time", "makespan", "total_distance")


@dataclass(frozen=True)
class Plan:
    """One tour per agent and what they cost.

    Attributes
    ----------
    tours : tuple of tuple of int
        For each agent its cells, depot first and last, or empty if it claimed nothing (R8).
    claims : tuple of tuple of int
        For each agent the landmarks that it was the first on, in order.
    cover_time, makespan, total_distance : int or float
        Steps until every landmark is visited, steps until the last agent is home, cells moved by
        all agents; ``math.inf`` if not every landmark is visited.
    objective : {"cover_time", "makespan", "total_distance"}
        What :attr:`cost` is.
    status : {"optimal", "feasible", "infeasible"}
        Whether the cost is proven to be the smallest; "infeasible" if landmarks are left.
    """

    tours: tuple[tuple[int, ...], ...]
    claims: tuple[tuple[int, ...], ...]
    cover_time: float
    makespan: float
    total_distance: float
    objective: str = "cover_time"
    status: str = "feasible"

    @property
    def success(self) -> bool:
        """Whether every landmark is visited."""
        return self.cover_time != math.inf

    @property
    def cost(self) -> float:
        """The cost in :attr:`objective`."""
        return float(getattr(self, self.objective))


def replay(problem: Problem, joint_actions: ArrayLike, objective: str = "cover_time") -> Plan:
    """Return the plan that joint actions amount to: what the environment would have scored.

    The episode ends when every landmark is visited or at the problem's step limit, if it has one;
    joint actions after that are not carried out.

    Parameters
    ----------
    problem : Problem
        What is played.
    joint_actions : array_like of int, shape (T, N)
        0 left, 1 right, 2 up, 3 down, 4 wait for each agent at each step.
    objective : {"cover_time", "makespan", "total_distance"}
        What the plan's ``cost`` is.

    Raises
    ------
    ValueError
        If the shape is wrong or an action is not one.
    """
    if not isinstance(problem, Problem):
        raise ValueError(f"problem must be a mapp_env.Problem, got {describe(problem)}")
    check_choice("objective", objective, OBJECTIVES)
    actions = _check_joint_actions(joint_actions, problem.n_agents)
    n_agents, n_landmarks = problem.n_agents, len(problem.landmarks)
    grid = problem.grid
    table = cell_table(grid)
    row = np.zeros(row_length(n_agents, n_landmarks), np.int32)
    landmarks = np.array(problem.landmarks, np.int32)
    reset_row(row, landmarks, grid.depot, n_agents, n_landmarks)
    flags = row[n_agents + n_landmarks : n_agents + 2 * n_landmarks]
    limit = len(actions) if problem.max_cycles is None else problem.max_cycles
    routes = [[grid.depot] for _ in range(n_agents)]
    tours: list[tuple[int, ...]] = [()] * n_agents
    claims: list[list[int]] = [[] for _ in range(n_agents)]
    for joint_action in actions[:limit]:
        before = flags.copy()
        _, terminated, _ = step_row(
            row,
            joint_action,
            n_agents,
            n_landmarks,
            limit,
            int(Reward.STEP),
            table,
            NO_DISTANCES,
            BY_COORDINATES,
        )
        cells = row[:n_agents].tolist()
        for agent, cell in enumerate(cells):
            if cell != routes[agent][-1]:
                routes[agent].append(cell)
        for landmark in np.flatnonzero(flags != before):
            cell = problem.landmarks[landmark]
            agent = cells.index(cell)
            claims[agent].append(cell)
            tours[agent] = (*routes[agent], *grid.path(cell, grid.depot)[1:])
        if terminated:
            break
    costs = measure_row(row, n_agents, n_landmarks, table)
    whole = bool(flags.all())
    cover_time, makespan, total = (int(cost) if whole else math.inf for cost in costs)
    return Plan(
        tours=tuple(tours),
        claims=tuple(tuple(cells) for cells in claims),
        cover_time=cover_time,
        makespan=makespan,
        total_distance=total,
        objective=objective,
        status="feasible" if whole else "infeasible",
    )


def _check_joint_actions(joint_actions: Any, n_agents: int) -> NDArray[np.int64]:
    """Return joint actions as an int64 array of shape (T, N)."""
    try:
        array = np.asarray(joint_actions)
    except (ValueError, RecursionError):
        array = np.array(None)  # ragged, or nested too deep
    if array.shape in ((0,), (0, n_agents)):
        return np.empty((0, n_agents), np.int64)
    if array.ndim != 2 or array.shape[1] != n_agents or array.dtype.kind not in "iu":
        raise ValueError(
            f"joint_actions must be integers of shape (T, {n_agents}), "
            f"got {describe(joint_actions)}"
        )
    wrong = np.argwhere((array < 0) | (array > WAIT))
    if len(wrong):
        step, agent = wrong[0].tolist()
        raise ValueError(
            f"joint_actions[{step}, {agent}] must be in 0..{WAIT}, got {array[step, agent]}"
        )
    return np.ascontiguousarray(array, np.int64)

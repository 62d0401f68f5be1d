"""What every single decision costs, in any state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapp_env.engine.rules import reset_row, step_row
from mapp_env.engine.state import new_rows, split
from mapp_env.engine.world import make_world
from mapp_env.grid import Grid
from mapp_env.problem import MAX_AGENTS, Problem, check_joint_actions
from mapp_env.solvers.families import smallest_limit_from
from mapp_env.solvers.held_karp import Steps
from mapp_env.solvers.oracle.states import (
    MAX_BATCH_LANDMARKS,
    Room,
    States,
    chunks,
    fill_action_costs,
    fill_next_costs,
    fill_optima,
    list_states,
    part_of,
)
from mapp_env.solvers.solution import Distances
from mapp_env.validation import as_array, describe

MAX_REGRET_LANDMARKS = 20  # as the exact solver
MAX_STEPS = 10_000_000  # from a cell to another


def next_costs(problems: Problem | Sequence[Problem]) -> NDArray[np.int32]:
    """Return the least cover time for each choice of an agent's next landmark.

    That is the optimum over all plans in which that agent walks to this landmark first (or visits
    none any more), whatever the others do. The least over an agent's choices is the optimum of the
    problem; a choice is optimal if it has that cost.

    Parameters
    ----------
    problems : Problem or sequence of Problem
        One problem, or B of the same numbers of agents N and landmarks K, from any starts and on
        any grids; K from 1 to 12. Step limits are ignored. Many problems of one grid take
        microseconds each.

    Returns
    -------
    ndarray of int32, shape (N, K + 1), of a sequence (B, N, K + 1)
        In steps: entry ``[n, k]`` if agent n's next landmark is ``landmarks[k]``, ``[n, K]`` if it
        visits none any more: int32's maximum if there is no such plan, of a single agent.

    Raises
    ------
    ValueError
        If they are not such problems.
    """
    many = [problems] if isinstance(problems, Problem) else problems
    if not isinstance(many, Sequence) or not all(isinstance(one, Problem) for one in many):
        raise ValueError(f"problems must be mapp_env.Problem, one or several, got {describe(many)}")
    sizes = {(one.n_agents, len(one.landmarks)) for one in many}
    if len(sizes) != 1:
        raise ValueError(
            "problems must be of the same numbers of agents and landmarks, got "
            f"{len(many)} problems of {len(sizes)} different ones"
        )
    ((n_agents, n_landmarks),) = sizes
    if n_landmarks > MAX_BATCH_LANDMARKS:
        raise ValueError(
            f"problems must have at most {MAX_BATCH_LANDMARKS} landmarks, got {n_landmarks}"
        )
    landmarks = np.array([one.landmarks for one in many])
    starts = np.array([one.start_cells for one in many])
    grids: dict[int, list[int]] = {}
    for index, one in enumerate(many):
        grids.setdefault(id(one.grid), []).append(index)
    costs = np.empty((len(many), n_agents, n_landmarks + 1), np.int32)
    room = Room.of(n_agents, n_landmarks)
    for places in grids.values():
        for part, states in list_states(many[places[0]].grid, landmarks[places], starts[places]):
            out = np.empty((len(states.home), *costs.shape[1:]), np.int32)
            fill_next_costs(states, room, out)
            costs[places[part]] = out
    return costs[0] if isinstance(problems, Problem) else costs


def next_costs_of(
    between: ArrayLike, starts: ArrayLike, unvisited: ArrayLike | None = None
) -> NDArray[np.int32]:
    """Return what :func:`next_costs` does for states that are given by their distances.

    Parameters
    ----------
    between : array_like of int, shape (B, K, K)
        Steps from landmark to landmark, the same in both directions; K from 1 to 12.
    starts : array_like of int, shape (B, N, K)
        Steps from where each agent stands to each landmark; N from 1 to 16.
    unvisited : array_like of bool, shape (B, K), optional
        Which landmarks are left; without it all of them.

    Returns
    -------
    ndarray of int32, shape (B, N, K + 1)
        In steps; int32's maximum for landmarks that are visited. Where none is left the last entry
        is 0.

    Raises
    ------
    ValueError
        If shapes or types are wrong, or a number is negative or above ten million. That
        distances obey the triangle inequality is up to the caller.
    """
    ways, stands = _steps("between", between), _steps("starts", starts)
    shape = stands.shape
    if stands.ndim != 3 or not 1 <= shape[2] <= MAX_BATCH_LANDMARKS:
        raise ValueError(
            f"starts must be of shape (B, N, K) with K in 1..{MAX_BATCH_LANDMARKS}, got {shape}"
        )
    n_states, n_agents, n_landmarks = shape
    if not 1 <= n_agents <= MAX_AGENTS:
        raise ValueError(f"starts must be of 1..{MAX_AGENTS} agents, got {n_agents}")
    if ways.shape != (n_states, n_landmarks, n_landmarks):
        raise ValueError(
            f"between must be of shape {(n_states, n_landmarks, n_landmarks)}, got {ways.shape}"
        )
    left = np.ones((n_states, n_landmarks), np.bool_)
    if unvisited is not None:
        flags = as_array(unvisited)
        if flags.shape != left.shape or flags.dtype != np.bool_:
            raise ValueError(
                f"unvisited must be bool of shape {left.shape}, got {flags.dtype} of shape "
                f"{flags.shape}"
            )
        left = np.ascontiguousarray(flags)
    states = States(ways, np.zeros((n_states, n_landmarks), np.int32), stands, left)
    costs = np.empty((n_states, n_agents, n_landmarks + 1), np.int32)
    room = Room.of(n_agents, n_landmarks)
    for part in chunks(n_states, n_agents, n_landmarks):
        fill_next_costs(part_of(states, part), room, costs[part])
    return costs


def regrets(problem: Problem, joint_actions: ArrayLike) -> NDArray[np.int64]:
    """Return the regret of each joint action: how many steps it is worse than an optimal one.

    That is the least cover time of what is left after it, plus the step it took, minus the least
    cover time before it: 0, 1 or 2. Over an episode that visits every landmark they sum to its
    cover time minus the optimum.

    Parameters
    ----------
    problem : Problem
        What is played, from its starts; its step limit is ignored.
    joint_actions : array_like of int, shape (T, N)
        0 left, 1 right, 2 up, 3 down, 4 wait for each agent at each step. Those after the last
        landmark is visited are not carried out, and have no regret.

    Returns
    -------
    ndarray of int64, shape (T,)
        One for each joint action that is carried out.

    Raises
    ------
    ValueError
        If the problem has more than 20 landmarks, the shape is wrong or an action is not one.

    Notes
    -----
    A state with 12 landmarks left takes about a millisecond for three agents, one with 20 some
    tenths of a second.
    """
    if not isinstance(problem, Problem):
        raise ValueError(f"problem must be a mapp_env.Problem, got {describe(problem)}")
    if len(problem.landmarks) > MAX_REGRET_LANDMARKS:
        raise ValueError(
            f"problem must have at most {MAX_REGRET_LANDMARKS} landmarks, got "
            f"{len(problem.landmarks)}"
        )
    actions = check_joint_actions(joint_actions, problem.n_agents)
    costs = costs_to_go(problem, *_walk(problem, actions))
    return np.diff(costs) + 1


def _steps(name: str, value: ArrayLike) -> Steps:
    """Return an array of steps as the kernels take them."""
    array = as_array(value)
    if array.dtype.kind not in "iu" or ((array < 0) | (array > MAX_STEPS)).any():
        raise ValueError(
            f"{name} must be integers in 0..{MAX_STEPS:,}, got {array.dtype} of shape {array.shape}"
        )
    return np.ascontiguousarray(array, np.int32)


def _walk(
    problem: Problem, actions: NDArray[np.int64]
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Return where agents stand, (T + 1, N), and which landmarks are left, (T + 1, K).

    That is before and after each joint action that is carried out.
    """
    n_agents, n_landmarks = problem.n_agents, len(problem.landmarks)
    world = make_world(problem.grid, n_agents, n_landmarks)
    row = new_rows(1, n_agents, n_landmarks)[0]
    landmarks, starts = np.array(problem.landmarks, np.int32), np.array(problem.start_cells)
    reset_row(row, landmarks, starts.astype(np.int32), world)
    rows = [row.copy()]
    for joint_action in actions:
        _, terminated, _ = step_row(row, joint_action, len(actions) + 1, world)
        rows.append(row.copy())
        if terminated:
            break
    states = [split(one, n_agents, n_landmarks) for one in rows]
    cells = np.array([state.cells for state in states])
    return cells, np.array([state.visited for state in states]) == 0


def costs_to_go(
    problem: Problem, cells: NDArray[np.int32], left: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return the least cover times of the states of an episode, (T + 1,)."""
    fields = problem.grid.distances_from(problem.landmarks)
    between = fields[:, list(problem.landmarks)]
    starts = np.ascontiguousarray(fields[:, cells].transpose(1, 2, 0))
    costs = np.zeros(len(cells), np.int64)
    many = left.sum(axis=1) > MAX_BATCH_LANDMARKS
    low, high = 0, None
    for step in np.flatnonzero(many):
        nodes = np.append(0, np.flatnonzero(left[step]) + 1)
        ways = np.pad(between, (1, 0))[np.ix_(nodes, nodes)]
        own = np.pad(starts[step], ((0, 0), (1, 0)))[:, nodes]
        costs[step] = smallest_limit_from(Distances(ways, own), False, low, high)
        # A step brings no landmark nearer by more than one, nor farther.
        low, high = int(costs[step]) - 1, int(costs[step]) + 1
    few = np.flatnonzero(~many)
    # Landmarks that are left first; of these there are few enough.
    order = np.argsort(~left[few], axis=1, kind="stable")[:, :MAX_BATCH_LANDMARKS]
    states = States(
        between[order[:, :, None], order[:, None, :]],
        np.zeros(order.shape, np.int32),
        np.take_along_axis(starts[few], order[:, None, :], axis=2),
        np.take_along_axis(left[few], order, axis=1),
    )
    room = Room.of(*states.starts.shape[1:])
    for part in chunks(len(few), *states.starts.shape[1:]):
        out = np.empty(len(few[part]), np.int32)
        fill_optima(part_of(states, part), False, room, out)
        costs[few[part]] = out
    return costs


def action_costs(
    grid: Grid,
    landmarks: NDArray[np.integer[Any]],
    unvisited: NDArray[np.bool_],
    cells: NDArray[np.integer[Any]],
    moves: NDArray[np.integer[Any]],
) -> Steps:
    """Return the least cover time of what is left after each joint action, (B, A ** N) int32.

    States are of landmarks, (B, K), which of them are unvisited, (B, K), and agents' cells, (B, N);
    ``moves``, (C, A), says where each action leads from each cell. The grid is small enough for the
    distances between all pairs of cells. Joint actions are in order, the first agent's most
    significant; one that visits everything that is left costs 0.
    """
    distances = grid.distances
    n_states, n_agents = cells.shape
    after = moves[cells].reshape(n_states, -1)
    states = States(
        distances[landmarks[:, :, None], landmarks[:, None, :]],
        np.zeros(landmarks.shape, np.int32),
        distances[after[:, :, None], landmarks[:, None, :]],
        unvisited,
    )
    costs = np.empty((n_states, moves.shape[1] ** n_agents), np.int32)
    room = Room.of(after.shape[1], landmarks.shape[1])
    fill_action_costs(states, moves.shape[1], room, costs)
    return costs

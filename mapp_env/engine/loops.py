"""The loops that run the rules over rows, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.observation import observe_row
from mapp_env.engine.rules import measure_row, reset_row, step_row
from mapp_env.grid import fill_distances
from mapp_env.problem import draw_landmarks

__all__ = [
    "fill_fields",
    "fill_joint_mask",
    "fill_joint_masks",
    "find_bad_action",
    "measure_rows",
    "observe_rows",
    "reset_rows",
    "step_and_observe",
    "step_rows",
]


@kernel
def _step_and_observe(
    row: NDArray[np.int32],
    actions: NDArray[np.int64],
    max_cycles: int,
    n_agents: int,
    n_landmarks: int,
    reward: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    view_distances: NDArray[np.int32],
    first_view_field: int,
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> tuple[float, bool, bool]:
    """Do what :func:`step_and_observe` does with actions that have been looked at.

    The rules index a table with them, and what is no action would leave its memory.
    """
    result: tuple[float, bool, bool] = step_row(
        row,
        actions,
        n_agents,
        n_landmarks,
        max_cycles,
        reward,
        table,
        distances,
        first_field,
    )
    observe_row(
        row,
        n_agents,
        n_landmarks,
        kind,
        table,
        view_distances,
        first_view_field,
        views,
        masks,
    )
    return result


@kernel
def step_and_observe(
    row: NDArray[np.int32],
    actions: NDArray[np.int64],
    max_cycles: int,
    n_agents: int,
    n_landmarks: int,
    reward: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    view_distances: NDArray[np.int32],
    first_view_field: int,
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> tuple[float, bool, bool]:
    """Step a row and look at it; parameters as in ``step_row`` and ``observe_row``.

    Raises
    ------
    ValueError
        If ``actions`` are not one an agent, each one that it has; nothing has moved then.
    """
    if actions.shape[0] != n_agents:
        raise ValueError("actions must hold one action an agent")
    for agent in range(n_agents):
        if not 0 <= actions[agent] < masks.shape[1]:
            raise ValueError("actions must be in 0..A-1, A the number of an agent's actions")
    result: tuple[float, bool, bool] = _step_and_observe(
        row,
        actions,
        max_cycles,
        n_agents,
        n_landmarks,
        reward,
        kind,
        table,
        distances,
        first_field,
        view_distances,
        first_view_field,
        views,
        masks,
    )
    return result


@kernel
def step_rows(
    rows: NDArray[np.int32],
    actions: NDArray[np.int64],
    skip: NDArray[np.bool_],
    limits: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    reward: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    view_distances: NDArray[np.int32],
    first_view_field: int,
    rewards: NDArray[np.float64],
    terminations: NDArray[np.bool_],
    truncations: NDArray[np.bool_],
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> None:
    """Step all rows but those of ``skip``, and look at all; parameters as ``step_and_observe``."""
    for index in range(rows.shape[0]):
        field = _field_of(index, first_field, n_landmarks)
        view_field = _field_of(index, first_view_field, n_landmarks)
        if skip[index]:
            rewards[index] = 0.0
            terminations[index] = False
            truncations[index] = False
            observe_row(
                rows[index],
                n_agents,
                n_landmarks,
                kind,
                table,
                view_distances,
                view_field,
                views[index],
                masks[index],
            )
        else:
            rewards[index], terminations[index], truncations[index] = _step_and_observe(
                rows[index],
                actions[index],
                limits[index],
                n_agents,
                n_landmarks,
                reward,
                kind,
                table,
                distances,
                field,
                view_distances,
                view_field,
                views[index],
                masks[index],
            )


@kernel
def observe_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    kind: int,
    table: NDArray[np.int32],
    distances: NDArray[np.int32],
    first_field: int,
    views: NDArray[np.float32],
    masks: NDArray[np.int8],
) -> None:
    """Look at some rows: ``views`` (M, V, F) and ``masks`` (M, N, A) of ``indices`` (M,)."""
    for place, index in enumerate(indices):
        field = _field_of(index, first_field, n_landmarks)
        observe_row(
            rows[index],
            n_agents,
            n_landmarks,
            kind,
            table,
            distances,
            field,
            views[place],
            masks[place],
        )


@kernel
def _field_of(index: int, first_field: int, n_landmarks: int) -> int:
    """Return what a row takes for ``first_field``: a line of its own if there are fields."""
    return first_field if first_field < 0 else index * n_landmarks


@kernel
def reset_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    words: NDArray[np.uint64],
    landmarks: NDArray[np.int32],
    candidates: NDArray[np.int32],
    depot: int,
    n_agents: int,
    n_landmarks: int,
) -> None:
    """Reset rows on given landmarks, or, where there are words, on landmarks drawn with them."""
    for place, index in enumerate(indices):
        if words.shape[0] > 0:
            draw_landmarks(words[place], candidates, landmarks[place])
        reset_row(rows[index], landmarks[place], depot, n_agents, n_landmarks)


@kernel
def measure_rows(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    n_agents: int,
    n_landmarks: int,
    table: NDArray[np.int32],
    costs: NDArray[np.float64],
) -> None:
    """Write the costs of some rows, (M, 3): cover time, makespan, total distance (R8)."""
    for place, index in enumerate(indices):
        cover_time, makespan, distance = measure_row(rows[index], n_agents, n_landmarks, table)
        costs[place, 0] = cover_time
        costs[place, 1] = makespan
        costs[place, 2] = distance


@kernel
def fill_fields(
    rows: NDArray[np.int32],
    indices: NDArray[np.int64],
    table: NDArray[np.int32],
    n_agents: int,
    n_landmarks: int,
    fields: NDArray[np.int32],
    queue: NDArray[np.int32],
) -> None:
    """Write the steps from every landmark of some rows: how grids too large for all pairs do it.

    Shapes: ``rows`` (B, row_length), ``indices`` (M,), ``fields`` (B * K, C), ``queue`` (C,).
    """
    for index in indices:
        for landmark in range(n_landmarks):
            start = rows[index, n_agents + landmark]
            fill_distances(table, start, fields[index * n_landmarks + landmark], queue)


@kernel
def fill_joint_mask(masks: NDArray[np.int8], joint: NDArray[np.int8]) -> None:
    """Write which numbered joint actions bump no agent, (A**N,), of the agents' masks, (N, A)."""
    n_agents, n_actions = masks.shape
    for action in range(n_actions):
        joint[action] = masks[n_agents - 1, action]
    size = n_actions
    for agent in range(n_agents - 2, -1, -1):
        # What the agents behind this one may do, once for each of its actions; last for action 0,
        # whose block is the one that is read.
        for action in range(n_actions - 1, -1, -1):
            allowed = masks[agent, action]
            block = np.uint32(action * size)
            for place in range(np.uint32(size)):
                joint[block + place] = joint[place] & allowed
        size *= n_actions


@kernel
def fill_joint_masks(masks: NDArray[np.int8], joint: NDArray[np.int8]) -> None:
    """Do :func:`fill_joint_mask` for every row: ``masks`` (M, N, A) and ``joint`` (M, A**N)."""
    for row in range(masks.shape[0]):
        fill_joint_mask(masks[row], joint[row])


@kernel
def find_bad_action(actions: NDArray[np.uint64], n_actions: int) -> int:
    """Return the position of the first action outside ``0..n_actions - 1``, or -1.

    Shape: ``actions`` (M,), int64 seen as uint64, so that a negative action is a huge one.
    """
    limit = np.uint64(n_actions)
    highest = np.uint64(0)
    for action in actions:
        # No early exit: the loop without one is vectorised, and bad actions are rare.
        highest = max(highest, action)
    if highest >= limit:
        for position, action in enumerate(actions):
            if action >= limit:
                return position
    return -1

"""What a batch is asked for when it is reset: which rows, and which problems they get."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.task import Task
from mapp_env.problem import check_landmarks
from mapp_env.validation import describe

__all__ = ["check_problems", "check_reset_mask"]


def check_reset_mask(options: Mapping[str, Any] | None, num_envs: int) -> NDArray[np.bool_]:
    """Return which rows to reset, shape (B,), the caller's array untouched.

    Raises
    ------
    ValueError
        If the options are no dict, or their mask is none.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be a dict or None, got {describe(options)}")
    mask = None if options is None else options.get("reset_mask")
    if mask is None:
        return np.ones(num_envs, np.bool_)
    valid = isinstance(mask, np.ndarray) and mask.dtype == np.bool_
    if not valid or mask.shape != (num_envs,) or not mask.any():
        raise ValueError(
            f"options['reset_mask'] must be a bool array of shape ({num_envs},) with at "
            f"least one True, got {describe(mask)}"
        )
    return np.array(mask, np.bool_)


def check_problems(
    options: Mapping[str, Any] | None, task: Task, num_envs: int
) -> tuple[NDArray[np.int32] | None, int | None]:
    """Return the landmarks that are asked for, shape (B, K), and the step limit; None if drawn.

    Raises
    ------
    ValueError
        If they are none of the task's.
    """
    landmarks = None if options is None else options.get("landmarks")
    if isinstance(landmarks, np.ndarray) and landmarks.ndim > 1:
        rows, pairs = (num_envs, task.n_landmarks), (task.n_landmarks, 2)
        if landmarks.shape not in (rows, (*rows, 2), pairs):
            raise ValueError(
                f"options['landmarks'] must be cells or (row, col) pairs, for each row {rows} or "
                f"{(*rows, 2)}, for all {pairs}, got shape {landmarks.shape}"
            )
        if landmarks.shape == rows == pairs:
            raise ValueError(
                "options['landmarks'] of shape (2, 2) may mean cells for each of 2 rows or (row, "
                "col) pairs for all: pass pairs for each row, shape (2, 2, 2), or a list of pairs"
            )
        if landmarks.shape != pairs:
            return _check_rows(landmarks, task), None
    problem = task.check_options(options)
    if problem is None:
        return None, None
    cells = np.array(problem.landmarks, np.int32)
    return np.repeat(cells[None], num_envs, axis=0), problem.max_cycles


def _check_rows(landmarks: NDArray[Any], task: Task) -> NDArray[np.int32]:
    """Return the landmarks of each row as cells, shape (B, K), if they satisfy rule R2.

    They are given as cells, shape (B, K), or as (row, col) pairs, shape (B, K, 2).
    """
    grid, cells = task.grid, landmarks
    ok = landmarks.dtype.kind in "iu"
    if ok and landmarks.ndim == 3:
        inside = ((landmarks >= 0) & (landmarks < grid.walls.shape)).all(axis=2)
        cells = np.where(inside, landmarks[..., 0] * grid.cols + landmarks[..., 1], grid.depot)
    if ok:
        ordered = np.sort(cells, axis=1)
        allowed = np.isin(cells, grid.reachable).all(axis=1)
        distinct = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
        ok = bool((allowed & distinct).all())
    if not ok:
        # Row by row, for the message that says which cell of which row is wrong and why.
        for index, wanted in enumerate(landmarks):
            check_landmarks(grid, wanted, name=f"options['landmarks'][{index}]")
    return cells.astype(np.int32)

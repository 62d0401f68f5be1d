"""What a batch is asked for when it is reset: which rows, and which problems they get."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.problem import check_landmarks
from mapp_env.task import Task
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
        if landmarks.shape not in (rows, pairs):
            raise ValueError(
                f"options['landmarks'] must be of shape {rows}, cells for each row, or {pairs}, "
                f"(row, col) pairs for all; got shape {landmarks.shape}"
            )
        if rows == pairs:
            raise ValueError(
                "options['landmarks'] of shape (2, 2) may mean a cell for each of 2 rows "
                "or (row, col) pairs: pass pairs as a list, or reset row by row"
            )
        if landmarks.shape == rows:
            return _check_cells(landmarks, task), None
    problem = task.check_options(options)
    if problem is None:
        return None, None
    cells = np.array(problem.landmarks, np.int32)
    return np.repeat(cells[None], num_envs, axis=0), problem.max_cycles


def _check_cells(landmarks: NDArray[Any], task: Task) -> NDArray[np.int32]:
    """Return landmarks of each row, shape (B, K), if they satisfy rule R2."""
    grid = task.grid
    ok = landmarks.dtype.kind in "iu"
    if ok:
        ordered = np.sort(landmarks, axis=1)
        allowed = np.isin(landmarks, grid.reachable).all(axis=1)
        distinct = (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)
        ok = bool((allowed & distinct).all())
    if not ok:
        # Row by row, for the message that says which cell of which row is wrong and why.
        for index, cells in enumerate(landmarks):
            check_landmarks(grid, cells, name=f"options['landmarks'][{index}]")
    return landmarks.astype(np.int32)

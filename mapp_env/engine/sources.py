"""Where the next problem comes from: drawn on the task's grid, or given by whoever resets."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel
from mapp_env.engine.task import Task
from mapp_env.problem import Problem, check_landmarks, draw_landmarks
from mapp_env.validation import describe

OPTIONS = ("landmarks", "problem")
"""What ``reset(options=...)`` knows."""

BATCH_OPTIONS = (*OPTIONS, "reset_mask")
"""What it knows in a batch."""


def draw_problems(task: Task, words: NDArray[np.uint64]) -> NDArray[np.int32]:
    """Return landmarks on the task's grid, shape (M, K), each row drawn with its random word."""
    landmarks = np.empty((len(words), task.n_landmarks), np.int32)
    _draw_rows(words, task.grid.reachable, landmarks)
    return landmarks


@kernel
def _draw_rows(
    words: NDArray[np.uint64], candidates: NDArray[np.int32], landmarks: NDArray[np.int32]
) -> None:
    for row, word in enumerate(words):
        draw_landmarks(word, candidates, landmarks[row])


def warn_of_unknown(options: Mapping[str, Any] | None, known: Sequence[str]) -> None:
    """Warn of options that are not ``known``: a typo would train on another task in silence.

    The one that PettingZoo's own tests pass, ``{"options": 1}``, is let through.
    """
    if not isinstance(options, Mapping):
        return
    given = [key for key in options if key != "options" or type(options[key]) is not int]
    unknown = [key for key in given if key not in known]
    if not unknown:
        return
    named = [key for key in unknown[:8] if isinstance(key, str)]
    meant = dict.fromkeys(near for key in named for near in get_close_matches(key, known))
    hint = f" (did you mean {' or '.join(map(repr, meant))}?)" if meant else ""
    warnings.warn(
        f"options of reset() that are unknown are ignored: {', '.join(map(describe, unknown[:8]))}"
        f"{hint}; known are {', '.join(map(repr, known))}",
        UserWarning,
        stacklevel=3,
    )


def check_options(task: Task, options: Mapping[str, Any] | None) -> Problem | None:
    """Return the problem that ``reset(options=...)`` asks for, or ``None`` for a random one.

    ``"landmarks"`` holds cells or (row, col) pairs, ``"problem"`` a whole problem on the task's
    grid with as many agents and landmarks. Other keys are not looked at.

    Raises a ValueError if the options are invalid.
    """
    if options is None:
        return None
    if not isinstance(options, Mapping):
        raise ValueError(f"options must be a dict or None, got {describe(options)}")
    problem, landmarks = options.get("problem"), options.get("landmarks")
    if problem is None and landmarks is None:
        return None
    if problem is None:
        cells = check_landmarks(task.grid, landmarks, task.n_landmarks, "options['landmarks']")
        return Problem(task.grid, cells, task.n_agents)
    if landmarks is not None:
        raise ValueError("options must hold 'problem' or 'landmarks', got both")
    if not isinstance(problem, Problem):
        raise ValueError(f"options['problem'] must be a mapp_env.Problem, got {describe(problem)}")
    wanted = (problem.grid, problem.n_agents, len(problem.landmarks))
    if wanted != (task.grid, task.n_agents, task.n_landmarks):
        raise ValueError(
            f"options['problem'] must be on this environment's {task.grid!r} with "
            f"{task.n_agents} agents and {task.n_landmarks} landmarks; got one on "
            f"{problem.grid!r} with {problem.n_agents} and {len(problem.landmarks)}"
        )
    return problem


def check_reset_mask(options: Mapping[str, Any] | None, n_rows: int) -> NDArray[np.bool_]:
    """Return which rows of a batch to reset, shape (B,), the caller's array untouched.

    Raises a ValueError if the options are not a dict, or their mask is invalid.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be a dict or None, got {describe(options)}")
    mask = None if options is None else options.get("reset_mask")
    if mask is None:
        return np.ones(n_rows, np.bool_)
    valid = isinstance(mask, np.ndarray) and mask.dtype == np.bool_
    if not valid or mask.shape != (n_rows,) or not mask.any():
        raise ValueError(
            f"options['reset_mask'] must be a bool array of shape ({n_rows},) with at "
            f"least one True, got {describe(mask)}"
        )
    return np.array(mask, np.bool_)


def check_problems(
    task: Task, options: Mapping[str, Any] | None, n_rows: int
) -> tuple[NDArray[np.int32] | None, int | None]:
    """Return the landmarks that a batch is reset on, shape (B, K), and the step limit.

    Both are None if nothing is asked for. Raises a ValueError if the options are invalid, or their
    problem is not of the task's grid and sizes.
    """
    landmarks = None if options is None else options.get("landmarks")
    if isinstance(landmarks, np.ndarray) and landmarks.ndim > 1:
        rows, pairs = (n_rows, task.n_landmarks), (task.n_landmarks, 2)
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
    problem = check_options(task, options)
    if problem is None:
        return None, None
    cells = np.array(problem.landmarks, np.int32)
    return np.repeat(cells[None], n_rows, axis=0), problem.max_cycles


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

"""What ``reset(options=...)`` asks for: problems, or grids to draw them on."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.sources import NO_GRIDS, OWN_LIMIT, Problems, Source
from mapp_env.engine.task import Task
from mapp_env.problem import Problem, check_landmarks
from mapp_env.validation import as_array, as_integer, describe

OPTIONS = ("landmarks", "grid", "problem")
"""What ``reset(options=...)`` knows."""

BATCH_OPTIONS = (*OPTIONS, "reset_mask")
"""What it knows in a batch."""


class Asked(NamedTuple):
    """What ``reset(options=...)`` asks for in each row: problems, or grids to draw them on."""

    grids: NDArray[np.int64]  # (B,), or NO_GRIDS
    problems: Problems | None  # of B rows


NOTHING = Asked(NO_GRIDS, None)


def warn_of_unknown(options: Mapping[str, Any] | None, known: Sequence[str]) -> None:
    """Warn of options that are not ``known``: a typo would train on another task in silence.

    The one that PettingZoo's own tests pass, ``{"options": 1}``, is let through.
    """
    given = options or {}
    unknown = [
        key
        for key, value in given.items()
        if key not in known and not (key == "options" and type(value) is int)
    ]
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


def check_options(source: Source, task: Task, options: Mapping[str, Any] | None) -> Asked:
    """Return what a single environment is asked for.

    ``"landmarks"`` holds cells or (row, col) pairs; ``"grid"`` the number of a grid of the pool,
    and without landmarks they are drawn on it; ``"problem"`` a whole problem on one of the task's
    grids with as many agents and landmarks. Other keys are not looked at.

    Raises a ValueError if the options are invalid.
    """
    landmarks, grid, problem = _read(options)
    if problem is not None:
        return Asked(NO_GRIDS, stack_problems(task, [problem], ["options['problem']"]))
    index = None if grid is None else check_grid_number(task, grid)
    if landmarks is None:
        return NOTHING if index is None else Asked(np.array([index]), None)
    index = _the_grid(task, index)
    name = "options['landmarks']"
    cells = check_landmarks(task.grids[index], landmarks, task.n_landmarks, name)
    return Asked(NO_GRIDS, source.place(np.array([index]), np.array([cells], np.int32)))


def check_problems(
    source: Source, task: Task, options: Mapping[str, Any] | None, n_rows: int
) -> Asked:
    """Return what a batch is asked for: what :func:`check_options` does, for all rows alike.

    Besides, ``"grid"`` may have shape (B,), ``"landmarks"`` (B, K) or (B, K, 2), and ``"problem"``
    may be a sequence of B problems.

    Raises a ValueError if the options are invalid.
    """
    landmarks, grid, problem = _read(options)
    if isinstance(problem, Sequence):
        if len(problem) != n_rows:
            raise ValueError(
                f"options['problem'] must be a problem, or a sequence of {n_rows}, one for each "
                f"row; got {len(problem)}"
            )
        names = [f"options['problem'][{row}]" for row in range(n_rows)]
        return Asked(NO_GRIDS, stack_problems(task, problem, names))
    by_row = isinstance(landmarks, np.ndarray) and _is_by_row(task, landmarks, n_rows)
    if not by_row and not isinstance(grid, Sequence | np.ndarray):
        asked = check_options(source, task, options)
        rows = np.zeros(n_rows, np.int64)
        grids = asked.grids.repeat(n_rows)
        return Asked(grids, None if asked.problems is None else asked.problems.take(rows))
    if grid is None:
        grids = np.full(n_rows, _the_grid(task, None))
    else:
        grids = _check_grid_numbers(task, grid, n_rows)
    if landmarks is None:
        return Asked(grids, None)
    if by_row:
        return Asked(NO_GRIDS, source.place(grids, _check_rows(landmarks, task, grids)))
    name = "options['landmarks']"
    cells = [
        check_landmarks(task.grids[index], landmarks, task.n_landmarks, f"{name} on grid {index}")
        for index in grids.tolist()
    ]
    return Asked(NO_GRIDS, source.place(grids, np.array(cells, np.int32)))


def check_reset_mask(options: Mapping[str, Any] | None, n_rows: int) -> NDArray[np.bool_]:
    """Return which rows of a batch to reset, shape (B,), the caller's array untouched.

    Raises a ValueError if the options are not a dict, or their mask is invalid.
    """
    _check_dict(options)
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


def check_grid_number(task: Task, value: object, name: str = "options['grid']") -> int:
    """Return the number of a grid of the task; raise a ValueError if there is none such."""
    index = as_integer(value)
    if index is None or not 0 <= index < len(task.grids):
        raise ValueError(
            f"{name} must be an integer in 0..{len(task.grids) - 1}, the number of a grid of this "
            f"environment, got {describe(value)}"
        )
    return index


def stack_problems(task: Task, problems: Sequence[object], names: Sequence[str]) -> Problems:
    """Return problems of a task as arrays; ``names`` are for messages.

    Raises a ValueError if one is none, is on another grid or of other sizes.
    """
    stacked = Problems(
        np.empty(len(problems), np.int64),
        np.empty((len(problems), task.n_landmarks), np.int32),
        np.empty((len(problems), task.n_agents), np.int32),
        np.full(len(problems), OWN_LIMIT),
    )
    for row, (name, problem) in enumerate(zip(names, problems, strict=True)):
        if not isinstance(problem, Problem):
            raise ValueError(f"{name} must be a mapp_env.Problem, got {describe(problem)}")
        index = task.numbers.get(problem.grid)
        sizes = problem.n_agents, len(problem.landmarks)
        if index is None or sizes != (task.n_agents, task.n_landmarks):
            own = f"this environment's {task.grid!r}"
            if task.is_pool:
                own = f"one of the {len(task.grids)} grids of this environment's pool"
            raise ValueError(
                f"{name} must be on {own} with {task.n_agents} agents and "
                f"{task.n_landmarks} landmarks; got one on "
                f"{problem.grid!r} with {problem.n_agents} and {len(problem.landmarks)}"
            )
        stacked.grids[row] = index
        stacked.landmarks[row] = problem.landmarks
        stacked.cells[row] = problem.start_cells
        if problem.max_cycles is not None:
            stacked.limits[row] = problem.max_cycles
    return stacked


def _check_dict(options: object) -> None:
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(f"options must be a dict or None, got {describe(options)}")


def _read(options: Mapping[str, Any] | None) -> tuple[Any, Any, Any]:
    """Return the values of ``OPTIONS``, ``None`` where there is none."""
    _check_dict(options)
    landmarks, grid, problem = (None if not options else options.get(name) for name in OPTIONS)
    for name, value in (("landmarks", landmarks), ("grid", grid)):
        if problem is not None and value is not None:
            raise ValueError(f"options must hold 'problem' or {name!r}, got both")
    return landmarks, grid, problem


def _the_grid(task: Task, index: int | None) -> int:
    """Return the grid that landmarks are on."""
    if index is None and len(task.grids) > 1:
        raise ValueError(
            "options['landmarks'] needs options['grid'] in an environment with a pool: cells mean "
            f"nothing without it; got no grid in 0..{len(task.grids) - 1}"
        )
    return index or 0


def _check_grid_numbers(task: Task, value: object, n_rows: int) -> NDArray[np.int64]:
    """Return the number of each row's grid, (B,), given for all rows or for each."""
    if not isinstance(value, Sequence | np.ndarray):
        return np.full(n_rows, check_grid_number(task, value))
    numbers = as_array(value)
    if numbers.shape != (n_rows,) or numbers.dtype.kind not in "iu":
        raise ValueError(
            f"options['grid'] must be an integer, or integers of shape ({n_rows},), got "
            f"{describe(value)}"
        )
    for row in np.flatnonzero((numbers < 0) | (numbers >= len(task.grids))):
        check_grid_number(task, int(numbers[row]), f"options['grid'][{row}]")
    return numbers.astype(np.int64)


def _is_by_row(task: Task, landmarks: NDArray[Any], n_rows: int) -> bool:
    """Return whether landmarks are given for each row, as cells or pairs, and not for all alike."""
    if landmarks.ndim < 2:
        return False
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
    return landmarks.shape != pairs


def _check_rows(landmarks: NDArray[Any], task: Task, grids: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the landmarks of each row as cells, shape (B, K), if they satisfy rule R2.

    They are given as cells, shape (B, K), or as (row, col) pairs, shape (B, K, 2).
    """
    found = np.empty((len(landmarks), task.n_landmarks), np.int32)
    for index in np.unique(grids):
        grid, rows = task.grids[index], np.flatnonzero(grids == index)
        given = cells = landmarks[rows]
        ok = landmarks.dtype.kind in "iu"
        if ok and landmarks.ndim == 3:
            inside = ((given >= 0) & (given < grid.walls.shape)).all(axis=2)
            cells = np.where(inside, given[..., 0] * grid.cols + given[..., 1], grid.depot)
        if ok:
            ordered = np.sort(cells, axis=1)
            allowed = np.isin(cells, grid.reachable).all(axis=1)
            ok = bool((allowed & (ordered[:, 1:] != ordered[:, :-1]).all(axis=1)).all())
        if not ok:
            # Row by row, for the message that says which cell of which row is wrong and why.
            for row, wanted in zip(rows, given, strict=True):
                check_landmarks(grid, wanted, name=f"options['landmarks'][{row}]")
        found[rows] = cells
    return found

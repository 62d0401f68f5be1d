"""Checks of what is passed in: every refusal names the argument, its value and what is allowed."""

import math
from numbers import Integral, Real

import numpy as np

from mapp_env import Grid
from mapp_env.grid import tell_apart


def check_count(name: str, value: object, low: int, high: int) -> None:
    """Refuse what is not a whole number in ``[low, high]``.

    Raises
    ------
    ValueError
        If `value` is a bool, fractional, or out of the range.
    """
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or not low <= value <= high:  # type: ignore[operator]
        raise ValueError(f"{name} must be a whole number from {low} to {high}, got {value!r}")


def check_number(name: str, value: object, low: float, high: float) -> None:
    """Refuse what is not a finite number in ``[low, high]``.

    Raises
    ------
    ValueError
        If `value` is a bool, not finite, or out of the range.
    """
    real = isinstance(value, Real) and not isinstance(value, bool)
    if not real or not math.isfinite(value) or not low <= value <= high:  # type: ignore
        raise ValueError(f"{name} must be a number from {low:g} to {high:g}, got {value!r}")


def check_choice(name: str, value: object, allowed: tuple[str, ...]) -> None:
    """Refuse what is not one of the `allowed` words.

    Raises
    ------
    ValueError
        If `value` is none of them.
    """
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {value!r}")


def check_flag(name: str, value: object) -> None:
    """Refuse what is not True or False.

    Raises
    ------
    ValueError
        If `value` is anything else.
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, got {value!r}")


def check_grid(policy: object, grid: Grid) -> None:
    """Refuse a policy that was trained on another grid; one that names none plays on any.

    Raises
    ------
    ValueError
        If its grid is another, or it is not known which one it is.
    """
    own = getattr(policy, "grid", None)
    if isinstance(own, Grid) and own != grid:
        raise ValueError(
            f"policy must be one of this grid, got one of another; here {tell_apart(grid, own)}"
        )


def check_rows(observations: object) -> np.ndarray:
    """Return observations as a table of numbers, a row per problem.

    Raises
    ------
    ValueError
        If they are no such table: ragged rows, another number of axes, or no real numbers.
    """
    try:
        array = np.asarray(observations)
    except (ValueError, TypeError, RecursionError):
        raise ValueError("observations must have rows of numbers, all of one length") from None
    if array.ndim != 2 or array.dtype.kind not in "fiub":
        raise ValueError(
            f"observations must be rows of numbers, got {array.dtype} of shape {array.shape}"
        )
    return array


def check_observations(
    observations: object, n_agents: int, n_landmarks: int, n_cells: int
) -> np.ndarray:
    """Return the observations as a fresh float32 array when they can come from the env.

    Raises
    ------
    ValueError
        If the shape is not (B, N + 2K), a cell is none of the grid's, or a flag is not 0 or 1.
    """
    array = check_rows(observations)
    if array.shape[1] != n_agents + 2 * n_landmarks:
        raise ValueError(
            f"observations must be numbers of shape (B, {n_agents + 2 * n_landmarks}), got "
            f"{array.dtype} of shape {array.shape}"
        )
    n_cell_inputs = n_agents + n_landmarks
    cells, flags = array[:, :n_cell_inputs], array[:, n_cell_inputs:]
    if not ((cells >= 0) & (cells < n_cells) & (cells == np.floor(cells))).all():
        raise ValueError(f"observations must have cells in 0..{n_cells - 1}, got something else")
    if not ((flags == 0) | (flags == 1)).all():
        raise ValueError("observations must have visited flags 0 or 1, got something else")
    return array.astype(np.float32)

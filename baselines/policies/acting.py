"""What acts: anything that commands the agents, and what it may be given."""

from typing import Protocol

import numpy as np

from baselines.networks import ANY
from mapp_env.evaluation.policies import check_grid as check_grid


class Acting(Protocol):
    """Anything that commands the agents: a policy."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return joint actions (B, N) for global observations (B, N + 2K)."""


def check_rows(observations: object) -> np.ndarray:
    """Return observations as a table of numbers, a row per problem.

    Raises a ValueError if they are no such table: ragged rows, another number of axes, or no real
    numbers.
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

    With `n_cells` ANY they may come from any grid.

    Raises a ValueError if the shape is not (B, N + 2K), a cell is none of the grid's, or a flag is
    not 0 or 1.
    """
    array = check_rows(observations)
    if array.shape[1] != n_agents + 2 * n_landmarks:
        raise ValueError(
            f"observations must be numbers of shape (B, {n_agents + 2 * n_landmarks}), got "
            f"{array.dtype} of shape {array.shape}"
        )
    n_cell_inputs = n_agents + n_landmarks
    cells, flags = array[:, :n_cell_inputs], array[:, n_cell_inputs:]
    limit = np.inf if n_cells == ANY else n_cells
    if not ((cells >= 0) & (cells < limit) & (cells == np.floor(cells))).all():
        raise ValueError(f"observations must have cells in 0..{limit - 1}, got something else")
    if not ((flags == 0) | (flags == 1)).all():
        raise ValueError("observations must have visited flags 0 or 1, got something else")
    return array.astype(np.float32)

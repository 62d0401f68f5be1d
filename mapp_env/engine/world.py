"""The world of a task: the tables that the rules look up, of one grid or of several."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.observation import PATH_OBSERVATIONS, Observation
from mapp_env.engine.rules import PATH_REWARDS, Reward, reward_distances
from mapp_env.engine.state import (
    ALL_PAIRS,
    LANDMARKS,
    MOVES,
    NO_DISTANCES,
    SHIFT,
    World,
    cell_table,
    path_distances,
)
from mapp_env.grid import Grid


def needs_paths(reward: Reward, observation: Observation, actions: int) -> bool:
    """Return whether rows look up shortest paths to their landmarks."""
    return reward in PATH_REWARDS or observation in PATH_OBSERVATIONS or actions == LANDMARKS


def make_world(
    grids: Grid | Sequence[Grid],
    n_agents: int,
    n_landmarks: int,
    reward: Reward = Reward.STEP,
    observation: Observation = Observation.GLOBAL,
    fields: NDArray[np.int32] = NO_DISTANCES[:0],
    actions: int = MOVES,
    return_home: bool = False,
) -> World:
    """Return what the rules look up on a grid, or on several; sizes are not checked here.

    ``fields``, shape (B * C, K), C of the largest grid, is where shortest paths from the rows'
    landmarks will stand; if it is empty, those of all pairs do. Raises a ValueError if shortest
    paths are looked up, without fields, on several grids or on one too large for all pairs.
    """
    pool = (grids,) if isinstance(grids, Grid) else tuple(grids)
    distances, distances_at = reward_distances(reward, pool, fields)
    paths, paths_at = NO_DISTANCES, ALL_PAIRS
    if observation in PATH_OBSERVATIONS or actions == LANDMARKS:
        paths, paths_at = path_distances(pool, fields)
    lines, table = _describe(pool), np.concatenate([cell_table(grid) for grid in pool])
    home = np.concatenate([grid.home for grid in pool])
    for array in (lines, table, home):
        array.flags.writeable = False
    return World(
        n_agents,
        n_landmarks,
        int(reward),
        int(observation),
        actions,
        int(return_home),
        distances_at,
        paths_at,
        lines,
        table,
        home,
        distances,
        paths,
    )


def _describe(grids: Sequence[Grid]) -> NDArray[np.int64]:
    """Return a line of numbers for each grid, see ``state.FIRST`` to ``RECIPROCAL``, (G, 7)."""
    sizes = [grid.n_cells for grid in grids]
    firsts = np.cumsum([0, *sizes[:-1]]).tolist()
    width = max(grid.cols for grid in grids)
    lines = [
        (first, size, grid.depot, grid.rows, grid.cols, width, -(-(1 << SHIFT) // grid.cols))
        for first, size, grid in zip(firsts, sizes, grids, strict=True)
    ]
    return np.array(lines, np.int64)

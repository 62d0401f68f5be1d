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
    WAYS,
    World,
    open_actions,
    path_distances,
    strides_of,
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
    widths = sorted({grid.cols for grid in pool})
    lines, strides = _describe(pool, widths), np.concatenate([strides_of(cols) for cols in widths])
    opened = np.concatenate([open_actions(grid) for grid in pool])
    home = np.concatenate([grid.home for grid in pool])
    for array in (lines, opened, strides, home):
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
        0,
        0,
        0,
        lines,
        opened,
        strides,
        home,
        distances,
        paths,
    )


def _describe(grids: Sequence[Grid], widths: Sequence[int]) -> NDArray[np.int64]:
    """Return a line of numbers for each grid, see ``state.FIRST`` to ``STRIDES``, (G, 8)."""
    places = {cols: WAYS * place for place, cols in enumerate(widths)}
    lines, first = [], 0
    for grid in grids:
        reciprocal = -(-(1 << SHIFT) // grid.cols)
        size = grid.rows, grid.cols, widths[-1]
        lines.append((first, grid.n_cells, grid.depot, *size, reciprocal, places[grid.cols]))
        first += grid.n_cells
    return np.array(lines, np.int64)

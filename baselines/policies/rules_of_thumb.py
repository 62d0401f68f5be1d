"""Policies without a network: chance, and two rules of thumb."""

import numpy as np

from baselines.policies.acting import Acting, check_observations, check_rows
from baselines.policies.settings import Setting
from mapp_env import Grid
from mapp_env.engine.state import split
from mapp_env.grid import MAX_ALL_PAIRS_CELLS
from mapp_env.solvers.earliest_arrival import assign_landmarks
from mapp_env.validation import check_count


class RandomPolicy:
    """Every agent takes each action with the same probability."""

    def __init__(self, n_agents: int, n_actions: int, rng: np.random.Generator) -> None:
        self.n_agents, self.n_actions, self.rng = n_agents, n_actions, rng

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return joint actions (B, N), whatever is observed.

        Raises a ValueError if the observations are not rows of numbers.
        """
        n_rows = len(check_rows(observations))
        return self.rng.integers(self.n_actions, size=(n_rows, self.n_agents))


class NearestLandmarkPolicy:
    """Every agent walks a shortest path to the unvisited landmark nearest to it.

    Of equally near landmarks the one given first counts, of equally good moves the first action.
    Agents do not coordinate: those on the same cell walk together.
    """

    def __init__(self, grid: Grid, n_agents: int, n_landmarks: int) -> None:
        # The table of first moves has an entry for every pair of cells.
        check_count("n_cells", grid.n_cells, 2, MAX_ALL_PAIRS_CELLS)
        self.grid, self.n_agents, self.n_landmarks = grid, n_agents, n_landmarks
        distances = np.asarray(grid.distances)  # (C, C), -1 unreachable
        self.distances = np.where(distances < 0, np.iinfo(np.int32).max, distances)
        after = self.distances[np.asarray(grid.moves)]  # (C, 4, C)
        self.first_moves = after.argmin(axis=1)  # (C, C): the action that comes nearest

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return joint actions (B, N).

        Raises a ValueError as :func:`~baselines.policies.acting.check_observations` does.
        """
        n, k = self.n_agents, self.n_landmarks
        observations = check_observations(observations, n, k, len(self.distances))
        state = split(observations.astype(np.int64), n, k)
        chosen = self.choose(state.cells, state.landmarks, state.visited == 0)
        actions: np.ndarray = self.first_moves[state.cells, chosen]
        return actions

    def choose(self, cells: np.ndarray, landmarks: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return the cell that each agent goes to, (B, N), by which landmarks are left, (B, K)."""
        steps = self.distances[cells[:, :, None], landmarks[:, None, :]].astype(np.int64)
        steps[np.broadcast_to(~left[:, None, :], steps.shape)] = np.iinfo(np.int64).max
        chosen: np.ndarray = np.take_along_axis(landmarks, steps.argmin(axis=-1), axis=1)
        return chosen


class EarliestArrivalPolicy(NearestLandmarkPolicy):
    """Of all agents and landmarks the pair that can meet first is settled first, then the next.

    Each agent walks to the first landmark that falls to it, and stays, or steps to and fro, if none
    does. Asked again at every step, it carries out the plan that it would have made at the start.
    """

    def choose(self, cells: np.ndarray, landmarks: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return the cell that each agent goes to, (B, N), by which landmarks are left, (B, K)."""
        who, when = assign_landmarks(self.distances, cells, landmarks, left)
        own = who[:, None, :] == np.arange(self.n_agents)[:, None]  # (B, N, K)
        first = np.where(own, when[:, None, :], np.iinfo(np.int64).max).argmin(axis=-1)
        chosen = np.take_along_axis(landmarks, first, axis=1)
        return np.where(own.any(axis=-1), chosen, cells)


RULES = {
    "nearest": ("nearest landmark", NearestLandmarkPolicy),
    "earliest": ("earliest arrival", EarliestArrivalPolicy),
}
"""Rules without a network: for each option value, the label in tables and the policy."""


def rules_of_thumb(setting: Setting) -> dict[str, Acting]:
    """Return the rules that every table has beside the policies, by how tables call them.

    There are none, and a line says so, on a grid for which the distances of all pairs of cells are
    not kept.
    """
    if setting.grid.n_cells > MAX_ALL_PAIRS_CELLS:
        names = " and ".join(label for label, _ in RULES.values())
        print(f"no rows for {names}: the grid has more than {MAX_ALL_PAIRS_CELLS:,} cells")
        return {}
    task = setting.grid, setting.n_agents, setting.n_landmarks
    return {label: rule(*task) for label, rule in RULES.values()}

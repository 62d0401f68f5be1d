"""What a policy is compared with: proven optima and bounds, and what its decisions have lost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.evaluation.episodes import Moments
from mapp_env.evaluation.problems import Group
from mapp_env.evaluation.progress import Progress
from mapp_env.solvers import optimal_costs, solve
from mapp_env.solvers.batch import MAX_BATCH_LANDMARKS
from mapp_env.solvers.bounds import lower_bound
from mapp_env.solvers.exact import MAX_EXACT_LANDMARKS
from mapp_env.solvers.solution import landmark_distances

MAX_REGRET_LANDMARKS = MAX_BATCH_LANDMARKS
"""Most landmarks for which the cost that is left is looked up in the middle of an episode."""


class Proven(NamedTuple):
    """What is proven about P problems in one objective."""

    optimum: NDArray[np.float64]  # (P,), NaN where none is proven
    bound: NDArray[np.float64]  # (P,), no plan costs less


def proven_costs(group: Group, objective: str, progress: Progress | None = None) -> Proven:
    """Return the optima of a group of problems: of up to 20 landmarks they are proven."""
    n_problems, n_landmarks = group.landmarks.shape
    if n_landmarks <= MAX_BATCH_LANDMARKS:
        left = np.ones(group.landmarks.shape, np.bool_)
        optimum = costs_to_go(group, group.starts, left, objective)
        return Proven(optimum, optimum)
    optimum, bound = np.full((2, n_problems), np.nan)
    for row in range(n_problems):
        problem = group.problem(row)
        if n_landmarks <= MAX_EXACT_LANDMARKS:
            optimum[row] = bound[row] = solve(problem, objective, "exact").cost
        else:
            bound[row] = lower_bound(problem, objective, landmark_distances(problem))
        if progress is not None:
            progress.add(1)
    return Proven(optimum, bound)


def costs_to_go(
    group: Group,
    cells: NDArray[np.int32],  # (P, N)
    left: NDArray[np.bool_],  # (P, K)
    objective: str,
) -> NDArray[np.float64]:
    """Return the least cost, (P,), of visiting what is left from where the agents are.

    Up to 12 landmarks may be left of each problem.
    """
    costs, counts = np.zeros(len(left)), left.sum(axis=1)
    for number, grid in enumerate(group.grids):
        for count in np.unique(counts[group.which == number]).tolist():
            rows = np.flatnonzero((group.which == number) & (counts == count))
            if count > 0:
                landmarks = group.landmarks[rows][left[rows]].reshape(-1, count)
                starts = cells[rows]
                given = {} if (starts == grid.depot).all() else {"starts": starts}
                costs[rows] = optimal_costs(grid, landmarks, group.n_agents, objective, **given)
    return costs


def find_losses(
    group: Group, moments: Moments, optimum: NDArray[np.float64], objective: str = "cover_time"
) -> NDArray[np.float64]:
    """Return what decisions have lost, in steps, where: (3, P).

    A decision's regret is the step it took, and the least cost from after it, less that from before
    it. Summed up: of the first decision; of those after it as long as more than one landmark is
    left; of those with one left. The three together are the cost less the ``optimum``, (P,), or,
    of an episode that ended unsolved, what it took and would have taken on at least. NaN beyond
    12 landmarks.
    """
    if group.landmarks.shape[1] > MAX_REGRET_LANDMARKS:
        return np.full(moments.steps.shape, np.nan)
    ahead = [
        costs_to_go(group, cells, left, objective)
        for cells, left in zip(moments.cells, moments.left, strict=True)
    ]
    total = np.vstack([optimum, moments.steps + ahead])
    losses: NDArray[np.float64] = np.diff(total, axis=0)
    return losses

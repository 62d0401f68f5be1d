"""What a policy is compared with: proven optima and bounds, and what its decisions have lost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.evaluation.episodes import Moments
from mapp_env.evaluation.problems import Group
from mapp_env.evaluation.progress import Progress
from mapp_env.solvers import optimal_costs
from mapp_env.solvers.bounds import lower_bound
from mapp_env.solvers.exact import MAX_EXACT_LANDMARKS, solve_exact
from mapp_env.solvers.oracle.states import MAX_BATCH_LANDMARKS
from mapp_env.solvers.solution import problem_distances


class Proven(NamedTuple):
    """What is proven about P problems in one objective."""

    optimum: NDArray[np.float64]  # (P,), NaN where none is proven
    bound: NDArray[np.float64]  # (P,), no plan costs less


def proven_costs(
    group: Group,
    objective: str,
    home: bool = False,
    may_rest: bool = True,
    progress: Progress | None = None,
) -> Proven:
    """Return the optima of a group of problems: of up to 20 landmarks they are proven.

    If ``home``, all agents walk home (R12), as the makespan and the total distance then count.
    ``may_rest`` says whether agents have an action to stay where they are.
    """
    n_problems, n_landmarks = group.landmarks.shape
    if n_landmarks <= MAX_BATCH_LANDMARKS:
        left = np.ones(group.landmarks.shape, np.bool_)
        bound = costs_to_go(group, group.starts, left, objective, home)
        optimum = bound.copy()
    else:
        optimum, bound = np.full((2, n_problems), np.nan)
        for row in range(n_problems):
            problem = group.problem(row)
            if n_landmarks <= MAX_EXACT_LANDMARKS:
                optimum[row] = bound[row] = solve_exact(problem, objective).bound
            else:
                bound[row] = lower_bound(problem, objective, problem_distances(problem))
            if progress is not None:
                progress.add(1)
        optimum, bound = (
            _with_ways_home(group, group.starts, costs, objective, home)
            for costs in (optimum, bound)
        )
    if home:
        optimum[~_is_attained(group, objective, may_rest)] = np.nan
    return Proven(optimum, bound)


def _ways_home(group: Group, cells: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the steps home of agents on cells, (P, N)."""
    steps = np.empty(cells.shape, np.int32)
    for number, grid in enumerate(group.grids):
        here = group.which == number
        steps[here] = grid.home[cells[here]]
    return steps


def _is_attained(group: Group, objective: str, may_rest: bool) -> NDArray[np.bool_]:
    """Return for which problems, (P,), a team that all walks home can meet the bound.

    Where nobody can rest on the depot, by an action or by walking into a wall beside it, agents
    step to and fro: they are home at the end if all ways home are alike even or odd. And all this
    stepping, and the ways home of idle agents, cost distance.
    """
    rests = [may_rest or grid.depot in grid.moves[grid.depot] for grid in group.grids]
    rest = np.array(rests)[group.which]
    if objective == "total_distance":
        return rest & group.from_depots
    odd = _ways_home(group, group.starts) % 2
    alike: NDArray[np.bool_] = (odd == odd[:, :1]).all(axis=1)
    return rest | alike | (objective == "cover_time")


def costs_to_go(
    group: Group,
    cells: NDArray[np.int32],  # (P, N)
    left: NDArray[np.bool_],  # (P, K)
    objective: str,
    home: bool = False,
) -> NDArray[np.float64]:
    """Return the least cost, (P,), of visiting what is left from where the agents are.

    NaN where more than 12 landmarks are left; ``home`` is as in :func:`proven_costs`.
    """
    costs, counts = np.zeros(len(left)), left.sum(axis=1)
    for number, grid in enumerate(group.grids):
        for count in np.unique(counts[group.which == number]).tolist():
            rows = np.flatnonzero((group.which == number) & (counts == count))
            if count > MAX_BATCH_LANDMARKS:
                costs[rows] = np.nan
            elif count > 0:
                landmarks = group.landmarks[rows][left[rows]].reshape(-1, count)
                starts = cells[rows]
                given = None if (starts == grid.depot).all() else starts
                costs[rows] = optimal_costs(grid, landmarks, group.n_agents, objective, given)
    return _with_ways_home(group, cells, costs, objective, home)


def _with_ways_home(
    group: Group,
    cells: NDArray[np.int32],
    costs: NDArray[np.float64],
    objective: str,
    home: bool,
) -> NDArray[np.float64]:
    """Return costs, (P,), raised to what it takes at least that all agents on cells walk home."""
    if not home or objective == "cover_time":
        return costs
    ways = _ways_home(group, cells)
    least = ways.max(axis=1) if objective == "makespan" else ways.sum(axis=1)
    raised: NDArray[np.float64] = np.maximum(costs, least)
    return raised


def find_losses(
    group: Group, moments: Moments, optimum: NDArray[np.float64], home: bool = False
) -> NDArray[np.float64]:
    """Return how many steps decisions have lost, in all and by where: (4, P).

    A decision's regret is the step it took, and the least cost from after it, less that from before
    it. Summed up: of all; of the first; of those after it as long as more than one landmark is
    left; of those with one left, or none. The cost is the cover time, or, if all walk ``home``, the
    makespan. The sum of all is the cost less the ``optimum``, (P,); an episode that ended unsolved
    costs what it took and would have taken on at least. NaN where the middle of an episode, with
    more than 12 landmarks left, would have to be solved.
    """
    ahead = [
        costs_to_go(group, cells, left, "makespan" if home else "cover_time", home)
        for cells, left in zip(moments.cells, moments.left, strict=True)
    ]
    costs = np.vstack([optimum, moments.steps + ahead])
    return np.vstack([costs[-1] - costs[0], np.diff(costs, axis=0)])

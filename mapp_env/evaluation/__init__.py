"""Judging any policy on any problems, beside what is proven about each of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.evaluation.episodes import play_episodes
from mapp_env.evaluation.optima import find_losses, proven_costs
from mapp_env.evaluation.policies import Acting, Policy, acting
from mapp_env.evaluation.problems import read_groups
from mapp_env.evaluation.progress import Progress
from mapp_env.evaluation.summary import LOSSES
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.validation import check_choice, check_flag

__all__ = ["evaluate"]

OWN = ("num_envs", "n_landmarks", "central_action", "autoreset_mode", "render_mode")
"""Arguments of a batched environment that are not for whoever judges."""

RESULTS = (
    *("solved", "cost", "optimum", "bound", "gap", "visited", "steps", "regret"),
    *LOSSES,
    *OBJECTIVES,
)


def evaluate(
    policy: Policy | Acting,
    problems: Any,
    objective: str | None = None,
    *,
    grid: Any = None,
    n_agents: int | None = None,
    max_cycles: int | None = None,
    progress: bool = True,
    **env_arguments: Any,
) -> dict[str, NDArray[Any]]:
    """Let a policy play each problem once, and compare what it cost with what is proven.

    Parameters
    ----------
    policy : object with ``act``, or function
        ``act(observations) -> actions``: for the observations, float32 of shape (B, ...), of B
        episodes that are still going on, as :func:`mapp_env.make_vec` gives them, it returns
        integers of shape (B, N). If it has a ``grid`` that is a :class:`Grid`, it plays on no
        other.
    problems : sequence of Problem, path or sequence of paths, or array_like of int, shape (P, K)
        What is played: problems, of whatever grids and sizes; problem files, or a folder of them
        (``*.json``, by name); or the landmark cells of problems of one ``grid``, a row each.
    objective : {"cover_time", "makespan", "total_distance"}, optional
        What ``cost`` is: the cover time unless said otherwise; with ``return_home``, where the
        team has to be home as well, the makespan.
    grid : str, path, Grid or sequence of Grid, optional
        Of landmark cells, their grid. Problems bring theirs; with them it may be a pool to which
        all of these belong, for policies whose observations depend on the whole pool: ``planes``
        are as large as its largest grid.
    n_agents : int, optional
        With landmark cells: 3, unless said otherwise.
    max_cycles : int, optional
        Step limit of all episodes. By default each problem's own or, if it has none, as many steps
        as a single agent may need that walks from each landmark to the next: 2 K times the
        distance from the depot to the farthest cell, 2 K + 2 times with ``return_home``.
    progress : bool
        Whether a bar says how far the work is, on the standard error stream, if it is a terminal.
    **env_arguments
        Arguments of the environment, as :func:`mapp_env.make_vec` takes them: ``observation``,
        ``actions``, ``return_home``, ``allow_wait``, ``reward``. Problems of several grids are
        played as a pool; with ``observation="planes"`` only those whose grids have the same sides,
        so that planes are as large as the grid, unless there is a ``grid`` pool.

    Returns
    -------
    dict of str to ndarray, shape (P,)
        One entry for each problem, in the order given:

        - ``solved`` (bool): whether all landmarks were visited (with ``return_home``, and all
          agents home) within the step limit;
        - ``cost``: of the episode in ``objective``, steps (or moves), infinite if it was not
          solved; ``cover_time``, ``makespan`` and ``total_distance``: the same, in each;
        - ``optimum``: the least cost of any plan, proven up to 20 landmarks, or where the cost
          meets the bound; else NaN (some with ``return_home``, see below);
        - ``bound``: a proven lower bound, equal to the optimum where there is one;
        - ``gap``: (cost - optimum) / optimum; NaN where unsolved, or without an optimum;
        - ``visited``: the share of landmarks visited at the end;
        - ``steps`` (int): decisions until the end;
        - ``regret``: steps lost a decision, the mean over an episode: the regret of a decision is
          the least cover time (with ``return_home``, the least makespan) from after it, plus 1,
          less that from before it. NaN for other objectives, without an optimum, or if the episode
          ended with more than 12 landmarks left;
        - ``lost_first``, ``lost_middle``, ``lost_last``: steps lost in all by the first decision;
          by later ones, while more than one landmark was left; by those with one left, or none.
          They add up to cost - optimum where the problem was solved. NaN beyond 12 landmarks.

    Raises
    ------
    ValueError
        If an argument is invalid, the policy fails or returns no such actions, or it is of another
        grid than a problem.

    Notes
    -----
    With ``return_home`` all agents walk home, also idle ones that start elsewhere. If they can
    neither wait nor walk into a wall beside the depot, some of these makespans cannot be met; then
    the optimum is NaN unless the policy meets the bound. So is that of the total distance, if
    agents start elsewhere.

    Examples
    --------
    >>> import mapp_env
    >>> def right(observations):
    ...     return np.ones((len(observations), 3), int)
    >>> found = mapp_env.evaluate(right, [[25, 26]], grid="paper-7x7")
    >>> float(found["cost"][0]), float(found["optimum"][0])
    (2.0, 2.0)
    """
    for name in OWN:
        if name in env_arguments:
            raise ValueError(f"{name} must be left out: an evaluation has its own")
    home = check_flag("return_home", env_arguments.get("return_home", False))
    counted = "makespan" if home else "cover_time"  # by the episode's steps
    objective = check_choice("objective", objective or counted, OBJECTIVES)
    acting(policy)
    shown = check_flag("progress", progress)
    by_shape = env_arguments.get("observation") == "planes"
    groups = read_groups(problems, grid, n_agents, max_cycles, home, by_shape)
    may_rest = bool(env_arguments.get("allow_wait")) or env_arguments.get("actions") == "landmarks"
    total = sum(len(group.places) for group in groups)
    found = {name: np.full(total, np.nan) for name in RESULTS}
    found["solved"], found["steps"] = np.zeros(total, np.bool_), np.zeros(total, np.int64)
    bar = Progress("playing" if shown else None, total)
    played = [play_episodes(policy, group, env_arguments, progress=bar) for group in groups]
    bar.close()
    bar = Progress("optima" if shown else None, total)
    for group, episodes in zip(groups, played, strict=True):
        optimum, bound = proven_costs(group, objective, home, may_rest, bar)
        cost = episodes.costs[objective]
        proven = np.where(cost == bound, bound, optimum)
        if (cost < bound).any():
            problem = group.problem(int((cost < bound).argmax()))
            raise RuntimeError(f"a {objective} below the proven bound: please report {problem!r}")
        values = {
            **episodes.costs,
            "solved": episodes.solved,
            "cost": cost,
            "optimum": proven,
            "bound": bound,
            "gap": np.where(episodes.solved, cost / proven - 1.0, np.nan),
            "visited": 1.0 - episodes.moments.left[-1].mean(axis=1),
            "steps": episodes.steps,
        }
        if objective == counted:
            losses = find_losses(group, episodes.moments, proven, home)
            values["regret"] = losses[0] / episodes.steps
            values |= dict(zip(LOSSES, losses[1:], strict=True))
        for name, value in values.items():
            found[name][group.places] = value
    bar.close()
    return found

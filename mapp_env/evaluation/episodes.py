"""The one loop of episodes: a policy plays each problem once, thousands at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.observation import Observation
from mapp_env.engine.state import WAIT
from mapp_env.engine.task import Task
from mapp_env.envs.vector_env import MappVectorEnv, make_vec
from mapp_env.evaluation.policies import Acting, acting, ask, check_grid
from mapp_env.evaluation.problems import Group
from mapp_env.evaluation.progress import Progress
from mapp_env.plans.plan import OBJECTIVES

BATCH = 4096  # problems played at a time
MAX_VALUES = 1 << 26  # of the observations, or the distance fields, of a batch: 256 MiB

FIRST, LAST, END = range(3)
"""Moments of an episode: after the first decision, as soon as no more than one landmark is left
(but not before the first decision), and at the end."""


class Moments(NamedTuple):
    """Where P episodes stood at the three moments."""

    steps: NDArray[np.int64]  # (3, P)
    cells: NDArray[np.int32]  # (3, P, N), of the agents
    left: NDArray[np.bool_]  # (3, P, K), landmarks not yet visited


class Episodes(NamedTuple):
    """What came of P episodes."""

    costs: dict[str, NDArray[np.float64]]  # (P,) in each objective, inf where unsolved
    moments: Moments
    actions: NDArray[np.int8]  # (T, kept, N), moves of the first ones; 0 after their end

    @property
    def steps(self) -> NDArray[np.int64]:
        """Steps until the end, (P,)."""
        steps: NDArray[np.int64] = self.moments.steps[END]
        return steps

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Which ended with every landmark visited, (P,)."""
        return np.isfinite(self.costs["cover_time"])


def play_episodes(
    policy: object,
    group: Group,
    arguments: dict[str, Any],
    n_kept: int = 0,
    batch: int = BATCH,
    progress: Progress | None = None,
) -> Episodes:
    """Let a policy play each problem of a group once.

    ``arguments`` are the environment's, but for what the problems say; the moves in the first
    ``n_kept`` problems are kept. The policy sees the episodes that are still going on, in
    the order of the problems.

    Raises a ValueError if an argument is invalid, the policy is of another grid, or it fails.
    """
    for number in np.unique(group.which):
        check_grid(policy, group.grids[number])
    (n_problems, n_landmarks), n_agents = group.landmarks.shape, group.n_agents
    longest = int(group.limits.max())
    sizes = {"n_agents": n_agents, "n_landmarks": n_landmarks, "max_cycles": longest}
    task = Task(grid=group.pool, **sizes, **arguments)
    n_kept, batch = min(n_kept, n_problems), min(batch, n_problems, _fitting_rows(task))
    envs = make_vec(batch, grid=group.pool, **sizes, autoreset_mode="NextStep", **arguments)
    found = Episodes(
        {name: np.full(n_problems, np.inf) for name in OBJECTIVES},
        Moments(
            np.zeros((3, n_problems), np.int64),
            np.zeros((3, n_problems, n_agents), np.int32),
            np.zeros((3, n_problems, n_landmarks), np.bool_),
        ),
        np.zeros((longest, n_kept, n_agents), np.int8),
    )
    for start in range(0, n_problems, batch):
        _play_batch(acting(policy), envs, group, start, found, progress)
    envs.close()
    return found


def _play_batch(
    act: Acting,
    envs: MappVectorEnv,
    group: Group,
    start: int,
    found: Episodes,
    progress: Progress | None,
) -> None:
    """Play the problems of a group from ``start`` on, as many as there are rows; note them."""
    # The last batch is filled up with problems played before; they are not read again.
    rows = np.minimum(np.arange(start, start + envs.num_envs), len(group.places) - 1)
    running = np.arange(envs.num_envs) < len(group.places) - start
    several = running.copy()  # whether more than one landmark is left
    state, task = envs._rows.state, envs.task
    observations = _begin(envs, group, rows)
    actions = np.zeros((envs.num_envs, task.n_agents), np.int64)
    for step in range(1, envs.max_cycles + 1):
        seen = observations if running.all() else observations[running]
        actions[running] = ask(act, seen, task.n_agents, task.n_actions)
        before = state.cells.copy()
        observations, _, terminated, truncated, infos = envs.step(actions)
        kept = running & (rows < found.actions.shape[1])
        if kept.any():
            moves = actions[kept]
            if task.actions != "moves":
                moves = _moves(before[kept], state.cells[kept], group.cols[rows[kept]])
            found.actions[step - 1, rows[kept]] = moves
        ended = running & (terminated | truncated)
        left = state.visited == 0
        last = several & (ended | (left.sum(axis=1) <= 1))
        for moment, now in ((FIRST, running & (step == 1)), (LAST, last), (END, ended)):
            if now.any():
                at = rows[now]
                found.moments.steps[moment, at] = step
                found.moments.cells[moment, at] = state.cells[now]
                found.moments.left[moment, at] = left[now]
        if ended.any():
            for name, cost in found.costs.items():
                cost[rows[ended]] = infos["metrics"][name][ended]
            if progress is not None:
                progress.add(int(ended.sum()))
        several &= ~last
        running &= ~ended  # results after a row's reset are ignored
        if not running.any():
            break


def _fitting_rows(task: Task) -> int:
    """Return how many problems of a task can be played at a time within reasonable memory."""
    views = 1 if task.observation_kind == Observation.GLOBAL else task.n_agents
    values = views * int(np.prod(task.view.shape))
    if task.needs_fields:
        values = max(values, task.n_landmarks * task.largest)
    return max(1, MAX_VALUES // values)


def _begin(envs: MappVectorEnv, group: Group, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Start the episodes of some problems of a group, (B,); return the observations (B, ...)."""
    options: dict[str, Any]
    if (group.limits == envs.max_cycles).all() and group.from_depots.all():
        cols = group.cols[rows, None]
        # As pairs: two rows of two cells could as well be two pairs.
        options = {"landmarks": np.stack(divmod(group.landmarks[rows], cols), axis=-1)}
        if len(group.grids) > 1:
            options["grid"] = group.which[rows]
    else:
        options = {"problem": [group.problem(row) for row in rows.tolist()]}
    observations, _ = envs.reset(seed=0, options=options)
    return observations


def _moves(
    before: NDArray[np.int32], after: NDArray[np.int32], cols: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the moves that led agents from cells to cells, (M, N), on grids with so many columns.

    On a grid of one column they are up and down.
    """
    change, across = after - before, cols[:, None]
    which = [change == -across, change == across, change == -1, change == 1]
    found: NDArray[np.int64] = np.select(which, [2, 3, 0, 1], WAIT)
    return found

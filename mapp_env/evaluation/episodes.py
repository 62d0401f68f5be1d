"""The one loop of episodes: a policy plays each problem once, thousands at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.state import split
from mapp_env.envs.vector_env import MappVectorEnv, make_vec
from mapp_env.evaluation.policies import acting, ask, check_grid
from mapp_env.evaluation.problems import Group
from mapp_env.evaluation.progress import Progress
from mapp_env.grid import pairs_of
from mapp_env.plans.plan import OBJECTIVES

BATCH = 4096  # problems played at a time

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
    actions: NDArray[np.int8]  # (T, kept, N), joint actions of the first ones; 0 after their end

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

    ``arguments`` are the environment's, but for what the problems say; the joint actions of the
    first ``n_kept`` problems are kept. The policy sees the episodes that are still going on, in
    the order of the problems.

    Raises a ValueError if an argument is invalid, the policy is of another grid, or it fails.
    """
    act = acting(policy)
    for grid in group.grids:
        check_grid(policy, grid)
    (n_problems, n_landmarks), n_agents = group.landmarks.shape, group.n_agents
    n_kept, batch = min(n_kept, n_problems), min(batch, n_problems)
    longest = int(group.limits.max())
    sizes = {"n_agents": n_agents, "n_landmarks": n_landmarks, "max_cycles": longest}
    envs = make_vec(batch, grid=group.grids[0], **sizes, autoreset_mode="NextStep", **arguments)
    costs = {name: np.full(n_problems, np.inf) for name in OBJECTIVES}
    moments = Moments(
        np.zeros((3, n_problems), np.int64),
        np.zeros((3, n_problems, n_agents), np.int32),
        np.zeros((3, n_problems, n_landmarks), np.bool_),
    )
    kept = np.zeros((longest, n_kept, n_agents), np.int8)
    for start in range(0, n_problems, batch):
        # The last batch is filled up with problems played before; they are not read again.
        rows = np.minimum(np.arange(start, start + batch), n_problems - 1)
        running = np.arange(batch) < n_problems - start
        several = running.copy()  # whether more than one landmark is left
        observations = _begin(envs, group, rows)
        actions = np.zeros((batch, n_agents), np.int64)
        for step in range(1, longest + 1):
            seen = observations if running.all() else observations[running]
            actions[running] = ask(act, seen, n_agents, envs.task.n_actions)
            if start < n_kept:
                drawn = running & (rows < n_kept)
                kept[step - 1, rows[drawn]] = actions[drawn]
            observations, _, terminated, truncated, infos = envs.step(actions)
            state = split(envs._rows.array, n_agents, n_landmarks)
            ended = running & (terminated | truncated)
            left = state.visited == 0
            last = several & (ended | (left.sum(axis=1) <= 1))
            several &= ~last
            for moment, now in ((FIRST, running & (step == 1)), (LAST, last), (END, ended)):
                if now.any():
                    at = rows[now]
                    moments.steps[moment, at] = step
                    moments.cells[moment, at] = state.cells[now]
                    moments.left[moment, at] = left[now]
            if ended.any():
                for name, cost in costs.items():
                    cost[rows[ended]] = infos["metrics"][name][ended]
                if progress is not None:
                    progress.add(int(ended.sum()))
            running = running & ~ended  # results after a row's reset are ignored
            if not running.any():
                break
    envs.close()
    return Episodes(costs, moments, kept)


def _begin(envs: MappVectorEnv, group: Group, rows: NDArray[np.int64]) -> NDArray[np.float32]:
    """Start the episodes of some problems of a group, (B,); return the observations (B, ...)."""
    # As pairs: two rows of two cells could as well be two pairs.
    pairs = pairs_of(group.grids[0], group.landmarks[rows])
    observations, _ = envs.reset(seed=0, options={"landmarks": pairs})
    return observations

"""A rule of thumb: of all agents and landmarks left, the pair that can meet first does, in turn."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.solvers.solution import UNBOUNDED


def assign_landmarks(
    distances: NDArray[np.integer[Any]],
    agents: NDArray[np.integer[Any]],
    landmarks: NDArray[np.integer[Any]],
    left: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give each landmark to the agent that can be there first, one landmark after another.

    The earliest arrival of any agent at any landmark is settled first; from there on that agent
    starts at that landmark, at that time. Of equal arrivals the lowest agent's counts, then the
    landmark that is listed first.

    Who walks to its next landmark and asks again at every step is told the same: a step brings the
    agent of each settled arrival one step nearer, and nobody else more than that.

    ``distances``, shape (S, S), are steps between nodes; ``agents``, shape (B, N), and
    ``landmarks``, shape (B, K), the nodes of B problems; ``left``, shape (B, K), says which are
    unvisited. Returned are the agent that goes to each landmark and in how many steps it is there,
    both of shape (B, K), or -1 and 0 for those that are not left.
    """
    at, left = agents.astype(np.int64), left.copy()
    steps = np.zeros(at.shape, np.int64)
    who = np.full(left.shape, -1, np.int64)
    when = np.zeros(left.shape, np.int64)
    while left.any():
        rows = np.flatnonzero(left.any(axis=1))
        arrivals = steps[rows, :, None] + distances[at[rows, :, None], landmarks[rows, None, :]]
        arrivals = np.where(left[rows, None, :], arrivals, UNBOUNDED).reshape(len(rows), -1)
        earliest = arrivals.argmin(axis=1)
        agent, landmark = np.divmod(earliest, left.shape[1])
        steps[rows, agent] = arrivals[np.arange(len(rows)), earliest]
        at[rows, agent] = landmarks[rows, landmark]
        who[rows, landmark], when[rows, landmark] = agent, steps[rows, agent]
        left[rows, landmark] = False
    return who, when

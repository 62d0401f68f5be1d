"""What every joint action costs in a state: the exact solver's answers, as labels.

From any cells of the agents and any unvisited landmarks: the least number of steps until all are
visited, after each joint action, by the reasoning of ``mapp_env.solve(..., "cover_time")``:
shortest routes through every set of landmarks (Held and Karp 1962), then the best partition of the
landmarks among the agents.
"""

import numpy as np

from mapp_env.compiled import nogil_kernel
from mapp_env.grid import FAR


def steps_left(
    cells: np.ndarray,  # (B, N) int64; with the next two the states
    landmarks: np.ndarray,  # (B, K) int64
    visited: np.ndarray,  # (B, K) bool
    moves: np.ndarray,  # (C, A) int64, where each action leads from each cell
    distances: np.ndarray,  # (C, C) int64 shortest-path steps
) -> np.ndarray:
    """Return the least steps to cover the rest after each joint action: (B, A ** N) int32."""
    n_agents, n_actions = cells.shape[1], moves.shape[1]
    out = np.empty((len(cells), n_actions**n_agents), np.int32)
    _steps_left(cells, landmarks, visited, moves, distances, out)
    return out


@nogil_kernel
def _steps_left(cells, landmarks, visited, moves, distances, out):  # type: ignore[no-untyped-def]
    n_agents, n_actions = cells.shape[1], moves.shape[1]
    n_landmarks = landmarks.shape[1]
    size = 1 << n_landmarks
    left = np.empty(n_landmarks, np.int64)
    routes = np.empty((n_landmarks, size), np.int64)  # from a landmark through a set
    alone = np.empty((n_agents, n_actions, size), np.int64)  # one agent, after its action
    team = np.empty((n_agents, size), np.int64)  # the first agents, after their actions
    for row in range(cells.shape[0]):
        count = 0
        for k in range(n_landmarks):
            if not visited[row, k]:
                left[count] = landmarks[row, k]
                count += 1
        everything = (1 << count) - 1
        for members in range(everything + 1):
            for start in range(count):
                routes[start, members] = _through(members, left[start], left, routes, distances)
        for agent in range(n_agents):
            for action in range(n_actions):
                there = moves[cells[row, agent], action]
                for members in range(everything + 1):
                    steps = _through(members, there, left, routes, distances)
                    alone[agent, action, members] = steps
        for joint in range(out.shape[1]):
            # Only the agents whose action differs from the joint action before.
            rest, base = joint, 1
            first = n_agents - 1
            while first > 0 and rest % n_actions == 0:
                rest //= n_actions
                first -= 1
            for agent in range(first, n_agents):
                base = n_actions ** (n_agents - 1 - agent)
                mine = alone[agent, joint // base % n_actions]
                for members in range(everything + 1):
                    if agent == 0:
                        team[0, members] = mine[members]
                        continue
                    if agent == n_agents - 1 and members != everything:
                        continue  # of the whole team only the whole set matters
                    least = FAR
                    part = members
                    while True:
                        least = min(least, max(mine[part], team[agent - 1, members ^ part]))
                        if part == 0:
                            break
                        part = (part - 1) & members
                    team[agent, members] = least
            out[row, joint] = team[n_agents - 1, everything]


@nogil_kernel
def _through(members, start, left, routes, distances):  # type: ignore[no-untyped-def]
    """Return the shortest way from a cell through a set of landmarks."""
    if members == 0:
        return 0
    least = FAR
    rest = members
    k = 0
    while rest:
        if rest & 1:
            least = min(least, distances[start, left[k]] + routes[k, members & ~(1 << k)])
        rest >>= 1
        k += 1
    return least

"""Replay of one agent's own transitions, among other landmarks than it met.

Landmarks do not influence how agents move, so what was experienced among some landmarks would have
happened among any, had everybody moved alike (relabelling, in the spirit of hindsight replay,
Andrychowicz et al. 2017). Visited flags and rewards are computed again by the rules.

A transition stays whole: where all agents stood, what the agent itself did, where all agents stood
then. What the others did is seen only as what has happened, and is never recombined: to imagine
what they could have done instead, as a central learner does (``imagined_replay``), takes commands
over them. The price is that their moves were meant for the landmarks that were there.
"""

import numpy as np

from baselines.networks import NetworkSpec
from baselines.replay.imagined import RelabelledReward, is_on
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import take


class RelabelledReplay:
    """The last transitions of an agent, given fresh landmarks when they are drawn.

    Parameters
    ----------
    spec
        Numbers of agents, landmarks and cells; what the network is given begins with them.
    depot
        Where no landmark can be.
    capacity
        Transitions that are kept.
    fresh
        Share of the transitions drawn that get fresh landmarks; the others keep their own.
    as_far
        Share of those of which as many are visited as were; of the others any number.
    """

    def __init__(
        self, spec: NetworkSpec, depot: int, capacity: int, fresh: float, as_far: float
    ) -> None:
        self.spec, self.depot = spec, depot
        self.fresh, self.as_far = fresh, as_far
        self.memory = ReplayMemory(capacity, spec.n_inputs, 1)
        self.known = np.zeros(spec.n_cells, np.bool_)  # cells that somebody has stood on

    def remember(self, observation: np.ndarray, action: int, next_observation: np.ndarray) -> None:
        """Keep a transition; the reward is computed when it is drawn."""
        self.memory.add(observation, np.array([action]), 0.0, next_observation, False)
        self.known[next_observation[: self.spec.n_agents].astype(np.int64)] = True
        self.known[self.depot] = False

    @property
    def ready(self) -> bool:
        """Whether enough cells are known to place landmarks."""
        return int(self.known.sum()) >= self.spec.n_landmarks

    def draw(self, n_rows: int, reward: RelabelledReward, rng: np.random.Generator) -> Batch:
        """Return transitions drawn uniformly and with repetition."""
        n, k = self.spec.n_agents, self.spec.n_landmarks
        batch = self.memory.sample(n_rows, rng)
        before, after = batch.observations, batch.next_observations[:, 0]
        cells, next_cells = before[:, :n].astype(np.int64), after[:, :n].astype(np.int64)

        known = np.flatnonzero(self.known)
        fresh = known[rng.random((n_rows, len(known))).argpartition(k - 1, axis=1)[:, :k]]
        n_visited = before[:, n + k : n + 2 * k].sum(axis=1)
        any_number = rng.integers(k, size=n_rows)
        n_visited = np.where(rng.random(n_rows) < self.as_far, n_visited, any_number)
        visited = (np.arange(k) < n_visited[:, None]) | is_on(cells, fresh)
        # With all of them visited, the episode would have been over.
        relabelled = (rng.random(n_rows) < self.fresh) & ~visited.all(axis=1)
        before[relabelled, n : n + k] = fresh[relabelled]
        before[relabelled, n + k : n + 2 * k] = visited[relabelled]

        landmarks = before[:, n : n + k].astype(np.int64)
        visited = (before[:, n + k : n + 2 * k] > 0) | is_on(next_cells, landmarks)
        after[:, n : n + k] = landmarks
        after[:, n + k : n + 2 * k] = visited
        return Batch(
            observations=before,
            actions=batch.actions,
            rewards=rewards_of(next_cells, landmarks, visited, reward)[:, None],
            next_observations=after[:, None],
            terminated=visited.all(axis=1)[:, None],
        )

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that changes, for a checkpoint."""
        return {**self.memory.arrays_by_name(), "known": self.known}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        self.memory.restore(arrays)
        self.known = take(arrays, "known", self.known)


def rewards_of(
    cells: np.ndarray, landmarks: np.ndarray, visited: np.ndarray, reward: RelabelledReward
) -> np.ndarray:
    """Return the team reward (B,) float32 of states (B, N), (B, K), (B, K) after a move."""
    if not reward.distances.size:
        return np.where(visited.all(axis=1), 0.0, -reward.scale).astype(np.float32)
    nearest = reward.distances[cells[:, :, None], landmarks[:, None, :]].min(axis=1)
    nearest[visited] = 0.0
    total: np.ndarray = -reward.scale * nearest.sum(axis=1)
    return total.astype(np.float32)

"""Replay of one agent's own transitions, among other landmarks than it met.

Landmarks do not influence how agents move, so what was experienced among some landmarks would have
happened among any, had everybody moved alike (relabelling, in the spirit of hindsight replay,
Andrychowicz et al. 2017). Visited flags and rewards are the rules' own for the new landmarks.

A transition stays whole: where all agents stood, what the agent itself did, where all agents stood
then. What the others did is seen only as what has happened, and is never recombined: to imagine
what they could have done instead, as a central learner does (``imagined.py``), takes commands
over them. The price is that their moves were meant for the landmarks that were there.
"""

import numpy as np

from baselines.networks import NetworkSpec
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import take
from mapp_env import Grid
from mapp_env.engine.rows import Rows
from mapp_env.engine.rules import WAIT
from mapp_env.engine.task import Task


class RelabelledReward:
    """What the engine's rules say of states with any landmarks.

    Parameters
    ----------
    grid
        The grid.
    reward
        Kind of the team reward (R6).
    scale
        What it is multiplied by, to keep values of the order of one.
    """

    def __init__(self, grid: Grid, reward: str, scale: float = 1.0) -> None:
        self.grid, self.reward, self.scale = grid, reward, scale

    def arrive(
        self, cells: np.ndarray, landmarks: np.ndarray, visited: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Visit the landmarks under agents (R5) that have just moved, and reward the move (R6).

        Parameters
        ----------
        cells, landmarks, visited
            (..., N) cells, (..., K) cells and (..., K) flags, which are broadcast.

        Returns
        -------
        visited, rewards
            (..., K) bool, and (...) float64, not scaled.
        """
        n, k, before = cells.shape[-1], landmarks.shape[-1], cells.shape[:-1]
        task = Task(self.grid, n, k, reward=self.reward, allow_wait=True)
        rows = Rows(task, int(np.prod(before)), n_views=1)
        parts = (cells, *(np.broadcast_to(part, (*before, k)) for part in (landmarks, visited)))
        state = np.concatenate(parts, axis=-1).reshape(rows.n_rows, -1)
        rows.state[:, : task.state_length] = state
        # The agents are where their moves have led: there they wait.
        rewards, *_ = rows.step(np.full((rows.n_rows, n), WAIT), np.zeros(rows.n_rows, np.bool_))
        flags = rows.state[:, n + k : task.state_length]
        return flags.reshape(*before, k) > 0, rewards.reshape(before)


class RelabelledReplay(ReplayMemory):
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
        super().__init__(capacity, spec.n_inputs, 1)
        self.spec, self.depot = spec, depot
        self.fresh, self.as_far = fresh, as_far
        self.known = np.zeros(spec.n_cells, np.bool_)  # cells that somebody has stood on

    def add(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Store a transition; reward and end are those of the landmarks it will be drawn with."""
        super().add(observation, actions, 0.0, next_observation, False)
        self.known[next_observation[: self.spec.n_agents].astype(np.int64)] = True
        self.known[self.depot] = False

    @property
    def ready(self) -> bool:
        """Whether enough cells are known to place landmarks."""
        return int(self.known.sum()) >= self.spec.n_landmarks

    def relabel(self, batch_size: int, reward: RelabelledReward, rng: np.random.Generator) -> Batch:
        """Draw transitions, uniformly and with repetition, and give a share fresh landmarks."""
        n, k = self.spec.n_agents, self.spec.n_landmarks
        batch = self.sample(batch_size, rng)
        before, after = batch.observations, batch.next_observations[:, 0]
        cells, next_cells = before[:, :n].astype(np.int64), after[:, :n].astype(np.int64)

        known = np.flatnonzero(self.known)
        fresh = draw_landmarks(known, batch_size, k, rng)
        n_visited = before[:, n + k : n + 2 * k].sum(axis=1)
        any_number = rng.integers(k, size=batch_size)
        n_visited = np.where(rng.random(batch_size) < self.as_far, n_visited, any_number)
        visited, _ = reward.arrive(cells, fresh, np.arange(k) < n_visited[:, None])
        # With all of them visited, the episode would have been over.
        relabelled = (rng.random(batch_size) < self.fresh) & ~visited.all(axis=1)
        before[relabelled, n : n + k] = fresh[relabelled]
        before[relabelled, n + k : n + 2 * k] = visited[relabelled]

        landmarks, visited = before[:, n : n + k], before[:, n + k : n + 2 * k]
        visited, rewards = reward.arrive(next_cells, landmarks, visited)
        after[:, n : n + k] = landmarks
        after[:, n + k : n + 2 * k] = visited
        return batch._replace(
            rewards=(np.float32(reward.scale) * rewards.astype(np.float32))[:, None],
            terminated=visited.all(axis=1)[:, None],
        )

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that changes, for a checkpoint."""
        return {**super().arrays_by_name(), "known": self.known}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        super().restore(arrays)
        self.known = take(arrays, "known", self.known)


def draw_landmarks(
    cells: np.ndarray, n_rows: int, n_landmarks: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw landmarks (n_rows, K) among some cells, distinct within each row."""
    order = rng.random((n_rows, len(cells))).argpartition(n_landmarks - 1, axis=1)
    landmarks: np.ndarray = cells[order[:, :n_landmarks]]
    return landmarks

"""Replay of one agent's own transitions, among other landmarks than it met.

Landmarks do not influence how agents move, so what was experienced among some landmarks would have
happened among any, had everybody moved alike (relabelling, in the spirit of hindsight replay,
Andrychowicz et al. 2017). Visited flags and rewards are the rules' own for the new landmarks.

A transition stays whole: where all agents stood, what the agent itself did, where all agents stood
then. What the others did is seen only as what has happened, and is never recombined: to imagine
what they could have done instead, as a central learner does (``imagined.py``), takes commands
over them. The price is that their moves were meant for the landmarks that were there.
"""

from typing import NamedTuple

import numpy as np

from baselines.networks import NetworkSpec
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import take
from mapp_env import Grid
from mapp_env.engine.loops import visit_rows
from mapp_env.engine.rules import Reward
from mapp_env.engine.state import World, split
from mapp_env.engine.world import make_world


class RelabelledReward(NamedTuple):
    """The team reward (R6) of states with any landmarks."""

    world: World  # what the engine's rules look up
    scale: float  # what the reward is multiplied by, to keep values of the order of one


def relabelled_reward(
    grid: Grid, n_agents: int, n_landmarks: int, reward: str, scale: float = 1.0
) -> RelabelledReward:
    """Return the reward of a kind: ``"manhattan"``, ``"geodesic"`` or ``"step"``."""
    world = make_world(grid, n_agents, n_landmarks, Reward[reward.upper()])
    return RelabelledReward(world, scale)


class RelabelledReplay(ReplayMemory):
    """The last transitions of an agent, given fresh landmarks when they are drawn.

    A share of the transitions drawn, `fresh`, get fresh landmarks, none on the depot; the others
    keep their own. Of a share of those, `as_far`, as many are visited as were; of the others any
    number.
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
        before, after = split(batch.observations, n, k), split(batch.next_observations[:, 0], n, k)

        known = np.flatnonzero(self.known)
        fresh = draw_landmarks(known, batch_size, k, rng)
        any_number = rng.integers(k, size=batch_size)
        n_visited = np.where(
            rng.random(batch_size) < self.as_far, before.visited.sum(axis=1), any_number
        )
        flags = np.arange(k) < n_visited[:, None]
        flags, _, over = visit_rows(reward.world, before.cells, fresh, flags)
        # With all of them visited, the episode would have been over.
        relabelled = (rng.random(batch_size) < self.fresh) & ~over
        before.landmarks[relabelled] = fresh[relabelled]
        before.visited[relabelled] = flags[relabelled]

        after.landmarks[:] = before.landmarks
        after.visited[:], rewards, terminated = visit_rows(
            reward.world, after.cells, after.landmarks, before.visited
        )
        rewards = np.float32(reward.scale) * rewards.astype(np.float32)
        return batch._replace(rewards=rewards[:, None], terminated=terminated[:, None])

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

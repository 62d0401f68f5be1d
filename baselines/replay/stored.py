"""Replay memory: a finite ring of transitions, first in, first out."""

from typing import NamedTuple

import numpy as np

from mapp_env.validation import check_count


class Batch(NamedTuple):
    """Transitions; B states, T actions tried in each, D numbers an observation, N who act."""

    observations: np.ndarray  # (B, D) float32
    actions: np.ndarray  # (B, T, N) int64, one action for each that acts
    rewards: np.ndarray  # (B, T) float32, the team reward, scaled
    next_observations: np.ndarray  # (B, T, D) float32, before any reset
    terminated: np.ndarray  # (B, T) bool, True where no reward can follow; a time-out is not that


class ReplayMemory:
    """The last `capacity` transitions, in arrays that are allocated once.

    Only ``terminated`` is kept of an episode's end: a time-out (truncation) says nothing about
    the state it stopped in, so the learner goes on from there (it bootstraps). The rewards of
    a batch are multiplied by `reward_scale`.

    Raises a ValueError if a size is invalid.
    """

    def __init__(
        self, capacity: int, observation_size: int, n_agents: int, reward_scale: float = 1.0
    ) -> None:
        check_count("capacity", capacity, 1, 100_000_000)
        check_count("observation_size", observation_size, 1, 1_000_000)
        check_count("n_agents", n_agents, 1, 1_000)
        self.capacity, self.reward_scale = capacity, reward_scale
        self.arrays = Batch(
            observations=np.zeros((capacity, observation_size), np.float32),
            actions=np.zeros((capacity, 1, n_agents), np.int64),
            rewards=np.zeros((capacity, 1), np.float32),
            next_observations=np.zeros((capacity, 1, observation_size), np.float32),
            terminated=np.zeros((capacity, 1), np.bool_),
        )
        self.n_added = 0  # ever; the next transition goes to row n_added % capacity

    def __len__(self) -> int:
        return min(self.n_added, self.capacity)

    @property
    def ready(self) -> bool:
        """Whether there is something to learn from."""
        return self.n_added > 0

    def add(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Store one transition in place of the oldest one when the memory is full."""
        transition = observation, actions, reward, next_observation, terminated
        for array, value in zip(self.arrays, transition, strict=True):
            array[self.n_added % self.capacity] = value
        self.n_added += 1

    def sample(self, batch_size: int, rng: np.random.Generator) -> Batch:
        """Draw `batch_size` stored transitions, uniformly and with repetition.

        Raises a ValueError if nothing is stored yet.
        """
        if len(self) == 0:
            raise ValueError("sample: the replay memory is empty, add a transition first")
        rows = rng.integers(len(self), size=batch_size)
        batch = Batch(*(array[rows] for array in self.arrays))
        return batch._replace(rewards=np.float32(self.reward_scale) * batch.rewards)

    def known_actions(self, observations: np.ndarray) -> None:
        """Return None: any action may be the next one."""

    # -- checkpoints

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that is stored."""
        filled = {name: array[: len(self)] for name, array in self.arrays._asdict().items()}
        return {**filled, "n_added": np.array(self.n_added)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        self.n_added = int(arrays["n_added"])
        for name, array in self.arrays._asdict().items():
            array[: len(self)] = arrays[name]

"""The paper's heuristics: an agent is pointed to a close unvisited landmark.

Paper, section 5: "an agent is directed towards left if there is an unvisited and close landmark
at the left. The influence of these heuristics to visit landmarks are larger at the beginning to
accelerate the training process and as the model is trained their influence gets lessened and
limited."

Close means here: on the agent's own row or column, at most `reach` moves away, with no wall
between. The influence is the probability, for each agent and step, that a pointed agent obeys.
The way home after the last landmark is rule R8 and belongs to ``mapp_env.replay``.
"""

import numpy as np

from baselines.policies.acting import Acting, check_grid, check_observations
from mapp_env import Grid
from mapp_env.engine.state import N_ACTIONS, split
from mapp_env.validation import check_count, check_number

NO_DIRECTION = -1


class LinearSchedule:
    """A value that goes in a straight line from `start` to `end`, then stays there."""

    def __init__(self, start: float, end: float, duration: int) -> None:
        check_count("duration", duration, 0, 1_000_000_000)
        self.start, self.end, self.duration = start, end, duration

    def __call__(self, time: int) -> float:
        """Return the value after `time` units (steps or episodes)."""
        if time >= self.duration:
            return self.end
        return self.start + (self.end - self.start) * time / self.duration


class Guidance:
    """Directions towards close landmarks on one grid."""

    def __init__(self, grid: Grid, n_agents: int, n_landmarks: int, reach: int) -> None:
        check_count("reach", reach, 1, 512)
        self.grid, self.reach = grid, reach
        self.n_agents, self.n_landmarks = n_agents, n_landmarks
        self.rays = sight_rays(grid, reach)

    def directions(self, observations: np.ndarray) -> np.ndarray:
        """Where each agent is pointed: (B, N) actions, -1 where no landmark is close.

        The nearest landmark wins; of two equally near ones, the first action in the order left,
        right, up, down.
        """
        state = split(observations.astype(np.int64), self.n_agents, self.n_landmarks)
        unvisited = np.where(state.visited > 0, -2, state.landmarks)  # -2 is on no ray
        in_sight = (self.rays[state.cells][..., None] == unvisited[:, None, None, :]).any(axis=-1)
        nearest = in_sight.argmax(axis=-1)  # the first in sight: rays run from near to far
        found = np.take_along_axis(in_sight, nearest[..., None], axis=-1)[..., 0]
        return np.where(found, nearest % N_ACTIONS, NO_DIRECTION)

    def apply(
        self,
        actions: np.ndarray,
        observations: np.ndarray,
        influence: float,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Replace the actions of pointed agents that obey (probability `influence` each)."""
        directions = self.directions(observations)
        obeys = rng.random(directions.shape) < influence
        return np.where(obeys & (directions != NO_DIRECTION), directions, actions)


class GuidedPolicy:
    """A policy whose agents obey the guidance with a fixed influence."""

    def __init__(
        self, policy: Acting, guidance: Guidance, influence: float, rng: np.random.Generator
    ) -> None:
        check_number("influence", influence, 0.0, 1.0)
        check_grid(policy, guidance.grid)
        self.grid = guidance.grid
        self.policy, self.guidance, self.influence, self.rng = policy, guidance, influence, rng

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return joint actions (B, N): the policy's, or the guidance's where an agent obeys it.

        Raises a ValueError as :func:`~baselines.policies.acting.check_observations` does.
        """
        guidance = self.guidance
        checked = check_observations(
            observations, guidance.n_agents, guidance.n_landmarks, len(guidance.rays)
        )
        actions = self.policy.act(checked)
        return guidance.apply(actions, checked, self.influence, self.rng)


def sight_rays(grid: Grid, reach: int) -> np.ndarray:
    """Cells in sight of every cell: (C, reach * 4), from near to far, -1 behind a wall or border.

    Column ``4 * d + a`` is the cell reached by d + 1 moves of action a without a bump.
    """
    moves = np.asarray(grid.moves)[:, :N_ACTIONS].astype(np.int64)
    here = np.repeat(np.arange(grid.n_cells)[:, None], N_ACTIONS, axis=1)  # (C, 4)
    clear = np.ones(here.shape, np.bool_)
    rays = np.full((grid.n_cells, reach, N_ACTIONS), -1, np.int64)
    for distance in range(reach):
        there = moves[here, np.arange(N_ACTIONS)]
        clear &= there != here
        rays[:, distance] = np.where(clear, there, -1)
        here = there
    return rays.reshape(grid.n_cells, reach * N_ACTIONS)

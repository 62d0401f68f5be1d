"""Replay by imagination: what was experienced, put together anew.

Two facts make every experienced move useful for every problem. Landmarks do not influence how
agents move, so a stored move is a move among any landmarks (relabelling, in the spirit of
hindsight replay, Andrychowicz et al. 2017). And agents do not influence each other (rule R4), so
moves of different agents and times make a valid joint transition (recombination). So all that is
kept of the real episodes is which cell each move has led to; visited flags and rewards follow by
the rules, and no move that nobody has made is ever imagined. It is Dyna (Sutton 1990) with a model
that is a table of what happened.

States are taken along imagined episodes, most of them from the depot with fresh landmarks, that
follow the learner's own policy: that is where its values will be used.
"""

import math
from typing import ClassVar, NamedTuple

import numpy as np

from baselines.networks import NetworkSpec, split_joint
from baselines.replay.stored import Batch
from baselines.runs.checkpoints import take
from mapp_env import Grid
from mapp_env.compiled import nogil_kernel

UNKNOWN = -1


class RelabelledReward(NamedTuple):
    """The team reward (R6) of a state with any landmarks."""

    distances: np.ndarray  # (C, C) float32 from a cell to a landmark, or (0, 0): -1 a step
    scale: float  # what it is multiplied by, to keep values of the order of one


def relabelled_reward(grid: Grid, reward: str, scale: float) -> RelabelledReward:
    """Return what the rules give for any landmarks."""
    if reward == "step":
        return RelabelledReward(np.zeros((0, 0), np.float32), scale)
    if reward == "geodesic":
        return RelabelledReward(np.asarray(grid.distances, np.float32), scale)
    steps = grid.manhattan_from(range(grid.n_cells))
    return RelabelledReward(steps.astype(np.float32), scale)


class ImaginedReplay:
    """Transitions imagined from experienced moves.

    Parameters
    ----------
    spec
        Numbers of agents, landmarks, actions and cells.
    depot
        Where episodes start.
    n_rows
        Episodes imagined side by side: the states of a batch.
    n_tried
        Joint actions tried in each state: the best by the values it is given, then others, the
        more likely the better (Boltzmann).
    temperature
        Difference of value at which another action is tried e times less.
    exploration
        Probability that an imagined episode follows any of the actions tried, not the best.
    from_depot
        Share of the episodes that start at the depot with all landmarks unvisited; the others
        start anywhere, with any number of landmarks left.
    max_length
        Steps after which an imagined episode is given up.
    retries
        Probability that an episode that was given up is begun again from the depot, with the same
        landmarks: so problems that the learner cannot solve stay until it can.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ("moves", "cells", "landmarks", "visited", "ages")

    def __init__(
        self,
        spec: NetworkSpec,
        depot: int,
        n_rows: int,
        n_tried: int,
        temperature: float,
        exploration: float,
        from_depot: float,
        max_length: int,
        retries: float = 0.0,
    ) -> None:
        self.spec, self.depot = spec, depot
        self.n_tried = min(n_tried, spec.n_joint_actions)
        self.temperature, self.exploration = temperature, exploration
        self.from_depot, self.max_length, self.retries = from_depot, max_length, retries
        n, k = spec.n_agents, spec.n_landmarks
        self.moves = np.full((spec.n_cells, spec.n_actions), UNKNOWN, np.int64)  # experienced
        self.cells = np.zeros((n_rows, n), np.int64)
        self.landmarks = np.zeros((n_rows, k), np.int64)
        self.visited = np.ones((n_rows, k), np.bool_)
        self.ages = np.full(n_rows, max_length, np.int64)  # of age: started anew when drawn
        self.digits = split_joint(np.arange(spec.n_joint_actions), n, spec.n_actions)

    def remember(
        self, observation: np.ndarray, actions: np.ndarray, next_observation: np.ndarray
    ) -> None:
        """Keep where each agent's move has led."""
        n = self.spec.n_agents
        self.moves[observation[:n].astype(np.int64), actions] = next_observation[:n]

    @property
    def ready(self) -> bool:
        """Whether enough cells are known to place landmarks."""
        return len(self._known_cells()) >= self.spec.n_landmarks

    def _known_cells(self) -> np.ndarray:
        """Return the cells that somebody has moved from, but for the depot."""
        known = np.flatnonzero((self.moves != UNKNOWN).any(axis=1))
        return known[known != self.depot]

    def observations(self) -> np.ndarray:
        """Return the imagined states as global observations (rows, N + 2K) float32."""
        return join(self.cells, self.landmarks, self.visited)

    def start_over(self, rng: np.random.Generator) -> np.ndarray:
        """Begin a new episode in each row that has ended; return these rows' numbers."""
        solved = self.visited.all(axis=1)
        ended = solved | (self.ages >= self.max_length)
        count, k = int(ended.sum()), self.spec.n_landmarks
        rows: np.ndarray = np.flatnonzero(ended)
        if count == 0:
            return rows
        known = self._known_cells()
        anywhere = np.append(known, self.depot)
        cells = anywhere[rng.integers(len(anywhere), size=(count, self.spec.n_agents))]
        at_depot = rng.random(count) < self.from_depot
        landmarks = known[rng.random((count, len(known))).argpartition(k - 1, axis=1)[:, :k]]
        again = ~solved[ended] & (rng.random(count) < self.retries)
        landmarks[again], at_depot[again] = self.landmarks[ended][again], True
        left = rng.integers(1, k + 1, size=count)
        # All visited already: such a row starts at the depot as well.
        visited = (np.arange(k) >= left[:, None]) | is_on(cells, landmarks)
        at_depot |= visited.all(axis=1)
        cells[at_depot] = self.depot
        visited[at_depot] = False
        self.cells[ended], self.landmarks[ended], self.visited[ended] = cells, landmarks, visited
        self.ages[ended] = 0
        return rows

    def draw(
        self, values: np.ndarray, reward: RelabelledReward, rng: np.random.Generator
    ) -> tuple[Batch, np.ndarray]:
        """Return a transition for each row and action tried; then let the episodes go on.

        Parameters
        ----------
        values
            (rows, A ** N) float32, what joint actions are worth in :meth:`observations`.
        reward
            How transitions are rewarded.
        rng
            Source of all choices.

        Returns
        -------
        batch
            The transitions.
        followed
            (rows,) which of the actions tried each episode goes on with.
        """
        n_rows = len(self.cells)
        before = self.observations()
        joint, cells, visited, rewards, done = try_actions(
            self.cells,
            self.landmarks,
            self.visited,
            values,
            rng.random((n_rows, self.n_tried)),
            self.temperature,
            self.moves,
            self.digits,
            *reward,
        )
        followed = np.where(
            rng.random(n_rows) < self.exploration, rng.integers(self.n_tried, size=n_rows), 0
        )
        rows = np.arange(n_rows)
        batch = Batch(
            observations=before,
            actions=self.digits[joint],
            rewards=rewards,
            next_observations=join(cells, self.landmarks[:, None], visited),
            terminated=done,
        )
        self.cells, self.visited = cells[rows, followed], visited[rows, followed]
        # Where somebody has been but not moved from, the story ends.
        stuck = (self.moves[self.cells] == UNKNOWN).all(axis=2).any(axis=1)
        self.ages = np.where(stuck, self.max_length, self.ages + 1)
        return batch, followed

    def follow(self, actions: np.ndarray) -> None:
        """Let the imagined episodes go on with joint actions (rows, N) whose moves are known."""
        self.cells = self.moves[self.cells, actions]
        self.visited = self.visited | is_on(self.cells, self.landmarks)
        self.ages += 1

    def known_actions(self, observations: np.ndarray) -> np.ndarray | None:
        """Return which actions somebody has made from there, (B, N, A); None if it is all.

        Where nobody has made any, all count as known: there is nothing else to go by.
        """
        unknown = self.moves == UNKNOWN
        unknown[unknown.all(axis=1)] = False
        if not unknown.any():
            return None
        return ~unknown[observations[:, : self.spec.n_agents].astype(np.int64)]

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that changes, for a checkpoint."""
        return {name: getattr(self, name) for name in self.CHANGING}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        for name in self.CHANGING:
            setattr(self, name, take(arrays, name, getattr(self, name)))


def join(cells: np.ndarray, landmarks: np.ndarray, visited: np.ndarray) -> np.ndarray:
    """Return global observations (..., N + 2K) of their three parts."""
    landmarks = np.broadcast_to(landmarks, visited.shape)
    return np.concatenate((cells, landmarks, visited), axis=-1).astype(np.float32)


def is_on(cells: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Return which landmarks (B, K) an agent (B, N) stands on."""
    on: np.ndarray = (landmarks[:, :, None] == cells[:, None, :]).any(axis=2)
    return on


@nogil_kernel
def try_actions(
    cells, landmarks, visited, values, chances, temperature, moves, digits, distances, scale
):  # type: ignore[no-untyped-def]
    """Return the joint actions tried in each state, and what each leads to.

    Of the joint actions all of whose moves are known: the best, then draws from the others with
    probabilities proportional to ``exp(value / temperature)``.
    """
    n_rows, n_tried = chances.shape
    n_joint, n_agents = digits.shape
    n_landmarks = landmarks.shape[1]
    joint = np.empty((n_rows, n_tried), np.int64)
    next_cells = np.empty((n_rows, n_tried, n_agents), np.int64)
    next_visited = np.empty((n_rows, n_tried, n_landmarks), np.bool_)
    rewards = np.zeros((n_rows, n_tried), np.float32)
    done = np.empty((n_rows, n_tried), np.bool_)
    weights = np.empty(n_joint)  # summed up
    for row in range(n_rows):
        best = -1
        for action in range(n_joint):
            weights[action] = 1.0
            for agent in range(n_agents):
                if moves[cells[row, agent], digits[action, agent]] < 0:
                    weights[action] = 0.0
            if weights[action] and (best < 0 or values[row, action] > values[row, best]):
                best = action
        total = 0.0
        for action in range(n_joint):
            if weights[action] and action != best:
                total += math.exp((values[row, action] - values[row, best]) / temperature)
            weights[action] = total
        for tried in range(n_tried):
            chosen = best
            if tried > 0 and total > 0.0:
                chosen = 0
                while chosen < n_joint - 1 and weights[chosen] <= chances[row, tried] * total:
                    chosen += 1
            joint[row, tried] = chosen
            for agent in range(n_agents):
                action = digits[chosen, agent]
                next_cells[row, tried, agent] = moves[cells[row, agent], action]
            left = 0
            for k in range(n_landmarks):
                there = visited[row, k]
                for agent in range(n_agents):
                    there |= next_cells[row, tried, agent] == landmarks[row, k]
                next_visited[row, tried, k] = there
                if there:
                    continue
                left += 1
                if distances.shape[0]:
                    nearest = np.float32(1e9)
                    for agent in range(n_agents):
                        cell = next_cells[row, tried, agent]
                        nearest = min(nearest, distances[cell, landmarks[row, k]])
                    rewards[row, tried] -= nearest
            if left and not distances.shape[0]:
                rewards[row, tried] = -1.0
            rewards[row, tried] *= scale  # as the environment's reward is when it was stored
            done[row, tried] = left == 0
    return joint, next_cells, next_visited, rewards, done

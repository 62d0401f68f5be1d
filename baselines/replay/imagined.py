"""Imagined replay: experienced moves, recombined.

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
from typing import Any, ClassVar

import numpy as np

from baselines.networks import NetworkSpec, split_joint
from baselines.replay.relabelled import RelabelledReward, draw_landmarks
from baselines.replay.stored import Batch
from baselines.runs.checkpoints import take
from mapp_env import Grid
from mapp_env.compiled import nogil_kernel
from mapp_env.engine.loops import visit_rows
from mapp_env.engine.world import make_world

UNKNOWN = -1


class ImaginedReplay:
    """Transitions imagined from experienced moves; the grid's walls are read by the rules alone.

    In each state joint actions are tried: the best by the values that are given, then others, the
    more likely the better (Boltzmann). Episodes that do not start at the depot, with all landmarks
    unvisited, start anywhere, with any number of landmarks left. Those that reach the step limit
    may begin again from the depot, with the same landmarks: so problems that the learner cannot
    solve stay until it can.
    """

    CHANGING: ClassVar[tuple[str, ...]] = ("moves", "cells", "landmarks", "visited", "ages")
    PRODUCT: ClassVar[Any] = np.float64  # of reward and scale: rewards' last bit depends on it

    def __init__(
        self,
        spec: NetworkSpec,
        grid: Grid,
        actors: list[int] | None = None,  # the agents whose moves are imagined, by default all
        *,
        n_rows: int,  # episodes imagined side by side: the states of a batch
        n_tried: int = 1,  # joint actions in each state
        temperature: float = 1.0,  # difference of value at which one is tried e times less
        exploration: float = 0.0,  # probability to follow any action tried, not the best
        from_depot: float,  # share of the episodes that start there
        max_length: int,  # step limit of an episode
        retries: float = 0.0,  # probability to begin one again that reached it
    ) -> None:
        n, k = spec.n_agents, spec.n_landmarks
        self.spec, self.depot = spec, grid.depot
        self.actors = list(range(n)) if actors is None else actors
        n_joint = spec.n_actions ** len(self.actors)
        self.digits = split_joint(np.arange(n_joint), len(self.actors), spec.n_actions)
        self.n_tried = min(n_tried, n_joint)
        self.temperature, self.exploration = temperature, exploration
        self.from_depot, self.max_length, self.retries = from_depot, max_length, retries
        self.world = make_world(grid, n, k)  # what the rules look up where no reward is asked for
        self.moves = np.full((spec.n_cells, spec.n_actions), UNKNOWN, np.int64)  # experienced
        self.cells = np.zeros((n_rows, n), np.int64)
        self.landmarks = np.zeros((n_rows, k), np.int64)
        self.visited = np.ones((n_rows, k), np.bool_)
        self.ages = np.full(n_rows, max_length, np.int64)  # of age: started anew when drawn

    # -- experience

    def add(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Keep where each actor's move has led."""
        cells = observation[self.actors].astype(np.int64)
        self.moves[cells, actions] = next_observation[self.actors]

    @property
    def ready(self) -> bool:
        """Whether enough cells are known to place landmarks."""
        return len(self._known_cells()) >= self.spec.n_landmarks

    def _known_cells(self) -> np.ndarray:
        """Return the cells with recorded moves, but for the depot."""
        known = np.flatnonzero((self.moves != UNKNOWN).any(axis=1))
        return known[known != self.depot]

    def known_actions(self, observations: np.ndarray) -> np.ndarray | None:
        """Return which actions have been made from there, (..., N, A); None if it is all.

        Where none has been made, all count as known: there is nothing else to go by.
        """
        unknown = self.moves == UNKNOWN
        unknown[unknown.all(axis=1)] = False
        if not unknown.any():
            return None
        return ~unknown[observations[..., self.actors].astype(np.int64)]

    # -- imagination

    def observations(self) -> np.ndarray:
        """Return the imagined states as the network is given them, (rows, D) float32."""
        return self._observe(self.cells, self.landmarks, self.visited)

    def _observe(self, cells: np.ndarray, landmarks: np.ndarray, visited: np.ndarray) -> np.ndarray:
        """Return states (..., N), (..., K), (..., K) as the network is given them."""
        return join(cells, landmarks, visited)

    def start_over(self, rng: np.random.Generator) -> np.ndarray:
        """Begin a new episode in each row that has ended; return these rows' numbers."""
        solved, rows = self._ended()
        count = len(rows)
        if count == 0:
            return rows
        known = self._known_cells()
        anywhere = np.append(known, self.depot)
        cells = anywhere[rng.integers(len(anywhere), size=(count, self.spec.n_agents))]
        at_depot = rng.random(count) < self.from_depot
        landmarks = draw_landmarks(known, count, self.spec.n_landmarks, rng)
        again = ~solved[rows] & (rng.random(count) < self.retries)
        self._begin(rows, cells, landmarks, at_depot, again, rng)
        return rows

    def _ended(self) -> tuple[np.ndarray, np.ndarray]:
        """Return which episodes are solved, (rows,) bool, and the numbers of all that are over."""
        solved = self.visited.all(axis=1)
        return solved, np.flatnonzero(solved | (self.ages >= self.max_length))

    def _begin(
        self,
        rows: np.ndarray,
        cells: np.ndarray,
        landmarks: np.ndarray,
        at_depot: np.ndarray,
        again: np.ndarray,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Begin episodes in some rows; return which of them start at the depot.

        Those `again` do so with the landmarks they had, and so do those that would start with
        all landmarks visited.
        """
        k = self.spec.n_landmarks
        landmarks[again] = self.landmarks[rows[again]]
        left = rng.integers(1, k + 1, size=len(rows))
        visited = np.arange(k) >= left[:, None]
        visited, _, over = visit_rows(self.world, cells, landmarks, visited)
        at_depot = at_depot | again | over
        cells[at_depot], visited[at_depot] = self.depot, False
        self.cells[rows], self.landmarks[rows], self.visited[rows] = cells, landmarks, visited
        self.ages[rows] = 0
        return at_depot

    def draw(
        self, values: np.ndarray, reward: RelabelledReward, rng: np.random.Generator
    ) -> tuple[Batch, np.ndarray]:
        """Return a transition for each row and action tried; then let the episodes go on.

        Values (rows, A ** N) float32 are of the actors' joint actions in :meth:`observations`.
        Returned is also which of the actions tried each episode goes on with, (rows,).
        """
        n_rows = len(self.cells)
        own = self.cells[:, self.actors]
        chances = rng.random((n_rows, self.n_tried))
        joint = try_actions(own, values, chances, self.temperature, self.moves, self.digits)
        actions = self.digits[joint]
        # What the others do is the same whatever the actors try.
        cells = np.repeat(self._others_move()[:, None], self.n_tried, axis=1)
        cells[:, :, self.actors] = self.moves[own[:, None], actions]
        landmarks = np.repeat(self.landmarks[:, None], self.n_tried, axis=1)
        visited = np.repeat(self.visited[:, None], self.n_tried, axis=1)
        parts = (part.reshape(-1, part.shape[-1]) for part in (cells, landmarks, visited))
        arrived = visit_rows(reward.world, *parts)
        visited, rewards, over = (part.reshape(n_rows, self.n_tried, -1) for part in arrived)
        scaled = self.PRODUCT(reward.scale) * rewards.astype(self.PRODUCT)
        followed = np.where(
            rng.random(n_rows) < self.exploration, rng.integers(self.n_tried, size=n_rows), 0
        )
        batch = Batch(
            observations=self.observations(),
            actions=actions,
            rewards=scaled.astype(np.float32)[:, :, 0],
            next_observations=self._observe(cells, landmarks, visited),
            terminated=over[:, :, 0],
        )
        rows = np.arange(n_rows)
        self.cells, self.visited = cells[rows, followed], visited[rows, followed]
        # An episode stops in a cell with no recorded moves.
        stuck = (self.moves[self.cells[:, self.actors]] == UNKNOWN).all(axis=2).any(axis=1)
        self.ages = np.where(stuck, self.max_length, self.ages + 1)
        return batch, followed

    def _others_move(self) -> np.ndarray:
        """Return where all agents but the actors are after the next step, (rows, N)."""
        return self.cells

    def follow(self, actions: np.ndarray) -> None:
        """Let the imagined episodes go on with joint actions (rows, N) whose moves are known."""
        self.cells = self.moves[self.cells, actions]
        self.visited, *_ = visit_rows(self.world, self.cells, self.landmarks, self.visited)
        self.ages += 1

    # -- checkpoints

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that changes."""
        return {name: getattr(self, name) for name in self.CHANGING}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        for name in self.CHANGING:
            setattr(self, name, take(arrays, name, getattr(self, name)))


def join(cells: np.ndarray, landmarks: np.ndarray, visited: np.ndarray) -> np.ndarray:
    """Return global observations (..., N + 2K) of their three parts."""
    landmarks = np.broadcast_to(landmarks, visited.shape)
    return np.concatenate((cells, landmarks, visited), axis=-1).astype(np.float32)


@nogil_kernel
def try_actions(cells, values, chances, temperature, moves, digits):  # type: ignore[no-untyped-def]
    """Return which joint actions are tried in each state, (rows, T) int64.

    Of the joint actions all of whose moves are known: the best, then draws from the others with
    probabilities proportional to ``exp(value / temperature)``.
    """
    n_rows, n_tried = chances.shape
    n_joint, n_agents = digits.shape
    joint = np.empty((n_rows, n_tried), np.int64)
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
            joint[row, tried] = best
            if tried > 0 and total > 0.0:
                chosen = 0
                while chosen < n_joint - 1 and weights[chosen] <= chances[row, tried] * total:
                    chosen += 1
                joint[row, tried] = chosen
    return joint

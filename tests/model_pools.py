"""Drawing a problem (R10) once more, as plain Python; and random games over pools of grids.

As tests/model.py, which plays them, this shares no code with the package. The draw is one 64-bit
word a reset, hashed with counters: -1, -2, ... for the grid, 0, 1, ... for the landmarks.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from model import REWARDS, Model, landmark_cells, random_rows

Rows = tuple[str, ...]


def permuted(word: int) -> int:
    """Return a 32-bit PCG's (RXS-M-XS) output after the state ``word``."""
    state = (word * 747796405 + 2891336453) % 2**32
    mixed = ((state >> ((state >> 28) + 4)) ^ state) * 277803737 % 2**32
    return (mixed >> 22) ^ mixed


def draw_below(limit: int, word: int, counters: Iterable[int]) -> int:
    """Return a uniform number below ``limit`` from the hashes of ``word`` with the counters."""
    for counter in counters:
        weyl = (word + counter * 0x9E3779B9) % 2**32
        bits = permuted(permuted(weyl) ^ (word >> 32))
        if bits < 2**32 // limit * limit:
            return bits % limit
    raise AssertionError("there are no more counters")


def draw_grid(word: int, n_grids: int) -> int:
    """Return which grid of a pool a reset draws."""
    return draw_below(n_grids, word, range(-1, -1000, -1))


def draw_landmarks(word: int, rows: Rows, count: int) -> tuple[int, ...]:
    """Return the landmarks that a reset draws on a grid: Floyd's sampling, ascending."""
    allowed, counters = landmark_cells(rows), iter(range(10**6))
    ranks: set[int] = set()
    for last in range(len(allowed) - count, len(allowed)):
        rank = draw_below(last + 1, word, counters)
        ranks.add(last if rank in ranks else rank)
    return tuple(allowed[rank] for rank in sorted(ranks))


@dataclass(frozen=True)
class Game:
    """A pool of grids, and everything else that an environment is told when it is made."""

    pool: tuple[Rows, ...]
    n_agents: int
    n_landmarks: int
    reward: str = "manhattan"
    actions: str = "moves"
    allow_wait: bool = False
    return_home: bool = False
    max_cycles: int = 50

    @property
    def sides(self) -> tuple[int, int]:
        """The most rows and the most columns of a grid."""
        return max(len(rows) for rows in self.pool), max(len(rows[0]) for rows in self.pool)

    @property
    def n_actions(self) -> int:
        """Number of an agent's actions."""
        return self.n_landmarks + 1 if self.actions == "landmarks" else 4 + self.allow_wait

    def episode(
        self, grid: int, landmarks: Sequence[int], starts: Sequence[int] | None = None,
        max_cycles: int | None = None,
    ) -> Model:  # fmt: skip
        """Return a fresh episode on a grid of the pool."""
        return Model(
            self.pool[grid],
            tuple(landmarks),
            self.n_agents,
            self.reward,
            self.allow_wait,
            self.max_cycles if max_cycles is None else max_cycles,
            None if starts is None else tuple(starts),
            self.actions,
            self.return_home,
            self.sides,
        )

    def drawn(self, word: int, grid: int | None = None) -> tuple[int, Model]:
        """Return the episode that a word draws, on a given grid or a drawn one; and its grid."""
        if grid is None:
            grid = draw_grid(word, len(self.pool))
        return grid, self.episode(grid, draw_landmarks(word, self.pool[grid], self.n_landmarks))

    def alone(self, grid: int) -> Game:
        """Return the same on one grid of the pool."""
        return replace(self, pool=(self.pool[grid],))

    def settings(self, **changes: Any) -> dict[str, Any]:
        """Return the package's arguments, all but the grids; those of version 0 only if set."""
        new = {"actions": self.actions, "return_home": self.return_home}
        return {
            "n_agents": self.n_agents,
            "n_landmarks": self.n_landmarks,
            "max_cycles": self.max_cycles,
            "reward": self.reward,
            "allow_wait": self.allow_wait,
            **{name: value for name, value in new.items() if value not in ("moves", False)},
            **changes,
        }


def random_starts(rng: random.Random, model: Model) -> tuple[int, ...]:
    """Return cells where the agents of a model could begin: reachable, none a landmark."""
    free = sorted(set(model.home) - set(model.landmarks))
    return tuple(rng.choice(free) for _ in range(model.n_agents))


def random_landmarks(rng: random.Random, rows: Rows, count: int) -> tuple[int, ...]:
    """Return landmarks, in any order."""
    return tuple(rng.sample(landmark_cells(rows), count))


def random_game(seed: int) -> Game:
    """Return game number ``seed``: sizes, rewards, actions and what ends an episode take turns."""
    rng = random.Random(seed * 6007 + 5)
    n_landmarks = 1 + seed * 5 % 8
    pool = []
    for _ in range(1 + seed % 5):
        if not pool or seed % 4:  # in each fourth game all grids have one shape
            n_rows, n_cols = rng.randint(1, 9), rng.randint(1, 9)
            while n_rows * n_cols <= n_landmarks:
                n_rows, n_cols = n_rows + 1, n_cols + 1
        pool.append(random_rows(rng, n_rows, n_cols, n_landmarks))
    actions = ("moves", "landmarks")[seed // 2 % 2]
    return Game(
        pool=tuple(pool),
        n_agents=1 + seed * 7 % 6,
        n_landmarks=n_landmarks,
        reward=REWARDS[(seed + seed // 3) % len(REWARDS)],  # all of them in every third game
        actions=actions,
        allow_wait=actions == "moves" and bool(seed // 4 % 2),
        return_home=seed % 7 % 2 == 1,
        max_cycles=rng.choice((1, 8, 20, 30, 50)),
    )


class Batch:
    """Rows of a game, each with its own stream of words, under one of the modes of autoreset.

    Parameters
    ----------
    words
        For each row what returns its next word.
    """

    def __init__(self, game: Game, words: Sequence[Callable[[], int]], mode: str) -> None:
        self.game, self.words, self.mode = game, words, mode
        self.grids = [0] * len(words)
        self.models: list[Model] = [game.drawn(0)[1] for _ in words]
        self.waiting = [False] * len(words)  # ended, and not reset yet

    def draw(self, row: int, grid: int | None = None) -> None:
        """Begin a row's next episode on a problem that is drawn."""
        self.grids[row], self.models[row] = self.game.drawn(self.words[row](), grid)
        self.waiting[row] = False

    def give(self, row: int, grid: int, model: Model) -> None:
        """Begin a row's next episode on a given problem."""
        self.grids[row], self.models[row] = grid, model
        self.waiting[row] = False

    def step(self, row: int, actions: Sequence[int]) -> tuple[float, bool, bool, Model, int]:
        """Step a row; return reward, flags, and the model and grid that these are of.

        After it, ``models[row]`` is what the row's observation is of.
        """
        if self.waiting[row] and self.mode == "NextStep":
            self.draw(row)
            return 0.0, False, False, self.models[row], self.grids[row]
        before, grid = self.models[row], self.grids[row]
        result = before.step(actions)
        self.waiting[row] = before.ended
        if before.ended and self.mode == "SameStep":
            self.draw(row)
        return (*result, before, grid)

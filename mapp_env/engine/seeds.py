"""Random words for the rows of a batch, each row from a generator of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mapp_env.validation import MAX_SEED, as_integer, check_count, describe

WORDS_AHEAD = 64
"""Words fetched from a row's generator at a time: a call for each would dominate a step."""


class RowSeeds:
    """A ``numpy.random.Generator`` for each row, seeded as a single environment seeds its own.

    There are no ``generators`` until the first :meth:`seed`; up to 64 words of each may have been
    fetched ahead.
    """

    def __init__(self, n_rows: int) -> None:
        self.n_rows = n_rows
        self.generators: list[np.random.Generator] = []
        self.seeds: list[int] = []
        self._words = np.zeros((n_rows, WORDS_AHEAD), np.uint64)
        self._used = np.full(n_rows, WORDS_AHEAD, np.int64)

    def check(self, seed: object) -> int | list[int | None] | None:
        """Return what ``reset(seed=...)`` was given: an int, a seed or ``None`` a row, or ``None``.

        Raises a ValueError if it is anything else.
        """
        if seed is None:
            return None
        if as_integer(seed) is not None:
            return check_count("seed", seed, 0, MAX_SEED)
        if isinstance(seed, np.ndarray) and seed.ndim == 1:
            seed = list(seed)
        if not isinstance(seed, Sequence) or isinstance(seed, str | bytes):
            raise ValueError(
                f"seed must be an integer, a sequence of {self.n_rows} or None, "
                f"got {describe(seed)}"
            )
        if len(seed) != self.n_rows:
            raise ValueError(f"seed must hold {self.n_rows} seeds, one a row, got {len(seed)}")
        return [
            None if one is None else check_count(f"seed[{index}]", one, 0, MAX_SEED)
            for index, one in enumerate(seed)
        ]

    def seed(self, seed: int | list[int | None] | None, indices: list[int]) -> None:
        """Give rows new generators: those of ``indices`` as ``seed`` says, all if none has one.

        An int is spread over the rows by ``numpy.random.SeedSequence``: row ``i`` gets the same
        seed whatever the number of rows, and seeds 0 and 1 have no row in common. A list seeds
        each row, ``None`` leaves its generator as it is.
        """
        if not self.generators:
            self.generators = [np.random.default_rng(0)] * self.n_rows
            self.seeds = [0] * self.n_rows
            spread = seed if isinstance(seed, int) else None
            self._set(spread_seed(spread, self.n_rows), list(range(self.n_rows)))
        elif isinstance(seed, int):
            self._set(spread_seed(seed, self.n_rows), indices)
        if isinstance(seed, list):
            self._set(seed, [index for index in indices if seed[index] is not None])

    def _set(self, seeds: Sequence[int | None], indices: list[int]) -> None:
        for index in indices:
            self.generators[index], self.seeds[index] = seeding.np_random(seeds[index])
        self._used[indices] = WORDS_AHEAD

    def next_words(self, indices: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return the next word of each row of ``indices``, shape (M,), as single draws would."""
        used = self._used.take(indices)
        spent = used == WORDS_AHEAD
        if spent.any():
            for index in indices[spent]:
                generator = self.generators[index]
                self._words[index] = generator.integers(2**64, size=WORDS_AHEAD, dtype=np.uint64)
            used %= WORDS_AHEAD
        words: NDArray[np.uint64] = self._words.take(indices * WORDS_AHEAD + used)
        self._used[indices] = used + 1
        return words


def spread_seed(seed: int | None, count: int) -> list[int]:
    """Return ``count`` independent seeds that depend on ``seed`` and their place alone."""
    words: list[int] = np.random.SeedSequence(seed).generate_state(count, np.uint64).tolist()
    return words

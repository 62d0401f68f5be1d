"""What is drawn with one random word: a grid of a pool, landmarks on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mapp_env.compiled import kernel

LOW_32_BITS = 0xFFFFFFFF


@kernel
def draw_landmarks(word: np.uint64, candidates: NDArray[np.int32], out: NDArray[np.int32]) -> None:
    """Choose distinct ones of ascending cells, every set equally likely, by one random word.

    Floyd's sampling (Bentley and Floyd 1987, doi:10.1145/30401.315746), then sorted: landmarks are
    a set, and a set should have one observation, not ``K!``. One word an episode lets each row of
    a batch draw from its own ``numpy.random.Generator`` without calling it from compiled code.
    """
    high = np.int64(word >> np.uint64(32))
    low = np.int64(word & np.uint64(LOW_32_BITS))
    count = out.shape[0]
    first = candidates.shape[0] - count
    used = 0
    for chosen in range(count):
        last = first + chosen
        # Uniform in 0..last: of the 2**32 values of `bits`, those past the last full multiple of
        # the range are drawn again.
        span = last + 1
        pick, multiple = 0, LOW_32_BITS
        while multiple > LOW_32_BITS + 1 - span:
            bits = scramble(scramble((low + used * 0x9E3779B9) & LOW_32_BITS) ^ high)
            used += 1
            pick = bits % span
            multiple = bits - pick
        for earlier in range(chosen):
            if out[earlier] == pick:
                pick = last
        # `out` holds ranks, ascending, until the end.
        place = chosen
        while place > 0 and out[place - 1] > pick:
            out[place] = out[place - 1]
            place -= 1
        out[place] = pick
    for index in range(count):
        out[index] = candidates[out[index]]


@kernel
def draw_grid(word: np.uint64, n_grids: int) -> int:
    """Return one of ``n_grids`` numbers, each equally likely, by a random word (R10).

    The word is scrambled as :func:`draw_landmarks` does it, which counts up from
    0; here the count goes down from -1, so that the landmarks are what they are without a draw.
    """
    high = np.int64(word >> np.uint64(32))
    low = np.int64(word & np.uint64(LOW_32_BITS))
    used = 0
    pick, multiple = 0, LOW_32_BITS
    while multiple > LOW_32_BITS + 1 - n_grids:
        used -= 1
        bits = scramble(scramble((low + used * 0x9E3779B9) & LOW_32_BITS) ^ high)
        pick = bits % n_grids
        multiple = bits - pick
    return int(pick)


# A 32-bit PCG RXS-M-XS (O'Neill 2014, HMC-CS-2014-0905) in 64-bit signed arithmetic that never
# overflows, so that it means the same with and without compilation.


@kernel
def next_word(word: int) -> int:
    """Return the generator's state after ``word``."""
    return (word * 747796405 + 2891336453) & LOW_32_BITS


@kernel
def scramble(word: int) -> int:
    """Return a permutation of 32 bits: the generator's output after ``word``."""
    state: int = next_word(word)
    state = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & LOW_32_BITS
    return (state >> 22) ^ state

"""What the network "pairs" looks up for an observation: numbers of rows in its tables."""

import math

import numpy as np

from mapp_env.compiled import nogil_kernel


@nogil_kernel
def arrange(observations, n, k, n_cells, sort):  # type: ignore[no-untyped-def]
    """Return what is to be looked up for global observations (B, N + 2K).

    Two places are added to the grid's cells: where all visited landmarks are put, and one that
    every agent pairs with besides, for what its cell says by itself.

    Returns
    -------
    pairs
        (B, N, K + 1) of each agent, its cell with each landmark's and with the second added place.
    landmarks
        (B, K) the landmarks' cells, or the first added place.
    order
        (B, N) the agents in the order of `pairs`: with `sort` that of their cells, of equal
        ones the first.
    """
    n_rows, n_places = len(observations), n_cells + 2
    pairs = np.empty((n_rows, n, k + 1), np.int64)
    landmarks = np.empty((n_rows, k), np.int64)
    order = np.empty((n_rows, n), np.int64)
    for row in range(n_rows):
        for index in range(k):
            visited = observations[row, n + k + index] > 0
            landmarks[row, index] = n_cells if visited else observations[row, n + index]
        for agent in range(n):
            place = agent
            while sort and place > 0:
                if observations[row, order[row, place - 1]] <= observations[row, agent]:
                    break
                order[row, place] = order[row, place - 1]
                place -= 1
            order[row, place] = agent
        for agent in range(n):
            cell = np.int64(observations[row, order[row, agent]])
            for index in range(k):
                pairs[row, agent, index] = cell * n_places + landmarks[row, index]
            pairs[row, agent, k] = cell * n_places + n_cells + 1
    return pairs, landmarks, order


@nogil_kernel
def routes(pairs, landmarks, n_cells):  # type: ignore[no-untyped-def]
    """Return the agents' cells with every two unvisited landmarks: (B * N, K (K - 1) / 2).

    A pair with a visited landmark has one row for itself, the last; so has a single landmark.

    Parameters
    ----------
    pairs, landmarks
        (B, N, K + 1) and (B, K), what :func:`arrange` returned.
    n_cells
        Cells of the grid.
    """
    n_rows, n, k = len(pairs), pairs.shape[1], landmarks.shape[1]
    n_two = n_cells * (n_cells - 1) // 2
    out = np.full((n_rows * n, max(1, k * (k - 1) // 2)), n_cells * n_two, np.int64)
    for row in range(n_rows):
        place = 0
        for one in range(k):
            for other in range(one):
                low = min(landmarks[row, one], landmarks[row, other])
                high = max(landmarks[row, one], landmarks[row, other])
                if high < n_cells and low != high:
                    two = high * (high - 1) // 2 + low
                    for agent in range(n):
                        cell = pairs[row, agent, k] // (n_cells + 2)
                        out[row * n + agent, place] = cell * n_two + two
                place += 1
    return out


def n_routes(n_cells: int) -> int:
    """Return how many rows :func:`routes` numbers."""
    return n_cells * math.comb(n_cells, 2) + 1


def between_landmarks(landmarks: np.ndarray, n_cells: int) -> np.ndarray:
    """Return each landmark with each: (B * K, K), of what :func:`arrange` returned."""
    k = landmarks.shape[1]
    both: np.ndarray = landmarks[:, :, None] * (n_cells + 1) + landmarks[:, None, :]
    return both.reshape(-1, k)

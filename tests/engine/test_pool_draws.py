"""Problems that a pool draws: every grid, and every set of landmarks on it, equally likely."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from model import landmark_cells

import mapp_env
from mapp_env import mapp_v0

# 4, 5, 3, 7 and 6 cells for landmarks, in all forms; a pocket in the last but one.
POOL = (
    ("D.", "..", ".#"),
    ("D.....",),
    (".D..",),
    ("...#.", ".D.#.", "..###"),
    ("..", ".D", "..", "#."),
)
N_ROWS = 10_000


def chi_square(counts: Any, expected: Any) -> float:
    """Return by how many of its standard deviations chi-square is above its mean."""
    counts, expected = np.asarray(counts, float).ravel(), np.asarray(expected, float).ravel()
    assert expected.min() > 5
    freedom = len(counts) - 1
    return float((((counts - expected) ** 2 / expected).sum() - freedom) / math.sqrt(2 * freedom))


def the_pool(rows: tuple[tuple[str, ...], ...] = POOL) -> list[mapp_env.Grid]:
    """Return the grids."""
    return [mapp_env.Grid.from_text("\n".join(one) + "\n") for one in rows]


def draws(n_landmarks: int, how: str) -> tuple[np.ndarray, np.ndarray]:
    """Return grids (B,) and landmarks (B, K): of a reset, of autoresets or of one row."""
    settings: dict[str, Any] = {"grid": the_pool(), "n_agents": 1, "n_landmarks": n_landmarks}
    if how == "one row":
        env = mapp_v0.parallel_env(**settings)
        infos = [env.reset(seed=5 if i == 0 else None)[1] for i in range(2000)]
        env.reset(seed=5)
        cells = []
        for _ in infos:
            cells.append(env.state()[1 : 1 + n_landmarks].astype(int))
            env.reset()
        return np.array([info["agent_0"]["grid"] for info in infos]), np.array(cells)
    envs = mapp_env.make_vec(N_ROWS, max_cycles=1, autoreset_mode="SameStep", **settings)
    observations, infos = envs.reset(seed=11)
    if how == "autoreset":
        for _ in range(3):
            observations, *_, infos = envs.step(np.zeros((N_ROWS, 1), int))
    return infos["grid"], observations[:, 1 : 1 + n_landmarks].astype(int)


@pytest.mark.parametrize("how", ["reset", "autoreset", "one row"])
@pytest.mark.parametrize("n_landmarks", [1, 2, 3])
def test_draws_are_uniform(n_landmarks: int, how: str) -> None:
    """Each grid is as likely as the others, and on each grid each set of landmarks."""
    grids, cells = draws(n_landmarks, how)
    counts = np.bincount(grids, minlength=len(POOL))
    assert chi_square(counts, np.full(len(POOL), len(grids) / len(POOL))) < 6
    for grid, rows in enumerate(POOL):
        sets = list(itertools.combinations(landmark_cells(rows), n_landmarks))
        drawn = [tuple(row) for row in cells[grids == grid].tolist()]
        assert set(drawn) == set(sets)
        if len(sets) > 1:
            seen = [drawn.count(one) for one in sets]
            assert chi_square(seen, np.full(len(sets), len(drawn) / len(sets))) < 6


@pytest.mark.parametrize("n_grids", [2, 3, 7, 100, 1000])
def test_sizes_of_pools_are_uniform(n_grids: int) -> None:
    """Also of many grids each is as likely, the first and the last not less than others."""
    grid = mapp_env.Grid.from_text("D..\n")
    envs = mapp_env.make_vec(15_000, grid=[grid] * n_grids, n_agents=1, n_landmarks=1)
    _, infos = envs.reset(seed=7)
    counts = np.bincount(infos["grid"], minlength=n_grids)
    assert len(counts) == n_grids
    assert abs(chi_square(counts, np.full(n_grids, 15_000 / n_grids))) < 6


def test_rows_and_episodes_are_independent() -> None:
    """Neither a row's neighbour, nor its episode before, nor its landmarks tell its grid."""
    envs = mapp_env.make_vec(
        N_ROWS, grid=the_pool(), n_agents=1, n_landmarks=1, max_cycles=1, autoreset_mode="SameStep"
    )
    _, infos = envs.reset(seed=4)
    first = infos["grid"]
    *_, infos = envs.step(np.zeros((N_ROWS, 1), int))
    second = infos["grid"]
    for one, other in ((first[1:], first[:-1]), (first, second), (second, np.roll(first, 1))):
        table = np.bincount(one * len(POOL) + other, minlength=len(POOL) ** 2)
        assert abs(chi_square(table, np.full(len(POOL) ** 2, len(one) / len(POOL) ** 2))) < 6


def test_grid_and_landmark_of_one_word_are_independent() -> None:
    """Where all grids of a pool have as many cells, the grid does not tell which is drawn."""
    for n_grids, line in ((2, "D.."), (4, "D...."), (5, "D....."), (3, "D.........")):
        grid = mapp_env.Grid.from_text(line)
        envs = mapp_env.make_vec(N_ROWS, grid=[grid] * n_grids, n_agents=1, n_landmarks=1)
        observations, infos = envs.reset(seed=6)
        n_cells = len(line) - 1
        pairs = infos["grid"] * n_cells + observations[:, 1].astype(int) - 1
        table = np.bincount(pairs, minlength=n_grids * n_cells)
        assert abs(chi_square(table, np.full(n_grids * n_cells, N_ROWS / len(table)))) < 6


def test_a_grid_alone_leaves_its_landmarks_to_chance() -> None:
    """options["grid"] draws each set of landmarks on that grid as often as the others."""
    envs = mapp_env.make_vec(N_ROWS, grid=the_pool(), n_agents=1, n_landmarks=2)
    wanted = np.arange(N_ROWS) % len(POOL)
    observations, infos = envs.reset(seed=3, options={"grid": wanted})
    assert infos["grid"].tolist() == wanted.tolist()
    for grid, rows in enumerate(POOL):
        sets = list(itertools.combinations(landmark_cells(rows), 2))
        drawn = [tuple(row) for row in observations[wanted == grid, 1:3].astype(int).tolist()]
        seen = [drawn.count(one) for one in sets]
        assert sum(seen) == len(drawn)
        assert chi_square(seen, np.full(len(sets), len(drawn) / len(sets))) < 6

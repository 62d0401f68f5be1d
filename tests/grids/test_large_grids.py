"""The largest grids, of 2048 rows and columns, in every role that a grid has."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest

from mapp_env import Grid, Problem, make_grid, make_vec, mapp_v0, sample_problems, solve

SIDE = 2048
LAST = SIDE * SIDE - 1


@pytest.fixture(scope="module")
def field() -> Grid:
    """Return the largest grid without walls: there all distances are known."""
    return Grid(np.zeros((SIDE, SIDE), np.bool_))


@pytest.fixture(scope="module")
def strewn() -> Grid:
    """Return a large grid with walls, as wide as real maps are."""
    return make_grid("random", rows=700, cols=1500, density=0.25)


def test_distances_on_the_largest_grid(field: Grid) -> None:
    """Steps are those of rows and columns, and moves stop at the borders."""
    row, col = np.divmod(np.arange(field.n_cells), SIDE)
    depot = divmod(field.depot, SIDE)
    assert depot == (SIDE // 2 - 1, SIDE // 2 - 1)
    assert (field.home == abs(row - depot[0]) + abs(col - depot[1])).all()
    assert (field.distances_from([LAST])[0] == (SIDE - 1 - row) + (SIDE - 1 - col)).all()
    corners = [0, SIDE - 1, LAST - SIDE + 1, LAST]
    assert field.moves[corners].tolist() == [
        [0, 1, 0, SIDE],
        [SIDE - 2, SIDE - 1, SIDE - 1, 2 * SIDE - 1],
        [LAST - SIDE + 1, LAST - SIDE + 2, LAST - 2 * SIDE + 1, LAST - SIDE + 1],
        [LAST - 1, LAST, LAST - SIDE, LAST],
    ]
    path = field.path(0, LAST)
    assert len(path) == 2 * SIDE - 1
    assert path[:SIDE] == tuple(range(SIDE))
    with pytest.raises(ValueError, match=r"use distances_from\(cells\)"):
        _ = field.distances
    for table in (field.distances_from, field.manhattan_from):
        with pytest.raises(ValueError, match=r"from 513 to all 4194304 would take 8606711808 byte"):
            table([0] * 513)


def test_copies_of_the_largest_grid(field: Grid, strewn: Grid) -> None:
    """Text, pickle and copy are the grid again, with one hash, and others are not."""
    for grid in (field, strewn):
        for again in (
            Grid.from_text(grid.text),
            pickle.loads(pickle.dumps(grid)),
            copy.deepcopy(grid),
        ):
            assert again == grid
            assert hash(again) == hash(grid)
        assert Grid(grid.walls, int(grid.reachable[0])) != grid
        assert len(repr(grid)) < 80
    assert repr(field) == f"Grid(rows=2048, cols=2048, depot={field.depot}, walls=0)"


def test_every_cell_of_the_largest_grid_can_be_told(field: Grid) -> None:
    """The global observation holds cell numbers exactly, and the space has room for the last."""
    env = mapp_v0.parallel_env(grid=field, n_agents=1, n_landmarks=3)
    landmarks = [0, LAST - 1, LAST]
    observations, _ = env.reset(options={"landmarks": landmarks})
    assert observations["agent_0"].tolist() == [field.depot, *landmarks, 0, 0, 0]
    assert env.observation_space("agent_0").contains(observations["agent_0"])


@pytest.mark.parametrize("observation", ["global", "geodesic", "distances"])
def test_a_large_grid_is_played(strewn: Grid, observation: str) -> None:
    """A batch's row is the scalar environment, and the reward minus the ways to the landmarks."""
    arguments = {
        "grid": strewn,
        "n_agents": 2,
        "n_landmarks": 3,
        "observation": observation,
        "reward": "geodesic",
    }
    env, envs = mapp_v0.parallel_env(**arguments), make_vec(3, **arguments)
    near = strewn.reachable[abs(strewn.home[strewn.reachable] - 9) < 3]
    landmarks = [int(near[0]), int(near[-1]), int(strewn.reachable[-1])]
    ways = dict(zip(landmarks, strewn.distances_from(landmarks), strict=True))
    seen, _ = env.reset(options={"landmarks": landmarks})
    batch, _ = envs.reset(options={"landmarks": landmarks})
    rng = np.random.default_rng(9)
    for _ in range(40):
        rows = [seen[agent] for agent in env.agents]
        own = rows[0] if observation == "global" else np.stack(rows)
        assert all(np.array_equal(own, row) for row in batch)
        actions = rng.integers(0, 4, 2)
        seen, rewards, *_ = env.step(dict(zip(env.agents, actions.tolist(), strict=True)))
        batch, scores, *_ = envs.step(np.stack([actions] * 3))
        state = env.state().astype(int)
        left = [cell for cell, gone in zip(landmarks, state[5:8], strict=True) if not gone]
        reward = -sum(int(ways[cell][state[:2]].min()) for cell in left)
        assert rewards["agent_0"] == reward
        assert scores.tolist() == [reward] * 3


def test_a_large_grid_is_solved(strewn: Grid) -> None:
    """A proven plan is valid, no longer than a search's, and no shorter than the farthest way."""
    problem = Problem(strewn, sample_problems(strewn, 1, 6, seed=2)[0].tolist(), 2)
    best = solve(problem)
    found = solve(problem, method="search", time_limit=0.1)
    for plan in (best, found):
        plan.verify(problem)
    assert best.status == "optimal"
    assert strewn.home[list(problem.landmarks)].max() <= best.cost <= found.cost

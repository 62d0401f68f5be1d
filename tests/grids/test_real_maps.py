"""Maps of others, from a folder that MAPP_MAPS names: each loads, is played and is solved."""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from mapp_env import Grid, Problem, load_grids, make_vec, mapp_v0, sample_problems, solve

FOLDER = os.environ.get("MAPP_MAPS")
PATHS = sorted(Path(FOLDER).glob("*.map")) if FOLDER else []
N_AGENTS, N_LANDMARKS = 3, 5

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FOLDER, reason="MAPP_MAPS names no folder of maps"),
]
each_map = pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)


def landmarks_of(grid: Grid) -> tuple[int, ...]:
    """Return the landmarks of a drawn problem."""
    return tuple(sample_problems(grid, 1, N_LANDMARKS, seed=6)[0].tolist())


def test_the_folder_has_maps() -> None:
    """A folder that is named has maps, and load_grids reads all of them in order."""
    assert PATHS
    grids = load_grids(str(FOLDER))
    assert grids == tuple(map(Grid.load, PATHS))


@each_map
def test_the_map_is_what_the_file_says(path: Path) -> None:
    """Sides, and every letter, are the file's; steps to the depot are those of a plain search."""
    header, text = path.read_text("ascii").split("map\n", 1)
    sides = dict(line.split() for line in header.splitlines())
    rows = text.splitlines()
    grid = Grid.load(path)
    assert (grid.rows, grid.cols) == (int(sides["height"]), int(sides["width"]))
    assert grid.walls.tolist() == [[letter in "#@TOW" for letter in row] for row in rows]
    assert Grid.from_text(grid.to_text()) == grid
    free = ~grid.walls.ravel()
    steps = {grid.depot: 0}
    queue = deque([grid.depot])
    while queue:
        cell = queue.popleft()
        row, col = divmod(cell, grid.cols)
        for ahead, inside in (
            (cell - grid.cols, row > 0),
            (cell + grid.cols, row + 1 < grid.rows),
            (cell - 1, col > 0),
            (cell + 1, col + 1 < grid.cols),
        ):
            if inside and free[ahead] and ahead not in steps:
                steps[ahead] = steps[cell] + 1
                queue.append(ahead)
    assert grid.home.tolist() == [steps.get(cell, -1) for cell in range(grid.n_cells)]


@each_map
@pytest.mark.parametrize("observation", ["global", "geodesic", "distances"])
@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_the_map_is_played(path: Path, observation: str, actions: str) -> None:
    """A batch's row is the scalar environment bit for bit, with moves and with landmarks."""
    arguments = {
        "grid": path,
        "n_agents": N_AGENTS,
        "n_landmarks": N_LANDMARKS,
        "observation": observation,
        "actions": actions,
        "reward": "geodesic",
        "max_cycles": 1_000,
    }
    env = mapp_v0.parallel_env(**arguments)
    envs = make_vec(2, **arguments)
    options = {"landmarks": landmarks_of(Grid.load(path))}
    seen, _ = env.reset(seed=1, options=options)
    batch, _ = envs.reset(seed=1, options=options)
    rng = np.random.default_rng(2)
    n_actions = 4 if actions == "moves" else N_LANDMARKS + 1
    for step in range(30):
        rows = [np.asarray(seen[agent]) for agent in env.agents]
        own = rows[0] if observation == "global" else np.stack(rows)
        assert np.array_equal(own, batch[0])
        assert np.array_equal(own, batch[1])
        chosen = rng.integers(n_actions, size=N_AGENTS)
        seen, rewards, ended, cut, _ = env.step(dict(zip(env.agents, chosen.tolist(), strict=True)))
        batch, scores, terminations, truncations, _ = envs.step(np.stack([chosen, chosen]))
        assert set(rewards.values()) == {float(scores[0])}
        assert any(ended.values()) == terminations[0]
        assert any(cut.values()) == truncations[0]
        if not env.agents:
            assert step > 0
            break


@each_map
def test_landmarks_are_walked_to(path: Path) -> None:
    """An agent that is sent to one landmark after another takes the steps between them, no more."""
    grid = Grid.load(path)
    landmarks = landmarks_of(grid)
    between = grid.distances_from([grid.depot, *landmarks])
    most = sum(int(between[index, cell]) for index, cell in enumerate(landmarks))
    env = mapp_v0.parallel_env(
        grid=grid, n_agents=1, n_landmarks=N_LANDMARKS, actions="landmarks", max_cycles=most + 1
    )
    _, infos = env.reset(options={"landmarks": landmarks})
    step = 0
    while env.agents:
        chosen = int(np.argmax(infos["agent_0"]["action_mask"]))
        _, _, _, _, infos = env.step({"agent_0": chosen})
        step += 1
    assert step <= most  # landmarks that were passed on the way are not gone to again
    assert infos["agent_0"]["metrics"]["cover_time"] == step >= grid.home[list(landmarks)].max()


@each_map
@pytest.mark.parametrize("anywhere", [False, True], ids=["depot", "anywhere"])
def test_the_map_is_solved(path: Path, anywhere: bool) -> None:
    """The solver's plan is valid, and played through the environment it costs what it says."""
    grid = Grid.load(path)
    cells = sample_problems(grid, 1, N_LANDMARKS + N_AGENTS, seed=7)[0]
    cells = np.random.default_rng(7).permutation(cells).tolist()
    starts = cells[N_LANDMARKS:] if anywhere else None
    problem = Problem(grid, cells[:N_LANDMARKS], N_AGENTS, starts=starts)
    nearest = grid.distances_from(sorted(set(problem.start_cells))).min(axis=0)
    best = solve(problem)
    found = solve(problem, method="search", time_limit=0.2)
    assert best.status == "optimal"
    assert nearest[list(problem.landmarks)].max() <= best.cost <= found.cost
    for plan in (best, found):
        plan.verify(problem)
        env = mapp_v0.parallel_env(
            grid=grid, n_agents=N_AGENTS, n_landmarks=N_LANDMARKS, max_cycles=int(plan.cost)
        )
        env.reset(options={"problem": problem})
        for joint in plan.joint_actions().tolist():
            _, _, _, _, infos = env.step(dict(zip(env.agents, joint, strict=True)))
        assert not env.agents
        assert infos["agent_0"]["metrics"]["cover_time"] == plan.cost


@pytest.mark.parametrize("actions", ["moves", "landmarks"])
def test_all_maps_are_one_pool(actions: str) -> None:
    """A pool of all maps plays each as an environment of that map alone, in rows side by side."""
    grids = load_grids(str(FOLDER))
    arguments = {
        "n_agents": N_AGENTS,
        "n_landmarks": N_LANDMARKS,
        "observation": "distances",
        "actions": actions,
        "max_cycles": 25,
    }
    envs = make_vec(len(grids), grid=grids, **arguments)
    rng = np.random.default_rng(3)
    landmarks = [landmarks_of(grid) for grid in grids]
    problems = [
        Problem(grid, cells, N_AGENTS) for grid, cells in zip(grids, landmarks, strict=True)
    ]
    batch, infos = envs.reset(seed=4, options={"problem": problems})
    assert infos["grid"].tolist() == list(range(len(grids)))
    alone = [mapp_v0.parallel_env(grid=grid, **arguments) for grid in grids]
    seen = [
        env.reset(options={"landmarks": cells})[0]
        for env, cells in zip(alone, landmarks, strict=True)
    ]
    n_actions = 4 if actions == "moves" else N_LANDMARKS + 1
    for _ in range(20):
        for row, views in enumerate(seen):
            assert np.array_equal(np.stack(list(views.values())), batch[row])
        chosen = rng.integers(n_actions, size=(len(grids), N_AGENTS))
        batch, scores, *_ = envs.step(chosen)
        for row, env in enumerate(alone):
            seen[row], rewards, *_ = env.step(
                dict(zip(env.agents, chosen[row].tolist(), strict=True))
            )
            assert set(rewards.values()) == {float(scores[row])}

"""A policy's routes for one problem, before and after a short training on it."""

import json

import numpy as np
import pytest

from baselines import finetune, solve
from baselines.networks import NetworkSpec, build_network, torch_generator
from baselines.policy import NetworkPolicy, save_policy
from baselines.settings import Setting
from mapp_env import Plan, make_grid
from mapp_env.solvers import optimal_costs

GRID = make_grid("random", rows=5, cols=5, seed=1, density=0.1)
SETTING = Setting(GRID, 2, 2, 20)
CELLS = tuple(GRID.reachable[[0, -1]].tolist())


def untrained(team: str = "one") -> NetworkPolicy:
    """Return a policy that has learned nothing."""
    outputs = "joint" if team == "one" else "agents"
    spec = NetworkSpec("pairs", 2, 2, 4, 25, 32, outputs, code_units=16, team=team)
    return NetworkPolicy(build_network(spec, torch_generator(np.random.SeedSequence(0))))


@pytest.fixture
def folder(tmp_path):
    """Return a run folder with an untrained policy."""
    save_policy(tmp_path / "policy.safetensors", untrained().network)
    config = {
        "options": {"n_agents": 2, "n_landmarks": 2, "max_cycles": 20},
        "grid": GRID.to_text(),
        "training_problems": [],
    }
    (tmp_path / "config.json").write_text(json.dumps(config))
    return tmp_path


def test_fine_tuning_finds_the_optimum():
    """From an untrained policy, on one problem of a small grid, 30 episodes find the optimum."""
    problem = solve.make_problem(SETTING, CELLS)
    args = finetune.Args(landmarks=CELLS, updates_per_episode=40, learning_rate=0.008)
    plan, n_episodes = finetune.finetune(args, untrained(), SETTING, problem)
    assert n_episodes < 30  # as short as the way to the farthest landmark, so it ends early
    plan.verify(problem)
    assert plan.cover_time == optimal_costs(GRID, [CELLS], 2)[0]
    again, _ = finetune.finetune(args, untrained(), SETTING, problem)
    assert again.tours == plan.tours


def test_fine_tuning_never_makes_it_worse():
    """The policy's own episode is one of those played, so what counts is at least as good."""
    problem = solve.make_problem(SETTING, CELLS)
    before = solve.solve_by_policy(untrained(), SETTING, problem)
    args = finetune.Args(landmarks=CELLS, episodes=1, random_episodes=0)
    after, n_episodes = finetune.finetune(args, untrained(), SETTING, problem)
    assert n_episodes == 1
    assert (after.success, after.cover_time) == (before.success, before.cover_time)


def test_fine_tuning_is_for_meta_agents():
    """A policy of independent learners is refused by name."""
    problem = solve.make_problem(SETTING, CELLS)
    with pytest.raises(ValueError, match="policy must be a meta-agent's, got one of shared"):
        finetune.finetune(finetune.Args(landmarks=CELLS), untrained("shared"), SETTING, problem)


def test_solving_from_the_command_line(folder, capsys):
    """Costs beside the optimum, a picture and a plan; exit code 1 where it is not solved."""
    plan, picture = folder / "plan.json", folder / "routes.png"
    args = solve.Args(CELLS, str(folder), picture, plan)
    status = solve.main(args)
    printed = capsys.readouterr().out
    loaded = Plan.load(plan)
    assert status == (0 if loaded.success else 1)
    assert f"optimum: cover time {optimal_costs(GRID, [CELLS], 2)[0]}" in printed
    assert ("policy: not solved" in printed) == (not loaded.success)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_solved_is_refused(folder):
    """A wrong number of landmarks, a wall, no policy: refused by name."""
    with pytest.raises(ValueError, match="landmarks must be 2 cells for this policy, got 3"):
        solve.main(solve.Args((*CELLS, 7), str(folder)))
    wall = int(np.flatnonzero(GRID.walls.ravel())[0])
    with pytest.raises(ValueError, match=r"landmarks\[1\] must be a free cell"):
        solve.main(solve.Args((CELLS[0], wall), str(folder)))
    with pytest.raises(ValueError, match="path must be a run folder or a weights file"):
        solve.main(solve.Args(CELLS, "nonsense"))

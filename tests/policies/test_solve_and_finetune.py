"""A policy's routes for one problem, before and after a short training on it."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

import mapp_env
from baselines import finetune, solve
from baselines.networks import build_network, network_spec, torch_generator
from baselines.policies import play
from baselines.policies.policy import NetworkPolicy, save_policy
from baselines.policies.settings import Setting
from mapp_env import Plan, make_grid, mapp_v0, replay
from mapp_env.solvers import optimal_costs

GRID = make_grid("random", rows=5, cols=5, seed=1, density=0.1)
SETTING = Setting(GRID, 2, 2, 20)
CELLS = tuple(GRID.reachable[[0, -1]].tolist())


def untrained(kind: str = "pairs", outputs: str = "joint", team: str = "one") -> NetworkPolicy:
    """Return a policy that has learned nothing."""
    options = {"code_units": 16} if kind == "pairs" else {}
    spec = network_spec(kind, 2, 2, 4, 25, 32, outputs, team=team, **options)
    return NetworkPolicy(build_network(spec, torch_generator(np.random.SeedSequence(0))))


@pytest.fixture
def folder(tmp_path):
    """Return a run folder with an untrained policy."""
    save_policy(tmp_path / "policy.safetensors", untrained().network, GRID)
    config = {
        "options": {"n_agents": 2, "n_landmarks": 2, "max_cycles": 20},
        "grid": GRID.to_text(),
        "training_problems": [],
    }
    (tmp_path / "config.json").write_text(json.dumps(config))
    return tmp_path


@pytest.mark.parametrize(
    ("kind", "outputs", "team"),
    [
        ("pairs", "joint", "one"),
        ("pairs", "agents", "one"),
        ("paper", "agents", "one"),
        ("pairs", "agents", "independent"),
        ("pairs", "agents", "shared"),
    ],
)
def test_fine_tuning_finds_the_optimum(kind, outputs, team):
    """From an untrained policy of any kind, on a small grid, 30 episodes find the optimum."""
    problem = SETTING.problem(CELLS)
    args = finetune.Args(
        landmarks=CELLS, imagined=512, updates_per_episode=5, learning_rate=0.005, patience=12
    )
    policy = untrained(kind, outputs, team)
    before = {name: tensor.clone() for name, tensor in policy.network.state_dict().items()}
    plan, n_episodes = finetune.finetune(args, policy, problem)
    assert n_episodes <= 30
    plan.verify(problem)
    assert plan.cover_time == optimal_costs(GRID, [CELLS], 2)[0]
    for name, tensor in policy.network.state_dict().items():
        assert torch.equal(tensor, before[name])  # the policy itself is left as it was
    again, _ = finetune.finetune(args, policy, problem)
    assert again.tours == plan.tours


def test_fine_tuning_never_makes_it_worse():
    """The policy's own episode is one of those played, so what counts is at least as good."""
    problem = SETTING.problem(CELLS)
    before = play(untrained(), [problem])[0]
    args = finetune.Args(landmarks=CELLS, episodes=1)
    after, n_episodes = finetune.finetune(args, untrained(), problem)
    assert n_episodes == 1
    assert (after.success, after.cover_time) == (before.success, before.cover_time)


def test_the_best_episode_counts_and_waiting_ends(monkeypatch):
    """Not the last episode but the best; over when its own have not become shorter for a while."""
    problem = SETTING.problem(CELLS)
    optimum = mapp_env.solve(problem)
    longer = [replace(optimum, cover_time=optimum.cover_time + n) for n in range(9)]
    # The policy's own, two at random, then those after training.
    plans = iter([longer[8], longer[8], longer[5], longer[6], longer[3], longer[4], longer[7]])
    monkeypatch.setattr(finetune.Tuner, "run_episode", lambda tuner, env, random: next(plans))
    monkeypatch.setattr(finetune.Tuner, "train", lambda tuner: None)
    args = finetune.Args(landmarks=CELLS, random_episodes=2, patience=2)
    best, n_episodes = finetune.finetune(args, untrained(), problem)
    assert (best.cover_time, n_episodes) == (longer[3].cover_time, 7)


def test_without_a_solution_all_episodes_are_played(monkeypatch):
    """However long it waits in vain; the first shows the policy, then as many as said explore."""
    played, run_episode = [], finetune.Tuner.run_episode

    def noted(tuner, env, random):
        played.append(random)
        return run_episode(tuner, env, random)

    monkeypatch.setattr(finetune.Tuner, "run_episode", noted)
    short = Setting(GRID, 2, 2, 1)  # no time to come to either landmark
    problem = short.problem(CELLS)
    args = finetune.Args(landmarks=CELLS, episodes=9, random_episodes=3, patience=1, imagined=16)
    best, n_episodes = finetune.finetune(args, untrained(), problem)
    assert not best.success
    assert n_episodes == 9
    assert played == [False, *[True] * 3, *[False] * 5]


def test_fine_tuning_from_the_command_line(folder, capsys):
    """One problem beside its optimum; several, of which it is counted how many became optimal."""
    short = {"imagined": 64, "updates_per_episode": 2, "policy": str(folder)}
    plan = folder / "plan.json"
    status = finetune.main(finetune.Args(landmarks=CELLS, plan=plan, **short))
    assert status == (0 if Plan.load(plan).success else 1)
    printed = capsys.readouterr().out
    assert f"optimum: cover time {optimal_costs(GRID, [CELLS], 2)[0]}" in printed
    assert "fine-tuned:" in printed
    assert finetune.main(finetune.Args(problems=2, **short)) == 0
    found = re.search(r"^2 problems .* found on (\d) \(", capsys.readouterr().out, re.MULTILINE)
    assert found is not None
    assert 0 <= int(found[1]) <= 2


def test_nothing_to_fine_tune_is_said(folder, monkeypatch, capsys):
    """A policy that solves all optimally: said so, and no error."""
    evaluate = finetune.evaluate

    def optimal(policy, setting, landmarks, optima):
        return replace(
            evaluate(policy, setting, landmarks, optima),
            success=np.ones(len(landmarks), bool),
            cover_time=optima.cover_time.astype(float),
        )

    monkeypatch.setattr(finetune, "evaluate", optimal)
    assert finetune.main(finetune.Args(problems=1, policy=str(folder))) == 0
    assert "solves all of" in capsys.readouterr().out


def test_what_cannot_be_fine_tuned_is_refused(folder):
    """What is drawn beside many problems, learning without episodes, too many joint actions."""
    with pytest.raises(ValueError, match="problems takes no landmarks"):
        finetune.Args(landmarks=CELLS, problems=2)
    for name in ("picture", "plan", "animation"):
        with pytest.raises(ValueError, match=f"problems takes no {name}"):
            finetune.Args(problems=2, **{name: folder / "out"})
    for changes in ({"imagined": 9}, {"updates_per_episode": 9}, {"patience": 9}):
        finetune.Args(landmarks=CELLS, episodes=10, **changes)
        with pytest.raises(ValueError, match=r"has no effect with episodes 9 and random_episodes"):
            finetune.Args(landmarks=CELLS, episodes=9, **changes)
    spec = network_spec("paper", 7, 2, 4, 25, 8)
    large = NetworkPolicy(build_network(spec, torch_generator(np.random.SeedSequence(0))))
    problem = mapp_env.Problem(GRID, CELLS, 7)
    with pytest.raises(ValueError, match=r"policy must be of a team with at most 1,024 joint"):
        finetune.finetune(finetune.Args(landmarks=CELLS), large, problem)


def test_a_policy_of_another_grid_is_not_fine_tuned():
    """As many cells, one wall moved: refused before anything is played."""
    other = make_grid("random", rows=5, cols=5, seed=2, density=0.1)
    policy = NetworkPolicy(untrained().network, other)
    problem = SETTING.problem(CELLS)
    with pytest.raises(ValueError, match=r"policy must be one of this grid, or of any"):
        finetune.finetune(finetune.Args(landmarks=CELLS), policy, problem)


def test_imagined_episodes_are_made_of_experienced_moves():
    """What is imagined would happen: replayed by the rules it covers all in as many steps.

    With no move known, or none that leads on, nothing is imagined; no unknown move ever is.
    """
    problem = SETTING.problem(CELLS)
    args = finetune.Args(landmarks=CELLS, imagined=64)
    tuner = finetune.Tuner(args, untrained().network, problem)
    assert tuner.imagine() is None
    rng = np.random.default_rng(0)
    env = mapp_v0.parallel_env(GRID, 2, 2, 20)
    for _ in range(3):
        tuner.run_episode(env, random=True)
    known = tuner.moves != finetune.UNKNOWN
    np.testing.assert_array_equal(tuner.moves[known], np.asarray(GRID.moves)[:, :4][known])
    for _ in range(20):
        cell, action = rng.choice(np.argwhere(tuner.moves != finetune.UNKNOWN))
        tuner.moves[cell, action] = finetune.UNKNOWN  # forgotten
        found = tuner.imagine()
        if found is None:
            continue
        actions = tuner.digits[found.joint]
        cells = found.observations[:, :2].astype(int)
        assert (tuner.moves[cells, actions] != finetune.UNKNOWN).all()
        played = replay(problem, actions)
        assert played.success
        assert played.cover_time == len(actions)


def test_solving_from_the_command_line(folder, capsys):
    """Costs beside the optimum, pictures and a plan; exit code 1 where it is not solved."""
    plan, picture, animation = folder / "plan.json", folder / "routes.png", folder / "both.gif"
    args = solve.Args(CELLS, str(folder), picture, plan, animation)
    status = solve.main(args)
    printed = capsys.readouterr().out
    loaded = Plan.load(plan)
    assert status == (0 if loaded.success else 1)
    assert f"optimum: cover time {optimal_costs(GRID, [CELLS], 2)[0]}" in printed
    assert ("policy: not solved" in printed) == (not loaded.success)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert animation.read_bytes().startswith(b"GIF")


def test_what_cannot_be_solved_is_refused(folder):
    """A wrong number of landmarks, a wall, no policy: refused by name."""
    with pytest.raises(ValueError, match="landmarks must be 2 cells for this policy, got 3"):
        solve.main(solve.Args((*CELLS, 7), str(folder)))
    wall = int(np.flatnonzero(GRID.walls.ravel())[0])
    with pytest.raises(ValueError, match=r"landmarks\[1\] must be a free cell"):
        solve.main(solve.Args((CELLS[0], wall), str(folder)))
    with pytest.raises(ValueError, match="path must be a run folder or a weights file"):
        solve.main(solve.Args(CELLS, "nonsense"))


def test_patience_begins_after_the_random_episodes(monkeypatch):
    """Only episodes played after training count as waiting, however long the random ones are."""
    problem = SETTING.problem(CELLS)
    optimum = mapp_env.solve(problem)
    monkeypatch.setattr(finetune.Tuner, "run_episode", lambda tuner, env, random: optimum)
    monkeypatch.setattr(finetune.Tuner, "train", lambda tuner: None)
    for random_episodes, patience in ((0, 1), (2, 1), (5, 3)):
        args = finetune.Args(
            landmarks=CELLS, random_episodes=random_episodes, patience=patience, episodes=20
        )
        _, n_episodes = finetune.finetune(args, untrained(), problem)
        assert n_episodes == 1 + random_episodes + patience


def test_a_searchs_best_is_not_called_the_optimum(folder, capsys):
    """Only what is proven is reported as the optimum, and only to that there is a gap."""
    problem = SETTING.problem(CELLS)
    best = mapp_env.solve(problem)
    for optimum, label in ((best, "optimum:"), (replace(best, status="feasible"), "best known:")):
        solve.report(problem, {"policy": best}, optimum)
        lines = capsys.readouterr().out.splitlines()
        assert ("gap" in lines[0]) == (label == "optimum:")
        assert lines[1].startswith(label)


def test_the_exit_code_tells_whether_it_is_solved(folder, monkeypatch):
    """0 for a policy that visits all, 1 for one that does not."""
    problem = SETTING.problem(CELLS)
    plans = {0: mapp_env.solve(problem), 1: replay(problem, [[0, 0]])}
    for code, plan in plans.items():
        monkeypatch.setattr(solve, "play", lambda *_, plan=plan: [plan])
        assert solve.main(solve.Args(CELLS, str(folder))) == code

"""Repair: what was not solved is taught from one's own episodes, and the rest stays as it was."""

import json
import os
import signal

import numpy as np
import pytest
import torch

from baselines import repair, self_improve
from baselines.networks import build_network, network_spec, split_joint, torch_generator
from baselines.policies.evaluation import evaluate, every_problem
from baselines.policies.policy import NetworkPolicy, load_policy, save_policy
from baselines.policies.settings import Setting
from baselines.repair import Args, Repaired
from mapp_env import Grid, Problem, replay

GRID = Grid.from_text("....\n.#D.\n..#.\n....")
SETTING = Setting(GRID, 2, 2, 20)
SMALL = {
    "attempts": 64,
    "problems": 32,
    "batch_size": 64,
    "taught_batch": 32,
    "updates_per_survey": 50,
    "learning_rate": 0.002,
    "evaluation_problems": 0,
}


def untrained(outputs: str = "joint"):
    """Return a network that has learned nothing."""
    spec = network_spec("pairs", 2, 2, 4, 16, 32, outputs, dueling=True, code_units=16)
    return build_network(spec, torch_generator(np.random.SeedSequence(0)))


def unsolved(network) -> np.ndarray:
    """Return the problems that a network does not solve."""
    problems = every_problem(SETTING)
    return problems[~evaluate(NetworkPolicy(network), SETTING, problems).success]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a run folder with a policy that solves most problems, not all."""
    start, path = tmp_path_factory.mktemp("start"), tmp_path_factory.mktemp("trained") / "run"
    save_policy(start / "policy.safetensors", untrained(), GRID)
    config = {
        "options": {"n_agents": 2, "n_landmarks": 2, "max_cycles": 20},
        "grid": GRID.to_text(),
        "training_problems": [[0, 3]],
    }
    (start / "config.json").write_text(json.dumps(config))
    args = self_improve.Args(
        policy=str(start),
        out=path,
        updates=400,
        problems=40,
        played_again=10,
        episodes=6,
        updates_per_round=8,
        batch_size=32,
        kept_batch=32,
        learning_rate=0.005,
        sharpness=1.0,
        alternatives=4,
        evaluation_problems=0,
    )
    assert self_improve.main(args) == 0
    return path


def test_what_is_taught_solves_what_was_not_solved(folder):
    """For every problem that is not solved, the states and actions of an episode that solves it."""
    network = load_policy(folder).network
    left = unsolved(network)
    assert 0 < len(left) < 0.6 * len(every_problem(SETTING))
    pupil = Repaired(Args(**SMALL), SETTING, network)
    pupil.survey()
    assert pupil.unsolved == len(left)
    starts = np.flatnonzero((pupil.taught_seen[:, :2] == GRID.depot).all(1))
    starts = [i for i in starts if not pupil.taught_seen[i, 4:].any()]
    solved = set()
    for first, after in zip(starts, [*starts[1:], None], strict=True):
        landmarks = pupil.taught_seen[first, 2:4].astype(int).tolist()
        actions = split_joint(pupil.taught_joint[first:after], 2, 4)
        if replay(Problem(GRID, landmarks, 2), actions).success:
            solved.add(tuple(landmarks))
    assert solved == set(map(tuple, left.tolist()))


def test_the_shortest_attempt_is_taught(folder, monkeypatch):
    """Of all attempts that solve a problem the shortest, cut at its end; of failures nothing."""
    pupil = Repaired(Args(**{**SMALL, "attempts": 3, "max_length": 6}), SETTING, untrained())
    seen = np.arange(6 * 3 * 6, dtype=np.float32).reshape(6, 3, 6)
    joint = np.arange(18).reshape(6, 3) % 16
    lengths = np.array([5, 2, 7])
    monkeypatch.setattr(repair, "play", lambda *_: (seen, joint, lengths))
    pupil.attempt(np.array([0, 3]))
    np.testing.assert_array_equal(pupil.taught_seen, seen[:2, 1])
    np.testing.assert_array_equal(pupil.taught_joint, joint[:2, 1])
    lengths = np.array([7, 7, 7])
    pupil.attempt(np.array([0, 3]))
    assert len(pupil.taught_seen) == 2


def test_the_loss_is_that_of_both_parts(folder):
    """Weight times the divergence from the anchor, plus the cross-entropy of what is taught."""
    network = load_policy(folder).network
    pupil = Repaired(Args(**{**SMALL, "anchor": 3.0}), SETTING, network)
    pupil.lesson()  # which surveys
    with torch.no_grad():
        for weights in network.head.parameters():
            weights.mul_(1.1)
    pupil.updates = 1
    state = pupil.rng.bit_generator.state
    loss = float(pupil.lesson().detach())
    pupil.rng.bit_generator.state = state
    seen = torch.from_numpy(pupil.seen[pupil.rng.integers(len(pupil.seen), size=64)])
    rows = pupil.rng.integers(len(pupil.taught_seen), size=32)
    with torch.no_grad():
        wanted, given = pupil.model(seen).log_softmax(1), network(seen).log_softmax(1)
        divergence = float((wanted.exp() * (wanted - given)).sum(1).mean())
        scores = network(torch.from_numpy(pupil.taught_seen[rows])).log_softmax(1)
        taught = -float(scores[np.arange(32), pupil.taught_joint[rows]].mean())
    assert divergence > 1e-4
    assert loss == pytest.approx(3.0 * divergence + taught, rel=1e-4)


def test_it_mends_and_leaves_the_rest(folder, tmp_path):
    """At least half is solved afterwards, and nearly all other episodes are as long as before."""
    start = load_policy(folder)
    before = evaluate(start, SETTING, every_problem(SETTING))
    # On so few problems the anchor meets those that are not solved as often as others.
    args = Args(policy=str(folder), updates=600, out=tmp_path / "run", anchor=1.0, **SMALL)
    assert repair.main(args) == 0
    after = evaluate(load_policy(tmp_path / "run"), SETTING, every_problem(SETTING))
    assert (~after.success).sum() <= 0.5 * (~before.success).sum()
    same = (after.steps == before.steps)[before.success]
    assert same.mean() > 0.7


def test_stopped_and_resumed_is_the_same(folder, tmp_path, monkeypatch):
    """Stopped by SIGTERM and resumed: the same bytes of metrics and weights."""
    options = {**SMALL, "updates": 130, "policy": str(folder), "checkpoint_seconds": 1e9}
    assert repair.main(Args(out=tmp_path / "whole", **options)) == 0
    update, calls = Repaired.update, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 71:
            os.kill(os.getpid(), signal.SIGTERM)
        return update(self)

    with monkeypatch.context() as patch:
        patch.setattr(Repaired, "update", interrupted)
        assert repair.main(Args(out=tmp_path / "run", **options)) == 143
    assert repair.main(Args(resume=tmp_path / "run")) == 0
    for name in ("metrics.csv", "policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_few_problems_are_drawn_where_there_are_too_many(monkeypatch):
    """A survey plays as many random problems as it may, when it may not play all."""
    played = []

    def noted(policy, setting, problems):
        played.append(problems)
        return evaluate(policy, setting, problems)

    monkeypatch.setattr(repair, "evaluate", noted)
    pupil = Repaired(Args(**{**SMALL, "surveyed": 10}), SETTING, untrained())
    pupil.survey()
    assert played[0].shape == (10, 2)
    assert np.isin(played[0], GRID.reachable).all()


def test_what_cannot_be_mended_is_refused():
    """Values of each agent's actions, no policy at all, bad numbers: refused by name."""
    with pytest.raises(ValueError, match="policy must be a meta-agent's with joint values"):
        Repaired(Args(**SMALL), SETTING, untrained("agents"))
    with pytest.raises(ValueError, match="policy must be the run folder of a trained meta-agent"):
        repair.main(Args())
    for name in ("attempts", "surveyed", "updates_per_survey", "taught_batch"):
        with pytest.raises(ValueError, match=f"^{name} must be"):
            Args(**{name: 0})


@pytest.mark.parametrize("half_precision", [False, True])
def test_surveyed_is_what_will_be_kept(folder, monkeypatch, half_precision):
    """The problems that are mended are those that the kept weights, rounded or not, leave."""
    network = load_policy(folder).network
    with torch.no_grad():
        for weights in network.head.parameters():
            weights.add_(torch.linspace(0, 1e-4, weights.numel()).view(weights.shape))
    expected = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    if half_precision:
        expected = {name: tensor.half().float() for name, tensor in expected.items()}
    played = []

    def noted(policy, setting, problems):
        played.append(policy.network.state_dict())
        return evaluate(policy, setting, problems)

    monkeypatch.setattr(repair, "evaluate", noted)
    args = Args(**{**SMALL, "surveyed": 10, "attempts": 3}, half_precision=half_precision)
    Repaired(args, SETTING, network).survey()
    assert all(torch.equal(played[0][name], tensor) for name, tensor in expected.items())

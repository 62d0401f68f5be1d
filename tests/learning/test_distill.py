"""Distillation: the solver's answers from any state, and a network that learns them."""

import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines import distill, independent_dqn, meta_dqn, self_improve
from baselines.learning import train
from baselines.learning.config import parse_options
from baselines.policies.evaluation import Setting, evaluate, find_optima, unseen_problems
from baselines.policies.policy import load_policy
from mapp_env import Grid, make_grid, sample_problems
from mapp_env.solvers import optimal_costs
from mapp_env.solvers.oracle.decisions import action_costs

SMALL = {
    "n_agents": 2,
    "n_landmarks": 2,
    "hidden_units": 32,
    "code_units": 16,
    "landmark_units": 8,
    "route_units": 4,
    "batch_size": 64,
    "evaluation_problems": 0,
}


@pytest.mark.parametrize(
    ("grid", "n_agents", "n_landmarks"),
    [
        (make_grid(), 3, 5),
        (make_grid(), 1, 4),
        (make_grid("rooms", rows=9, cols=8, seed=2), 4, 3),
        (make_grid("maze", rows=7, cols=9, seed=1), 2, 6),
    ],
)
def test_labels_at_the_depot_are_the_optimum(grid, n_agents, n_landmarks):
    """One step and the best that is left after it are the proven optimum of the problem."""
    landmarks = sample_problems(grid, 200, n_landmarks).astype(np.int64)
    cells = np.full((200, n_agents), grid.depot)
    steps = action_costs(grid, landmarks, np.ones(landmarks.shape, bool), cells, grid.moves)
    optimum = optimal_costs(grid, landmarks, n_agents)
    np.testing.assert_array_equal(steps.min(axis=1) + 1, optimum)


@pytest.mark.parametrize(("n_agents", "n_landmarks"), [(1, 3), (2, 3), (3, 4)])
def test_labels_are_consistent_along_any_walk(n_agents, n_landmarks):
    """What is left after an action is one step more than what is left after the best next one."""
    grid = make_grid("random", rows=6, cols=7, seed=4, density=0.25)
    rng = np.random.default_rng(n_agents)
    anywhere = np.append(grid.reachable, grid.depot)
    cells = rng.choice(anywhere, (40, n_agents))
    landmarks = sample_problems(grid, 40, n_landmarks).astype(np.int64)
    visited = (landmarks[:, :, None] == cells[:, None]).any(2) | (rng.random(landmarks.shape) < 0.3)
    steps = action_costs(grid, landmarks, ~visited, cells, grid.moves)
    for joint in range(4**n_agents):
        actions = np.array(np.unravel_index(joint, (4,) * n_agents))
        following = grid.moves[cells, actions]
        after = visited | (landmarks[:, :, None] == following[:, None]).any(2)
        left = action_costs(grid, landmarks, ~after, following, grid.moves).min(axis=1) + 1
        np.testing.assert_array_equal(steps[:, joint], np.where(after.all(axis=1), 0, left))


def test_wrong_answers_are_asked_again_until_they_are_right():
    """Just the states whose greedy action is not optimal wait, the oldest first, and come next."""
    args = distill.Args(**{**SMALL, "asked_again": 5})
    distilled = distill.Distilled(args, make_grid())
    grid = make_grid()

    def wrong(obs: np.ndarray) -> np.ndarray:
        cells, landmarks, flags = np.split(obs.astype(np.int64), (2, 4), axis=1)
        steps = action_costs(grid, landmarks, flags == 0, cells, grid.moves)
        with torch.inference_mode():
            best = distilled.network(torch.from_numpy(obs)).argmax(1).numpy()
        return steps[np.arange(len(obs)), best] > steps.min(axis=1)

    for _ in range(5):
        waiting = distilled.mistakes.copy()
        distilled.batch_loss()  # and no step, so the network stays as it is
        stays = waiting[:5][wrong(waiting[:5])] if len(waiting) else waiting
        kept = len(waiting) - len(waiting[:5])
        np.testing.assert_array_equal(distilled.mistakes[:kept], waiting[5:])
        assert wrong(distilled.mistakes).all()
        assert len(distilled.mistakes) >= kept + len(stays)
    assert len(distilled.mistakes) > 50
    for array in distilled.own_arrays()["mistakes"].values():
        assert len(array) == len(distilled.mistakes)


@pytest.mark.parametrize("decay", [0.0, 0.3])
def test_weights_decay_with_the_step_size(decay):
    """Vectors that are never looked up shrink by the step size times the decay, and only so."""
    args = distill.Args(**SMALL, weight_decay=decay, updates=4, learning_rate=0.5)
    distilled = distill.Distilled(args, make_grid())
    wall = next(cell for cell in range(49) if make_grid().walls.flat[cell])
    row = wall * 51 + wall  # an agent in a wall, and a landmark there
    start = distilled.network.pairs.weight[row].detach().clone()
    expected = start.clone()
    for update in range(4):
        rate = 0.5 * (1 - update / 4) * (update + 1) / 200  # it rises for 200 updates
        expected *= 1 - rate * decay
        distilled.advance()
    torch.testing.assert_close(distilled.network.pairs.weight[row], expected, rtol=1e-6, atol=0.0)
    assert torch.equal(expected, start) == (decay == 0.0)


@pytest.mark.parametrize("changes", [{"n_landmarks": 3}, {"n_landmarks": 2, "n_agents": 6}])
def test_what_cannot_be_taught_is_refused(changes, tmp_path):
    """More landmarks than there are cells for, or too many joint actions: before any folder."""
    (tmp_path / "grid.txt").write_text(".D.")
    args = distill.Args(
        grid=str(tmp_path / "grid.txt"), out=tmp_path / "run", **{**SMALL, **changes}
    )
    with pytest.raises(ValueError, match=r"n_landmarks must be|outputs must be"):
        distill.main(args)
    assert not (tmp_path / "run").exists()


def test_few_problems_are_all_evaluated(tmp_path):
    """Where there are fewer problems than are asked for, the table is over all of them."""
    (tmp_path / "grid.txt").write_text("..D..")
    options = {**SMALL, "updates": 3, "evaluation_problems": 1000}
    args = distill.Args(grid=str(tmp_path / "grid.txt"), out=tmp_path / "run", **options)
    assert distill.main(args) == 0
    assert "network alone,6," in (tmp_path / "run" / "evaluation.csv").read_text()


def test_it_learns_the_optimum(tmp_path):
    """On a small grid a few hundred updates solve every problem, nearly all of them optimally."""
    (tmp_path / "grid.txt").write_text("....\n.#D.\n..#.\n....")
    args = distill.Args(
        grid=str(tmp_path / "grid.txt"), updates=400, out=tmp_path / "run", max_cycles=20, **SMALL
    )
    assert distill.main(args) == 0
    setting = Setting(Grid.load(tmp_path / "grid.txt"), 2, 2, 20)
    problems = unseen_problems(setting, 78)
    result = evaluate(
        load_policy(tmp_path / "run"), setting, problems, find_optima(setting, problems)
    )
    assert result.summary()["solved %"] == 100.0
    assert result.summary()["optimal %"] > 95.0


def test_stopped_and_resumed_is_the_same(tmp_path, monkeypatch):
    """Stopped by SIGTERM and resumed: the same bytes of metrics and weights."""
    options = {**SMALL, "updates": 250, "checkpoint_seconds": 1e9}
    assert distill.main(distill.Args(out=tmp_path / "whole", **options)) == 0
    advance, calls = distill.Distilled.advance, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 137:
            os.kill(os.getpid(), signal.SIGTERM)
        return advance(self)

    with monkeypatch.context() as patch:
        patch.setattr(distill.Distilled, "advance", interrupted)
        assert distill.main(distill.Args(out=tmp_path / "run", **options)) == 143
    assert distill.main(distill.Args(resume=tmp_path / "run")) == 0
    for name in ("metrics.csv", "policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    with pytest.raises(ValueError, match="leave out seed"):
        distill.main(distill.Args(resume=tmp_path / "run", seed=1))


def test_what_is_wrong_with_a_checkpoint_is_said(tmp_path, monkeypatch, forge):
    """Without any of its parts, or deleted, it is not continued, and metrics.csv stays.

    Before that a second signal ends the training at once.
    """
    folder = tmp_path / "run"
    batch_loss, calls = distill.Distilled.batch_loss, []

    def interrupted(self):
        calls.append(None)
        for _ in range({130: 1, 131: 2}.get(len(calls), 0)):
            os.kill(os.getpid(), signal.SIGTERM)
        return batch_loss(self)

    with monkeypatch.context() as patch:
        patch.setattr(distill.Distilled, "batch_loss", interrupted)
        options = {**SMALL, "updates": 250, "checkpoint_seconds": 1e9}
        assert distill.main(distill.Args(out=folder, **options)) == 143
        assert distill.main(distill.Args(resume=folder)) == 143
    assert len(calls) == 131
    (folder / "checkpoints" / "000000000000.json").unlink()
    arrays, state = {}, {}
    forge(folder, tmp_path / "same", lambda a, s: (arrays.update(a), state.update(s)))
    assert distill.main(distill.Args(resume=tmp_path / "same")) == 0
    changes = [lambda a, s, name=name: a.pop(name) for name in arrays]
    changes += [lambda a, s, name=name: s.pop(name) for name in state]
    changes += [lambda a, s: [a.pop(n) for n in arrays if n.startswith("optimiser.")]]
    changes += [lambda a, s: s.update(updates=129), lambda a, s: s["losses"].pop()]
    for index, change in enumerate(changes):
        copy = forge(folder, tmp_path / str(index), change)
        with pytest.raises(ValueError, match=r"^checkpoint 130 does not fit this run: "):
            distill.main(distill.Args(resume=copy))
        assert (copy / "metrics.csv").read_bytes() == (folder / "metrics.csv").read_bytes()
    for path in (folder / "checkpoints").iterdir():
        path.unlink()
    with pytest.raises(ValueError, match=r"checkpoints to go on from are gone"):
        distill.main(distill.Args(resume=folder))
    assert len((folder / "metrics.csv").read_text().splitlines()) == 2


@pytest.mark.parametrize("script", [distill, self_improve, meta_dqn, independent_dqn])
def test_a_resumed_run_takes_no_options(script, monkeypatch):
    """On the command line not even one with its default: the run may have another."""
    monkeypatch.setattr(sys, "argv", ["script", "--resume", "run", "--seed", "0"])
    with pytest.raises(ValueError, match=r"resume goes on with the run's own options.* seed$"):
        parse_options(script.Args, "")
    monkeypatch.setattr(sys, "argv", ["script", "--resume", "run"])
    assert parse_options(script.Args, "").resume == Path("run")


@pytest.mark.parametrize(
    ("script", "former", "name"),
    [
        (meta_dqn, "--huber", "huber_delta"),
        (self_improve, "--sharpness", "inverse_temperature"),
    ],
)
@pytest.mark.parametrize("words", ["{} 0.25", "{}=0.25"])
def test_former_names_of_options_are_understood(script, former, name, words):
    """Commands that were documented before an option was renamed still say the same."""
    options = parse_options(script.Args, "", words.format(former).split())
    assert getattr(options, name) == 0.25


def test_it_goes_on_from_a_policy(tmp_path, monkeypatch):
    """With its weights, to the bit, even if it is gone later.

    Another network is refused, and so is the same one of another grid.
    """
    first, options = tmp_path / "first", {**SMALL, "updates": 10}
    assert distill.main(distill.Args(out=first, **options, half_precision=False)) == 0
    start = load_policy(first).network.state_dict()
    with pytest.raises(ValueError, match="policy must have the network"):
        distill.main(distill.Args(policy=str(first), **{**options, "hidden_units": 33}))
    (tmp_path / "other.txt").write_text(make_grid().to_text().replace("...#...", "..#...."))
    other = {**options, "grid": str(tmp_path / "other.txt"), "policy": str(first)}
    with pytest.raises(ValueError, match="policy must be one of this grid"):
        distill.main(distill.Args(**other))
    further = {**options, "policy": str(first), "seed": 1}
    assert distill.main(distill.Args(out=tmp_path / "whole", **further)) == 0

    def killed(training, *others):
        for name, tensor in training.network.state_dict().items():
            assert torch.equal(tensor, start[name])
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(train, "train", killed)
        with pytest.raises(ZeroDivisionError):
            distill.main(distill.Args(out=tmp_path / "run", **further))
    for path in first.glob("*.*"):
        path.unlink()
    assert distill.main(distill.Args(resume=tmp_path / "run")) == 0
    for name in ("metrics.csv", "policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_too_many_mistakes_forget_the_oldest(monkeypatch):
    """Where more answers are wrong than may wait, those that have waited longest are dropped."""
    monkeypatch.setattr(distill, "MAX_MISTAKES", 30)
    distilled = distill.Distilled(distill.Args(**{**SMALL, "asked_again": 5}), make_grid())
    distilled.batch_loss()
    for _ in range(3):
        waiting = distilled.mistakes.copy()
        assert len(waiting) == 30
        distilled.batch_loss()
        # Of a batch of 64 more than 30 answers are wrong, so that all that waits is new.
        old = {tuple(row) for row in waiting[5:].tolist()}
        assert sum(tuple(row) in old for row in distilled.mistakes.tolist()) < 5


def test_the_last_update_still_teaches():
    """The step size falls in a straight line, and reaches 0 only when all updates are done."""
    distilled = distill.Distilled(distill.Args(**SMALL, updates=4, learning_rate=0.5), make_grid())
    for _ in range(4):
        before = [weights.detach().clone() for weights in distilled.network.parameters()]
        distilled.advance()
        after = distilled.network.parameters()
        assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("half_precision", [False, True])
def test_a_run_starts_with_its_policys_own_weights(tmp_path, monkeypatch, half_precision):
    """What it may have to start from again is kept to the bit, however the end is kept."""
    kept = []

    def noted(training, grid, run, *others):
        start = load_policy(run.folder).network.state_dict()
        kept.append([torch.equal(start[k], v) for k, v in training.network.state_dict().items()])
        raise ZeroDivisionError

    monkeypatch.setattr(train, "train", noted)
    args = distill.Args(out=tmp_path / "run", half_precision=half_precision, **SMALL)
    with pytest.raises(ZeroDivisionError):
        distill.main(args)
    assert all(kept[0])

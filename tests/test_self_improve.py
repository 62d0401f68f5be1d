"""Self-improvement: what is taught is what turned out best among what was tried, and it helps."""

import copy
import json
import os
import signal

import numpy as np
import pytest
import torch

from baselines import distill, imitation, self_improve
from baselines.distill import Distilled
from baselines.evaluation import evaluate, find_optima, unseen_problems
from baselines.networks import NetworkSpec, build_network, split_joint, torch_generator
from baselines.policy import NetworkPolicy, load_policy, save_policy
from baselines.self_improve import Args, Lessons, NewestLessons, SelfImproved
from baselines.settings import Setting
from mapp_env import Grid, Problem, mapp_v0, replay

GRID = Grid.from_text("....\n.#D.\n..#.\n....")
SETTING = Setting(GRID, 2, 2, 20)
SMALL = {
    "problems": 60,
    "tried_problems": 40,
    "played_again": 10,
    "updates_per_round": 8,
    "batch_size": 32,
    "tried_batch": 32,
    "mistakes_batch": 32,
    "learning_starts": 50,
    "kept_states": 500,
    "kept_mistakes": 100,
    "learning_rate": 0.005,
    "evaluation_problems": 0,
    "sharpness": 1.0,
    "alternatives": 4,
    "others": 2,
    "averaging": 0.02,
}


def untrained(outputs: str = "joint"):
    """Return a network that has learned nothing."""
    spec = NetworkSpec("pairs", 2, 2, 4, 16, 32, outputs, dueling=True, code_units=16)
    return build_network(spec, torch_generator(np.random.SeedSequence(0)))


@pytest.fixture(scope="module")
def half_trained():
    """Return a network that solves some problems, not all of them in the best way."""
    options = {"n_agents": 2, "n_landmarks": 2, "hidden_units": 32, "code_units": 16}
    pupil = Distilled(distill.Args(**options, batch_size=64, updates=1000), GRID)
    for _ in range(60):
        pupil.update()
    return pupil.network


@pytest.fixture
def folder(tmp_path):
    """Return a run folder with an untrained policy."""
    path = tmp_path / "start"
    path.mkdir()
    save_policy(path / "policy.safetensors", untrained())
    config = {
        "options": {"n_agents": 2, "n_landmarks": 2, "max_cycles": 20},
        "grid": GRID.to_text(),
        "training_problems": [[0, 3]],
    }
    (path / "config.json").write_text(json.dumps(config))
    return path


@pytest.mark.parametrize("exploration", [0.0, 0.4])
def test_episodes_are_what_the_rules_make_of_them(half_trained, exploration):
    """Lengths are those of replayed actions, which are greedy but for the share that explores."""
    pupil = SelfImproved(Args(**{**SMALL, "exploration": exploration}), SETTING, half_trained)
    landmarks = unseen_problems(SETTING, 40)
    observations, joint, lengths = pupil.episodes(landmarks)
    actions = split_joint(joint, 2, 4)
    given_up = greedy = played = 0
    for row, length in enumerate(lengths):
        problem = Problem(GRID, landmarks[row].tolist(), 2)
        plan = replay(problem, actions[:length, row])
        assert plan.cover_time == length if plan.success else length == pupil.args.max_length
        given_up += not plan.success
        assert not observations[length:, row].any()
        assert observations[:length, row, 2:4].tolist() == [landmarks[row].tolist()] * length
        best = pupil.scores(observations[:length, row]).argmax(axis=1)
        greedy += (best == joint[:length, row]).sum()
        played += length
    assert 0 < given_up < 40
    # A random action is the greedy one in a sixteenth of the cases.
    assert greedy / played == pytest.approx(1 - exploration * 15 / 16, abs=0.08)
    assert exploration or greedy == played


@pytest.mark.parametrize("alternatives", [2, 7, 16])
def test_best_actions_are_those_after_which_all_is_visited_soonest(half_trained, alternatives):
    """Of the likeliest actions; found again one by one, through the rules of the scalar env."""
    changes = {
        "problems": 6,
        "alternatives": alternatives,
        "others": 0,
        "tried_problems": 5,
        "played_again": 5,
    }
    pupil = SelfImproved(Args(**{**SMALL, **changes, "exploration": 0.3}), SETTING, half_trained)
    env = mapp_v0.parallel_env(GRID, 2, 2, pupil.args.max_length)
    landmarks = unseen_problems(SETTING, 6)
    observations, joint, lengths = pupil.episodes(landmarks)
    times, problems = np.nonzero(np.arange(len(observations))[:, None] < lengths)
    seen = observations[times, problems]
    lessons = pupil.best_actions(landmarks, joint, times, problems, seen)
    assert len(lessons.seen) == len(seen) > 30
    policy = NetworkPolicy(pupil.network)
    n_good = []
    for row, (time, problem) in enumerate(zip(times, problems, strict=True)):
        likely = np.sort(pupil.scores(seen[row : row + 1])[0].argsort()[-alternatives:])
        steps = {}
        for action in likely.tolist():
            commands = [*split_joint(joint[:time, problem], 2, 4), *split_joint([action], 2, 4)]
            here, _ = env.reset(options={"landmarks": landmarks[problem].tolist()})
            step = 0
            while env.agents:
                if step >= len(commands):
                    commands.append(policy.act(here["agent_0"][None])[0])
                if step == time:
                    np.testing.assert_array_equal(here["agent_0"], seen[row])
                chosen = dict(zip(env.agents, commands[step].tolist(), strict=True))
                here, _, terminated, _, _ = env.step(chosen)
                step += 1
            steps[action] = step if terminated["agent_0"] else 99
        least = min(min(steps.values()), 98)
        expected = [action for action, count in steps.items() if count == least]
        assert np.flatnonzero(lessons.good[row]).tolist() == expected
        n_good.append(len(expected))
    assert 0 in n_good or alternatives == 16
    assert max(n_good) > 1


@pytest.mark.parametrize(("alternatives", "others"), [(4, 2), (5, 0), (16, 3), (2, 20)])
def test_the_likeliest_are_tried_and_random_others(alternatives, others):
    """Each once; all others have their turn sooner or later."""
    args = Args(**{**SMALL, "alternatives": alternatives, "others": others})
    pupil = SelfImproved(args, SETTING, untrained())
    scores = np.random.default_rng(0).normal(size=(2000, 16)).astype(np.float32)
    tried = pupil.tried(scores)
    assert tried.shape == (2000, min(alternatives + others, 16))
    assert (np.diff(np.sort(tried, axis=1), axis=1) > 0).all()
    ranks = np.argsort(np.argsort(-scores, axis=1), axis=1)
    chosen = np.take_along_axis(ranks, tried, axis=1)
    assert (np.sort(chosen, axis=1)[:, :alternatives] == np.arange(min(alternatives, 16))).all()
    if others:
        counts = np.bincount(chosen.ravel(), minlength=16)[alternatives:]
        expected = 2000 * min(others / (16 - alternatives), 1) if alternatives < 16 else 0
        np.testing.assert_allclose(counts, expected, rtol=0.2)


def played_by_hand(monkeypatch, lengths, good, **changes):
    """Return a pupil whose episodes and best actions are given: greedy is always action 0."""
    pupil = SelfImproved(
        Args(**{**SMALL, "problems": len(lengths), "tried_problems": len(lengths), **changes}),
        SETTING,
        untrained(),
    )
    seen = np.arange(3 * len(lengths), dtype=np.float32).reshape(3, -1, 1).repeat(6, axis=2)
    played = []

    def episodes(landmarks):
        played.append(landmarks.tolist())
        return seen, np.zeros(seen.shape[:2], np.int64), np.array(lengths)

    def best_actions(landmarks, joint, times, problems, seen):
        rows = np.array(
            [good[problem][time] for time, problem in zip(times, problems, strict=True)]
        )
        marked = np.zeros((len(seen), 16), np.bool_)
        marked[np.flatnonzero(rows >= 0), rows[rows >= 0]] = True
        return Lessons(seen, marked)

    monkeypatch.setattr(pupil, "episodes", episodes)
    monkeypatch.setattr(pupil, "best_actions", best_actions)
    monkeypatch.setattr(pupil, "scores", lambda seen: np.eye(16)[np.zeros(len(seen), int)])
    return pupil, played


def test_what_is_kept_of_a_round(monkeypatch):
    """States in which something is good; as mistakes those in which the greedy action is not."""
    # Of each problem what is good in its states, -1 for nothing; the third state of 1 never was.
    good = [[0, 3, 0], [0, 5], [-1, -1, 2]]
    pupil, played = played_by_hand(monkeypatch, [3, 2, 3], good, played_again=1)
    pupil.play()
    kept, mistakes = (
        lessons.rows.where(slice(len(lessons))) for lessons in (pupil.kept, pupil.mistakes)
    )
    assert sorted(kept.seen[:, 0]) == [0, 1, 3, 4, 6, 8]
    assert sorted(zip(mistakes.seen[:, 0], mistakes.good.argmax(axis=1), strict=True)) == [
        (3, 3),
        (4, 5),
        (8, 2),
    ]
    assert pupil.again.tolist() == played[0]


def test_problems_come_again_until_nothing_is_mistaken(monkeypatch):
    """Those with a mistake wait, the oldest first, and so many of them are played each time."""
    good = [[0], [1], [2], [3]]
    pupil, played = played_by_hand(monkeypatch, [1, 1, 1, 1], good, played_again=2)
    pupil.play()
    _, first, second, third = played[0]
    assert pupil.again.tolist() == [first, second, third]
    good[:] = [[0], [1], [0], [0]]
    pupil.play()
    assert played[1][:2] == [first, second]
    assert pupil.again.tolist() == [third, second]
    good[:] = [[0], [0], [0], [0]]
    pupil.play()
    assert played[2][:2] == [third, second]
    assert not len(pupil.again)


def test_a_policy_that_solves_nothing_is_refused(monkeypatch):
    """Where no try ends, there is nothing to be taught."""
    pupil, _ = played_by_hand(monkeypatch, [3], [[-1, -1, -1]], played_again=1)
    with pytest.raises(ValueError, match="it solves no problem within max_length"):
        pupil.play()


def test_loss_is_the_probability_of_a_good_action():
    """Minus its logarithm, by hand: two of four actions are good."""
    scores = torch.log(torch.tensor([[0.1, 0.2, 0.3, 0.4]]))
    good = torch.tensor([[False, True, False, True]])
    assert float(imitation.good_actions_loss(scores, good)) == pytest.approx(-np.log(0.6))


def test_the_average_plays(half_trained):
    """It starts as the network, goes a share of the way to it with each update, and scores."""
    pupil = SelfImproved(Args(**{**SMALL, "averaging": 0.25}), SETTING, copy.deepcopy(half_trained))
    seen = np.zeros((1, 6), np.float32)
    mean = pupil.network.hidden.weight.detach().clone()
    assert torch.equal(pupil.player.hidden.weight, mean)
    for _ in range(3):
        pupil.update()
        mean += 0.25 * (pupil.network.hidden.weight.detach() - mean)
        torch.testing.assert_close(pupil.player.hidden.weight, mean)
    assert not torch.equal(pupil.network.hidden.weight, mean)
    with torch.inference_mode():
        scores = pupil.player(torch.from_numpy(seen)).numpy()
    np.testing.assert_array_equal(pupil.scores(seen), scores)


@pytest.mark.parametrize("at_a_time", [3, 7])
def test_a_full_memory_forgets_the_oldest(at_a_time):
    """The newest lessons are kept, as many as there is room for, and go through a checkpoint."""
    pupil = SelfImproved(Args(**SMALL), SETTING, untrained())
    newest = NewestLessons(5, pupil.spec)
    assert not len(newest.draw(4, pupil.rng).seen)
    for first in range(0, 3 * at_a_time, at_a_time):
        numbers = np.arange(first, first + at_a_time) % 16
        marks = np.eye(16, dtype=np.bool_)[numbers]
        newest.add(Lessons(np.repeat(numbers[:, None], 6, axis=1), marks))
    other = NewestLessons(5, pupil.spec)
    other.restore(newest.arrays())
    expected = sorted(n % 16 for n in range(3 * at_a_time - 5, 3 * at_a_time))
    for lessons in (newest, other):
        assert sorted(lessons.rows.seen[:, 0]) == expected
        assert sorted(lessons.rows.good.argmax(axis=1)) == expected
        assert set(lessons.draw(50, pupil.rng).seen[:, 0]) == set(expected)


def test_it_improves(folder, tmp_path):
    """On a small grid, from an untrained policy, nearly all problems are solved optimally."""
    args = Args(policy=str(folder), updates=1000, out=tmp_path / "run", **SMALL)
    problems = unseen_problems(SETTING, 78)
    optima = find_optima(SETTING, problems)
    before = evaluate(load_policy(folder), SETTING, problems, optima).summary()
    assert self_improve.main(args) == 0
    after = evaluate(load_policy(tmp_path / "run"), SETTING, problems, optima).summary()
    assert before["optimal %"] < 50
    assert after["solved %"] > 95
    assert after["optimal %"] > 85


def test_stopped_and_resumed_is_the_same(folder, tmp_path, monkeypatch):
    """Stopped by SIGTERM and resumed: the same bytes of metrics and weights."""
    options = {**SMALL, "updates": 150, "policy": str(folder), "checkpoint_seconds": 1e9}
    assert self_improve.main(Args(out=tmp_path / "whole", **options)) == 0
    update, calls = SelfImproved.update, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 61:
            os.kill(os.getpid(), signal.SIGTERM)
        return update(self)

    with monkeypatch.context() as patch:
        patch.setattr(SelfImproved, "update", interrupted)
        assert self_improve.main(Args(out=tmp_path / "run", **options)) == 143
    assert self_improve.main(Args(resume=tmp_path / "run")) == 0
    for name in ("metrics.csv", "policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    with pytest.raises(ValueError, match="leave out all others"):
        self_improve.main(Args(resume=tmp_path / "run", seed=1))


def test_what_cannot_be_improved_is_refused():
    """Values of each agent's actions, and no policy at all: refused by name."""
    with pytest.raises(ValueError, match="policy must be a meta-agent's with joint values"):
        SelfImproved(Args(**SMALL), SETTING, untrained("agents"))
    with pytest.raises(ValueError, match="policy must be the run folder of a trained meta-agent"):
        self_improve.main(Args())


def test_sharpness_changes_no_greedy_action():
    """Values read as logits: only how likely the other actions are depends on the sharpness."""
    observations = np.zeros((50, 6), np.float32)
    observations[:, :4] = np.random.default_rng(0).integers(16, size=(50, 4))
    network = untrained()
    before = NetworkPolicy(network).act(observations)
    with torch.no_grad():
        values = network(torch.from_numpy(observations))
        self_improve.sharpen(network, 9.0)
        torch.testing.assert_close(network(torch.from_numpy(observations)), 9.0 * values)
    np.testing.assert_array_equal(NetworkPolicy(network).act(observations), before)


def test_a_run_needs_nothing_but_its_folder(folder, tmp_path, monkeypatch):
    """Killed before its first checkpoint, its start gone: it begins again from its own copy."""
    options = {**SMALL, "updates": 20, "policy": str(folder), "sharpness": 3.0}
    assert self_improve.main(Args(out=tmp_path / "whole", **options)) == 0

    def killed(*arguments):
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(imitation, "train", killed)
        with pytest.raises(ZeroDivisionError):
            self_improve.main(Args(out=tmp_path / "run", **options))
    for path in folder.iterdir():
        path.unlink()
    assert self_improve.main(Args(resume=tmp_path / "run")) == 0
    for name in ("metrics.csv", "policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    (tmp_path / "run" / "checkpoints" / "000000000020.safetensors").write_bytes(b"damaged")
    with pytest.raises(ValueError, match="checkpoint"):
        self_improve.main(Args(resume=tmp_path / "run"))

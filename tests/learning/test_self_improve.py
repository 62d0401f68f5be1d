"""Self-improvement: what is taught is the shortest of one's own episodes, and it helps."""

import json
import os
import signal

import numpy as np
import pytest
import torch

from baselines import self_improve
from baselines.learning import train
from baselines.learning.imitation import good_actions_loss
from baselines.networks import build_network, network_spec, split_joint, torch_generator
from baselines.policies.episodes import draw_problems, make_envs, rollout
from baselines.policies.evaluation import evaluate, find_optima, unseen_problems
from baselines.policies.policy import NetworkPolicy, load_policy, save_policy
from baselines.policies.settings import Setting
from baselines.self_improve import Args, Labelled, SelfImproved
from mapp_env import Grid, Problem, mapp_v0, replay

GRID = Grid.from_text("....\n.#D.\n..#.\n....")
SETTING = Setting(GRID, 2, 2, 20)
SMALL = {
    "problems": 40,
    "played_again": 10,
    "episodes": 6,
    "updates_per_round": 8,
    "batch_size": 32,
    "kept_batch": 32,
    "kept_states": 500,
    "learning_rate": 0.005,
    "evaluation_problems": 0,
    "inverse_temperature": 1.0,
    "alternatives": 4,
}


def untrained(outputs: str = "joint"):
    """Return a network that has learned nothing."""
    spec = network_spec("pairs", 2, 2, 4, 16, 32, outputs, dueling=True, code_units=16)
    return build_network(spec, torch_generator(np.random.SeedSequence(0)))


@pytest.fixture
def folder(tmp_path):
    """Return a run folder with an untrained policy."""
    path = tmp_path / "start"
    path.mkdir()
    save_policy(path / "policy.safetensors", untrained(), GRID)
    config = {
        "options": {"n_agents": 2, "n_landmarks": 2, "max_cycles": 20},
        "grid": GRID.to_text(),
        "training_problems": [[0, 3]],
    }
    (path / "config.json").write_text(json.dumps(config))
    return path


def test_episodes_are_what_the_rules_make_of_them():
    """Lengths are those of replayed actions; every so-many-th episode is the greedy policy's."""
    learner = SelfImproved(Args(**SMALL), SETTING, untrained())
    drawn = unseen_problems(SETTING, 40)
    landmarks = np.repeat(drawn, 6, axis=0)
    observations, joint, lengths = learner.episodes(landmarks)
    actions = split_joint(joint, 2, 4)
    unsolved = lengths > learner.args.max_length
    assert 0 < unsolved.sum() < len(lengths)
    for row in range(len(lengths)):
        problem = Problem(GRID, landmarks[row].tolist(), 2)
        played = replay(problem, actions[: min(lengths[row], len(actions)), row])
        assert played.success == (not unsolved[row])
        if played.success:
            assert played.cover_time == lengths[row]
            assert not observations[lengths[row] :, row].any()
    with torch.inference_mode():
        for step, obs in enumerate(observations):
            going_on = np.flatnonzero((np.arange(len(lengths)) % 6 == 0) & (lengths > step))
            greedy = learner.network(torch.from_numpy(obs[going_on])).argmax(1).numpy()
            np.testing.assert_array_equal(joint[step, going_on], greedy)
    assert len(np.unique(joint[0, 1:6])) > 1  # the others are drawn


def test_the_shortest_episode_is_taught(monkeypatch):
    """Of equally short ones the greedy one; only what is shorter than the greedy one is kept."""
    args = Args(**{**SMALL, "problems": 3, "episodes": 3, "max_length": 4, "played_again": 1})
    learner = SelfImproved(args, SETTING, untrained())
    # Problem 0: all alike; 1: the third is shortest; 2: nobody has solved it.
    lengths = np.array([2, 2, 2, 4, 3, 1, 5, 5, 5])
    joint = np.arange(4 * 9).reshape(4, 9) % 16
    obs = np.repeat(np.arange(36, dtype=np.float32).reshape(4, 9, 1), 6, axis=2)
    asked = []

    def label(landmarks, observations, joint, lengths, chosen):
        asked.append(np.argwhere(chosen).tolist())
        return Labelled(observations[chosen], np.ones((chosen.sum(), 16), bool))

    monkeypatch.setattr(learner, "episodes", lambda landmarks: (obs, joint, lengths))
    monkeypatch.setattr(learner, "label", label)
    learner.play_round()
    assert learner.fresh.obs[:, 0].tolist() == [0, 5, 9]
    assert learner.fresh.good.sum(axis=1).tolist() == [1, 1, 1]
    taught = learner.fresh.good.argmax(axis=1).tolist()
    assert taught == [joint[0, 0], joint[0, 5], joint[1, 0]]
    assert asked == [[[0, 1]]]
    assert learner.n_kept == 1
    assert learner.kept.obs[0, 0] == 5
    # The one that nobody has solved comes again as well.
    assert len(learner.again) == 2
    lengths[:] = 5
    with pytest.raises(ValueError, match="it solves no problem within max_length"):
        learner.play_round()


@pytest.mark.parametrize("alternatives", [1, 7, 16])
def test_good_actions_are_those_that_are_as_short(alternatives):
    """Of the likeliest actions just those after which the greedy policy is through in time.

    Found again one by one, through the rules. The action that was taken always counts.
    """
    changes = {"problems": 5, "episodes": 40, "alternatives": alternatives, "played_again": 5}
    learner = SelfImproved(Args(**{**SMALL, **changes}), SETTING, untrained())
    env = mapp_v0.parallel_env(GRID, 2, 2, 20)
    landmarks = unseen_problems(SETTING, 5)
    observations, joint, lengths = learner.episodes(np.repeat(landmarks, 40, axis=0))
    best = lengths.reshape(5, 40).argmin(axis=1) + 40 * np.arange(5)
    observations, joint, lengths = observations[:, best], joint[:, best], lengths[best]
    steps = np.arange(len(joint))[:, None]
    chosen = (steps < lengths) & (lengths <= learner.args.max_length)
    labelled = learner.label(landmarks, observations, joint, lengths, chosen)
    room = learner.envs.num_envs // alternatives
    assert len(labelled.obs) == min(chosen.sum(), room)
    policy = NetworkPolicy(learner.network)
    other = 0
    for (time, problem), obs, good in zip(np.argwhere(chosen), *labelled, strict=False):
        np.testing.assert_array_equal(obs, observations[time, problem])
        assert good[joint[time, problem]]
        with torch.inference_mode():
            likely = learner.network(torch.from_numpy(obs[None]))[0].topk(alternatives).indices
        for action in range(16):
            if action == joint[time, problem]:
                continue
            commands = [*split_joint(joint[:time, problem], 2, 4), *split_joint([action], 2, 4)]
            here, _ = env.reset(options={"landmarks": landmarks[problem].tolist()})
            for step in range(lengths[problem]):
                if not env.agents:
                    break
                if step >= len(commands):
                    commands.append(policy.act(here["agent_0"][None])[0])
                chosen_actions = dict(zip(env.agents, commands[step].tolist(), strict=True))
                here, _, terminated, _, _ = env.step(chosen_actions)
            as_short = terminated["agent_0"]
            assert good[action] == (as_short and action in likely.tolist())
            other += good[action]
    assert other or alternatives == 1


def test_loss_is_the_probability_of_a_good_action():
    """Minus its logarithm, by hand: two of four actions are good."""
    scores = torch.log(torch.tensor([[0.1, 0.2, 0.3, 0.4]]))
    good = torch.tensor([[False, True, False, True]])
    assert float(good_actions_loss(scores, good)) == pytest.approx(-np.log(0.6))


@pytest.mark.parametrize(("drawn", "bolder"), [(10, True), (11, True), (12, False)])
def test_it_draws_as_boldly_as_it_should(monkeypatch, drawn, bolder):
    """Where drawn episodes are hardly longer than greedy ones, the next ones are drawn bolder."""
    args = Args(**{**SMALL, "problems": 2, "episodes": 2, "detour": 0.15, "played_again": 1})
    learner = SelfImproved(args, SETTING, untrained())
    lengths = np.array([10, drawn, 10, drawn])
    obs, joint = np.zeros((12, 4, 6), np.float32), np.zeros((12, 4), np.int64)
    monkeypatch.setattr(learner, "episodes", lambda landmarks: (obs, joint, lengths))
    learner.play_round()
    assert (learner.inverse_temperature < 1) == bolder


def test_problems_come_again_until_the_greedy_episode_is_shortest(monkeypatch):
    """Those where it was not wait, the oldest first, and so many of them are played each time."""
    args = Args(**{**SMALL, "problems": 4, "episodes": 2, "played_again": 2})
    learner = SelfImproved(args, SETTING, untrained())
    obs, joint = np.zeros((9, 8, 6), np.float32), np.zeros((9, 8), np.int64)
    played = []

    def episodes(landmarks):
        played.append(landmarks[::2].tolist())
        return obs, joint, np.array(lengths)

    monkeypatch.setattr(learner, "episodes", episodes)
    monkeypatch.setattr(learner, "label", lambda *_: Labelled.empty(0, learner.spec))
    lengths = [3, 2, 3, 3, 9, 1, 4, 2]
    learner.play_round()
    first, second, third = (played[0][i] for i in (0, 2, 3))
    assert learner.again.tolist() == [first, second, third]
    lengths = [3, 3, 3, 2, 3, 3, 3, 3]
    learner.play_round()
    assert played[1][:2] == [first, second]
    assert learner.again.tolist() == [third, second]
    lengths = [3, 3] * 4
    learner.play_round()
    assert played[2][:2] == [third, second]
    assert not len(learner.again)


def test_a_full_memory_forgets_the_oldest():
    """The newest states are kept, as many as there is room for."""
    learner = SelfImproved(Args(**{**SMALL, "kept_states": 5}), SETTING, untrained())
    for first in (0, 3, 6):
        numbers = np.arange(first, first + 3)
        learner.keep(
            Labelled(np.repeat(numbers[:, None], 6, axis=1), np.eye(16, dtype=bool)[numbers])
        )
    assert sorted(learner.kept.good.argmax(axis=1)) == [4, 5, 6, 7, 8]
    assert sorted(learner.kept.obs[:, 0]) == [4, 5, 6, 7, 8]


def test_it_improves(folder, tmp_path):
    """On a small grid, from an untrained policy, nearly all problems are solved optimally."""
    args = Args(policy=str(folder), updates=600, out=tmp_path / "run", **SMALL)
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
    advance, calls = SelfImproved.advance, []

    def interrupted(self):
        calls.append(None)
        if len(calls) == 61:
            os.kill(os.getpid(), signal.SIGTERM)
        return advance(self)

    with monkeypatch.context() as patch:
        patch.setattr(SelfImproved, "advance", interrupted)
        assert self_improve.main(Args(out=tmp_path / "run", **options)) == 143
    assert self_improve.main(Args(resume=tmp_path / "run")) == 0
    for name in ("metrics.csv", "policy.safetensors"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    with pytest.raises(ValueError, match="leave out seed"):
        self_improve.main(Args(resume=tmp_path / "run", seed=1))


def test_what_cannot_be_improved_is_refused():
    """Values of each agent's actions, and no policy at all: refused by name."""
    with pytest.raises(ValueError, match="policy must be a meta-agent's with joint values"):
        SelfImproved(Args(**SMALL), SETTING, untrained("agents"))
    with pytest.raises(ValueError, match="policy must be the run folder of a trained meta-agent"):
        self_improve.main(Args())


def test_scaling_changes_no_greedy_action():
    """Values read as logits: only how likely the other actions are depends on the factor."""
    observations = np.zeros((50, 6), np.float32)
    observations[:, :4] = np.random.default_rng(0).integers(16, size=(50, 4))
    network = untrained()
    before = NetworkPolicy(network).act(observations)
    with torch.no_grad():
        values = network(torch.from_numpy(observations))
        self_improve.scale_outputs(network, 9.0)
        torch.testing.assert_close(network(torch.from_numpy(observations)), 9.0 * values)
    np.testing.assert_array_equal(NetworkPolicy(network).act(observations), before)


def test_a_run_needs_nothing_but_its_folder(folder, tmp_path, monkeypatch):
    """Killed before its first checkpoint, its start gone: it begins again from its own copy.

    Killed before that copy was written, it begins again from the policy that it was given.
    """
    options = {**SMALL, "updates": 20, "policy": str(folder), "inverse_temperature": 3.0}
    assert self_improve.main(Args(out=tmp_path / "whole", **options)) == 0

    def killed(*arguments):
        raise ZeroDivisionError

    for name in ("save_policy", "train"):
        with monkeypatch.context() as patch:
            patch.setattr(train, name, killed)
            with pytest.raises(ZeroDivisionError):
                self_improve.main(Args(out=tmp_path / name, **options))
    assert self_improve.main(Args(resume=tmp_path / "save_policy")) == 0
    for path in folder.iterdir():
        path.unlink()
    assert self_improve.main(Args(resume=tmp_path / "train")) == 0
    for run in ("save_policy", "train"):
        for name in ("metrics.csv", "policy.safetensors"):
            assert (tmp_path / run / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    (tmp_path / "train" / "checkpoints" / "000000000020.safetensors").write_bytes(b"damaged")
    with pytest.raises(ValueError, match="checkpoint"):
        self_improve.main(Args(resume=tmp_path / "train"))


def test_what_no_episode_solves_comes_again(monkeypatch):
    """Problems that were given up, and those with a shorter episode, come again; others do not."""
    args = Args(**{**SMALL, "problems": 3, "played_again": 3, "episodes": 2, "max_length": 6})
    learner = SelfImproved(args, SETTING, untrained())
    played = []
    obs, joint = np.zeros((7, 6, 6), np.float32), np.zeros((7, 6), np.int64)

    def episodes(landmarks):
        played.append(landmarks[::2].tolist())
        return obs, joint, np.array([7, 7, 3, 3, 4, 2])

    monkeypatch.setattr(learner, "episodes", episodes)
    monkeypatch.setattr(learner, "label", lambda *_: Labelled.empty(0, learner.spec))
    learner.play_round()
    assert learner.again.tolist() == [played[0][0], played[0][2]]


def test_the_table_is_over_problems_never_trained_on(folder, tmp_path, monkeypatch):
    """What the policy was trained on to begin with is none of the problems evaluated."""
    config = json.loads((folder / "config.json").read_text())
    rows = GRID.reachable.tolist()
    config["training_problems"] = [[a, b] for a in rows[:6] for b in rows if a < b]
    (folder / "config.json").write_text(json.dumps(config))
    seen = {tuple(sorted(row)) for row in config["training_problems"]}
    played = []

    def noted(policy, setting, problems, *others, **more):
        played.append({tuple(row) for row in problems.tolist()})
        return evaluate(policy, setting, problems, *others, **more)

    monkeypatch.setattr(train, "evaluate", noted)
    options = {**SMALL, "evaluation_problems": 10, "updates": 2}
    assert self_improve.main(Args(policy=str(folder), out=tmp_path / "run", **options)) == 0
    assert len(played[0]) == 10
    assert not played[0] & seen


def test_two_problems_of_two_landmarks_are_played():
    """Episodes are those of the problems given, also where these could mean pairs."""
    landmarks = draw_problems(GRID.reachable, SETTING.n_landmarks, 3, np.random.default_rng(0))
    network, lengths = untrained(), []
    for count in (2, 3):
        envs = make_envs(SETTING, count, 30)
        greedy, rng = np.ones(count, bool), np.random.default_rng(0)
        lengths.append(rollout(envs, network, landmarks[:count], 30, 1.0, greedy, rng).lengths)
    assert lengths[0].tolist() == lengths[1][:2].tolist()

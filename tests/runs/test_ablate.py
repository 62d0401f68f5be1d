"""The ablation: every variant is the default preset but for one component."""

import csv
from dataclasses import asdict

import pytest
import torch

from baselines import ablate, meta_dqn
from baselines.ablate import VARIANTS, Args
from baselines.learning.config import parse_options
from baselines.learning.training import Streams
from mapp_env import make_grid

WORDS = [
    *("--n-problems", "1", "--episodes-per-problem", "4", "--max-cycles", "15"),
    *("--learning-starts", "10", "--updates-per-episode", "2", "--batch-size", "8"),
    *("--evaluation-problems", "30"),
]


def test_every_variant_changes_one_component():
    """Each variant's options are accepted and all differ from the default's; no two are alike."""
    default = asdict(parse_options(meta_dqn.Args, "", []))
    changes = []
    for words in VARIANTS.values():
        options = asdict(parse_options(meta_dqn.Args, "", list(words)))
        changes.append({k: v for k, v in options.items() if v != default[k]})
    assert changes[0] == {}
    for change, words in zip(changes, VARIANTS.values(), strict=True):
        assert len(change) == sum(word.startswith("--") for word in words)
    assert len({str(change) for change in changes}) == len(VARIANTS)


def test_a_small_ablation(tmp_path):
    """It trains the variants asked for and sums up each over its seeds."""
    threads = torch.get_num_threads()
    chosen = Args(tmp_path, variants=("default", "double DQN"), seeds=2, jobs=2)
    assert ablate.main(chosen, WORDS) == 0
    assert torch.get_num_threads() == threads
    with (tmp_path / "ablation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["variant"], row["seeds"]) for row in rows] == [
        ("default", "2"),
        ("double DQN", "2"),
    ]
    config = (tmp_path / "double_DQN-seed1" / "config.json").read_text()
    assert '"double": true' in config


@pytest.mark.parametrize("variants", [(), ("default", "default"), ("triple DQN",)])
def test_no_unknown_or_double_variants(variants):
    """What cannot be compared is refused by name."""
    with pytest.raises(ValueError, match=r"^variants must be"):
        Args(variants=variants)


def test_variants_are_what_they_are_called():
    """Each variant changes what its name says, to what it says."""
    learners = {}
    for variant, words in VARIANTS.items():
        more = ["--hidden-units", "8", "--batch-size", "4"]
        more += ["--code-units", "4"] * ("--network" not in words)  # of the network "pairs" alone
        args = parse_options(meta_dqn.Args, "", [*more, *words])
        learners[variant] = meta_dqn.MetaLearner(args, make_grid(), Streams.spawn(0))
    rewards = {
        variant: [
            "step" if learner.goal(progress).reward.distances.size == 0 else "manhattan"
            for progress in (0.0, 0.5, 1.0)
        ]
        for variant, learner in learners.items()
        if learner.goals
    }
    assert rewards.pop("-1 a step alone") == ["step"] * 3
    assert rewards.pop("paper's reward alone") == ["manhattan"] * 3
    assert set(map(tuple, rewards.values())) == {("manhattan", "step", "step")}
    assert learners["plain numbers"].spec.kind == "paper"
    assert learners["12 outputs"].spec.values_shape == (3, 4)
    assert learners["replay as played"].imagined is None
    assert learners["one action a state"].imagined.n_tried == 1
    assert learners["no wider action gap"].args.action_gap == 0
    assert learners["no retries"].imagined.retries == 0
    assert learners["double DQN"].args.double
    assert not learners["no dueling"].spec.dueling
    assert not learners["constant step size"].args.learning_rate_falls
    assert learners["guidance"].args.guidance_start == 1

"""The policies that come with the baselines: what is said of them is so."""

import numpy as np
import pytest

from baselines import solve
from baselines.policies.evaluation import evaluate, every_problem, find_optima
from baselines.policies.policy import PRETRAINED, load_policy, pretrained_names
from baselines.policies.settings import Setting
from mapp_env import make_grid, sample_problems

MIB = 1024 * 1024
STATED = {  # gap and optimal in %, and how far chance may take each on 20,000 problems
    "pretrained": (0.40, 0.06, 98.06, 0.4),
    "pretrained-distilled": (0.0155, 0.01, 99.90, 0.08),
}


def test_these_come_with_the_baselines():
    """Two, each of less than 4 MiB, with the options that made it."""
    assert pretrained_names() == sorted(STATED)
    for name in STATED:
        assert (PRETRAINED / name / "policy.safetensors").stat().st_size < 4 * MIB
        assert (PRETRAINED / name / "config.json").is_file()


@pytest.mark.parametrize("name", STATED)
def test_figures_are_those_stated(name):
    """On 20,000 random problems, within what chance allows; never below the proven optimum."""
    grid = make_grid()
    setting = Setting(grid)
    problems = sample_problems(grid, 20_000, n_landmarks=5, seed=5)
    optima = find_optima(setting, problems)
    result = evaluate(load_policy(name), setting, problems, optima)
    gap, of_gap, optimal, of_optimal = STATED[name]
    figures = result.summary()
    assert (~result.success).sum() <= (name != "pretrained")  # which leaves one of all 658,008
    assert figures["gap %"] == pytest.approx(gap, abs=of_gap)
    assert figures["optimal %"] == pytest.approx(optimal, abs=of_optimal)
    for cost in ("cover_time", "makespan", "total_distance"):
        found = getattr(result, cost)[result.success]
        assert (found >= np.asarray(getattr(optima, cost))[result.success]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "unsolved"), [("pretrained", 0), ("pretrained-distilled", 1)])
def test_all_problems_are_solved_but_those_stated(name, unsolved):
    """Of all 658,008 problems exactly as many are left unsolved as the documents say."""
    setting = Setting(make_grid())
    result = evaluate(load_policy(name), setting, every_problem(setting))
    assert (~result.success).sum() == unsolved


def test_solve_uses_the_pretrained_policy(capsys):
    """By default: the routes of the five landmarks, beside the optimum."""
    assert solve.main(solve.Args((0, 6, 20, 42, 48))) == 0
    printed = capsys.readouterr().out
    assert "policy: cover time" in printed
    assert "optimum: cover time 12" in printed

"""Evaluation: the figures are those of the rules, on problems never trained on."""

import numpy as np
import pytest

from baselines import evaluate as evaluation_module
from baselines.evaluate import (
    Setting,
    count_unseen,
    evaluate,
    format_table,
    save_table,
    unseen_problems,
)
from baselines.policy import NearestLandmarkPolicy, RandomPolicy
from mapp_env import Grid, Problem, make_grid, replay

PAPER = Setting(make_grid("paper-7x7"))
WIDE = Setting(Grid.from_text("D......#\n.##.#...\n...#...."), 2, 3, 30)


def rivals(setting: Setting):
    random = RandomPolicy(setting.n_agents, 4, np.random.default_rng(0))
    return random, NearestLandmarkPolicy(setting.grid, setting.n_agents, setting.n_landmarks)


@pytest.mark.parametrize("setting", [PAPER, WIDE])
def test_costs_equal_those_of_replaying_the_actions(setting):
    """For every problem, replay() of the kept actions gives the same success and costs."""
    problems = unseen_problems(setting, 60)
    for policy in rivals(setting):
        result = evaluate(policy, setting, problems, n_kept=len(problems))
        for index, landmarks in enumerate(problems.tolist()):
            problem = Problem(setting.grid, landmarks, setting.n_agents, setting.max_cycles)
            plan = replay(problem, result.actions[: result.steps[index], index])
            assert plan.success == result.success[index]
            assert plan.cover_time == result.cover_time[index]
            assert plan.makespan == result.makespan[index]
            assert plan.total_distance == result.total_distance[index]
            limit = plan.cover_time if plan.success else setting.max_cycles
            assert result.steps[index] == limit


def test_nearest_landmark_solves_everything_and_chance_does_not():
    """The paper's grid is solved by walking to the nearest landmark, and rarely by chance."""
    problems = unseen_problems(PAPER, 500)
    chance, nearest = (evaluate(policy, PAPER, problems).summary() for policy in rivals(PAPER))
    assert nearest["solved %"] == 100.0
    assert nearest["steps (solved)"] == nearest["steps (unsolved = 50)"]
    assert 5.0 < chance["solved %"] < 25.0
    assert chance["steps (solved)"] < chance["steps (unsolved = 50)"]


def test_size_of_the_batch_changes_nothing(monkeypatch):
    """Problems played a few at a time, the last batch not full, give the same figures."""
    problems = unseen_problems(PAPER, 50)
    nearest = rivals(PAPER)[1]
    whole = evaluate(nearest, PAPER, problems, n_kept=20)
    monkeypatch.setattr(evaluation_module, "BATCH", 7)
    parts = evaluate(nearest, PAPER, problems, n_kept=20)
    for name in ("success", "steps", "cover_time", "makespan", "total_distance"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    for index, steps in enumerate(whole.steps[:20]):
        np.testing.assert_array_equal(whole.actions[:steps, index], parts.actions[:steps, index])


def test_unseen_problems_are_never_training_problems():
    """On a grid with few problems, leaving some out leaves exactly the others."""
    setting = Setting(Grid.from_text("D....\n....."), 1, 2, 20)
    everything = {tuple(row) for row in unseen_problems(setting, 36).tolist()}
    assert len(everything) == 36
    seen = sorted(everything)[:20]
    backwards = [cells[::-1] for cells in seen]  # the order of landmarks is no difference
    left = {tuple(row) for row in unseen_problems(setting, 16, backwards).tolist()}
    assert left == everything - set(seen)
    assert count_unseen(setting, backwards) == 16
    with pytest.raises(ValueError, match="n_problems must be at most 16"):
        unseen_problems(setting, 17, backwards)


def test_problems_that_do_not_fit_are_refused():
    """A wrong number of landmarks, or none, is refused before anything is played."""
    nearest = rivals(PAPER)[1]
    for shape in ((0, 5), (3, 4), (5,)):
        with pytest.raises(ValueError, match="landmarks must be cells of shape"):
            evaluate(nearest, PAPER, np.zeros(shape, int))


def test_table_says_when_nothing_was_solved(tmp_path):
    """Costs of unsolved problems are shown as a dash, never as a number; steps count the limit."""
    setting = Setting(PAPER.grid, max_cycles=1)
    result = evaluate(rivals(setting)[1], setting, unseen_problems(setting, 10))
    table = format_table({"one step": result})
    cells = [cell.strip() for cell in table.splitlines()[-1].split("|")[1:-1]]
    assert cells == ["one step", "10", "0.0", "-", "1.0", "-", "-"]
    save_table(tmp_path, {"one step": result})
    assert (tmp_path / "evaluation.md").read_text() == table + "\n"
    header, row = (tmp_path / "evaluation.csv").read_text().splitlines()
    assert len(header.split(",")) == len(row.split(",")) == 7


def test_only_the_actions_asked_for_are_kept():
    """Of a thousand problems two byte-sized routes are kept, and none unless asked for."""
    problems = unseen_problems(PAPER, 1000)
    nearest = rivals(PAPER)[1]
    two = evaluate(nearest, PAPER, problems, n_kept=2)
    assert two.actions.shape == (50, 2, 3)
    assert two.actions.nbytes == 300
    assert evaluate(nearest, PAPER, problems).actions.size == 0
    assert evaluate(nearest, PAPER, problems[:3], n_kept=5).actions.shape == (50, 3, 3)
    with pytest.raises(ValueError, match=r"n_kept must be .* got -1"):
        evaluate(nearest, PAPER, problems, n_kept=-1)

"""Evaluation: the figures are those of the rules, on problems never trained on."""

import dataclasses
import importlib.util
import itertools
import os
import re
from pathlib import Path

import numpy as np
import pytest

import mapp_env
from baselines import evaluate as script
from baselines.networks import build_network, network_spec
from baselines.policies import evaluation as evaluation_module
from baselines.policies.evaluation import (
    count_unseen,
    evaluate,
    every_problem,
    find_optima,
    format_table,
    play,
    regret_lines,
    save_table,
    unseen_problems,
)
from baselines.policies.guidance import Guidance, GuidedPolicy
from baselines.policies.policy import NetworkPolicy
from baselines.policies.rules_of_thumb import (
    RULES,
    EarliestArrivalPolicy,
    NearestLandmarkPolicy,
    RandomPolicy,
)
from baselines.policies.settings import Setting
from mapp_env import Grid, Problem, make_grid, replay, solve
from mapp_env.evaluation.summary import losses_line, summarise

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
    assert nearest["cover time"] == nearest["unsolved = 50"]
    assert 5.0 < chance["solved %"] < 25.0
    assert chance["cover time"] < chance["unsolved = 50"]


def earliest_arrivals(problem: Problem) -> list[list[int]]:
    """Return each agent's landmarks in order, by the rule as one would do it by hand."""
    distances = problem.grid.distances
    left = list(problem.landmarks)
    at, steps = [problem.grid.depot] * problem.n_agents, [0] * problem.n_agents
    routes: list[list[int]] = [[] for _ in at]
    while left:
        pairs = itertools.product(range(problem.n_agents), left)
        agent, landmark = min(
            pairs, key=lambda pair: steps[pair[0]] + distances[at[pair[0]], pair[1]]
        )
        steps[agent] += int(distances[at[agent], landmark])
        at[agent] = landmark
        routes[agent].append(landmark)
        left.remove(landmark)
    return routes


@pytest.mark.parametrize("setting", [PAPER, WIDE, dataclasses.replace(WIDE, n_agents=5)])
def test_earliest_arrival_is_its_plan(setting):
    """Asked anew at every step the policy walks the routes that the rule lays down at the start."""
    problems = unseen_problems(setting, 60)
    policy = EarliestArrivalPolicy(setting.grid, setting.n_agents, setting.n_landmarks)
    result = evaluate(policy, setting, problems, n_kept=len(problems))
    for index, landmarks in enumerate(problems.tolist()):
        problem = Problem(setting.grid, landmarks, setting.n_agents)
        plan = replay(problem, result.actions[: result.steps[index], index])
        assert [list(claims) for claims in plan.claims] == earliest_arrivals(problem)
        assert plan.cover_time == result.cover_time[index]


def test_earliest_arrival_is_the_solvers_benchmark(monkeypatch):
    """A name stands for one rule: the policy costs what the method of this name costs there."""
    monkeypatch.setattr(os, "environ", os.environ.copy())  # it sets how many threads there are
    path = Path(__file__).parents[2] / "benchmarks" / "solvers.py"
    spec = importlib.util.spec_from_file_location("benchmark_of_solvers", path)
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    problems = unseen_problems(PAPER, 100)
    _, rule = RULES["earliest"]
    result = evaluate(rule(PAPER.grid, 3, 5), PAPER, problems)
    for objective in ("cover_time", "makespan"):
        costs = [
            benchmark.METHODS["earliest arrival"](Problem(PAPER.grid, row, 3), objective, 1.0).cost
            for row in problems.tolist()
        ]
        assert getattr(result, objective).tolist() == costs


@pytest.mark.parametrize("policy", ["random", "nearest", "earliest"])
def test_both_rules_stand_beside_every_policy(policy, tmp_path):
    """Whatever is evaluated, both rules of thumb have a row, under the names that documents use."""
    script.main(script.Args(policy, 20, out=tmp_path))
    rows = (tmp_path / "evaluation.csv").read_text().splitlines()[1:]
    labels = [row.split(",")[0] for row in rows]
    own = {"nearest": "nearest landmark", "earliest": "earliest arrival"}.get(policy, policy)
    assert labels[0] == own
    assert sorted(labels) == sorted(
        {own, "nearest landmark", "earliest arrival", "optimum of each cost"}
    )


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


def grids_of_49_cells():
    """Return the paper's grid with other walls, with another depot, and of another shape."""
    text = PAPER.grid.to_text()
    yield Grid.from_text(text.replace("...#...", "..#...."))
    yield Grid(PAPER.grid.walls, depot=0)
    yield Grid.from_text("D" + "." * 48)


def test_a_policy_plays_on_its_own_grid_alone():
    """Same size, another wall or depot: refused, guided too; an equal grid, or none, plays."""
    spec = network_spec("paper", 3, 5, 4, 49, 8)
    network = build_network(spec)
    guidance = Guidance(PAPER.grid, 3, 5, 3)
    rng = np.random.default_rng(0)
    own = NetworkPolicy(network, Grid.from_text(PAPER.grid.to_text()))
    policies = [own, rivals(PAPER)[1], GuidedPolicy(own, guidance, 0.5, rng)]
    policies.append(GuidedPolicy(rivals(PAPER)[0], guidance, 0.5, rng))
    problems = unseen_problems(PAPER, 3)
    for policy in (*policies, NetworkPolicy(network)):
        assert len(evaluate(policy, PAPER, problems).steps) == 3
    for grid, said in zip(
        grids_of_49_cells(),
        (
            "cell 44 is a wall, not free, and 1 more differ",
            "the depot is cell 0, not 24",
            "1 x 49 cells, not 7 x 7",
        ),
        strict=True,
    ):
        other = Setting(grid)
        problems = unseen_problems(other, 3)
        for policy in policies:
            with pytest.raises(ValueError, match=f"^policy must be one of this grid, .*{said}$"):
                evaluate(policy, other, problems)
        assert len(evaluate(NetworkPolicy(network), other, problems).steps) == 3
        with pytest.raises(ValueError, match="policy must be one of this grid"):
            GuidedPolicy(own, Guidance(grid, 3, 5, 3), 0.5, rng)


def test_table_says_when_nothing_was_solved(tmp_path):
    """Costs of unsolved problems are shown as a dash, never as a number; steps count the limit."""
    setting = Setting(PAPER.grid, max_cycles=1)
    result = evaluate(rivals(setting)[1], setting, unseen_problems(setting, 10))
    table = format_table({"one step": result})
    cells = [cell.strip() for cell in table.splitlines()[-1].split("|")[1:-1]]
    assert cells == ["one step", "10", "0.00", "-", "-", "-", "-", "1.00", "-", "-"]
    save_table(tmp_path, {"one step": result})
    assert (tmp_path / "evaluation.md").read_text() == table + "\n"
    header, row = (tmp_path / "evaluation.csv").read_text().splitlines()
    assert len(header.split(",")) == len(row.split(",")) == 10


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


class Walking:
    """Walks the optimal plan of each problem, but for some, where it waits a step at first."""

    def __init__(self, setting: Setting, landmarks: np.ndarray, late: set[int]) -> None:
        self.plans = {}
        for index, row in enumerate(landmarks.tolist()):
            problem = Problem(setting.grid, row, setting.n_agents)
            actions = solve(problem).joint_actions()
            # Into the border, from a depot in the corner.
            bump = np.zeros((1, setting.n_agents), actions.dtype)
            self.plans[tuple(row)] = np.concatenate((bump, actions)) if index in late else actions
        self.n_agents, self.n_landmarks = setting.n_agents, setting.n_landmarks
        self.steps: dict[tuple[int, ...], int] = {}

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return the next joint action of each row's problem."""
        actions = np.empty((len(observations), self.n_agents), int)
        for row, observation in enumerate(observations.astype(int)):
            key = tuple(observation[self.n_agents : self.n_agents + self.n_landmarks].tolist())
            step = self.steps.get(key, 0)
            actions[row] = self.plans[key][step]
            self.steps[key] = step + 1
        return actions


def test_gaps_are_to_the_optimum():
    """A policy that walks optimal plans has no gap, and one step late exactly that step's share."""
    problems = unseen_problems(WIDE, 20)
    optima = find_optima(WIDE, problems)
    late = {3, 11}
    result = evaluate(Walking(WIDE, problems, late), WIDE, problems, optima)
    expected = [1 / optima.cover_time[index] if index in late else 0.0 for index in range(20)]
    np.testing.assert_allclose(result.gaps, expected)
    summary = result.summary()
    assert summary["gap %"] == pytest.approx(100 * np.mean(expected))
    assert summary["worst gap %"] == pytest.approx(100 * max(expected))
    assert summary["optimal %"] == 90.0
    assert summary["cover time"] == pytest.approx(optima.cover_time.mean() + 0.1)
    table = format_table({"late": result}).splitlines()
    assert len(table) == 4
    assert table[-1].startswith("| optimum of each cost |")


@pytest.mark.parametrize("n_landmarks", [3, 13])
def test_optima_are_those_of_solve(n_landmarks):
    """In each objective, by the batch of small problems and by one problem after the other."""
    setting = dataclasses.replace(WIDE, n_landmarks=n_landmarks)
    problems = unseen_problems(setting, 8)
    optima = find_optima(setting, problems)
    for objective in ("cover_time", "makespan", "total_distance"):
        costs = [
            solve(Problem(setting.grid, row, setting.n_agents), objective, "exact").cost
            for row in problems.tolist()
        ]
        assert getattr(optima, objective).tolist() == costs


def test_optima_are_those_of_the_team():
    """One agent, two and sixteen have each their own optimum."""
    problems = unseen_problems(PAPER, 30)
    means = []
    for n_agents in (1, 2, 16):
        setting = dataclasses.replace(PAPER, n_agents=n_agents)
        optima = find_optima(setting, problems)
        rows = problems.tolist()
        costs = [solve(Problem(PAPER.grid, row, n_agents)).cost for row in rows]
        assert optima.cover_time.tolist() == costs
        means.append(optima.cover_time.mean())
    assert means == sorted(set(means), reverse=True)


def test_optimal_share_counts_among_all_problems():
    """Whoever solves a few problems, these at their best, is not optimal on all."""
    problems = unseen_problems(PAPER, 200)
    optima = find_optima(PAPER, problems)
    limit = int(np.median(optima.cover_time))
    setting = dataclasses.replace(PAPER, max_cycles=limit)

    result = evaluate(Walking(setting, problems, set()), setting, problems, optima)
    share = 100 * (optima.cover_time <= limit).mean()
    assert 50 <= share < 100
    summary = result.summary()
    assert summary["solved %"] == summary["optimal %"] == pytest.approx(share)
    assert summary["gap %"] == summary["worst gap %"] == 0.0


def test_no_problem_and_no_optimum_are_said(capsys):
    """More landmarks than cells are named as such; without optima a line says why."""
    with pytest.raises(ValueError, match=r"n_landmarks must be at most 40, .* got 41"):
        script.main(script.Args("nearest", 5, n_landmarks=41))
    script.main(script.Args("nearest", 2, n_landmarks=21))
    assert "no gaps: optima are proven up to 20 landmarks" in capsys.readouterr().out


def test_no_optima_no_gaps():
    """Beyond the exact solver's reach gaps are dashes, and there is no row of the optimum."""
    setting = Setting(Grid(np.zeros((6, 6), np.bool_)), 2, 21, 3)
    problems = unseen_problems(setting, 2)
    assert find_optima(setting, problems) is None
    result = evaluate(rivals(setting)[1], setting, problems)
    assert np.isnan(
        [result.summary()[name] for name in ("gap %", "optimal %", "worst gap %")]
    ).all()
    assert len(format_table({"nearest": result}).splitlines()) == 3


def test_regrets_are_those_of_the_packages_evaluation(monkeypatch, capsys):
    """The lines below the table tell what mapp_env.evaluate finds; of many problems a sample does.

    Without optima there are none.
    """
    problems = unseen_problems(PAPER, 60)
    optima = find_optima(PAPER, problems)
    policy = rivals(PAPER)[1]
    table = {"nearest": evaluate(policy, PAPER, problems, optima)}
    found = mapp_env.evaluate(policy, problems, grid=PAPER.grid, max_cycles=PAPER.max_cycles)
    figures = summarise(found)
    assert figures["regret"] > 0
    assert regret_lines(table) == [f"nearest: {losses_line(figures)}"]
    for name in ("cover_time", "steps"):
        np.testing.assert_array_equal(getattr(table["nearest"], name), found[name])
    np.testing.assert_array_equal(table["nearest"].gaps, found["gap"])
    monkeypatch.setattr(evaluation_module, "MAX_JUDGED", 25)
    part = summarise({name: values[::3] for name, values in found.items()})
    assert regret_lines(table) == [
        "regrets are those of 20 problems, spread evenly among all",
        f"nearest: {losses_line(part)}",
    ]
    assert regret_lines({"nearest": evaluate(policy, PAPER, problems)}) == []
    script.main(script.Args("nearest", 20))
    printed = capsys.readouterr().out
    for label in ("nearest landmark", "earliest arrival"):
        assert re.search(rf"^{label}: regret 0\.\d+ steps a decision: first dec", printed, re.M)


def test_playing_starts_anywhere():
    """Problems of several grids, sizes and starts: each plan is its own problem's."""
    rng = np.random.default_rng(0)
    problems = []
    for setting in (PAPER, WIDE, PAPER):
        row = unseen_problems(setting, 1, seed=len(problems))[0].tolist()
        free = [cell for cell in setting.grid.reachable.tolist() if cell not in row]
        starts = rng.choice(free, setting.n_agents).tolist()
        problems.append(Problem(setting.grid, row, setting.n_agents, starts=starts))

    class Anywhere:
        def act(self, observations):
            n_agents = {13: 3, 8: 2}[observations.shape[1]]
            return rng.integers(4, size=(len(observations), n_agents))

    for problem, plan in zip(problems, play(Anywhere(), problems), strict=True):
        plan.verify(problem)


def test_cost_below_the_optimum_is_an_error():
    """An evaluation that beats a proven optimum cannot be true, and is not built."""
    problems = unseen_problems(PAPER, 30)
    optima = find_optima(PAPER, problems)
    result = evaluate(rivals(PAPER)[1], PAPER, problems, optima)
    costs = result.makespan.copy()
    costs[7] = optima.makespan[7] - 1
    with pytest.raises(RuntimeError, match="a makespan below the proven optimum"):
        dataclasses.replace(result, makespan=costs)


def test_universe_is_every_problem(tmp_path, capsys):
    """`--problems universe` plays each set of landmarks once, and writes the table if asked to."""
    (tmp_path / "tiny.txt").write_text("D....\n.....")
    setting = Setting(Grid.load(tmp_path / "tiny.txt"), 1, 2, 20)
    sets = list(itertools.combinations(range(1, 10), 2))
    assert every_problem(setting).tolist() == [list(cells) for cells in sets]
    options = {"grid": str(tmp_path / "tiny.txt"), "n_agents": 1, "n_landmarks": 2}
    folder = tmp_path / "new" / "table"
    script.main(script.Args("nearest", "universe", out=folder, **options))
    printed, errors = capsys.readouterr()
    table = (folder / "evaluation.md").read_text()
    assert printed.startswith(table)
    assert "| nearest landmark     |       36 |" in table
    assert "largest gap: landmarks" in printed
    assert errors == ""  # no bar where there is no terminal


def test_universe_too_large_is_refused_before_playing():
    """A universe of billions is refused by number; so is a folder that cannot be made."""
    with pytest.raises(
        ValueError, match=r"this grid has 3,838,380 problems of 6 landmarks|at most"
    ):
        script.main(script.Args("random", "universe", n_landmarks=12))
    with pytest.raises(ValueError, match="out: cannot write into /dev/null/x"):
        script.main(script.Args("random", 3, out=script.Path("/dev/null/x")))


def test_shares_are_never_rounded_up_to_all():
    """One problem unsolved in a hundred thousand does not show as 100 %."""
    assert evaluation_module._format_cell("solved %", 99.9999) == "99.99"
    assert evaluation_module._format_cell("optimal %", 100.0) == "100.00"
    for tenths in range(1001):
        share = 100.0 * (tenths / 1000)
        assert evaluation_module._format_cell("solved %", share) == f"{tenths / 10:.2f}"


def test_problems_out_of_reach_are_said(capsys):
    """Where even the optimum takes more than the step limit, a line says of how many problems."""
    setting = Setting(make_grid(), 3, 1, 5)
    count = int((find_optima(setting, every_problem(setting)).cover_time > 5).sum())
    assert 0 < count < 40
    asked = {"policy": "nearest", "problems": "universe", "n_landmarks": 1}
    script.main(script.Args(**asked, max_cycles=5))
    said = f"out of reach: {count} of 40 problems take more than 5 steps"
    assert said in capsys.readouterr().out
    script.main(script.Args(**asked))
    assert "out of reach" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"grid": "paper-7x7"}, "grid has no effect with policy 'pretrained'"),
        ({"n_agents": 3}, "n_agents has no effect with policy 'pretrained'"),
        ({"n_landmarks": 4}, "n_landmarks has no effect with policy 'pretrained'"),
        ({"max_cycles": 9}, "max_cycles has no effect with policy 'pretrained'"),
        ({"guidance_reach": 3}, "guidance_reach has no effect with guidance 0"),
    ],
)
def test_options_without_effect_are_refused(options, said):
    """What a trained policy brings along cannot be chosen, and reach is nothing without guidance.

    Of a policy without a run each of them counts, and reach counts beside guidance.
    """
    with pytest.raises(ValueError, match=said):
        script.Args("pretrained", **options)
    script.Args("nearest", guidance=0.5, **options)


def test_a_problem_is_seen_once():
    """Problems that were trained on twice, or in another order, count once."""
    total = count_unseen(PAPER, [])
    once = [(0, 6, 20, 42, 48), (1, 2, 3, 4, 5)]
    assert count_unseen(PAPER, [*once, *once, (48, 42, 20, 6, 0)]) == total - 2


@pytest.mark.parametrize("name", ["solved %", "optimal %"])
def test_no_share_says_all_where_one_is_missing(name):
    """A share is shown as 100 only if it is."""
    assert evaluation_module._format_cell(name, 99.9999) == "99.99"
    assert evaluation_module._format_cell(name, 100.0) == "100.00"


@pytest.mark.parametrize("count", [1, 2, 3])
def test_two_problems_of_two_landmarks(count):
    """So few problems of so few landmarks are evaluated as any, though they might be pairs."""
    setting = Setting(make_grid("paper-7x7"), 3, 2)
    landmarks = unseen_problems(setting, 3)
    policy = NearestLandmarkPolicy(setting.grid, 3, 2)
    some = evaluate(policy, setting, landmarks[:count], n_kept=count)
    every = evaluate(policy, setting, landmarks)
    assert some.cover_time.tolist() == every.cover_time[:count].tolist()
    assert some.actions.shape[1] == count


def test_playing_gives_the_plans_of_all_problems_in_order():
    """Problems of two step limits, mixed: each plan is that of its own episode."""
    for setting in (PAPER, WIDE):
        policy = rivals(setting)[1]
        problems = [
            Problem(setting.grid, row, setting.n_agents, limit)
            for row in unseen_problems(setting, 4).tolist()
            for limit in (setting.max_cycles, 2)
        ]
        for problem, plan in zip(problems, play(policy, problems), strict=True):
            plan.verify(problem)
            alone = dataclasses.replace(setting, max_cycles=problem.max_cycles)
            result = evaluate(policy, alone, np.array([problem.landmarks]))
            assert (plan.success, plan.cover_time) == (result.success[0], result.cover_time[0])
        assert play(policy, []) == []
    with pytest.raises(ValueError, match="policy must be one of this grid"):
        play(rivals(PAPER)[1], problems)


def test_playing_without_a_limit_is_long_enough():
    """The nearest landmark is always reached in time; a limit that is given counts instead."""
    problem = Problem(PAPER.grid, (0, 6, 20, 42, 48), 3)
    policy = rivals(PAPER)[1]
    assert play(policy, [problem])[0].success
    assert not play(policy, [problem], max_cycles=3)[0].success
    for limit in (0, 10_000_000, 1.5):
        with pytest.raises(ValueError, match="max_cycles must be"):
            play(policy, [problem], max_cycles=limit)

"""Judging policies: what is returned is what the rules and the solvers say, however it is asked."""

from __future__ import annotations

import io
import itertools
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mapp_env
from mapp_env import Grid, Problem, evaluate, make_grid, replay, sample_problems, solve
from mapp_env.evaluation import episodes, problems
from mapp_env.evaluation.progress import Progress
from mapp_env.solvers import regrets
from mapp_env.solvers.exact import solve_exact

PAPER = make_grid("paper-7x7")
LIMIT = 40


def mixed_problems(n_agents: tuple[int, ...] = (1, 2, 3)) -> list[Problem]:
    """Return problems of many grids and sizes, half of them with starts, some with a step limit."""
    rng, found = np.random.default_rng(0), []
    kinds = ("random", "maze", "rooms", "warehouse")
    for index in range(24):
        sides = {"rows": 7 + index % 3, "cols": 7 + index % 2}
        grid = make_grid(kinds[index % 4], **sides, seed=index // 2)
        n, k = n_agents[index % len(n_agents)], 1 + index % 5
        cells = sample_problems(grid, 1, n_landmarks=k, seed=index)[0].tolist()
        free = [cell for cell in (grid.depot, *grid.reachable.tolist()) if cell not in cells]
        starts = rng.choice(free, n).tolist() if index % 2 else None
        found.append(Problem(grid, cells, n, LIMIT if index % 3 else 7, starts))
    return found


class Hashing:
    """Acts at random, but always alike on what looks alike; N is that of the observations.

    In global observations it cannot be seen: then it is ``n_agents``.
    """

    def __init__(self, n_actions: int = 4, n_agents: int | None = None) -> None:
        self.n_actions, self.n_agents = n_actions, n_agents

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (B, N)."""
        n_rows, n_agents = len(observations), self.n_agents or observations.shape[1]
        flat = np.floor(97 * observations.reshape(n_rows, -1).astype(np.float64)).astype(np.int64)
        mixed = (flat * (1 + np.arange(flat.shape[1]) ** 2)).sum(axis=1)
        mixed = mixed[:, None] * 7919 + 104729 * np.arange(n_agents)
        return (mixed ^ (mixed >> 7)) % self.n_actions


class Optimal:
    """Takes the first joint action that loses nothing; its grid is the only one."""

    def __init__(self, grid: Grid, n_agents: int, n_landmarks: int) -> None:
        self.grid, self.sizes = grid, (n_agents, n_landmarks)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (B, N)."""
        n, k = self.sizes
        actions = []
        for row in observations.astype(int):
            landmarks, visited = row[n : n + k], row[n + k :] == 1
            left = Problem(self.grid, landmarks[~visited], n, starts=row[:n])
            every = itertools.product(range(4), repeat=n)
            actions.append(next(joint for joint in every if regrets(left, [joint])[0] == 0))
        return np.array(actions)


def equal(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    """Check that two results are the same, NaN included."""
    assert found.keys() == expected.keys()
    for name, values in found.items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


KINDS: list[dict[str, Any]] = [
    {"observation": "geodesic"},
    {"observation": "own_first", "reward": "step"},
    {"observation": "planes", "allow_wait": True},
    {"observation": "distances", "actions": "landmarks"},
    {"observation": "distances", "actions": "landmarks", "return_home": True},
    {"observation": "geodesic", "allow_wait": True, "return_home": True},
]


# -- what is played ----------------------------------------------------------------------------


@pytest.mark.parametrize("options", KINDS)
def test_a_mixture_is_its_problems_one_by_one(options: dict[str, Any]) -> None:
    """Whatever is observed and done: many grids, sizes and starts together change no result."""
    policy = Hashing(2 if "actions" in options else 4)
    given = mixed_problems()
    together = evaluate(policy, given, **options)
    for index, problem in enumerate(given):
        alone = evaluate(policy, [problem], **options)
        equal({name: values[index : index + 1] for name, values in together.items()}, alone)
    assert 0 < together["visited"].mean() < 1


@pytest.mark.parametrize("options", KINDS[:4])
def test_costs_are_those_of_replaying_the_moves(options: dict[str, Any]) -> None:
    """The moves that were made, for landmark actions too, replayed give costs, steps and visits."""
    policy = Hashing(2 if "actions" in options else 4)
    given = mixed_problems()
    found = evaluate(policy, given, "makespan", **options)
    limits = [problem.max_cycles or 0 for problem in given]
    for group in problems.group_problems(given, limits, options["observation"] == "planes"):
        played = episodes.play_episodes(policy, group, options, n_kept=len(group.places))
        for row, place in enumerate(group.places.tolist()):
            plan = replay(given[place], played.actions[: played.steps[row], row])
            assert (found["solved"][place], found["cost"][place]) == (plan.success, plan.makespan)
            assert found["cover_time"][place] == plan.cover_time
            assert found["total_distance"][place] == plan.total_distance
            assert found["steps"][place] == len(plan.actions)
            claimed = sum(map(len, plan.claims)) / len(given[place].landmarks)
            assert found["visited"][place] == pytest.approx(claimed)


def test_of_an_unsolved_problem_the_share_visited_is_told() -> None:
    """One landmark of four on the way: a quarter; no cost, no gap, but optimum and bound."""
    line = Grid.from_text("D......")
    found = evaluate(Right(1), [[1, 4, 5, 6]], grid=line, n_agents=1, max_cycles=3)
    assert not found["solved"][0]
    assert found["visited"][0] == 0.25
    assert found["cost"][0] == np.inf
    assert np.isnan(found["gap"][0])
    assert found["optimum"][0] == found["bound"][0] == 6
    assert found["steps"][0] == 3
    assert found["regret"][0] == 0


class Right:
    """Walks right for ever."""

    def __init__(self, n_agents: int) -> None:
        self.n_agents = n_agents

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return (B, N) actions."""
        return np.full((len(observations), self.n_agents), 1)


def test_a_function_is_a_policy() -> None:
    """An object's act, the function itself and a list of lists of it are the same policy."""
    rows = sample_problems(PAPER, 30, seed=2)
    policy = Hashing(n_agents=3)
    expected = evaluate(policy, rows, grid=PAPER)
    equal(evaluate(policy.act, rows, grid="paper-7x7"), expected)
    equal(evaluate(lambda seen: policy.act(seen).tolist(), rows.tolist(), grid=PAPER), expected)


def test_rows_are_problems(tmp_path: Path) -> None:
    """Landmark rows, problems, problem files in a list and a folder of them are the same."""
    rows = sample_problems(PAPER, 12, n_landmarks=2, seed=3)
    policy = Hashing(n_agents=2)
    expected = evaluate(policy, rows, grid=PAPER, n_agents=2)
    given = [Problem(PAPER, row, 2) for row in rows.tolist()]
    equal(evaluate(policy, given), expected)
    paths = [tmp_path / f"{index:02}.json" for index in range(12)]
    for problem, path in zip(given, paths, strict=True):
        problem.save(path)
    (tmp_path / "notes.txt").write_text("no problem")
    equal(evaluate(policy, tmp_path), expected)
    equal(evaluate(policy, [str(path) for path in paths]), expected)
    equal(evaluate(policy, paths[3]), evaluate(policy, given[3:4]))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_two_problems_of_two_landmarks(count: int) -> None:
    """So few problems of so few landmarks are played as any, though they might be pairs."""
    rows = sample_problems(PAPER, 3, n_landmarks=2, seed=1)
    policy = Hashing(n_agents=3)
    some, every = (evaluate(policy, part, grid=PAPER) for part in (rows[:count], rows))
    equal(some, {name: values[:count] for name, values in every.items()})


def test_without_a_limit_there_are_enough_steps() -> None:
    """One agent that visits the landmarks in any order is done in time; a limit is kept to."""
    rows = sample_problems(PAPER, 20, seed=4)
    policy = Optimal(PAPER, 1, 5)
    assert evaluate(policy, rows, grid=PAPER, n_agents=1)["solved"].all()
    assert not evaluate(policy, rows, grid=PAPER, n_agents=1, max_cycles=3)["solved"].any()
    stuck = evaluate(Right(3), rows, grid=PAPER)
    assert set(stuck["steps"].tolist()) == {2 * int(PAPER.home.max()) * 5}
    own = evaluate(Right(3), [Problem(PAPER, [0], max_cycles=limit) for limit in (4, 9)])
    assert own["steps"].tolist() == [4, 9]
    home = evaluate(Right(3), rows[:1], grid=PAPER, return_home=True)
    assert home["steps"].tolist() == [2 * int(PAPER.home.max()) * 6]


@pytest.mark.parametrize("name", ["MAX_VALUES", "MAX_POOL_CELLS", "BATCH"])
def test_little_room_changes_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Played a few problems, or a few grids, at a time, the results are the same."""
    given, policy = mixed_problems(), Hashing()
    options = {"observation": "geodesic", "reward": "geodesic"}
    whole = evaluate(policy, given, **options)
    small = {"MAX_VALUES": 700, "MAX_POOL_CELLS": 60, "BATCH": 2}[name]
    monkeypatch.setattr(problems if name == "MAX_POOL_CELLS" else episodes, name, small)
    if name == "BATCH":
        real = episodes.play_episodes
        monkeypatch.setattr(
            "mapp_env.evaluation.play_episodes",
            lambda *arguments, **named: real(*arguments, batch=2, **named),
        )
    equal(evaluate(policy, given, **options), whole)


def test_a_pool_decides_how_large_planes_are() -> None:
    """Of a pool that is given, planes are as large as its largest grid; else as their own."""
    given = mixed_problems((2,))
    sides: set[tuple[int, ...]] = set()

    def act(seen: np.ndarray) -> np.ndarray:
        sides.add(seen.shape[-2:])
        return Hashing().act(seen)

    pool = [*{problem.grid: None for problem in given}, make_grid("maze", rows=12, cols=9)]
    options = {"observation": "planes", "max_cycles": 5}
    evaluate(act, given, **options)
    assert sides == {problem.grid.walls.shape for problem in given}
    assert len(sides) > 1
    sides.clear()
    together = evaluate(act, given, grid=pool, **options)
    assert sides == {(12, 9)}
    alone = [evaluate(act, [problem], grid=pool, **options)["steps"][0] for problem in given]
    assert together["steps"].tolist() == alone
    for kind in ("geodesic", "distances"):
        options = {"observation": kind, "max_cycles": 20}
        equal(
            evaluate(Hashing(), given, grid=pool, **options),
            evaluate(Hashing(), given, **options),
        )


# -- what is proven ----------------------------------------------------------------------------


def test_an_optimal_policy_has_no_gap_and_no_regret() -> None:
    """Whoever walks optimal plans meets the optimum of each problem, and no decision loses."""
    rows = sample_problems(PAPER, 15, n_landmarks=4, seed=5)
    found = evaluate(Optimal(PAPER, 2, 4), rows, grid=PAPER, n_agents=2)
    expected = [solve(Problem(PAPER, row, 2)).cost for row in rows.tolist()]
    assert found["optimum"].tolist() == found["bound"].tolist() == expected
    assert found["cost"].tolist() == expected
    for name in ("gap", "regret", "lost_first", "lost_middle", "lost_last"):
        assert not found[name].any(), name
    free = PAPER.reachable.tolist()
    given = [
        Problem(PAPER, row, 2, starts=[cell for cell in free if cell not in row][index::30][:2])
        for index, row in enumerate(rows.tolist()[:5])
    ]
    found = evaluate(Optimal(PAPER, 2, 4), given)
    assert found["cost"].tolist() == [solve_exact(problem, "cover_time").bound for problem in given]
    assert not found["regret"].any()


@pytest.mark.parametrize("objective", ["cover_time", "makespan", "total_distance"])
def test_gaps_are_to_the_optimum_of_each(objective: str) -> None:
    """Each objective has its own optimum, from any starts; regrets only where steps are counted."""
    given = [problem for problem in mixed_problems() if len(problem.landmarks) < 3]
    found = evaluate(Hashing(), given, objective, observation="geodesic", max_cycles=300)
    assert found["solved"].any()
    for index, problem in enumerate(given):
        optimum = solve_exact(problem, objective).bound
        assert found["optimum"][index] == found["bound"][index] == optimum
        assert found["cost"][index] == found[objective][index]
        if found["solved"][index]:
            assert found["gap"][index] == pytest.approx((found["cost"][index] - optimum) / optimum)
    assert np.isnan(found["regret"]).all() == (objective != "cover_time")


@pytest.mark.parametrize("count", [13, 20, 25])
def test_many_landmarks(count: int) -> None:
    """Up to 20 the optimum is proven; beyond, a bound, and where a policy meets it the optimum."""
    room = Grid.from_text("\n".join([14 * ".", "D" + 13 * ".", 14 * "."]))
    spread = room.reachable[:count].tolist()
    line = Grid.from_text("D" + 40 * ".")
    straight = list(range(1, count + 1))
    given = [Problem(room, spread, 2), Problem(line, straight, 2)]
    found = evaluate(Right(2), given, max_cycles=count)
    assert found["cost"].tolist() == [np.inf, count]
    assert found["optimum"][1] == found["bound"][1] == count
    assert found["gap"][1] == 0
    assert found["regret"][1] == 0
    if count <= 20:
        assert found["optimum"][0] == found["bound"][0] == solve(given[0]).cost
    else:
        assert np.isnan(found["optimum"][0])
        assert 13 <= found["bound"][0] <= solve(given[0], time_limit=0.2).cost


# -- what is refused ---------------------------------------------------------------------------


def raising(observations: np.ndarray) -> np.ndarray:
    """Fail."""
    raise KeyError("weights")


OTHER = Grid.from_text(PAPER.to_text().replace("...#...", "..#...."))


@pytest.mark.parametrize(
    ("policy", "said"),
    [
        (raising, r"policy cannot play this problem: KeyError\('weights'\)"),
        (
            lambda seen: np.zeros((len(seen), 2), int),
            r"integers of shape \(4, 3\), got shape \(4, 2",
        ),
        (lambda seen: np.zeros(len(seen), int), r"integers of shape \(4, 3\), got shape \(4,\)"),
        (lambda seen: np.zeros((len(seen), 3)), "got shape .4, 3., dtype float64"),
        (lambda seen: None, r"got shape \(\), dtype object"),
        (lambda seen: [[0, 1, 2]] * 3 + [[0]], "policy must act with integers"),
        (
            lambda seen: np.full((len(seen), 3), 4),
            r"policy must act with integers in 0\.\.3, got 4",
        ),
        (lambda seen: np.full((len(seen), 3), -1), r"in 0\.\.3, got -1"),
        (7, r"policy must have act\(observations\), or be a function of observations, got 7"),
        (Optimal(OTHER, 3, 5), "policy must be one of this grid, .* here cell 44 is free, not a w"),
    ],
)
def test_bad_policies_are_refused(policy: Any, said: str) -> None:
    """A policy that raises, or returns anything but actions, is named, and what was expected."""
    with pytest.raises(ValueError, match=said):
        evaluate(policy, sample_problems(PAPER, 4, seed=0), grid=PAPER)


def test_a_policy_is_refused_before_anything_is_played() -> None:
    """That of one grid is not asked once if one of many problems is on another."""
    asked = []

    class Picky:
        grid = PAPER

        def act(self, observations: np.ndarray) -> np.ndarray:
            asked.append(len(observations))
            return np.ones((len(observations), 1), int)

    given = [Problem(grid, [0] if n == 1 else [0, 1], 1) for grid in (PAPER, OTHER) for n in (1, 2)]
    evaluate(Picky(), given[:2], max_cycles=2)
    asked.clear()
    with pytest.raises(ValueError, match="another grid"):
        evaluate(Picky(), given)
    assert asked == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"problems": []}, "problems must be mapp_env.Problems, problem files"),
        ({"problems": 5}, "problems must be mapp_env.Problems, .* got 5"),
        ({"problems": [[0, 1]]}, "grid must be given with landmarks"),
        ({"problems": [[0, 24]], "grid": PAPER}, r"problems\[0\]\[1\] must not be the depot"),
        ({"problems": [[1, 2], [3, 3]], "grid": PAPER}, r"problems\[1\]\[1\] must differ"),
        ({"problems": [[0.5]], "grid": PAPER}, "problems must be mapp_env.Problems"),
        ({"problems": [[0], [1, 2]], "grid": PAPER}, "problems must be mapp_env.Problems"),
        ({"problems": [[0]], "grid": "nowhere"}, "grid must be"),
        ({"problems": [Problem(PAPER, [0])], "grid": [OTHER]}, r"problems\[0\] must be on a grid"),
        ({"problems": [Problem(PAPER, [0])], "grid": []}, "grid must be a grid, or a sequence"),
        ({"problems": [Problem(PAPER, [0])], "n_agents": 3}, "n_agents must be left out"),
        ({"problems": [Problem(PAPER, [0]), [1]]}, "problems must be mapp_env.Problems"),
        ({"n_agents": 17}, "n_agents must be"),
        ({"max_cycles": 0}, "max_cycles must be"),
        ({"objective": "speed"}, "objective must be one of 'cover_time'"),
        ({"progress": 1}, "progress must be True or False"),
        ({"observation": "smell"}, "observation must be one of"),
        ({"return_home": "yes"}, "return_home must be True or False"),
        ({"num_envs": 3}, "num_envs must be left out"),
        ({"render_mode": "ansi"}, "render_mode must be left out"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], said: str) -> None:
    """Each refusal names the argument, before the policy is asked."""
    with pytest.raises(ValueError, match=said):
        evaluate(
            raising,
            **{
                "problems": [[0]],
                **arguments,
                **({"grid": PAPER} if "problems" not in arguments else {}),
            },
        )


def test_files_that_are_no_problems_are_named(tmp_path: Path) -> None:
    """A folder without problems, a file that is none and one that is not there are said by name."""
    with pytest.raises(ValueError, match=r"problems must be in files \*.json, there is none in"):
        evaluate(raising, tmp_path)
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(ValueError, match=r"problems: .*a\.json: is not strict JSON"):
        evaluate(raising, tmp_path)
    with pytest.raises(ValueError, match=r"problems: .*b\.json'?: cannot be opened"):
        evaluate(raising, [tmp_path / "b.json"])


def test_a_cost_below_what_is_proven_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results that beat a proven bound cannot be true, and are not returned."""
    real = mapp_env.solvers.optimal_costs
    monkeypatch.setattr(
        "mapp_env.evaluation.optima.optimal_costs",
        lambda *arguments, **named: real(*arguments, **named) + 1,
    )
    with pytest.raises(RuntimeError, match="a cover_time below the proven bound"):
        evaluate(Right(1), [[25, 26]], grid=PAPER, n_agents=1)


# -- progress ----------------------------------------------------------------------------------


class Terminal(io.StringIO):
    """A stream that says that somebody watches."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def test_progress_is_shown_in_terminals_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar that grows to all, and leaves nothing behind; nothing elsewhere, or if unwanted."""
    monkeypatch.setattr("mapp_env.evaluation.progress.INTERVAL", -1.0)
    for stream, shown in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        evaluate(Right(3), [[25], [26]], grid=PAPER)
        lines = stream.getvalue().split("\r")
        assert any(f"|{30 * '#'}| 2 of 2, " in line for line in lines) == shown
        assert lines[-1] == ("\033[K" if shown else "")
    monkeypatch.setattr(sys, "stderr", Terminal())
    evaluate(Right(3), [[25], [26]], grid=PAPER, progress=False)
    Progress(None, 3).add(3)
    assert sys.stderr.getvalue() == ""  # type: ignore[attr-defined]


def test_limits_and_names_are_said_in_the_docstring() -> None:
    """Every entry of the results is documented."""
    found = evaluate(Right(3), [[25]], grid=PAPER)
    text = evaluate.__doc__ or ""
    assert all(f"``{name}``" in text for name in found)


def test_the_order_of_problems_is_theirs() -> None:
    """Given backwards, the results come backwards."""
    given, policy = mixed_problems(), Hashing()
    forwards = evaluate(policy, given, observation="distances")
    backwards = evaluate(policy, given[::-1], observation="distances")
    equal({name: values[::-1] for name, values in backwards.items()}, forwards)

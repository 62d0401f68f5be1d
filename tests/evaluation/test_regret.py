"""What decisions lose, and what a team that walks home can do: equal to searches by the rules."""

from __future__ import annotations

import heapq
import itertools
from typing import Any

import numpy as np
import pytest

from mapp_env import Grid, Problem, evaluate, make_grid, sample_problems
from mapp_env.evaluation import episodes, optima, problems
from mapp_env.evaluation.summary import LOSSES, PLACES, losses_line, lost_figures, summarise
from mapp_env.solvers import regrets

PAPER = make_grid("paper-7x7")


def random_policy(n_agents: int, n_actions: int = 4, seed: int = 0) -> Any:
    """Return a policy that draws its actions."""
    rng = np.random.default_rng(seed)
    return lambda seen: rng.integers(n_actions, size=(len(seen), n_agents))


# -- regrets -----------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"actions": "landmarks"}])
@pytest.mark.parametrize("n_landmarks", [1, 2, 4])
def test_losses_are_sums_of_regrets(options: dict[str, Any], n_landmarks: int) -> None:
    """In all, at first, later and with one landmark left: the regrets of the moves really made."""
    rng = np.random.default_rng(1)
    given = []
    for row in sample_problems(PAPER, 25, n_landmarks=n_landmarks, seed=6).tolist():
        free = [cell for cell in PAPER.reachable.tolist() if cell not in row]
        given.append(Problem(PAPER, row, 2, 30, rng.choice(free, 2).tolist()))
    actions = n_landmarks + 1 if options else 4
    (group,) = problems.group_problems(given, [30] * 25)
    played = episodes.play_episodes(random_policy(2, actions), group, options, n_kept=25)
    found = evaluate(random_policy(2, actions), given, **options)
    assert found["solved"].any()
    for index, problem in enumerate(given):
        moves = played.actions[: played.steps[index], index]
        lost = regrets(problem, moves)
        left = [problem.after(moves[:step]) for step in range(len(moves))]
        few = [step > 0 and len(one.landmarks) == 1 for step, one in enumerate(left)]
        assert found["lost_first"][index] == lost[0]
        assert found["lost_last"][index] == lost[few].sum()
        assert found["lost_middle"][index] == lost[1:].sum() - lost[few].sum()
        assert found["regret"][index] == pytest.approx(lost.mean())
        if found["solved"][index]:
            total = sum(found[name][index] for name in LOSSES)
            assert total == found["cost"][index] - found["optimum"][index]


def test_an_episode_that_lost_nothing_but_time_is_judged() -> None:
    """Unsolved: what it took and would take on, less the optimum; one to and fro loses two each."""
    line = Grid.from_text("...D...")
    to_and_fro = itertools.cycle((1, 0))
    found = evaluate(
        lambda seen: np.full((len(seen), 1), next(to_and_fro)),
        [[0]],
        grid=line,
        n_agents=1,
        max_cycles=6,
    )
    assert (found["cost"][0], found["optimum"][0]) == (np.inf, 3)
    # Away from it and back: 2, 0, 2, 0, 2, 0 steps lost.
    assert [found[name][0] for name in LOSSES] == [2, 0, 4]
    assert found["regret"][0] == 1


def test_shares_are_of_all_that_was_lost() -> None:
    """A mean over decisions, not problems; shares add up to 1; what is not known does not count."""
    losses = np.array(
        [[3.0, 1, np.nan, 0, 6], [1, 0, 0, 0, np.nan], [2, 0, 0, 0, 0], [0, 1, 0, 0, 0]]
    )
    steps = np.array([10, 2, 5, 3, 15])
    figures = lost_figures(losses, steps)
    assert figures["regret"] == pytest.approx(10 / 30)
    assert [figures[name] for name in LOSSES] == [0.25, 0.5, 0.25]
    line = losses_line(figures)
    shares = f"{PLACES[0]} 25.0 %, {PLACES[1]} 50.0 %, {PLACES[2]} 25.0 %"
    assert line == f"regret 0.3333 steps a decision: {shares}"
    nothing = lost_figures(np.zeros((4, 2)), np.array([3, 4]))
    assert losses_line(nothing) == "regret 0.0000 steps a decision"
    assert np.isnan(lost_figures(np.full((4, 1), np.nan), np.array([3]))["regret"])


def test_a_summary_is_over_the_solved() -> None:
    """Means of costs and gaps are those of the solved problems; shares count all."""
    rows = sample_problems(PAPER, 200, n_landmarks=2, seed=8)
    found = evaluate(random_policy(3), rows, grid=PAPER, max_cycles=25)
    figures, solved = summarise(found), found["solved"]
    assert 0 < solved.sum() < 200
    assert figures["solved"] == solved.mean()
    assert figures["cost"] == found["cost"][solved].mean()
    assert figures["optimum"] == found["optimum"][solved].mean()
    assert figures["gap"] == pytest.approx(found["gap"][solved].mean())
    assert figures["optimal"] == (found["cost"] == found["optimum"]).mean()
    assert figures["worst_gap"] == found["gap"][solved].max()
    decisions = found["steps"].sum()
    assert figures["regret"] == pytest.approx((found["regret"] * found["steps"]).sum() / decisions)
    assert sum(figures[name] for name in LOSSES) == pytest.approx(1)


# -- home --------------------------------------------------------------------------------------


def least_home(problem: Problem, may_wait: bool) -> dict[str, int]:
    """Return the least steps, and cells moved, until all is visited and all are home.

    By searches through the rules, state by state (Dijkstra).
    """
    grid, moves = problem.grid, range(5 if may_wait else 4)
    start = (problem.start_cells, tuple(sorted(problem.landmarks)))
    done = ((grid.depot,) * problem.n_agents, ())
    costs = {}
    for name in ("makespan", "total_distance"):
        queue, closed = [(0, *start)], set()
        while (queue[0][1:]) != done:
            cost, cells, left = heapq.heappop(queue)
            if (cells, left) in closed:
                continue
            closed.add((cells, left))
            for joint in itertools.product(moves, repeat=len(cells)):
                after = tuple(
                    cell if move == 4 else int(grid.moves[cell, move])
                    for cell, move in zip(cells, joint, strict=True)
                )
                moved = sum(one != other for one, other in zip(cells, after, strict=True))
                still = tuple(mark for mark in left if mark not in after)
                step = 1 if name == "makespan" else moved
                heapq.heappush(queue, (cost + step, after, still))
        costs[name] = queue[0][0]
    return costs


HOMES = ("...\n.D.\n...", "D..\n...", "..#\n.D.", "...\n.D.\n.#.", "....\n.D..", "....D")


@pytest.mark.parametrize("allow_wait", [True, False])
def test_the_optimum_of_walking_home_is_that_of_a_search(allow_wait: bool) -> None:
    """From any starts, idle agents too: no bound is above what a search by the rules finds.

    And wherever an optimum is said to be proven it is that: always if agents can rest.
    """
    rng = np.random.default_rng(2)
    missed = 0
    for text, k in itertools.product(HOMES, (1, 2)):
        grid = Grid.from_text(text)
        row = rng.choice(grid.reachable, k, replace=False).tolist()
        free = [cell for cell in (grid.depot, *grid.reachable.tolist()) if cell not in row]
        for starts in itertools.combinations_with_replacement(free[:5], 2):
            problem = Problem(grid, row, 2, starts=starts)
            (group,) = problems.group_problems([problem], [30])
            for objective, cost in least_home(problem, allow_wait).items():
                proven = optima.proven_costs(group, objective, True, allow_wait)
                assert proven.bound[0] <= cost
                assert proven.optimum[0] == cost or np.isnan(proven.optimum[0])
                if allow_wait and objective == "makespan":
                    assert proven.optimum[0] == cost
                missed += proven.bound[0] < cost
    assert missed > 0  # distances of idle agents, and odd ways without a rest


@pytest.mark.parametrize("allow_wait", [True, False])
def test_who_cannot_rest_may_be_late(allow_wait: bool) -> None:
    """Far from all walls an agent one step from home is not there at an even time, unless it waits.

    Then no optimum is claimed, but where the policy itself meets the bound.
    """
    grid = Grid(np.zeros((7, 7), np.bool_))
    problem = Problem(grid, [22], 2, starts=(24, 25))
    least = least_home(problem, allow_wait)["makespan"]
    (group,) = problems.group_problems([problem], [30])
    proven = optima.proven_costs(group, "makespan", True, allow_wait)
    assert proven.bound[0] == 4
    assert least == (4 if allow_wait else 6)
    np.testing.assert_array_equal(proven.optimum, [4 if allow_wait else np.nan])


def test_all_home_is_judged_by_the_makespan() -> None:
    """With return_home the cost is the makespan that was walked, and so is the optimum."""
    line = Grid.from_text("D....")

    def there_and_back(seen: np.ndarray) -> np.ndarray:
        return np.where(seen[:, 2:] == 1, 0, 1)  # right until the landmark is visited, then left

    found = evaluate(there_and_back, [[2], [4]], grid=line, n_agents=1, return_home=True)
    assert found["solved"].all()
    assert found["cost"].tolist() == found["optimum"].tolist() == [4, 8]
    assert found["cover_time"].tolist() == [2, 4]
    assert not found["regret"].any()
    cover = evaluate(
        there_and_back, [[2], [4]], "cover_time", grid=line, n_agents=1, return_home=True
    )
    assert cover["cost"].tolist() == cover["optimum"].tolist() == [2, 4]
    assert np.isnan(cover["regret"]).all()
    right = evaluate(
        lambda seen: np.ones((len(seen), 1), int),
        [[2]],
        grid=line,
        n_agents=1,
        return_home=True,
        max_cycles=4,
    )
    assert not right["solved"][0]
    assert right["visited"][0] == 1
    # After the landmark, two steps on and away from home: each loses two.
    assert [right[name][0] for name in LOSSES] == [0, 0, 4]


def test_regrets_of_walking_home_add_up() -> None:
    """From any starts the losses of all decisions are the makespan walked less the optimum."""
    rng = np.random.default_rng(3)
    grid = Grid.from_text("...\n.D.\n..#")
    given = []
    for _ in range(20):
        row = rng.choice(grid.reachable, 2, replace=False).tolist()
        free = [cell for cell in (grid.depot, *grid.reachable.tolist()) if cell not in row]
        given.append(Problem(grid, row, 2, starts=rng.choice(free, 2).tolist()))
    found = evaluate(random_policy(2, 5), given, return_home=True, allow_wait=True, max_cycles=2000)
    assert found["solved"].all()
    assert (found["lost_first"] >= 0).all()
    total = sum(found[name] for name in LOSSES)
    np.testing.assert_array_equal(total, found["cost"] - found["optimum"])
    np.testing.assert_array_equal(found["cost"], found["steps"])

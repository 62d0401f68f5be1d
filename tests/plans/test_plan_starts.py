"""Plans of agents that start anywhere (R10): played, checked, walked by solvers, kept in files."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

import mapp_env.plans.plan
from mapp_env import Grid, Plan, Problem, replay, solve
from mapp_env.plans.tours import walk_routes

OBJECTIVES = ("cover_time", "makespan", "total_distance")
CROSS = "#####\n#...#\n#.D.#\n#...#\n#####"


def random_problem(rng: np.random.Generator, most_landmarks: int = 5) -> Problem:
    """Return a problem on a grid of random walls, with a depot and agents anywhere."""
    while True:
        walls = rng.random(rng.integers(1, 7, 2)) < rng.choice((0.0, 0.2, 0.35))
        if walls.all():
            continue
        grid = Grid(walls, int(rng.choice(np.flatnonzero(~walls))))
        if grid.reachable.size:
            break
    count = int(rng.integers(1, min(most_landmarks, grid.reachable.size) + 1))
    landmarks = rng.choice(grid.reachable, count, replace=False)
    others = np.setdiff1d(np.append(grid.reachable, grid.depot), landmarks)
    starts = rng.choice(others, rng.integers(1, 5)).tolist()
    return Problem(grid, landmarks.tolist(), len(starts), starts=starts)


def walk(problem: Problem, actions: np.ndarray) -> dict[str, object]:
    """Return tours, claims and costs of an episode, by the text of R2 to R8 and R10 alone."""
    grid = problem.grid
    cells, left = list(problem.start_cells), set(problem.landmarks)
    walks = [[cell] for cell in cells]
    claims: list[list[tuple[int, int]]] = [[] for _ in cells]
    marks = [(0, 0)] * len(cells)  # length of the walk, and step, at the last claim
    ties = 0
    for step, joint in enumerate(actions, 1):
        if not left:
            break
        for agent, action in enumerate(joint):
            row, col = divmod(cells[agent], grid.cols)
            down, right = ((0, -1), (0, 1), (-1, 0), (1, 0), (0, 0))[action]
            row, col = row + down, col + right
            if 0 <= row < grid.rows and 0 <= col < grid.cols and not grid.walls[row, col]:
                to = row * grid.cols + col
                walks[agent] += [to] * (to != cells[agent])
                cells[agent] = to
        for agent, cell in enumerate(cells):
            if cell in left:
                ties += cells.count(cell) > 1
                left.remove(cell)
                claims[agent].append((cell, step))
                marks[agent] = (len(walks[agent]), step)
    home = grid.home.tolist()
    cut = [(line[:n], step) for line, (n, step) in zip(walks, marks, strict=True)]
    lengths = [len(line) - 1 + home[line[-1]] if line else 0 for line, _ in cut]
    ends = [step + home[line[-1]] if line else 0 for line, step in cut]
    times = [step for _, step in marks]
    costs = (math.inf,) * 3 if left else (max(times), max(ends), sum(lengths))
    return {
        "heads": [tuple(line) for line, _ in cut],
        "lengths": lengths,
        "claims": tuple(tuple(cell for cell, _ in line) for line in claims),
        "costs": costs,
        "ties": ties,
    }


def test_a_replay_is_what_the_rules_say() -> None:
    """Tours begin at the agents' starts and end on the depot; claims and costs are the rules'."""
    rng = np.random.default_rng(0)
    solved = 0
    for _ in range(300):
        problem = random_problem(rng, 3)
        actions = rng.integers(0, 5, (40, problem.n_agents))
        plan, told = replay(problem, actions), walk(problem, actions)
        assert plan.claims == told["claims"]
        assert (plan.cover_time, plan.makespan, plan.total_distance) == told["costs"]
        assert [max(len(tour) - 1, 0) for tour in plan.tours] == told["lengths"]
        for tour, head in zip(plan.tours, told["heads"], strict=True):  # type: ignore[call-overload]
            assert tour[: len(head)] == head
            assert not tour or tour[-1] == problem.grid.depot
        plan.verify()
        solved += plan.success
    assert 100 < solved < 300


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_solvers_plan_is_played_again(objective: str) -> None:
    """From any starts a solved plan verifies, and its actions replay to the same plan."""
    rng = np.random.default_rng(1)
    for _ in range(100):
        problem = random_problem(rng)
        plan = solve(problem, objective)
        plan.verify()
        for allow_wait in (False, True):
            again = replay(problem, plan.joint_actions(allow_wait), objective)
            assert (again.tours, again.claims, again.cost) == (plan.tours, plan.claims, plan.cost)
            assert again.claim_steps == plan.claim_steps
        assert replay(problem, plan.joint_actions(), objective).actions == plan.actions


def test_agents_without_a_route_claim_nothing() -> None:
    """Whoever has no route stays on its start or beside it, and never is first on a landmark.

    It waits only where all four neighbours are landmarks that are left.
    """
    rng = np.random.default_rng(2)
    idle = waits = 0
    for _ in range(400):
        problem = random_problem(rng, 8)
        grid = problem.grid
        # The later agents have no routes.
        busy = int(rng.integers(1, problem.n_agents + 1))
        routes: list[list[int]] = [[] for _ in problem.start_cells]
        for cell in problem.landmarks:
            routes[rng.integers(busy)].append(cell)
        actions = walk_routes(problem, routes)
        plan = replay(problem, actions)
        assert plan.success
        assert len(plan.actions) == len(actions)
        assert all(route or not claims for route, claims in zip(routes, plan.claims, strict=True))
        steps = {}  # when each landmark is visited
        for cells, when in zip(plan.claims, plan.claim_steps, strict=True):
            steps.update(zip(cells, when, strict=True))
        at = list(problem.start_cells)
        for step, joint in enumerate(actions.tolist()):
            for agent, action in enumerate(joint):
                if action == 4:
                    assert not routes[agent] or at[agent] == grid.depot
                    assert all(steps.get(to, 0) > step for to in grid.moves[at[agent]].tolist())
                    waits += 1
                else:
                    at[agent] = int(grid.moves[at[agent], action])
                if not routes[agent]:
                    start = problem.start_cells[agent]
                    assert at[agent] in (start, *grid.moves[start])
        idle += sum(not route for route in routes)
    assert idle > 200
    assert waits > 0


def test_an_agent_between_landmarks_waits() -> None:
    """Alone between four landmarks, an agent without a task waits until one is visited."""
    grid = Grid.from_text(".....\n.....\n.....\nD....")
    problem = Problem(grid, (2, 6, 8, 12), 2, starts=(7, 15))
    actions = walk_routes(problem, ([], [12, 6, 2, 8]))
    plan = replay(problem, actions, "total_distance")
    assert plan.claims == ((), (12, 6, 2, 8))
    assert actions[:, 0].tolist()[:3] == [4, 4, 4]
    assert (actions[3:, 0] < 4).all()
    with pytest.raises(ValueError, match="agent 0 of this plan waits at step 0"):
        plan.joint_actions()
    assert replay(problem, plan.joint_actions(allow_wait=True)).claims == plan.claims


def test_idle_agents_bump_beside_their_starts() -> None:
    """An agent without a task bumps into the wall beside its own start, not the depot's."""
    problem = Problem(Grid.from_text("D....\n.....\n.....\n...#."), (10,), 2, starts=(15, 13))
    assert walk_routes(problem, ([10], [])).tolist() == [[2, 3]]


def test_renaming_agents_renames_the_plan() -> None:
    """Agents in another order, each with its start and actions: the same tours, in that order."""
    rng = np.random.default_rng(3)
    compared = 0
    for _ in range(300):
        problem = random_problem(rng, 4)
        actions = rng.integers(0, 5, (30, problem.n_agents))
        order = rng.permutation(problem.n_agents)
        starts = [problem.start_cells[agent] for agent in order]
        renamed = dataclasses.replace(problem, starts=starts)
        plan, other = replay(problem, actions), replay(renamed, actions[:, order])
        assert other.cover_time == plan.cover_time
        # Of two that come at once, the lower index claims: names matter there, and only there.
        if not walk(problem, actions)["ties"]:
            compared += 1
            for name in ("tours", "claims", "claim_steps"):
                was = getattr(plan, name)
                assert list(getattr(other, name)) == [was[agent] for agent in order]
            assert (other.makespan, other.total_distance) == (plan.makespan, plan.total_distance)
    assert 100 < compared < 300


def test_starts_on_the_depot_change_nothing() -> None:
    """To say that all start on the depot is to say nothing: the same plans, to the last action."""
    rng = np.random.default_rng(4)
    for _ in range(40):
        problem = random_problem(rng)
        plain = Problem(problem.grid, problem.landmarks, problem.n_agents)
        said = dataclasses.replace(plain, starts=(plain.grid.depot,) * plain.n_agents)
        assert said == plain
        for objective in OBJECTIVES:
            assert solve(said, objective) == solve(plain, objective)


# -- what is refused -----------------------------------------------------------------------------

PROBLEM = Problem(Grid.from_text("....\n.D..\n...."), (0, 11), 2, starts=(3, 8))
PLAN = solve(PROBLEM)


def test_tours_begin_at_the_agents_own_start() -> None:
    """A tour from elsewhere, even the depot or the other start, or without its end is refused."""
    assert [tour[0] for tour in PLAN.tours] == [3, 8]
    for tours in (
        PLAN.tours[::-1],
        (PLAN.tours[0][1:], PLAN.tours[1]),
        (PLAN.tours[0][:-1], PLAN.tours[1]),
        ((5, 1, 0, 1, 5), PLAN.tours[1]),
    ):
        with pytest.raises(ValueError, match="must start at cell 3 and end at the depot, cell 5"):
            dataclasses.replace(PLAN, tours=tours).verify()


def test_a_plan_is_of_its_starts_alone() -> None:
    """A plan is not one of the problem with other starts, nor of the one without."""
    for starts in ((8, 3), (3, 9), None):
        with pytest.raises(ValueError, match="plan: "):
            PLAN.verify(dataclasses.replace(PROBLEM, starts=starts))


# -- files -----------------------------------------------------------------------------------------

OLD_PROBLEM = r"""{
 "format": "mapp_env problem",
 "version": 1,
 "grid": "..#.\n.D..\n....",
 "landmarks": [0, 3, 11],
 "n_agents": 2,
 "max_cycles": 20
}
"""
OLD_PLAN = r"""{
 "format": "mapp_env plan",
 "version": 1,
 "problem": {"grid": "..#.\n.D..\n....", "landmarks": [0, 3, 11], "n_agents": 2, "max_cycles": 20},
 "objective": "cover_time",
 "status": "optimal",
 "solver": "exact",
 "seconds": 0.042687967001256766,
 "bound": 5,
 "cover_time": 5,
 "makespan": 8,
 "total_distance": 12,
 "tours": [[5, 6, 7, 11, 7, 3, 7, 6, 5], [5, 4, 0, 1, 5]],
 "claims": [[11, 3], [0]],
 "claim_steps": [[3, 5], [2]],
 "actions": ["11322", "02130"]
}
"""


def test_files_of_version_1_are_read(tmp_path: Path) -> None:
    """Files from before there were starts hold the problem and the plan that is made today."""
    (tmp_path / "problem.json").write_text(OLD_PROBLEM, encoding="ascii")
    (tmp_path / "plan.json").write_text(OLD_PLAN, encoding="ascii")
    problem, plan = Problem.load(tmp_path / "problem.json"), Plan.load(tmp_path / "plan.json")
    assert plan.problem == problem
    assert (problem.starts, problem.start_cells) == (None, (5, 5))
    assert plan == solve(problem)


def test_an_old_file_has_no_starts(tmp_path: Path) -> None:
    """The new field in an old file is an unknown field, and without it a new one lacks one."""
    path = tmp_path / "problem.json"
    for version, starts in ((1, {"starts": [3, 8]}), (2, {})):
        fields = {**json.loads(OLD_PROBLEM), "version": version, **starts}
        path.write_text(json.dumps(fields), encoding="ascii")
        with pytest.raises(ValueError, match=r"unknown field 'starts'|lacks the field 'starts'"):
            Problem.load(path)


@pytest.mark.parametrize("listed", [100_000, 0])
def test_plans_from_starts_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, listed: int
) -> None:
    """Written and read, a plan is the same: its tours as cells, or as moves from each start."""
    monkeypatch.setattr(mapp_env.plans.plan, "MAX_LISTED_CELLS", listed)
    rng = np.random.default_rng(6)
    for _ in range(30):
        problem = random_problem(rng)
        plan = solve(problem, "makespan")
        plan.save(tmp_path / "plan.json")
        loaded = Plan.load(tmp_path / "plan.json")
        assert loaded == plan
        assert loaded.problem is not None
        assert loaded.problem.starts == problem.starts
        tours = json.loads((tmp_path / "plan.json").read_text())["tours"]
        assert all(type(tour) is (list if listed else str) for tour in tours)


@pytest.mark.parametrize(
    ("starts", "reason"),
    [
        ([3], "starts must hold 2 cells"),
        ([3, 8, 8], "starts must hold 2 cells"),
        ([3, 0], r"starts\[1\] must not be a landmark"),
        ([3, 12], r"starts\[1\] must be a cell"),
        ([3, "8"], "field 'starts' must hold integers"),
        ("depot", "field 'starts' must be a list"),
    ],
)
def test_bad_starts_of_a_file_are_refused(tmp_path: Path, starts: object, reason: str) -> None:
    """A problem's starts are as checked in a plan file as everywhere."""
    PLAN.save(tmp_path / "plan.json")
    fields = json.loads((tmp_path / "plan.json").read_text())
    fields["problem"]["starts"] = starts
    (tmp_path / "plan.json").write_text(json.dumps(fields), encoding="ascii")
    with pytest.raises(ValueError, match=reason) as caught:
        Plan.load(tmp_path / "plan.json")
    assert "plan.json" in str(caught.value)

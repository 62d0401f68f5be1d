"""Plans: what they record, what they play again, and that verify() lets nothing broken through."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from mapp_env import Grid, Plan, Problem, make_grid, replay, sample_problems, solve
from mapp_env.plans.tours import walk_tours

LINE = Problem(Grid.from_text("#D...#"), (2, 4), 2)  # cells 1 to 4 are free


def random_walk(rng: np.random.Generator, n_actions: int = 5) -> tuple[Problem, np.ndarray]:
    """Return a small problem and random joint actions, often enough to solve it."""
    grid = Grid(np.zeros((3, 3), bool))
    landmarks = rng.choice(grid.reachable, rng.integers(1, 4), replace=False).tolist()
    problem = Problem(grid, landmarks, int(rng.integers(1, 4)))
    return problem, rng.integers(0, n_actions, (25, problem.n_agents))


def test_a_plan_records_what_was_played() -> None:
    """A replay's plan holds the actions up to the last claim, and each claim with its step."""
    plan = replay(LINE, [[1, 0], [0, 1], [1, 1], [1, 1], [1, 1]])
    assert plan.actions == ((1, 0), (0, 1), (1, 1), (1, 1))
    assert plan.claims == ((2,), (4,))
    assert plan.claim_steps == ((1,), (4,))
    assert plan.tours == ((1, 2, 1), (1, 2, 3, 4, 3, 2, 1))
    assert (plan.cover_time, plan.makespan, plan.total_distance) == (4, 7, 8)
    assert (plan.solver, plan.bound, plan.status, plan.problem) == (
        "replay",
        None,
        "feasible",
        LINE,
    )


def test_joint_actions_play_the_same_plan() -> None:
    """What joint_actions() returns replays to an equal plan, bumps and detours and all."""
    rng = np.random.default_rng(0)
    solved = 0
    for _ in range(300):
        problem, actions = random_walk(rng, 4)
        plan = replay(problem, actions)
        solved += plan.success
        again = plan.joint_actions()
        assert again.shape == (min(len(actions), plan.cover_time), problem.n_agents)
        assert replay(problem, again) == plan
    assert 50 < solved < 300


def test_joint_actions_with_waits_cost_the_same() -> None:
    """With waits, idle agents stand still; tours, claims and costs stay."""
    rng = np.random.default_rng(1)
    waits = 0
    for _ in range(300):
        problem, actions = random_walk(rng)
        plan = replay(problem, actions)
        waiting = plan.joint_actions(allow_wait=True)
        again = replay(problem, waiting)
        for name in ("tours", "claims", "claim_steps", "cover_time", "makespan", "total_distance"):
            assert getattr(again, name) == getattr(plan, name)
        waits += int((waiting == 4).sum() > (np.array(plan.actions) == 4).sum())
    assert waits > 100


def test_agents_wait_from_when_they_could_be_home() -> None:
    """With waits, an agent acts as before until it had the time to walk home, and then stands."""
    rng = np.random.default_rng(3)
    late = 0
    for _ in range(300):
        problem, actions = random_walk(rng, 4)
        plan = replay(problem, actions)
        waiting = plan.joint_actions(allow_wait=True)
        for agent, claims in enumerate(plan.claims):
            home = 0
            if claims:
                home = plan.claim_steps[agent][-1] + int(problem.grid.home[claims[-1]])
            before = np.array(plan.actions).reshape(waiting.shape)[:home, agent]
            assert waiting[:home, agent].tolist() == before.tolist()
            assert (waiting[home:, agent] == 4).all()
            late += 0 < home < len(waiting)
    assert late > 50


def test_a_replay_ends_at_the_problems_limit() -> None:
    """Actions beyond the problem's step limit are not carried out, landmarks there not visited."""
    for limit, solved in ((2, False), (3, True), (4, True), (None, True)):
        problem = dataclasses.replace(LINE, max_cycles=limit)
        plan = replay(problem, [[1, 4]] * 5)
        assert (plan.success, len(plan.actions)) == (solved, 3 if solved else 2)
        assert plan.claims == ((2, 4) if solved else (2,), ())


def test_joint_actions_refuse_what_they_cannot_say() -> None:
    """A plan that waits cannot be played without the action; one without actions not at all."""
    plan = replay(LINE, [[1, 4], [1, 4], [1, 4]])
    assert plan.success
    with pytest.raises(ValueError, match="agent 1 of this plan waits at step 0"):
        plan.joint_actions()
    by_hand = dataclasses.replace(plan, actions=(), claim_steps=(), problem=None)
    for problem in (None, LINE):
        with pytest.raises(ValueError, match="needs a plan from"):
            dataclasses.replace(by_hand, problem=problem).joint_actions()
    nothing = replay(LINE, np.empty((0, 2), int))
    assert nothing.joint_actions().shape == (0, 2)


def test_joint_actions_are_the_callers() -> None:
    """Writing into the returned array does not change the plan."""
    plan = solve(LINE)
    plan.joint_actions()[:] = 0
    plan.joint_actions(allow_wait=True)[:] = 0
    plan.verify()


def test_every_replay_verifies() -> None:
    """Whatever was played, solved or not, its plan verifies."""
    rng = np.random.default_rng(2)
    for _ in range(300):
        problem, actions = random_walk(rng)
        plan = replay(problem, actions[: rng.integers(0, 26)])
        plan.verify()
        plan.verify(problem)


def test_a_plan_by_hand_verifies() -> None:
    """Tours, claims and costs are enough, if the tours are walked without a pause."""
    plan = Plan(((1, 2, 3, 4, 3, 2, 1), ()), ((2, 4), ()), 3, 6, 6)
    plan.verify(LINE)
    with pytest.raises(ValueError, match="problem must be"):
        plan.verify()
    with pytest.raises(ValueError, match="cover_time is stated as 4, the rules give 3"):
        dataclasses.replace(plan, cover_time=4).verify(LINE)


def test_an_idle_agent_leaves_a_claim_to_who_arrives() -> None:
    """Home early, agent 0 does not step on the landmark that agent 1 reaches at the same time."""
    problem = Problem(Grid.from_text("...\n.D.\n..."), (3, 5), 2)
    actions = walk_tours(problem, [(4, 5, 4), (4, 1, 0, 3, 4)])
    assert actions.tolist() == [[1, 2], [0, 0], [1, 3]]
    Plan(((4, 5, 4), (4, 1, 0, 3, 4)), ((5,), (3,)), 3, 4, 6).verify(problem)


def test_an_idle_agent_bumps_where_it_can() -> None:
    """With a wall beside the depot, an agent without a task stays, though a way is free first."""
    problem = Problem(Grid.from_text("#...D#"), (1, 3), 2)
    assert walk_tours(problem, [(4, 3, 2, 1, 2, 3, 4), ()]).tolist() == [[0, 1]] * 3


PLUS = Problem(Grid.from_text("#.#\n.D.\n#.#"), (1, 3, 5, 7), 3)  # landmarks on all sides


def test_an_idle_agent_waits_until_a_way_is_free() -> None:
    """With landmarks all around, an agent before the one that walks leaves it the first claim."""
    tour = (4, 1, 4, 3, 4, 5, 4, 7, 4)
    actions = walk_tours(PLUS, [(), tour, ()])
    assert actions[:, 0].tolist() == [4, 2, 3, 2, 3, 2, 3]
    assert actions[:, 2].tolist() == [2, 3, 2, 3, 2, 3, 2]
    assert replay(PLUS, actions).claims == ((), (1, 3, 5, 7), ())


def test_an_idle_agent_follows_the_lowest_of_a_tie() -> None:
    """Where two arrive at once, the one of lower index claims, so one between may come along."""
    actions = walk_tours(PLUS, [(4, 1, 4, 3, 4, 5, 4), (), (4, 1, 4, 7, 4)])
    assert actions[:, 1].tolist() == [2, 3, 2, 3, 2]
    assert replay(PLUS, actions).claims == ((1, 3, 5), (), (7,))


def test_long_plans_are_checked() -> None:
    """A tour of a hundred thousand cells verifies, or is found to jump: each step is seen once."""
    plan = Plan(((1, 2) * 50_000 + (1, 2, 3, 4, 3, 2, 1), ()), ((2, 4), ()), 100_003, 100_006, 1)
    with pytest.raises(ValueError, match="total_distance is stated as 1, the rules give 100006"):
        plan.verify(LINE)
    jump = dataclasses.replace(plan, tours=(plan.tours[0][:-3] + plan.tours[0][-2:], ()))
    with pytest.raises(ValueError, match="jumps from cell 4 to 2"):
        jump.verify(LINE)


OPEN = Problem(Grid.from_text("...\n.D.\n..#"), (0, 2), 2)  # cells 0 to 7 are free
PLAN = replay(OPEN, [[0, 1], [2, 2]])
TOURS = ((4, 3, 0, 1, 4), (4, 5, 2, 1, 4))
BROKEN: dict[str, tuple[dict[str, Any], str]] = {
    "starts elsewhere": ({"tours": (TOURS[0][1:], TOURS[1])}, "start and end at the depot"),
    "ends elsewhere": ({"tours": (TOURS[0][:-1], TOURS[1])}, "start and end at the depot"),
    "jumps": ({"tours": ((4, 0, 1, 4), TOURS[1])}, "jumps from cell 4 to 0"),
    "jumps a row": ({"tours": (TOURS[0], (4, 3, 2, 1, 4))}, "jumps from cell 3 to 2"),
    "stands still": ({"tours": ((4, 3, 0, 0, 1, 4), TOURS[1])}, "jumps from cell 0 to 0"),
    "wall": ({"tours": ((4, 5, 8, 5, 4), TOURS[1])}, "enters cell 8, which is a wall"),
    "off the grid": ({"tours": ((4, 9, 4), TOURS[1])}, "must be a cell in 0..8"),
    "below the grid": ({"tours": ((4, -5, 4), TOURS[1])}, "must be a cell in 0..8"),
    "no whole number": ({"tours": ((4, 3.0, 4), TOURS[1])}, "must be a cell in 0..8"),
    "one agent": ({"tours": TOURS[:1]}, "has 1 tours and 2 lists of claims"),
    "three agents": ({"tours": (*TOURS, ())}, "has 3 tours"),
    "three claimers": ({"claims": (*PLAN.claims, ())}, "3 lists of claims"),
    "misses a landmark": ({"tours": (TOURS[0], ()), "claims": ((0,), ())}, "claims is stated"),
    "claims twice": ({"claims": ((0,), (0,))}, "claims is stated"),
    "claims a free cell": ({"claims": ((0,), (2, 1))}, "claims is stated"),
    "claims without a tour": ({"tours": (TOURS[0], ())}, "tours is stated"),
    "a tour without claims": (
        {"claims": ((0,), ()), "cover_time": math.inf, "makespan": math.inf},
        "cover_time is stated as inf",
    ),
    "does not visit": ({"tours": (TOURS[1], TOURS[1])}, "tours is stated"),
    "claims in another order": (
        {"tours": ((4, 3, 0, 1, 2, 1, 4), ()), "claims": ((2, 0), ())},
        "claims is stated",
    ),
    "detour home": ({"tours": ((4, 3, 0, 3, 4, 3, 4), TOURS[1])}, "tours is stated"),
    "other way out": ({"tours": ((4, 1, 0, 1, 4), TOURS[1])}, "tours is stated"),
    "swapped claims": ({"claims": PLAN.claims[::-1], "tours": PLAN.tours[::-1]}, "claims is"),
    "cover time": ({"cover_time": 1}, "cover_time is stated as 1, the rules give 2"),
    "makespan": ({"makespan": 3}, "makespan is stated as 3"),
    "total distance": ({"total_distance": 7}, "total_distance is stated as 7"),
    "infinite": ({"cover_time": math.inf, "status": "infeasible"}, "cover_time is stated as inf"),
    "actions": ({"actions": ((0, 1), (2, 2), (0, 0))}, "actions are not"),
    "other actions": ({"actions": ((0, 1), (2, 3))}, "rules give"),
    "no claim steps": ({"claim_steps": ()}, "claim_steps and actions"),
    "claim steps": ({"claim_steps": ((1,), (2,))}, "claim_steps and actions"),
    "objective": ({"objective": "time"}, "objective must be one of"),
    "status": ({"status": "great"}, "status must be one of"),
    "solved and infeasible": ({"status": "infeasible"}, "contradicts success=True"),
    "bound": ({"bound": 3}, "bound 3 is above the cost"),
    "unproven": ({"status": "optimal"}, "'optimal' needs bound"),
    "a pair for a cell": ({"tours": ((4, (1, 0), 0, 1, 4), TOURS[1])}, "must be a cell in 0..8"),
    "a huge number": ({"tours": ((4, 10**30, 4), TOURS[1])}, "must be a cell in 0..8"),
    "claim steps alone": ({"actions": (), "claim_steps": ((9,), (9,))}, "claim_steps and actions"),
    "no number for a bound": (
        {"bound": math.nan},
        "bound must be an integer in 0..9007199254740991, got nan",
    ),
    "a bound above all": ({"bound": 2**53}, "bound must be an integer in 0..9007199254740991"),
    "bound below 0": ({"bound": -1}, "bound must be an integer in 0..9007199254740991, got -1"),
    "no number of seconds": (
        {"seconds": math.nan},
        "seconds must be a number in 0..9007199254740991, got nan",
    ),
    "an absurd number of seconds": (
        {"seconds": 1e300},
        "seconds must be a number in 0..9007199254740991, got 1e",
    ),
    "negative seconds": (
        {"seconds": -1e-9},
        "seconds must be a number in 0..9007199254740991, got -1e-09",
    ),
    "a long name": ({"solver": "x" * 101}, "solver must be a str of at most 100 letters"),
    "below the bound": ({"status": "optimal", "bound": 1}, "'optimal' needs bound"),
}


def test_the_plan_to_be_broken_is_whole() -> None:
    """The plan that the next test breaks in many ways verifies, and has these tours."""
    PLAN.verify()
    assert PLAN.tours == TOURS


@pytest.mark.parametrize("name", BROKEN)
def test_verify_finds_the_fault(name: str) -> None:
    """Each way to break a plan is refused, for its own reason."""
    change, reason = BROKEN[name]
    with pytest.raises(ValueError, match=reason.replace("(", r"\(").replace("..", r"\.\.")):
        dataclasses.replace(PLAN, **change).verify(OPEN)


def test_verify_against_another_problem() -> None:
    """A plan is not one of a problem with other landmarks, walls or agents."""
    problem = Problem(make_grid(), (0, 6, 20, 42, 48), 3)
    plan = solve(problem)
    plan.verify(problem)
    grid = problem.grid
    walls = grid.walls.copy()
    walls.flat[plan.tours[0][2]] = True
    for other in (
        Problem(grid, (0, 6, 20, 42), 3),
        Problem(grid, (0, 6, 20, 42, 47), 3),
        Problem(grid, (0, 6, 20, 42, 48), 4),
        Problem(Grid(walls, grid.depot), (0, 6), 3),
    ):
        with pytest.raises(ValueError, match="plan: "):
            plan.verify(other)


def test_equal_plans_are_equal() -> None:
    """How long a plan took is no part of what it is."""
    problem = Problem(make_grid(), (0, 6, 20), 2)
    first, second = solve(problem), solve(problem)
    assert first == second
    assert first.seconds > 0
    assert hash(first) == hash(second)


@pytest.mark.parametrize("objective", ["cover_time", "makespan", "total_distance"])
def test_who_waits_is_at_home(objective: str) -> None:
    """With waiting an agent walks as recorded until it is home for good, and waits only there."""
    rng = np.random.default_rng(5)
    waited = 0
    for landmarks in sample_problems(make_grid(), 30, seed=5).tolist():
        problem = Problem(make_grid(), landmarks, int(rng.integers(1, 5)))
        plan = solve(problem, objective)
        actions = plan.joint_actions(allow_wait=True)
        cells = np.full(problem.n_agents, problem.grid.depot)
        moves = np.column_stack([problem.grid.moves, np.arange(problem.grid.n_cells)])
        for step, joint in enumerate(actions):
            assert (cells[joint == 4] == problem.grid.depot).all()
            for agent in np.flatnonzero(joint == 4):
                assert not plan.claim_steps[agent] or plan.claim_steps[agent][-1] <= step
                assert (actions[step:, agent] == 4).all()
            assert (np.array(plan.actions[step])[joint != 4] == joint[joint != 4]).all()
            cells = moves[cells, joint]
            waited += int((joint == 4).sum())
        for agent, steps in enumerate(plan.claim_steps):
            at_home = steps[-1] + problem.grid.home[plan.claims[agent][-1]] if steps else 0
            assert (actions[at_home:, agent] == 4).all()
    assert waited > 0


def test_replay_ends_at_the_problems_limit() -> None:
    """Exactly as many steps as the limit are carried out, and what lies beyond is left undone."""
    for limit in (1, 2, 3, 4, None):
        problem = Problem(LINE.grid, (4,), 1, limit)
        plan = replay(problem, [[1]] * 5)
        assert len(plan.actions) == min(limit or 5, 3)
        assert plan.success == (len(plan.actions) == 3)


def test_tours_that_leave_a_landmark_are_walked_to_their_end() -> None:
    """Without a claim to wait for, the joint actions are as many as the longest tour has moves."""
    tours = ((1, 2, 1), (1, 2, 3, 2, 1))
    actions = walk_tours(LINE, tours)  # nobody comes to cell 4
    assert actions.tolist() == [[1, 1], [0, 1], [0, 0], [0, 0]]
    assert walk_tours(LINE, ((), ())).shape == (0, 2)


def test_a_plan_may_take_longer_than_an_episode() -> None:
    """A plan is checked, kept and compared whatever the step limit of its problem."""
    problem = Problem(make_grid(), (0, 6, 20, 42, 48), 3, max_cycles=2)
    plan = solve(problem)
    assert plan.cover_time > 2
    plan.verify()
    by_hand = Plan(plan.tours, plan.claims, plan.cover_time, plan.makespan, plan.total_distance)
    by_hand.verify(problem)
    assert (
        Plan(**{**by_hand.__dict__, "problem": problem}).to_record()["problem"]["max_cycles"] == 2
    )


@pytest.mark.parametrize("status", ["feasible", "optimal"])
def test_what_leaves_a_landmark_is_infeasible(status: str) -> None:
    """A plan that does not visit all is called nothing else, and one that does not infeasible."""
    unsolved, solved = replay(LINE, [[1, 1]]), replay(LINE, [[1, 0]] * 3)
    unsolved.verify()
    with pytest.raises(ValueError, match=f"status '{status}' contradicts success=False"):
        dataclasses.replace(unsolved, status=status).verify()
    with pytest.raises(ValueError, match="status 'infeasible' contradicts success=True"):
        dataclasses.replace(solved, status="infeasible").verify()

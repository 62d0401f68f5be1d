"""Every face of the package plays exactly the game of tests/model.py."""

from __future__ import annotations

import functools
import itertools
import math
import random
from collections import Counter
from typing import Any

import gymnasium
import numpy as np
import pytest
from model import (
    OBSERVATIONS,
    PAPER_ROWS,
    REWARDS,
    Case,
    Model,
    joint_number,
    landmark_cells,
    lively_action,
    moved,
    random_case,
    random_rows,
    shortest,
)

import mapp_env
from mapp_env import mapp_v0

N_CASES = 36
CASES = range(N_CASES)


@functools.cache
def the_case(seed: int) -> Case:
    """Return case ``seed``, made once per process."""
    return random_case(seed)


@functools.cache
def the_grid(rows: tuple[str, ...]) -> mapp_env.Grid:
    """Return the package's grid of these rows, made once per process."""
    return mapp_env.Grid.from_text("\n".join(rows) + "\n")


def make_parallel(case: Case, **changes: Any) -> Any:
    """Return the PettingZoo parallel face of a case."""
    return mapp_v0.parallel_env(grid=the_grid(case.rows), **{**case.settings(), **changes})


def make_central(case: Case, **changes: Any) -> gymnasium.Env:
    """Return the Gymnasium face of a case."""
    settings = {**case.settings(), **changes}
    return gymnasium.make(
        "mapp_env/Central-v0", grid=the_grid(case.rows), disable_env_checker=True, **settings
    )


def check_numbers(array: Any, numbers: list[float]) -> None:
    """Hold an observation to be a float32 vector of exactly these numbers."""
    assert isinstance(array, np.ndarray)
    assert array.dtype == np.float32
    assert array.tolist() == numbers


def check_metrics(info: dict[str, Any], model: Model) -> None:
    """Hold metrics to be there on the last step and on no other, and to be the model's."""
    if not model.ended:
        assert "metrics" not in info
        return
    assert info["metrics"] == model.metrics()
    assert type(info["metrics"]["success"]) is bool
    for name in ("cover_time", "makespan", "total_distance"):
        assert type(info["metrics"][name]) is float


def check_mask(mask: Any, expected: list[int] | list[list[int]]) -> None:
    """Hold a mask to be int8, with a 1 exactly for the actions that do not bump."""
    assert isinstance(mask, np.ndarray)
    assert mask.dtype == np.int8
    assert mask.tolist() == expected


def test_cases_are_not_vacuous() -> None:
    """The cases hold both endings, bumps, waits, every reward, shared claims and big problems."""
    seen: Counter[str] = Counter()
    for seed in CASES:
        case = the_case(seed)
        model = case.model()
        for actions in case.actions:
            before = list(model.cells)
            model.step(actions)
            for agent, action in enumerate(actions):
                seen["wait"] += action == 4
                seen["bump"] += action != 4 and before[agent] == model.cells[agent]
            new = [sum(cell == now for now in model.cells) for cell in model.cells]
            seen["shared cell"] += max(new) > 1
        seen["terminated"] += model.terminated
        seen["truncated"] += model.truncated
        seen["wide"] += len(case.rows) != len(case.rows[0])
        seen["line"] += min(len(case.rows), len(case.rows[0])) == 1
        seen["16 agents"] += case.n_agents == 16
        seen["64 landmarks"] += len(case.landmarks) == 64
        seen[f"{case.reward}, wait {case.allow_wait}"] += 1
        seen["idle agent"] += model.terminated and not all(model.claimed)
        seen["two claims"] += any(len(claims) > 1 for claims in model.claimed)
    assert len(seen) == 11 + 2 * len(REWARDS)
    assert all(count >= 2 for count in seen.values()), seen


@pytest.mark.parametrize("seed", CASES)
def test_parallel_env_plays_the_model(seed: int) -> None:
    """ParallelEnv: observations, rewards, flags, masks, metrics and agents are the model's."""
    case = the_case(seed)
    env = make_parallel(case)
    for _ in range(2):  # a second episode on the same object starts afresh
        model = case.model()
        observations, infos = env.reset(options={"landmarks": list(case.landmarks)})
        agents = [f"agent_{index}" for index in range(case.n_agents)]
        assert env.possible_agents == agents
        assert env.agents == agents
        assert list(observations) == list(infos) == agents
        for index, agent in enumerate(agents):
            check_numbers(observations[agent], model.global_observation())
            check_mask(infos[agent]["action_mask"], model.action_mask(index))
            assert "metrics" not in infos[agent]
        check_numbers(env.state(), model.global_observation())
        for actions in case.actions:
            assert env.agents == agents
            reward, terminated, truncated = model.step(actions)
            results = env.step(dict(zip(agents, actions, strict=True)))
            observations, rewards, terminations, truncations, infos = results
            assert rewards == dict.fromkeys(agents, reward)
            assert terminations == dict.fromkeys(agents, terminated)
            assert truncations == dict.fromkeys(agents, truncated)
            for flag in [*terminations.values(), *truncations.values()]:
                assert type(flag) is bool
            for value in rewards.values():
                assert isinstance(value, float)
            assert list(observations) == list(infos) == agents
            for index, agent in enumerate(agents):
                check_numbers(observations[agent], model.global_observation())
                assert env.observation_space(agent).contains(observations[agent])
                check_mask(infos[agent]["action_mask"], model.action_mask(index))
                check_metrics(infos[agent], model)
            check_numbers(env.state(), model.global_observation())
        assert model.ended
        assert env.agents == []


@pytest.mark.parametrize("seed", CASES)
def test_aec_env_plays_the_model(seed: int) -> None:
    """AEC: each agent's last() after each round shows the model's step, ``own_first`` view."""
    case = the_case(seed)
    env = mapp_v0.env(grid=the_grid(case.rows), observation="own_first", **case.settings())
    env.reset(options={"landmarks": list(case.landmarks)})
    model = case.model()
    reward, terminated, truncated = 0.0, False, False
    for actions in [*case.actions, None]:
        order = range(case.n_agents)
        if actions is None:  # PettingZoo sends ended agents off in the order of their names
            order = sorted(order, key=str)
        for index in order:
            assert env.agent_selection == f"agent_{index}"
            observation, last_reward, last_terminated, last_truncated, info = env.last()
            check_numbers(observation, model.own_first(index))
            assert last_reward == reward
            assert (last_terminated, last_truncated) == (terminated, truncated)
            check_mask(info["action_mask"], model.action_mask(index))
            check_metrics(info, model)
            env.step(None if actions is None else actions[index])
        if actions is not None:
            reward, terminated, truncated = model.step(actions)
    assert model.ended
    assert env.agents == []


@pytest.mark.parametrize("central_action", ["joint", "multi"])
@pytest.mark.parametrize("seed", CASES)
def test_central_env_plays_the_model(seed: int, central_action: str) -> None:
    """Central-v0: one number (first agent most significant) or one action per agent, as modelled.

    More than six agents have no joint number, so there ``joint`` checks the default space.
    """
    case = the_case(seed)
    multi = central_action == "multi" or case.n_agents > 6
    env = make_central(case, **({"central_action": "multi"} if central_action == "multi" else {}))
    model = case.model()
    if multi:
        assert env.action_space.nvec.tolist() == [model.n_actions] * case.n_agents
    else:
        assert env.action_space.n == model.n_actions**case.n_agents
    observation, info = env.reset(options={"landmarks": list(case.landmarks)})
    for actions in [None, *case.actions]:
        if actions is not None:
            action = np.array(actions) if multi else joint_number(actions, model.n_actions)
            observation, reward, terminated, truncated, info = env.step(action)
            assert (reward, terminated, truncated) == model.step(actions)
            assert isinstance(reward, float)
            assert type(terminated) is type(truncated) is bool
        check_numbers(observation, model.global_observation())
        assert env.observation_space.contains(observation)
        masks = [model.action_mask(agent) for agent in range(case.n_agents)]
        check_mask(info["action_mask"], masks)
        if multi:
            assert "joint_action_mask" not in info
        else:  # the outer product of the agents' masks, the first agent most significant
            every = functools.reduce(lambda some, mask: np.multiply.outer(some, mask), masks, 1)
            check_mask(info["joint_action_mask"], every.ravel().tolist())
        check_metrics(info, model)
    assert model.ended


@pytest.mark.parametrize("seed", CASES)
def test_replay_scores_as_the_model(seed: int) -> None:
    """replay(): the plan's costs and claims are the model's, its tours are closed legal walks."""
    case = the_case(seed)
    model = case.model()
    for actions in case.actions:
        model.step(actions)
    problem = mapp_env.Problem(
        the_grid(case.rows), case.landmarks, n_agents=case.n_agents, max_cycles=case.max_cycles
    )
    actions = np.array(case.actions)
    plan = mapp_env.replay(problem, actions)
    metrics = model.metrics()
    assert plan.success is metrics["success"]
    for name in ("cover_time", "makespan", "total_distance"):
        assert getattr(plan, name) == metrics[name]
    assert [list(claims) for claims in plan.claims] == model.claimed
    assert len(plan.tours) == case.n_agents
    moves = 0
    for index, tour in enumerate(plan.tours):
        if not model.claimed[index]:
            assert tuple(tour) == ()
            continue
        assert tour[0] == tour[-1] == the_grid(case.rows).depot
        for here, there in itertools.pairwise(tour):
            assert there in [moved(case.rows, here, action) for action in range(5)]
        assert set(model.claimed[index]) <= set(tour)
        moves += sum(here != there for here, there in itertools.pairwise(tour))
        cut = model.claim_step[index]
        walked = [
            cell
            for cell, before in zip(
                model.history[index][1 : cut + 1], model.history[index][:cut], strict=True
            )
            if cell != before
        ]
        cells = [c for c, before in zip(tour[1:], tour, strict=False) if c != before]
        assert cells[: len(walked)] == walked
        assert len(cells) - len(walked) == model.home[model.history[index][cut]]
    if model.terminated:
        assert moves == metrics["total_distance"]


@pytest.mark.parametrize("kind", OBSERVATIONS)
@pytest.mark.parametrize("seed", [0, 1, 3, 4, 7, 9, 12, 17, 23, 26, 27, 34])
def test_observation_kinds_are_the_model(seed: int, kind: str) -> None:
    """Each kind holds what its documentation lists, for every agent, on all three faces.

    Central-v0 and make_vec give the global vector once and the other kinds stacked per agent.
    Visited landmarks keep their geodesic features; the first feature says that they are visited.
    """
    case = the_case(seed)
    env = make_parallel(case, observation=kind)
    central = make_central(case, observation=kind, central_action="multi")
    venv = mapp_env.make_vec(2, grid=the_grid(case.rows), observation=kind, **case.settings())
    options = {"landmarks": list(case.landmarks)}
    model = case.model()
    observations, _ = env.reset(options=dict(options))
    whole, _ = central.reset(options=dict(options))
    batch, _ = venv.reset(options=dict(options))
    agents = list(env.possible_agents)
    for actions in [*case.actions[:30], None]:
        expected = [
            np.array(model.observation(kind, index), dtype=np.float32)
            for index in range(case.n_agents)
        ]
        for index, agent in enumerate(agents):
            assert observations[agent].dtype == np.float32
            assert observations[agent].shape == expected[index].shape
            np.testing.assert_allclose(observations[agent], expected[index], rtol=3e-7, atol=0)
            assert env.observation_space(agent).contains(observations[agent])
        stacked = np.stack([observations[agent] for agent in agents])
        if kind == "global":
            stacked = stacked[0]
        assert whole.tobytes() == stacked.tobytes()
        assert whole.shape == stacked.shape
        assert batch.dtype == np.float32
        assert batch.tobytes() == np.stack([whole, whole]).tobytes()
        if actions is None or model.ended:
            break
        model.step(actions)
        observations, *_ = env.step(dict(zip(agents, actions, strict=True)))
        whole, *_ = central.step(np.array(actions))
        batch, *_ = venv.step(np.array([actions, actions]))


N_ROWS, N_STEPS = 24, 110


@pytest.mark.parametrize("setting", range(8))
def test_vector_rows_play_the_model(setting: int) -> None:
    """make_vec: every row is the model's game for several episodes, landmarks drawn or given."""
    case = the_case((0, 4, 5, 8, 27, 7, 10, 1)[setting])
    rng = random.Random(setting)
    settings = case.settings()
    reward, allow_wait = REWARDS[setting % len(REWARDS)], bool(setting % 2)
    settings.update(max_cycles=(5, 30, 50)[setting % 3], reward=reward, allow_wait=allow_wait)
    n_rows = 6 if len(case.landmarks) == 64 else N_ROWS
    n_agents, n_landmarks = case.n_agents, len(case.landmarks)
    allowed = landmark_cells(case.rows)
    given = [rng.sample(allowed, n_landmarks) for _ in range(n_rows)]
    venv = mapp_env.make_vec(n_rows, grid=the_grid(case.rows), **settings)
    observations, infos = venv.reset(seed=setting, options={"landmarks": np.array(given)})

    def fresh(landmarks: list[int]) -> Model:
        return Model(
            case.rows, tuple(landmarks), n_agents, reward, allow_wait, settings["max_cycles"]
        )

    models = [fresh(landmarks) for landmarks in given]
    ended = [False] * n_rows
    for step in range(N_STEPS + 1):
        if step:
            actions = np.array([lively_action(model, rng) for model in models])
            observations, rewards, terminations, truncations, infos = venv.step(actions)
            assert rewards.dtype == np.float64
            assert terminations.dtype == truncations.dtype == np.bool_
        for row, model in enumerate(models):
            if step and models[row].ended:  # this call began the row's next episode
                drawn = observations[row, n_agents : n_agents + n_landmarks].astype(int).tolist()
                assert len(set(drawn)) == n_landmarks
                assert set(drawn) <= set(allowed)
                model = models[row] = fresh(drawn)
                expected: tuple[float, bool, bool] = (0.0, False, False)
                ended[row] = True
            elif step:
                expected = model.step(actions[row].tolist())
            if step:
                assert (rewards[row], terminations[row], truncations[row]) == expected
            check_numbers(observations[row], model.global_observation())
            check_mask(
                infos["action_mask"][row], [model.action_mask(agent) for agent in range(n_agents)]
            )
            assert infos["_action_mask"][row]
            has_metrics = "_metrics" in infos and bool(infos["_metrics"][row])
            assert has_metrics == model.ended
            if has_metrics:
                scored = {
                    name: infos["metrics"][name][row]
                    for name in ("success", "cover_time", "makespan", "total_distance")
                }
                assert scored == model.metrics()
    assert all(ended)


@pytest.mark.parametrize("n_steps_too_few", [0, 1])
def test_last_step_ends_one_way(n_steps_too_few: int) -> None:
    """Covering on the very last step terminates; one step less truncates; never both (R7)."""
    found = 0
    for seed in CASES:
        case = the_case(seed)
        model = case.model()
        for actions in case.actions:
            model.step(actions)
        if not model.terminated or model.steps < 2:
            continue
        found += 1
        env = make_central(case, max_cycles=model.steps - n_steps_too_few, central_action="multi")
        env.reset(options={"landmarks": list(case.landmarks)})
        for actions in case.actions[: model.steps - n_steps_too_few]:
            _, reward, terminated, truncated, info = env.step(np.array(actions))
        assert terminated is (n_steps_too_few == 0)
        assert truncated is (n_steps_too_few == 1)
        assert (reward == 0.0) is terminated
        assert info["metrics"]["success"] is terminated
    assert found >= 8


def test_paper_problem_by_hand() -> None:
    """A hand-computed episode on paper-7x7: rewards, claims, cover time, makespan, distance.

    Agent 0 goes up to 17, agent 1 bumps left into the wall 23, agent 2 goes right to 25; then
    agent 1 goes down to 31 while the others walk on in vain.
    """
    env = mapp_v0.parallel_env(n_landmarks=3)
    observations, _ = env.reset(options={"landmarks": [17, 31, 25]})
    assert observations["agent_0"].tolist() == [24, 24, 24, 17, 31, 25, 0, 0, 0]
    observations, rewards, terminations, _, infos = env.step(
        {"agent_0": 2, "agent_1": 0, "agent_2": 1}
    )
    assert observations["agent_2"].tolist() == [17, 24, 25, 17, 31, 25, 1, 0, 1]
    assert rewards["agent_1"] == -1.0
    assert infos["agent_1"]["action_mask"].tolist() == [0, 1, 1, 1]
    assert not terminations["agent_0"]
    observations, rewards, terminations, truncations, infos = env.step(
        {"agent_0": 2, "agent_1": 3, "agent_2": 1}
    )
    assert observations["agent_0"].tolist() == [10, 31, 26, 17, 31, 25, 1, 1, 1]
    assert rewards["agent_2"] == 0.0
    assert terminations["agent_1"]
    assert not truncations["agent_1"]
    assert infos["agent_0"]["metrics"] == {
        "success": True,
        "cover_time": 2.0,
        "makespan": 3.0,  # agent 1: a bump, one step, one step home
        "total_distance": 6.0,
    }


def test_paper_grid_is_r1() -> None:
    """The default grid is the one of R1: its walls, its depot and its row-major cells."""
    grid = mapp_env.make_grid("paper-7x7")
    walls = [[letter == "#" for letter in line] for line in PAPER_ROWS]
    assert grid.walls.tolist() == walls
    assert (grid.rows, grid.cols, grid.depot) == (7, 7, 24)
    assert sum(map(sum, walls)) == 8
    state = mapp_v0.parallel_env()
    state.reset(seed=0)
    assert state.state().shape == (13,)
    assert state.state()[:3].tolist() == [24.0, 24.0, 24.0]


@pytest.mark.parametrize("seed", range(12))
def test_grid_tables_are_the_model(seed: int) -> None:
    """Grid: text, moves, distances, home, reachable cells and paths are those of plain BFS.

    From a wall nothing leads anywhere; of equal paths the first in the order of actions is taken.
    """
    rng = random.Random(seed)
    rows = random_rows(rng, rng.randint(1, 9), rng.randint(2, 9), 1)
    grid = mapp_env.Grid.from_text("\n".join(rows) + "\n")
    n_rows, n_cols = len(rows), len(rows[0])
    assert (grid.rows, grid.cols, grid.n_cells) == (n_rows, n_cols, n_rows * n_cols)
    assert mapp_env.Grid.from_text(grid.to_text()).to_text() == grid.to_text()
    assert sorted(grid.reachable.tolist()) == landmark_cells(rows)
    home = shortest(rows, grid.depot)
    for cell in range(grid.n_cells):
        if rows[cell // n_cols][cell % n_cols] == "#":
            assert (grid.moves[cell] == cell).all()
            assert (grid.distances[cell] == -1).all()
            assert (grid.distances_from([cell]) == -1).all()
            continue
        assert [int(n) for n in grid.moves[cell][:4]] == [moved(rows, cell, a) for a in range(4)]
        assert grid.home[cell] == home.get(cell, -1)
        steps = shortest(rows, cell)
        row = [steps.get(other, -1) for other in range(grid.n_cells)]
        assert grid.distances[cell].tolist() == row
        assert grid.distances_from([cell]).tolist() == [row]
    for goal in landmark_cells(rows):
        path = grid.path(grid.depot, goal)
        assert len(path) == home[goal] + 1
        assert (path[0], path[-1]) == (grid.depot, goal)
        for here, there in itertools.pairwise(path):
            ways = [moved(rows, here, action) for action in range(4)]
            ahead = grid.distances[goal, here] - 1
            assert there == next(way for way in ways if grid.distances[goal, way] == ahead)


def test_claim_goes_to_the_lowest_index() -> None:
    """Agents that reach a landmark on one step: the lowest index claims, the others get nothing."""
    problem = mapp_env.Problem(mapp_env.Grid.from_text("D..\n"), (2,), n_agents=3)
    plan = mapp_env.replay(problem, np.array([[1, 1, 0], [1, 1, 1], [0, 1, 1]]))
    assert [list(claims) for claims in plan.claims] == [[2], [], []]
    assert [bool(tour) for tour in plan.tours] == [True, False, False]
    assert (plan.cover_time, plan.makespan, plan.total_distance) == (2, 4, 4)


def test_unfinished_plan_costs_infinity() -> None:
    """A replay that misses a landmark is no success, and each of its costs is infinite."""
    problem = mapp_env.Problem(mapp_env.Grid.from_text("..D..\n"), (0, 4), n_agents=1)
    plan = mapp_env.replay(problem, np.array([[0], [0]]))
    assert plan.success is False
    assert plan.cover_time == plan.makespan == plan.total_distance == math.inf


def test_drawn_landmarks_are_uniform_over_the_allowed_cells() -> None:
    """Over many seeds each allowed cell is drawn about equally often, the forbidden ones never."""
    n_rows = 3000
    venv = mapp_env.make_vec(n_rows, n_landmarks=5, n_agents=1)
    observations, _ = venv.reset(seed=11)
    drawn = observations[:, 1:6].astype(int)
    allowed = landmark_cells(PAPER_ROWS)
    counts = np.bincount(drawn.ravel(), minlength=49)
    assert set(np.flatnonzero(counts)) == set(allowed)
    expected = n_rows * 5 / len(allowed)
    assert np.abs(counts[allowed] - expected).max() < 5 * math.sqrt(expected)
    assert len({tuple(sorted(row)) for row in drawn.tolist()}) > 0.98 * n_rows


def play_parallel(env: Any) -> int:
    """Play an episode without a visit on a PettingZoo parallel face; return its length."""
    length = 0
    while env.agents:
        *_, truncations, _ = env.step(dict.fromkeys(env.agents, 0))
        length += 1
    assert all(truncations.values())
    return length


def play_aec(env: Any) -> int:
    """Do so agent by agent."""
    length = 0
    while env.agents:
        ended = env.truncations[env.agent_selection]
        length += not ended and env.agent_selection == env.possible_agents[0]
        env.step(None if ended else 0)
    return length


def play_gymnasium(env: Any) -> int:
    """Do so on a Gymnasium face."""
    length, truncated = 0, False
    while not truncated:
        *_, truncated, _ = env.step(env.action_space.sample())
        length += 1
    return length


@pytest.mark.parametrize(
    ("make", "play"),
    [
        (mapp_v0.parallel_env, play_parallel),
        (mapp_v0.raw_env, play_aec),
        (mapp_v0.env, play_aec),
        (lambda **more: gymnasium.make("mapp_env/Central-v0", **more).unwrapped, play_gymnasium),
        (lambda **more: gymnasium.make("mapp_env/Tuple-v0", **more).unwrapped, play_gymnasium),
    ],
    ids=["parallel", "aec", "ordered aec", "central", "tuple"],
)
def test_max_cycles_may_be_assigned(make: Any, play: Any) -> None:
    """An assigned max_cycles is read back, truncates the next episodes, and not the present one."""
    env = make(max_cycles=20, n_landmarks=40)
    limit = 20
    for following in (3, 30, 7):
        env.reset(seed=1)
        env.max_cycles = following
        assert env.max_cycles == env.unwrapped.max_cycles == following
        assert play(env) == limit
        limit = following
    with pytest.raises(ValueError, match="max_cycles must be an integer in 1"):
        env.max_cycles = 0
    env.reset()
    assert play(env) == env.max_cycles == 7


def test_wrappers_hand_max_cycles_on() -> None:
    """Gymnasium's set_attr and set_wrapper_attr reach the limit of the environments inside."""
    env = gymnasium.make("mapp_env/Central-v0", n_landmarks=40)
    env.set_wrapper_attr("max_cycles", 4)
    env.reset(seed=0)
    assert play_gymnasium(env) == env.get_wrapper_attr("max_cycles") == 4
    envs = gymnasium.make_vec("mapp_env/Central-v0", 2, vectorization_mode="sync", n_landmarks=40)
    envs.set_attr("max_cycles", [3, 5])
    envs.reset(seed=0)
    ends = [envs.step(envs.action_space.sample())[3].tolist() for _ in range(5)]
    assert ends == [[False, False]] * 2 + [[True, False], [False, False], [False, True]]
    assert envs.get_attr("max_cycles") == (3, 5)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_max_cycles_of_a_batch_may_be_assigned(mode: str) -> None:
    """It counts for the rows that are reset later, by themselves or not; a row under way stays."""
    envs = mapp_env.make_vec(3, autoreset_mode=mode, max_cycles=4, n_landmarks=40)
    envs.reset(seed=0)
    actions = np.zeros((3, 3), int)
    envs.step(actions)
    envs.max_cycles = 6
    mask = np.array([True, False, False])
    envs.reset(options={"reset_mask": mask})  # row 0 begins, with six steps to go
    late = 1 if mode == "NextStep" else 0  # a step that only resets
    ends: list[list[int]] = [[], [], []]
    for step in range(1, 13):
        truncated = envs.step(actions)[3]
        for row in np.flatnonzero(truncated):
            ends[row].append(step)
        if mode == "Disabled" and truncated.any():
            envs.reset(options={"reset_mask": truncated})
    assert ends == [[6] if late else [6, 12], [3, 9 + late], [3, 9 + late]]
    assert envs.max_cycles == 6
    with pytest.raises(ValueError, match="max_cycles must be an integer in 1"):
        envs.max_cycles = 2.5  # type: ignore[assignment]
    assert envs.max_cycles == 6


@pytest.mark.parametrize("kind", ["global", "geodesic"])
@pytest.mark.parametrize("reward_kind", REWARDS)
def test_large_grid_plays_the_model(reward_kind: str, kind: str) -> None:
    """On a grid too large to keep all distances, rewards and observations are the model's too."""
    rng = random.Random(5)
    rows = random_rows(rng, 62, 67, 30)
    near = sorted(shortest(rows, the_grid(rows).depot).items(), key=lambda item: item[1])
    landmarks = tuple(near[index][0] for index in (5, 30, 12, 8))
    assert the_grid(rows).n_cells > 4096
    case = Case(rows, landmarks, 2, reward_kind, False, 60, ())
    model = case.model()
    env = make_parallel(case, observation=kind)
    observations, _ = env.reset(options={"landmarks": list(landmarks)})
    while not model.ended:
        actions = lively_action(model, rng)
        reward, terminated, truncated = model.step(actions)
        observations, rewards, terminations, truncations, infos = env.step(
            dict(zip(env.agents, actions, strict=True))
        )
        assert rewards["agent_0"] == reward
        assert terminations["agent_1"] is terminated
        assert truncations["agent_1"] is truncated
        for index, agent in enumerate(env.possible_agents):
            expected = np.array(model.observation(kind, index), dtype=np.float32)
            np.testing.assert_allclose(observations[agent], expected, rtol=3e-7, atol=0)
            check_metrics(infos[agent], model)
    assert model.terminated


def test_largest_grid_and_counts() -> None:
    """A 512x512 grid with 16 agents and 256 landmarks resets and steps, with every reward."""
    grid = mapp_env.Grid.from_text("\n".join(["." * 512] * 512) + "\n")
    for reward in REWARDS:
        env = mapp_v0.parallel_env(grid=grid, n_agents=16, n_landmarks=256, reward=reward)
        env.reset(seed=0)
        before = env.state()
        _, rewards, *_ = env.step(dict.fromkeys(env.agents, 1))
        after = env.state()
        assert (after[:16] == before[:16] + 1).all()
        places = after[16:272].astype(int)
        here = int(after[0])
        far = sum(
            abs(cell // 512 - here // 512) + abs(cell % 512 - here % 512)
            for cell in places.tolist()
        )
        known = {"step": -1.0, "manhattan": -float(far), "geodesic": -float(far)}
        assert rewards["agent_0"] == known.get(reward, rewards["agent_1"])


def test_the_longest_way() -> None:
    """On a path of 131,327 steps, the longest of a 512x512 serpentine, no distance is cut short."""
    walls = np.zeros((512, 512), bool)
    walls[1::2] = True
    walls[1::4, -1] = walls[3::4, 0] = False
    grid = mapp_env.Grid(walls, depot=0)
    end = int(grid.home.argmax())
    assert grid.home[end] == 131_327
    env = mapp_v0.parallel_env(
        grid=grid, n_agents=2, n_landmarks=1, reward="geodesic", observation="geodesic"
    )
    env.reset(options={"landmarks": [end]})
    observations, rewards, *_ = env.step({"agent_0": 1, "agent_1": 0})
    assert rewards["agent_0"] == -131_326
    for agent, ways in (("agent_0", (131_326, 131_327)), ("agent_1", (131_327, 131_326))):
        seen = observations[agent][1:3] * (512 + 512)
        np.testing.assert_allclose(seen, ways, rtol=1e-7)
    plan = mapp_env.solve(mapp_env.Problem(grid, (end,), 2))
    assert (plan.cost, plan.makespan) == (131_327, 2 * 131_327)


def test_problem_brings_its_own_limit() -> None:
    """A Problem's max_cycles limits its own episode, on all faces, and no later one."""
    problem = mapp_env.Problem(
        mapp_env.make_grid("paper-7x7"), (0, 6, 20, 42, 48), n_agents=3, max_cycles=3
    )
    env = mapp_v0.parallel_env(max_cycles=6)
    central = gymnasium.make("mapp_env/Central-v0", max_cycles=6)
    venv = mapp_env.make_vec(2, max_cycles=6, autoreset_mode="Disabled")
    for limit, options in ((3, {"problem": problem}), (6, None)):
        env.reset(seed=0, options=options)
        central.reset(seed=0, options=options)
        venv.reset(seed=0, options=options)
        for step in range(1, limit + 1):
            *_, truncations, _ = env.step(dict.fromkeys(env.agents, 0))
            assert truncations["agent_0"] is (step == limit)
            assert central.step(0)[3] is (step == limit)
            batch = venv.step(np.zeros((2, 3), dtype=int))
            assert batch[3].tolist() == [step == limit] * 2


@pytest.mark.parametrize("as_pairs", [False, True])
def test_landmark_option_takes_cells_and_pairs(as_pairs: bool) -> None:
    """options["landmarks"] means the same as cells and as (row, col) pairs, in the given order."""
    cells = [48, 0, 42, 6, 20]
    given: Any = [(cell // 7, cell % 7) for cell in cells] if as_pairs else cells
    env = mapp_v0.parallel_env()
    with pytest.warns(UserWarning, match="'unknown'"):
        env.reset(seed=0, options={"landmarks": given, "unknown": 1})
    assert env.state()[3:8].tolist() == cells
    problem = mapp_env.Problem(mapp_env.make_grid("paper-7x7"), tuple(cells), n_agents=3)
    env.reset(options={"problem": problem})
    assert env.state()[3:8].tolist() == cells


@pytest.mark.parametrize("face", ["parallel", "central", "vector"])
def test_a_problems_limit_ends_with_its_episode(face: str) -> None:
    """A problem without a limit has the environment's, whatever the one before it brought."""
    grid = mapp_env.make_grid()
    env: Any = {
        "parallel": lambda: mapp_v0.parallel_env(max_cycles=6),
        "central": lambda: gymnasium.make("mapp_env/Central-v0", max_cycles=6),
        "vector": lambda: mapp_env.make_vec(2, max_cycles=6, autoreset_mode="Disabled"),
    }[face]()
    for limit, expected in ((3, 3), (None, 6), (9, 9), (None, 6)):
        problem = mapp_env.Problem(grid, (0, 6, 20, 42, 48), 3, limit)
        env.reset(options={"problem": problem})
        steps, over = 0, False
        while not over:
            if face == "parallel":
                env.step(dict.fromkeys(env.agents, 0))
                over = not env.agents
            else:
                *_, truncated, _ = env.step(0 if face == "central" else np.zeros((2, 3), np.int64))
                over = bool(np.all(truncated))
            steps += 1
        assert steps == expected


@pytest.mark.parametrize("n_landmarks", [1, 2, 3])
def test_few_landmarks_are_uniform_too(n_landmarks: int) -> None:
    """Also of one landmark each allowed cell is as likely, the last one not less than others."""
    n_rows = 8000
    observations, _ = mapp_env.make_vec(n_rows, n_landmarks=n_landmarks).reset(seed=5)
    drawn = observations[:, 3 : 3 + n_landmarks].astype(int)
    allowed = landmark_cells(PAPER_ROWS)
    counts = np.bincount(drawn.ravel(), minlength=49)[allowed]
    expected = n_rows * n_landmarks / len(allowed)
    assert np.abs(counts - expected).max() < 4.5 * math.sqrt(expected)

"""Laws that hold for every grid and every sequence of actions."""

from __future__ import annotations

import copy
import os
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from model import OBSERVATIONS, PAPER_ROWS, REWARDS, landmark_cells, symmetries, transform

import mapp_env
from mapp_env import mapp_v0
from mapp_env.engine.loops import visit_rows
from mapp_env.engine.rules import Reward
from mapp_env.engine.world import make_world

REPOSITORY = Path(__file__).resolve().parents[2]


@st.composite
def grids(draw: st.DrawFn, least: int = 3) -> tuple[str, ...]:
    """Draw the rows of a small grid with at least ``least`` cells for landmarks."""
    n_rows, n_cols = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    n_cells = n_rows * n_cols
    walls = draw(st.lists(st.booleans(), min_size=n_cells, max_size=n_cells))
    letters = ["#" if wall else "." for wall in walls]
    letters[draw(st.integers(0, n_cells - 1))] = "D"
    rows = tuple("".join(letters[row * n_cols : (row + 1) * n_cols]) for row in range(n_rows))
    assume(len(landmark_cells(rows)) >= least)
    return rows


@st.composite
def games(draw: st.DrawFn, n_agents: int = 3, n_steps: int = 14) -> dict[str, Any]:
    """Draw a grid, landmarks, settings and joint actions."""
    rows = draw(grids())
    cells = landmark_cells(rows)
    landmarks = draw(st.permutations(cells))[: draw(st.integers(1, min(5, len(cells))))]
    action = st.integers(0, 4)
    joint = st.lists(action, min_size=n_agents, max_size=n_agents)
    return {
        "rows": rows,
        "landmarks": list(landmarks),
        "reward": draw(st.sampled_from(REWARDS)),
        "actions": draw(st.lists(joint, min_size=n_steps, max_size=n_steps)),
    }


def play(
    rows: tuple[str, ...],
    landmarks: list[int],
    reward: str,
    actions: list[list[int]],
    observation: str = "global",
) -> list[tuple[list[float], float, bool, bool, dict[str, Any]]]:
    """Play the actions through Central-v0; return each step's state, reward, flags, metrics."""
    env = gymnasium.make(
        "mapp_env/Central-v0",
        disable_env_checker=True,
        grid=mapp_env.Grid.from_text("\n".join(rows) + "\n"),
        n_agents=len(actions[0]),
        n_landmarks=len(landmarks),
        max_cycles=len(actions),
        reward=reward,
        observation=observation,
        allow_wait=True,
        central_action="multi",
    )
    env.reset(options={"landmarks": landmarks})
    steps = []
    for joint in actions:
        state, value, terminated, truncated, info = env.step(np.array(joint))
        steps.append((state.tolist(), value, terminated, truncated, info.get("metrics", {})))
        if terminated or truncated:
            break
    return steps


@given(games())
def test_eight_symmetries_change_nothing(game: dict[str, Any]) -> None:
    """Turning or mirroring grid, landmarks and actions turns the route, and changes no number."""
    rows, n_agents = game["rows"], len(game["actions"][0])
    base = play(**game)
    seen = set()
    for matrix in symmetries():
        turned = transform(rows, matrix)
        seen.add(turned.action)
        steps = play(
            turned.rows,
            [turned.cell[cell] for cell in game["landmarks"]],
            game["reward"],
            [[turned.action[action] for action in joint] for joint in game["actions"]],
        )
        assert [step[1:] for step in steps] == [step[1:] for step in base]
        for (state, *_), (original, *_) in zip(steps, base, strict=True):
            cells = [turned.cell[int(cell)] for cell in original[:n_agents]]
            assert state[:n_agents] == cells
    assert len(seen) == 8


@given(games())
def test_moves_made_elsewhere_meet_the_same_rules(game: dict[str, Any]) -> None:
    """`visit_rows`, told where agents stand after each move, gives what the environment gives."""
    n_agents, n_landmarks = len(game["actions"][0]), len(game["landmarks"])
    steps = play(**game)
    states = np.array([state for state, *_ in steps], int)
    cells, landmarks, visited = np.split(states, [n_agents, n_agents + n_landmarks], axis=1)
    before = np.vstack((np.zeros_like(visited[:1]), visited[:-1])).astype(bool)
    grid = mapp_env.Grid.from_text("\n".join(game["rows"]) + "\n")
    world = make_world(grid, n_agents, n_landmarks, Reward[game["reward"].upper()])
    after, rewards, terminated = visit_rows(world, cells, landmarks, before)
    assert after.dtype == np.bool_
    assert np.array_equal(after, visited)
    assert rewards.tolist() == [reward for _, reward, *_ in steps]
    assert terminated.tolist() == [ended for _, _, ended, *_ in steps]


@given(games(), st.permutations(range(3)), st.randoms(use_true_random=False))
def test_names_of_agents_and_landmarks_change_nothing(
    game: dict[str, Any], order: list[int], rng: random.Random
) -> None:
    """Renaming agents and reordering landmarks permutes the state and keeps the team's numbers.

    Which of several agents claims a landmark on one step does depend on the index, so only
    cover time and success are compared among the metrics when two arrive on it together.
    """
    base = play(**game)
    n_landmarks = len(game["landmarks"])
    places = list(range(n_landmarks))
    rng.shuffle(places)
    renamed = play(
        game["rows"],
        [game["landmarks"][place] for place in places],
        game["reward"],
        [[joint[agent] for agent in order] for joint in game["actions"]],
    )
    assert len(renamed) == len(base)
    together, seen = False, [0.0] * n_landmarks
    for (state, *after), (original, *before) in zip(renamed, base, strict=True):
        assert state[:3] == [original[agent] for agent in order]
        assert state[3 : 3 + n_landmarks] == [original[3 + place] for place in places]
        flags = original[3 + n_landmarks :]
        assert state[3 + n_landmarks :] == [flags[place] for place in places]
        assert after[:3] == before[:3]
        for place in range(n_landmarks):
            if flags[place] > seen[place]:
                together |= original[:3].count(original[3 + place]) > 1
        seen = flags
    first, second = base[-1][-1], renamed[-1][-1]
    assert first["success"] == second["success"]
    assert first["cover_time"] == second["cover_time"]
    reordered = play(  # the same agents: every metric is the same
        game["rows"],
        [game["landmarks"][place] for place in places],
        game["reward"],
        game["actions"],
    )
    assert reordered[-1][-1] == first
    if not together:
        assert first == second


@given(games())
def test_laws_of_an_episode(game: dict[str, Any]) -> None:
    """Flags only rise; reward is 0 exactly when all are visited; the end has exactly one reason.

    Rewards are whole numbers, and costs of a covered episode respect each other's bounds.
    """
    n_landmarks = len(game["landmarks"])
    steps = play(**game)
    flags = [0.0] * n_landmarks
    for number, (state, reward, terminated, truncated, metrics) in enumerate(steps, start=1):
        now = state[3 + n_landmarks :]
        assert all(a <= b for a, b in zip(flags, now, strict=True))
        flags = now
        assert (reward == 0.0) == all(now) == terminated
        assert reward <= 0.0
        assert reward == int(reward)
        assert not (terminated and truncated)
        assert truncated == (number == len(game["actions"]) and not terminated)
        assert bool(metrics) == (terminated or truncated)
    metrics = steps[-1][-1]
    assert metrics["success"] == steps[-1][2]
    if metrics["success"]:
        assert metrics["cover_time"] == len(steps)
        assert metrics["cover_time"] < metrics["makespan"]
        assert metrics["total_distance"] <= 3 * metrics["makespan"]
        assert metrics["total_distance"] % 2 == 0  # closed walks on a chessboard are even
    else:
        assert set(metrics.values()) == {False, float("inf")}


@given(games(), st.sampled_from(OBSERVATIONS))
def test_geodesic_reward_bounds_manhattan(game: dict[str, Any], kind: str) -> None:
    """Walls only lengthen ways: the geodesic reward is never above the Manhattan one.

    Neither the reward nor the observation kind changes the play.
    """
    game = {key: value for key, value in game.items() if key != "reward"}
    near = play(reward="manhattan", **game)
    far = play(reward="geodesic", observation=kind, **game)
    assert [step[2:] for step in near] == [step[2:] for step in far]
    for first, second in zip(near, far, strict=True):
        assert second[1] <= first[1]
    if not any("#" in row for row in game["rows"]):
        assert [step[1] for step in near] == [step[1] for step in far]


def drive(env: Any, seed: int | None, action_seed: int, episodes: int) -> list[Any]:
    """Return everything a parallel env says during some episodes of random actions."""
    rng, said = np.random.default_rng(action_seed), []
    for episode in range(episodes):
        said.append(env.reset(seed=seed) if episode == 0 else env.reset())
        said.append(env.state())
        while env.agents:
            actions = {a: int(rng.integers(env.action_space(a).n)) for a in env.agents}
            said.append(env.step(actions))
            said.append(env.state())
    return said


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_twins_and_strangers(kind: str, same: Any) -> None:
    """Equal seeds play bitwise equal episodes, later ones too; another seed another episode."""

    def make() -> Any:
        return mapp_v0.parallel_env(observation=kind, n_agents=2, allow_wait=True, max_cycles=25)

    first, twin, stranger = make(), make(), make()
    said = drive(first, 6, 0, 4)
    same(said, drive(twin, 6, 0, 4))
    other = drive(stranger, 7, 0, 1)
    assert said[1].tolist() != other[1].tolist()
    same(said, drive(first, 6, 0, 4))  # and the same object starts over
    begun = [i for i, item in enumerate(said) if isinstance(item, tuple) and len(item) == 2]
    problems = {tuple(said[index + 1].tolist()) for index in begun}  # the state after each reset
    assert len(problems) == len(begun) == 4


def test_a_seed_is_used_up_by_its_reset() -> None:
    """reset() without a seed goes on drawing; many resets give many different problems."""
    env = mapp_v0.parallel_env()
    env.reset(seed=1)
    drawn = []
    for _ in range(60):
        drawn.append(tuple(env.state()[3:8].tolist()))
        env.reset()
    assert len(set(drawn)) == 60


def test_neighbouring_seeds_draw_different_landmarks() -> None:
    """Seeds 0..199 draw 200 different problems."""
    env = mapp_v0.parallel_env()
    drawn = set()
    for seed in range(200):
        env.reset(seed=seed)
        drawn.add(tuple(sorted(env.state()[3:8].tolist())))
    assert len(drawn) >= 199


def test_reset_with_given_landmarks_needs_no_luck(same: Any) -> None:
    """Given landmarks replace the draw whatever the seed, and the play has no luck in it."""
    cells = [0, 6, 20, 42, 48]
    said = []
    for seed in (1, 2):
        env = mapp_v0.parallel_env()
        env.reset(seed=seed, options={"landmarks": cells})
        steps = [env.step(dict.fromkeys(env.agents, action)) for action in (1, 1, 2, 0)]
        said.append(steps)
    same(said[0], said[1])


def global_generators() -> list[Any]:
    """Return the state of every global random generator that is loaded."""
    states: list[Any] = [random.getstate(), copy.deepcopy(np.random.get_state())]  # noqa: NPY002
    try:
        import torch
    except ImportError:
        return states
    return [*states, torch.random.get_rng_state().numpy().copy()]


def test_global_generators_are_untouched(same: Any) -> None:
    """No face reads or moves the global state of random, numpy or torch."""
    random.seed(1)
    np.random.seed(2)  # noqa: NPY002

    def use_everything(seed: int | None) -> list[Any]:
        said = drive(mapp_v0.parallel_env(max_cycles=8), seed, 0, 2)
        env = gymnasium.make("mapp_env/Central-v0", central_action="multi")
        said.append(env.reset(seed=seed))
        said.append(env.step(np.zeros(3, dtype=int)))
        venv = mapp_env.make_vec(5, max_cycles=3)
        said.append(venv.reset(seed=seed))
        for _ in range(6):
            said.append(venv.step(np.ones((5, 3), dtype=int)))
        said.append(mapp_env.sample_problems(mapp_env.make_grid("paper-7x7"), 5, seed=4))
        return said

    before = global_generators()
    seeded = use_everything(5)
    use_everything(None)
    same(before, global_generators())
    random.seed(99)
    np.random.seed(98)  # noqa: NPY002
    same(seeded, use_everything(5))


def arrays_in(item: Any) -> list[np.ndarray]:
    """Return every array inside a nested result."""
    if isinstance(item, np.ndarray):
        if item.dtype == object:
            return [array for part in item.flat for array in arrays_in(part)]
        return [item]
    if isinstance(item, dict):
        return [array for part in item.values() for array in arrays_in(part)]
    if isinstance(item, (list, tuple)):
        return [array for part in item for array in arrays_in(part)]
    return []


def scribble(item: Any) -> int:
    """Overwrite every writable array inside a result; return how many there were."""
    count = 0
    for array in arrays_in(item):
        if array.flags.writeable and array.size:
            array.fill(1 if array.dtype == bool else 77)
            count += 1
    return count


@pytest.mark.parametrize("kind", OBSERVATIONS)
@pytest.mark.parametrize("face", ["parallel", "central", *(mode.name for mode in AutoresetMode)])
def test_returned_arrays_are_the_callers(face: str, kind: str, same: Any) -> None:
    """Writing into anything returned changes nothing later; no two returned arrays share memory."""
    arguments: dict[str, Any] = {
        "observation": kind, "n_agents": 2, "n_landmarks": 3, "max_cycles": 6,
    }  # fmt: skip
    if face == "parallel":
        envs = [mapp_v0.parallel_env(**arguments) for _ in range(2)]
    elif face == "central":
        envs = [
            gymnasium.make("mapp_env/Central-v0", central_action="multi", **arguments)
            for _ in range(2)
        ]
    else:
        mode = AutoresetMode[face]
        envs = [mapp_env.make_vec(3, autoreset_mode=mode, **arguments) for _ in range(2)]
    rng = np.random.default_rng(0)
    clean, dirty = envs
    everything: list[np.ndarray] = []
    scribbled = 0
    ended: Any = None
    for step in range(20):
        results = []
        actions: Any = rng.integers(4, size=(3, 2) if face in AutoresetMode.__members__ else 2)
        for env in envs:
            over = step == 0 or ended is True
            if face == "parallel":
                joint = {f"agent_{i}": int(action) for i, action in enumerate(actions)}
                said = env.reset(seed=3) if over else env.step(joint)
                results.append((said, env.state()))
            elif over:
                results.append(env.reset(seed=3))
            elif face == "DISABLED" and ended is not None and np.any(ended):
                results.append(env.reset(options={"reset_mask": ended.copy()}))
            else:
                results.append(env.step(actions))
        same(results[0], results[1])
        said = results[0][0] if face == "parallel" else results[0]
        if len(said) == 5 and face == "parallel":
            ended = not clean.agents
        elif len(said) == 5:
            ended = said[2] | said[3]
        else:
            ended = None
        fresh = arrays_in(results[1])
        for index, array in enumerate(fresh):
            for other in fresh[:index] + everything:
                assert not np.shares_memory(array, other) or not array.flags.writeable
        everything.extend(fresh)
        scribbled += scribble(results[1])
        if face == "parallel":
            scribble([dirty.state()])
    assert scribbled >= 20


@pytest.mark.parametrize("dtype", [np.int64, np.int32, np.int8, np.uint8, np.uint64])
def test_actions_are_read_only_to_the_env(dtype: type, same: Any) -> None:
    """Actions of any integer type, also in a read-only or strided array, are read, not written."""
    plain = mapp_env.make_vec(4, max_cycles=9)
    typed = mapp_env.make_vec(4, max_cycles=9)
    same(plain.reset(seed=1)[0], typed.reset(seed=1)[0])
    rng = np.random.default_rng(0)
    for _ in range(12):
        actions = rng.integers(4, size=(4, 3))
        wide = np.zeros((4, 6), dtype=dtype)
        wide[:, ::2] = actions
        strided = wide[:, ::2]
        strided.flags.writeable = False
        same(plain.step(actions), typed.step(strided))
        assert strided.tolist() == actions.tolist()


def test_scalar_action_types_mean_the_same(same: Any) -> None:
    """Python and NumPy integers are the same action; the dict of actions is left alone."""
    said = []
    for kind in (int, np.int64, np.int32, np.uint8):
        env = mapp_v0.parallel_env()
        env.reset(seed=2)
        actions = {agent: kind(2) for agent in env.agents}
        shuffled = dict(reversed(actions.items()))
        said.append(env.step(shuffled))
        assert shuffled == dict(reversed(actions.items()))
    for other in said[1:]:
        same(said[0], other)


def test_landmark_option_is_copied() -> None:
    """Changing the caller's landmark array after reset changes nothing in the env."""
    env = mapp_v0.parallel_env()
    cells = np.array([0, 6, 20, 42, 48])
    env.reset(options={"landmarks": cells})
    cells[:] = 1
    assert env.state()[3:8].tolist() == [0, 6, 20, 42, 48]


def test_grid_and_problem_are_frozen() -> None:
    """A grid's arrays refuse writes and its fields refuse assignment; so do a problem's."""
    grid = mapp_env.make_grid("paper-7x7")
    problem = mapp_env.Problem(grid, landmarks=(0, 6, 20, 42, 48), n_agents=3)
    for array in (grid.walls, grid.moves, grid.home, grid.distances, grid.reachable):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    for thing, name in ((grid, "depot"), (problem, "landmarks"), (problem, "n_agents")):
        with pytest.raises((AttributeError, TypeError)):
            setattr(thing, name, 1)


def test_env_does_not_share_with_another() -> None:
    """Two environments on one grid do not see each other's agents, landmarks or metadata."""
    grid = mapp_env.make_grid("paper-7x7")
    first, second = mapp_v0.parallel_env(grid=grid), mapp_v0.parallel_env(grid=grid)
    first.reset(seed=1)
    second.reset(seed=2)
    state = first.state().tolist()
    for _ in range(5):
        second.step(dict.fromkeys(second.agents, 1))
    second.max_cycles = 3
    assert first.state().tolist() == state
    assert first.max_cycles == 50
    first.step(dict.fromkeys(first.agents, 1))
    assert len(first.agents) == 3


@given(grids(least=4), st.integers(0, 2**32 - 1))
def test_drawn_landmarks_are_allowed(rows: tuple[str, ...], seed: int) -> None:
    """Drawn landmarks are distinct allowed cells on every grid, also when all of them are taken."""
    allowed = landmark_cells(rows)
    for count in {1, 3, min(len(allowed), 64)}:
        env = mapp_v0.parallel_env(
            grid=mapp_env.Grid.from_text("\n".join(rows) + "\n"), n_agents=1, n_landmarks=count
        )
        env.reset(seed=seed)
        drawn = env.state()[1 : 1 + count].astype(int).tolist()
        assert len(set(drawn)) == count
        assert set(drawn) <= set(allowed)


@given(st.integers(1, 40), st.integers(1, 6), st.integers(0, 2**31))
@settings(max_examples=15)
def test_sample_problems_are_distinct(n_problems: int, n_landmarks: int, seed: int) -> None:
    """sample_problems: rows are distinct problems of allowed cells, and a seed repeats them."""
    grid = mapp_env.make_grid("paper-7x7")
    rows = mapp_env.sample_problems(grid, n_problems, n_landmarks=n_landmarks, seed=seed)
    assert rows.shape == (n_problems, n_landmarks)
    assert rows.dtype == np.int32
    assert set(rows.ravel().tolist()) <= set(landmark_cells(PAPER_ROWS))
    assert all(len(set(row)) == n_landmarks for row in rows.tolist())
    assert len({frozenset(row) for row in rows.tolist()}) == n_problems
    again = mapp_env.sample_problems(grid, n_problems, n_landmarks=n_landmarks, seed=seed)
    assert rows.tobytes() == again.tobytes()


def run_python(*arguments: str, **environment: str) -> str:
    """Return what a fresh interpreter prints."""
    done = subprocess.run(
        [sys.executable, "-W", "error::SyntaxWarning", *arguments],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), **environment},
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_compiled_and_plain_kernels_play_the_same() -> None:
    """With NUMBA_DISABLE_JIT=1 the same source, as plain Python, gives the same digest."""
    script = "tests/engine/golden/make.py"
    compiled = run_python(script, "--digest", NUMBA_DISABLE_JIT="0")
    plain = run_python(script, "--digest", NUMBA_DISABLE_JIT="1")
    assert len(compiled.strip()) == 64
    assert compiled == plain


def test_import_is_light() -> None:
    """Importing the package, and playing without drawing, loads no torch, drawing or trainer."""
    code = (
        "import sys, mapp_env\n"
        "from mapp_env import mapp_v0\n"
        "import gymnasium, mapp_env.adapters\n"
        "heavy = {'torch', 'matplotlib', 'pygame', 'PIL', 'stable_baselines3', 'supersuit'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
        "env = mapp_v0.parallel_env(); env.reset(seed=0)\n"
        "env.step(dict.fromkeys(env.agents, 0))\n"
        "mapp_env.make_vec(2).reset(seed=0)\n"
        "gymnasium.make('mapp_env/Tuple-v0').reset(seed=0)\n"
        "import mapp_env.rendering\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    assert run_python("-c", code).splitlines() == ["[]", "[]"]


def test_any_part_of_a_sample_is_fair() -> None:
    """The first problems of a sample are no other than the last, also of nearly all there are."""
    grid = mapp_env.make_grid("paper-7x7")
    for n_problems in (60, 700):  # drawn one by one, and from a list of all 780
        rows = mapp_env.sample_problems(grid, n_problems, n_landmarks=2, seed=4)
        first, last = rows[: n_problems // 2].mean(), rows[n_problems // 2 :].mean()
        assert abs(first - last) < 4


def test_walls_are_the_callers() -> None:
    """An array that a grid was made of stays writable, and writing into it changes no grid."""
    walls = np.zeros((3, 4), bool)
    grid = mapp_env.Grid(walls)
    walls[:] = True
    assert not grid.walls.any()
    assert not grid.walls.flags.writeable


def test_infos_are_each_agents_own() -> None:
    """What one agent's wrapper writes into its info, metrics included, no other agent sees."""
    env = mapp_v0.parallel_env(max_cycles=1)
    env.reset(seed=0)
    *_, infos = env.step(dict.fromkeys(env.agents, 0))
    infos["agent_0"]["metrics"]["cover_time"] = -1.0
    infos["agent_0"]["action_mask"][:] = 7
    for agent in ("agent_1", "agent_2"):
        assert infos[agent]["metrics"]["cover_time"] == np.inf
        assert infos[agent]["action_mask"].max() == 1


@pytest.mark.parametrize("face", ["parallel", "vector"])
def test_copies_on_large_grids_go_on_alone(face: str) -> None:
    """A copy made in mid-episode, where distances are kept for each landmark, has its own."""
    grid = mapp_env.make_grid("random", rows=70, cols=70, seed=3)
    settings: dict[str, Any] = {"grid": grid, "reward": "geodesic", "observation": "geodesic"}
    if face == "parallel":
        env: Any = mapp_v0.parallel_env(**settings)
    else:
        env = mapp_env.make_vec(2, **settings)

    def play(each: Any, seed: int | None) -> list[Any]:
        seen = [] if seed is None else [each.reset(seed=seed)[0]]
        for action in (0, 1, 2, 3):
            if face == "parallel":
                seen.append(each.step(dict.fromkeys(each.agents, action))[:2])
            else:
                seen.append(each.step(np.full((2, 3), action))[:2])
        return seen

    play(env, 1)
    twin = copy.deepcopy(env)
    expected = str(play(env, None))
    assert str(play(twin, None)) == expected
    first = str(play(env, 2))
    assert str(play(twin, 2)) == first
    assert str(play(twin, 3)) == str(play(env, 3)) != first


def test_paths_prefer_the_first_action() -> None:
    """Of equally short paths the one is taken that goes left, right, up, down as soon as it can."""
    grid = mapp_env.Grid(np.zeros((3, 3), bool))
    assert grid.path(0, 8) == (0, 1, 2, 5, 8)
    assert grid.path(8, 0) == (8, 7, 6, 3, 0)
    assert grid.path(2, 6) == (2, 1, 0, 3, 6)
    assert grid.path(6, 2) == (6, 7, 8, 5, 2)
    assert grid.path(0, grid.depot) == (0, 1, 4)

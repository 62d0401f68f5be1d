"""make_vec is Gymnasium's SyncVectorEnv over Central-v0, only faster: bit for bit the same."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from model import OBSERVATIONS, landmark_cells

import mapp_env
from mapp_env import mapp_v0

MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)

# Small enough that a random walk ends both ways, and several times in a hundred steps.
SMALL_ROWS = ("...", ".D#", "...", "#..")
SMALL = "\n".join(SMALL_ROWS) + "\n"


def settings(**changes: Any) -> dict[str, Any]:
    """Return the arguments of a small, lively environment."""
    return {
        "grid": mapp_env.Grid.from_text(SMALL),
        "n_agents": 2,
        "n_landmarks": 3,
        "max_cycles": 12,
        **changes,
    }


def make_sync(n_rows: int, mode: AutoresetMode, **arguments: Any) -> SyncVectorEnv:
    """Return Gymnasium's own vector environment over single Central environments."""

    def make() -> gymnasium.Env:
        return gymnasium.make(
            "mapp_env/Central-v0",
            central_action="multi",
            disable_env_checker=True,
            **arguments,
        )

    return SyncVectorEnv([make] * n_rows, autoreset_mode=mode)


def random_actions(rng: np.random.Generator, venv: Any) -> np.ndarray:
    """Return a batch of actions; a NumPy integer array (B, N)."""
    return rng.integers(venv.single_action_space.nvec, size=venv.action_space.shape)


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_rows_equal_sync_vector_env(kind: str, mode: AutoresetMode, same: Any) -> None:
    """Observations, rewards, flags and whole infos equal SyncVectorEnv's in every mode.

    That covers final_obs and final_info, the ``_key`` masks, dtypes, and the reward and flags
    of the step that resets.
    """
    n_rows, ends, successes = 5, 0, 0
    arguments = settings(
        observation=kind,
        allow_wait=kind == "planes",
        reward={"planes": "step", "geodesic": "geodesic"}.get(kind, "manhattan"),
    )
    ours = mapp_env.make_vec(n_rows, autoreset_mode=mode, **arguments)
    assert isinstance(ours, gymnasium.vector.VectorEnv)
    assert ours.num_envs == n_rows
    assert ours.metadata["autoreset_mode"] == mode
    result = ours.reset(seed=21)
    theirs = make_sync(n_rows, mode, **arguments)
    assert ours.single_observation_space == theirs.single_observation_space
    assert ours.observation_space == theirs.observation_space
    assert ours.single_action_space == theirs.single_action_space
    assert ours.action_space == theirs.action_space
    same(result, theirs.reset(seed=[int(seed) for seed in ours.np_random_seed]))
    rng = np.random.default_rng(3)
    for _ in range(90):
        actions = random_actions(rng, ours)
        result = ours.step(actions)
        same(result, theirs.step(actions.copy()))
        _, _, terminations, truncations, infos = result
        ended = terminations | truncations
        assert not (terminations & truncations).any()
        ends += int(ended.sum())
        successes += int(terminations.sum())
        if mode == AutoresetMode.SAME_STEP:
            assert ("final_obs" in infos) == ended.any()
        if mode == AutoresetMode.DISABLED and ended.any():
            same(
                ours.reset(options={"reset_mask": ended.copy()}),
                theirs.reset(options={"reset_mask": ended.copy()}),
            )
    assert ends >= 3 * n_rows
    assert 0 < successes < ends


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_row_equals_single_env(mode: AutoresetMode, same: Any) -> None:
    """Row i is a single Central env reset with np_random_seed[i], episode after episode."""
    n_rows = 4
    venv = mapp_env.make_vec(n_rows, autoreset_mode=mode, **settings())
    batch, infos = venv.reset(seed=5)
    singles, pending = [], [False] * n_rows
    for row in range(n_rows):
        env = gymnasium.make("mapp_env/Central-v0", central_action="multi", **settings())
        observation, info = env.reset(seed=int(venv.np_random_seed[row]))
        same(observation, batch[row])
        same(info["action_mask"], infos["action_mask"][row])
        singles.append(env)
    rng = np.random.default_rng(0)
    n_ends = 0
    for _ in range(60):
        actions = random_actions(rng, venv)
        batch, rewards, terminations, truncations, infos = venv.step(actions)
        for row, env in enumerate(singles):
            if mode == AutoresetMode.NEXT_STEP and pending[row]:
                observation, info = env.reset()
                step = (observation, 0.0, False, False, info)
                pending[row] = False
            else:
                step = env.step(actions[row])
                pending[row] = step[2] or step[3]
            observation, reward, terminated, truncated, info = step
            ended = pending[row]
            n_ends += ended
            if ended:
                scored = infos["final_info"] if mode == AutoresetMode.SAME_STEP else infos
                for name, value in info["metrics"].items():
                    assert scored["metrics"][name][row] == value
                    assert scored["metrics"][f"_{name}"][row]
            if ended and mode == AutoresetMode.SAME_STEP:
                same(infos["final_obs"][row], observation)
                same(infos["final_info"]["action_mask"][row], info["action_mask"])
                observation, info = env.reset()
            same(observation, batch[row])
            assert rewards[row] == reward
            assert (terminations[row], truncations[row]) == (terminated, truncated)
            same(info["action_mask"], infos["action_mask"][row])
        if mode == AutoresetMode.DISABLED and any(pending):
            batch, infos = venv.reset(options={"reset_mask": np.array(pending)})
            for row, env in enumerate(singles):
                if pending[row]:
                    same(env.reset()[0], batch[row])
            pending = [False] * n_rows
    assert n_ends > 3 * n_rows


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_rows_equal_sync_for_many_episodes(mode: AutoresetMode, same: Any) -> None:
    """Hundreds of one-step episodes draw the landmarks that single environments would draw."""
    arguments = settings(max_cycles=1)
    ours = mapp_env.make_vec(2, autoreset_mode=mode, **arguments)
    result = ours.reset(seed=12)
    theirs = make_sync(2, mode, **arguments)
    same(result, theirs.reset(seed=[int(seed) for seed in ours.np_random_seed]))
    drawn = set()
    for _ in range(300):
        actions = np.zeros((2, 2), dtype=int)
        result = ours.step(actions)
        same(result, theirs.step(actions))
        if mode == AutoresetMode.DISABLED:
            ended = result[2] | result[3]
            assert ended.all()
            result = ours.reset(options={"reset_mask": ended.copy()})
            same(result, theirs.reset(options={"reset_mask": ended.copy()}))
        drawn.add(tuple(result[0][0, 2:5].tolist()))
    assert len(drawn) > 50  # of the 84 there are


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("kind", ["global", "geodesic", "own_first"])
def test_large_grids_equal_sync_vector_env(kind: str, mode: AutoresetMode, same: Any) -> None:
    """On a grid too large to keep all distances, rows with their own resets are exact as well."""
    text = "\n".join(["D" + "." * 69, *["." * 70] * 59]) + "\n"
    arguments = settings(
        grid=mapp_env.Grid.from_text(text),
        reward="geodesic" if kind == "global" else "manhattan",
        observation=kind,
        max_cycles=4,
    )
    ours = mapp_env.make_vec(3, autoreset_mode=mode, **arguments)
    result = ours.reset(seed=31)
    theirs = make_sync(3, mode, **arguments)
    same(result, theirs.reset(seed=[int(seed) for seed in ours.np_random_seed]))
    options = {"landmarks": np.array([[1, 2, 70], [71, 1, 3], [4, 280, 9]])}
    ours.reset(options=dict(options))
    for row, env in enumerate(theirs.envs):
        env.reset(options={"landmarks": options["landmarks"][row]})
    rng = np.random.default_rng(4)
    successes = 0
    for step in range(12):
        actions = rng.integers(4, size=(3, 2))
        if step < 2:
            actions = np.array([[1, 3], [1, 3], [1, 3]])
        result = ours.step(actions)
        same(result, theirs.step(actions))
        ended = result[2] | result[3]
        successes += int(result[2].sum())
        if mode == AutoresetMode.DISABLED and ended.any():
            same(
                ours.reset(options={"reset_mask": ended.copy()}),
                theirs.reset(options={"reset_mask": ended.copy()}),
            )
    assert successes >= 1


def test_partial_seeds_equal_sync_vector_env(same: Any) -> None:
    """A list of seeds with None reseeds the others alone; a reset_mask keeps the masked rows."""
    ours = mapp_env.make_vec(3, autoreset_mode=AutoresetMode.DISABLED, **settings())
    theirs = make_sync(3, AutoresetMode.DISABLED, **settings())
    same(ours.reset(seed=[4, 5, 6]), theirs.reset(seed=[4, 5, 6]))
    for seeds, mask in (
        ([9, None, None], None),
        ([None, 8, 7], [True, True, False]),
        (None, [False, False, True]),
        (None, None),
    ):
        calls = []
        for venv in (ours, theirs):
            options = None if mask is None else {"reset_mask": np.array(mask)}
            calls.append(venv.reset(seed=seeds, options=options))
        same(*calls)
        assert [int(seed) for seed in ours.np_random_seed] == list(theirs.np_random_seed)


def test_next_step_mode_resets_one_step_late() -> None:
    """NEXT_STEP: the step after an end ignores the action, pays 0, and ends nothing."""
    arguments = settings(grid=mapp_env.Grid.from_text("D..\n"), n_agents=1, n_landmarks=2)
    venv = mapp_env.make_vec(2, **arguments)
    assert venv.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    venv.reset(seed=0)
    right, left = np.array([[1], [1]]), np.array([[0], [0]])
    *_, infos = venv.step(right)
    assert "metrics" not in infos
    batch, rewards, terminations, _, infos = venv.step(right)
    assert batch[:, 0].tolist() == [2.0, 2.0]
    assert terminations.all()
    assert infos["metrics"]["cover_time"].tolist() == [2.0, 2.0]
    assert infos["metrics"]["total_distance"].tolist() == [4.0, 4.0]
    batch, rewards, terminations, truncations, infos = venv.step(right)
    assert batch[:, 0].tolist() == [0.0, 0.0]
    assert rewards.tolist() == [0.0, 0.0]
    assert not terminations.any()
    assert not truncations.any()
    assert "metrics" not in infos
    batch, rewards, *_ = venv.step(left)
    assert rewards.tolist() == [-3.0, -3.0]


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_rows_do_not_depend_on_their_neighbours(mode: AutoresetMode, same: Any) -> None:
    """The first rows of a large batch are the rows of a small batch with the same seed."""
    few = mapp_env.make_vec(3, autoreset_mode=mode, **settings())
    many = mapp_env.make_vec(11, autoreset_mode=mode, **settings())
    few_batch, _ = few.reset(seed=8)
    many_batch, _ = many.reset(seed=8)
    same(few_batch, many_batch[:3])
    rng = np.random.default_rng(1)
    ended_any = False
    for _ in range(40):
        actions = random_actions(rng, many)
        small = few.step(actions[:3])
        large = many.step(actions)
        for a, b in zip(small[:4], large[:4], strict=True):
            same(a, b[:3])
        ended = large[2] | large[3]
        ended_any |= bool(ended[:3].any())
        if mode == AutoresetMode.DISABLED and ended.any():
            large_batch, _ = many.reset(options={"reset_mask": ended.copy()})
            if ended[:3].any():
                small_batch, _ = few.reset(options={"reset_mask": ended[:3].copy()})
                same(small_batch, large_batch[:3])
    assert ended_any


def test_equal_seeds_twin_and_other_seeds_share_no_row() -> None:
    """The same seed gives the same batch; neighbouring seeds share no row and no row seed."""
    paper = {"n_landmarks": 8}
    batches, seeds = {}, {}
    for seed in (0, 1, 2):
        venv = mapp_env.make_vec(64, **paper)
        batch, _ = venv.reset(seed=seed)
        again, _ = mapp_env.make_vec(64, **paper).reset(seed=seed)
        assert batch.tobytes() == again.tobytes()
        batches[seed] = {tuple(row) for row in batch.tolist()}
        seeds[seed] = {int(number) for number in venv.np_random_seed}
        assert len(batches[seed]) == len(seeds[seed]) == 64
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert not batches[first] & batches[second]
        assert not seeds[first] & seeds[second]


def test_masked_seed_is_for_the_rows_of_the_mask(same: Any) -> None:
    """reset(seed=0) of some rows gives them the seeds of a whole reset, and leaves all others'."""
    mask = np.array([False, True, True, False])
    venv, twin, fresh = (mapp_env.make_vec(4, **settings()) for _ in range(3))
    whole, _ = fresh.reset(seed=0)
    for each in (venv, twin):
        each.reset(seed=9)
    before = venv.np_random_seed
    batch, _ = venv.reset(seed=0, options={"reset_mask": mask.copy()})
    twin.reset(options={"reset_mask": mask.copy()})
    same(batch[mask], whole[mask])
    pairs = zip(mask, fresh.np_random_seed, before, strict=True)
    assert venv.np_random_seed == tuple(new if chosen else old for chosen, new, old in pairs)
    rows, others = venv.reset()[0], twin.reset()[0]
    same(rows[~mask], others[~mask])  # they have drawn on as if nothing had been seeded
    assert not (rows[mask] == others[mask]).all()


def test_unseeded_batches_differ() -> None:
    """Without a seed two batches draw different problems, and a second reset draws new ones."""
    venv = mapp_env.make_vec(32)
    first, _ = venv.reset()
    second, _ = venv.reset()
    other, _ = mapp_env.make_vec(32).reset()
    rows = [{tuple(row) for row in batch.tolist()} for batch in (first, second, other)]
    assert not rows[0] & rows[1]
    assert not rows[0] & rows[2]
    assert len(rows[0]) == 32


def test_list_seeds_are_the_rows_seeds(same: Any) -> None:
    """A list of seeds seeds each row like a single env; a second seeding starts all over."""
    seeds = [7, 123456789, 3, 7]
    venv = mapp_env.make_vec(4, **settings())
    venv.reset(seed=99)
    venv.step(np.zeros((4, 2), dtype=int))
    batch, _ = venv.reset(seed=seeds)
    assert [int(seed) for seed in venv.np_random_seed] == seeds
    for row, seed in enumerate(seeds):
        env = gymnasium.make("mapp_env/Central-v0", central_action="multi", **settings())
        same(env.reset(seed=seed)[0], batch[row])
    same(batch[0], batch[3])


def test_reset_mask_resets_only_its_rows(same: Any) -> None:
    """reset_mask starts the named rows anew and leaves every other row where it was."""
    arguments = settings(n_landmarks=5, max_cycles=50)
    venv = mapp_env.make_vec(4, autoreset_mode=AutoresetMode.DISABLED, **arguments)
    twin = mapp_env.make_vec(4, autoreset_mode=AutoresetMode.DISABLED, **arguments)
    for env in (venv, twin):
        env.reset(seed=2)
    rng = np.random.default_rng(2)
    actions = [random_actions(rng, venv) for _ in range(6)]
    for action in actions[:3]:
        before = venv.step(action)[0]
        twin.step(action)
    batch, infos = venv.reset(options={"reset_mask": np.array([True, False, False, True])})
    same(batch[1:3], before[1:3])
    assert (batch[[0, 3], :2] == 4).all()  # back on the depot
    assert (batch[[0, 3], 7:] == 0).all()
    assert infos["_action_mask"].tolist() == [True, False, False, True]
    for action in actions[3:]:
        ours, others = venv.step(action), twin.step(action)
        same(ours[0][1:3], others[0][1:3])
        same(ours[1][1:3], others[1][1:3])


def test_partial_reset_leaves_the_ends_of_other_rows(same: Any) -> None:
    """Where rows end together and some are reset by hand, the others' ends are not forgotten."""
    arguments = settings(max_cycles=3, n_landmarks=5)
    ours = mapp_env.make_vec(3, **arguments)
    theirs = make_sync(3, AutoresetMode.NEXT_STEP, **arguments)
    waiting = mapp_env.make_vec(3, autoreset_mode=AutoresetMode.DISABLED, **arguments)
    for venv in (ours, theirs, waiting):
        venv.reset(seed=[4, 5, 6])
        for _ in range(3):
            ended = venv.step(np.zeros((3, 2), int))[3]
        assert ended.all()
        venv.reset(options={"reset_mask": np.array([True, False, False])})
    for action in (1, 3, 0, 2, 1, 0):
        actions = np.full((3, 2), action)
        same(ours.step(actions), theirs.step(actions))
    with pytest.raises(gymnasium.error.ResetNeeded, match="row 1 has ended"):
        waiting.step(np.zeros((3, 2), int))
    waiting.reset(options={"reset_mask": np.array([False, True, False])})
    with pytest.raises(gymnasium.error.ResetNeeded, match="row 2 has ended"):
        waiting.step(np.zeros((3, 2), int))


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_transitions_are_the_callers(mode: AutoresetMode, same: Any) -> None:
    """Whoever steps by advance() may write into every array of what it returns."""
    clean, dirty = (mapp_env.make_vec(4, autoreset_mode=mode, **settings()) for _ in range(2))
    rng, ends = np.random.default_rng(3), 0
    for venv in (clean, dirty):
        venv.reset(seed=7)
    for _ in range(60):
        actions = random_actions(rng, clean)
        found = [tuple(venv.advance(actions)) for venv in (clean, dirty)]
        same(*found)
        ended = found[0][2] | found[0][3]
        ends += int(ended.sum())
        for array in found[1]:
            if isinstance(array, np.ndarray) and array.size:
                array.fill(1)
        if mode == AutoresetMode.DISABLED and ended.any():
            for venv in (clean, dirty):
                venv.reset(options={"reset_mask": ended.copy()})
    assert ends > 8


def test_disabled_mode_refuses_to_step_a_finished_row() -> None:
    """DISABLED: stepping while a finished row waits for its reset raises, and works after it."""
    arguments = settings(grid=mapp_env.Grid.from_text("D..\n"), n_agents=1, n_landmarks=2)
    venv = mapp_env.make_vec(2, autoreset_mode=AutoresetMode.DISABLED, **arguments)
    venv.reset(seed=0)
    venv.step(np.array([[1], [1]]))
    batch, _, terminations, _, _ = venv.step(np.array([[1], [0]]))
    assert terminations.tolist() == [True, False]
    with pytest.raises((ValueError, AssertionError, RuntimeError, gymnasium.error.Error)):
        venv.step(np.array([[1], [1]]))
    venv.reset(options={"reset_mask": terminations.copy()})
    batch, *_ = venv.step(np.array([[1], [1]]))
    assert batch[:, 0].tolist() == [1.0, 1.0]


def test_joint_numbers_in_a_batch(same: Any) -> None:
    """With central_action="joint" a row's action is one number, first agent most significant.

    That is also what gymnasium.make_vec gives, so that its rows act like gymnasium.make's.
    """
    plain = mapp_env.make_vec(3, **settings())
    joint = mapp_env.make_vec(3, central_action="joint", **settings())
    made = gymnasium.make_vec("mapp_env/Central-v0", num_envs=3, **settings())
    for venv in (joint, made):
        assert venv.single_action_space == gymnasium.spaces.Discrete(16)
        assert venv.action_space.shape == (3,)

    def without_joint_masks(result: Any) -> Any:
        infos = {key: value for key, value in result[-1].items() if "joint" not in key}
        assert result[-1]["_joint_action_mask"].all()
        return (*result[:-1], infos)

    first = plain.reset(seed=6)
    same(first, without_joint_masks(joint.reset(seed=6)))
    rng = np.random.default_rng(6)
    for _ in range(40):
        actions = random_actions(rng, plain)
        numbers = actions[:, 0] * 4 + actions[:, 1]
        same(plain.step(actions), without_joint_masks(joint.step(numbers)))
    for bad in ([16, 0, 0], [-1, 0, 0], [0, 0], [[0, 0]] * 3, [0.5, 0, 0]):
        with pytest.raises(ValueError, match="action"):
            joint.step(np.array(bad))


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_joint_rows_equal_sync_vector_env(mode: AutoresetMode, same: Any) -> None:
    """With numbered joint actions whole infos are SyncVectorEnv's, too, masks of them included.

    Writing into the masks changes nothing later.
    """
    make = {"id": "mapp_env/Central-v0", "num_envs": 4, "allow_wait": True, **settings()}
    ours = gymnasium.make_vec(**make, autoreset_mode=mode)
    theirs = gymnasium.make_vec(
        **make, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}
    )
    seeds = [3, 4, 5, 6]
    result = ours.reset(seed=seeds)
    same(result, theirs.reset(seed=seeds))
    rng, ends = np.random.default_rng(8), 0
    for _ in range(60):
        assert result[-1]["joint_action_mask"].shape == (4, 25)
        result[-1]["joint_action_mask"][:] = 0
        actions = rng.integers(25, size=4)
        result = ours.step(actions)
        same(result, theirs.step(actions))
        ended = result[2] | result[3]
        ends += int(ended.sum())
        if mode == AutoresetMode.DISABLED and ended.any():
            result = ours.reset(options={"reset_mask": ended.copy()})
            same(result, theirs.reset(options={"reset_mask": ended.copy()}))
    assert ends > 8


@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("limit", [5, 12, 40, -1])
def test_max_episode_steps_limit_as_in_sync_mode(
    limit: int, mode: AutoresetMode, same: Any
) -> None:
    """gymnasium.make_vec(..., max_episode_steps=limit) ends every episode where sync mode does.

    But for two things in which Gymnasium's wrapper is poorer: it calls an episode that is solved at
    the very step a time-out, too, and those that it cuts short have no metrics.
    """
    make = {
        "id": "mapp_env/Central-v0", "num_envs": 4, "max_episode_steps": limit,
        "central_action": "multi", **settings(),
    }  # fmt: skip
    ours = gymnasium.make_vec(**make, autoreset_mode=mode)
    theirs = gymnasium.make_vec(
        **make, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}
    )
    seeds = [3, 4, 5, 6]
    same(ours.reset(seed=seeds), theirs.reset(seed=seeds))
    rng, solved_last, cut = np.random.default_rng(8), 0, 0
    for _ in range(120):
        actions = random_actions(rng, ours)
        batch, rewards, terminations, truncations, infos = ours.step(actions)
        wanted, gains, ends, cuts, theirs_infos = theirs.step(actions)
        same((batch, rewards, terminations), (wanted, gains, ends))
        same(truncations, cuts & ~ends)
        solved_last += int((cuts & ends).sum())
        cut += int(truncations.sum())
        ended = terminations | truncations
        if mode == AutoresetMode.SAME_STEP and ended.any():
            same(infos["final_obs"], theirs_infos["final_obs"])
            infos, theirs_infos = infos["final_info"], theirs_infos["final_info"]
        same(infos["action_mask"], theirs_infos["action_mask"])
        if ended.any():
            same(infos["_metrics"], ended)
            same(infos["metrics"]["success"], terminations)
            own = theirs_infos.get("_metrics", np.zeros(4, bool))
            for name in ("cover_time", "makespan", "total_distance"):
                costs = infos["metrics"][name]
                assert np.isinf(costs[truncations]).all()
                if own.any():
                    same(costs[own], theirs_infos["metrics"][name][own])
        if mode == AutoresetMode.DISABLED and ended.any():
            for venv in (ours, theirs):
                venv.reset(options={"reset_mask": ended.copy()})
    assert cut > 4
    assert solved_last > 0 or limit in (-1, 40)


def test_max_episode_steps_bounds_every_limit() -> None:
    """It holds for limits that are assigned or brought by a problem, too, and must be a count."""
    envs = gymnasium.make_vec("mapp_env/Central-v0", num_envs=2, max_episode_steps=4)
    problem = mapp_env.Problem(mapp_env.make_grid(), (0, 6, 20, 42, 48), 3, max_cycles=9)
    envs.max_cycles = 8
    assert envs.max_cycles == 8
    for options in (None, {"problem": problem}):
        envs.reset(seed=0, options=options)
        ends = [bool(envs.step(np.zeros(2, int))[3].all()) for _ in range(4)]
        assert ends == [False, False, False, True]
    again = gymnasium.make_vec(envs.spec)  # what it was made with is in its spec
    again.reset(seed=0)
    assert [bool(again.step(np.zeros(2, int))[3].all()) for _ in range(4)][-1]
    for value in (0, -2, 2.5, True, "7"):
        with pytest.raises(ValueError, match="max_episode_steps"):
            gymnasium.make_vec("mapp_env/Central-v0", num_envs=2, max_episode_steps=value)


@pytest.mark.parametrize("per_row", [True, False])
def test_landmark_option(per_row: bool) -> None:
    """options["landmarks"] is one problem for all rows (K,), or one per row (B, K)."""
    cells = landmark_cells(SMALL_ROWS)
    rows = [cells[:3], cells[3:6], [cells[5], cells[0], cells[2]]]
    given = np.array(rows) if per_row else rows[2]
    venv = mapp_env.make_vec(3, **settings())
    batch, _ = venv.reset(seed=1, options={"landmarks": given})
    expected = rows if per_row else [rows[2]] * 3
    assert batch[:, 2:5].astype(int).tolist() == expected


def test_given_landmarks_hold_for_one_episode() -> None:
    """Given landmarks are for the next episode only: a row that resets itself draws its own."""
    venv = mapp_env.make_vec(16, max_cycles=2)
    given = [0, 6, 20, 42, 48]
    batch, _ = venv.reset(seed=1, options={"landmarks": given})
    assert batch[:, 3:8].tolist() == [given] * 16
    for _ in range(3):
        batch, *_ = venv.step(np.zeros((16, 3), dtype=int))
    assert all(sorted(row) != given for row in batch[:, 3:8].tolist())


def test_options_are_not_modified() -> None:
    """Resetting leaves the caller's options, seeds and arrays as they were."""
    options = {
        "landmarks": np.array([[0, 1, 2], [3, 6, 7]]),
        "reset_mask": np.array([True, True]),
    }
    before = copy.deepcopy(options)
    seeds = [1, 2]
    venv = mapp_env.make_vec(2, **settings())
    venv.reset(seed=seeds, options=options)
    assert seeds == [1, 2]
    assert options.keys() == before.keys()
    for key in options:
        assert options[key].tolist() == before[key].tolist()


def test_batch_of_one_and_large_batch() -> None:
    """A batch of one row, and one of 300, have the shapes that they declare."""
    for n_rows in (1, 300):
        venv = mapp_env.make_vec(n_rows, **settings())
        batch, infos = venv.reset(seed=0)
        assert batch.shape == venv.observation_space.shape == (n_rows, 8)
        assert infos["action_mask"].shape == (n_rows, 2, 4)
        venv.close()


def test_infos_keep_nothing_of_the_callers_mask() -> None:
    """Which rows were reset can be written over in the infos without touching what was passed."""
    envs = mapp_env.make_vec(3)
    envs.reset(seed=0)
    mask = np.array([True, False, True])
    _, infos = envs.reset(options={"reset_mask": mask})
    infos["_action_mask"][:] = False
    assert mask.tolist() == [True, False, True]


def test_seed_0_of_a_row_is_a_seed() -> None:
    """In a list of seeds 0 seeds its row as any other, also when rows were seeded before."""
    envs = mapp_env.make_vec(2)
    first = envs.reset(seed=[0, 1])[0]
    envs.reset()
    assert np.array_equal(envs.reset(seed=[0, 1])[0], first)
    assert envs.np_random_seed == (0, 1)


@pytest.mark.parametrize("observation", ["planes", "distances"])
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.name)
def test_state_is_each_single_environments(mode: AutoresetMode, observation: str) -> None:
    """state() has, whatever is observed, what single environments of the rows' seeds say of it.

    It is fresh, and in next-step mode an ended row keeps its last state for one step.
    """
    arguments = settings(observation=observation)
    envs = mapp_env.make_vec(3, autoreset_mode=mode, **arguments)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.state()
    envs.reset(seed=4)
    singles = [mapp_v0.parallel_env(**arguments) for _ in range(3)]
    for single, seed in zip(singles, envs.np_random_seed, strict=True):
        single.reset(seed=seed)
    rng, ended, ends = np.random.default_rng(0), np.zeros(3, bool), 0
    for _ in range(40):
        state = envs.state()
        assert state.dtype == np.float32
        assert state.tolist() == [single.state().tolist() for single in singles]
        state[:] = -1
        if mode == AutoresetMode.DISABLED and ended.any():
            envs.reset(options={"reset_mask": ended.copy()})
            for row in np.flatnonzero(ended):
                singles[row].reset()
            ended[:] = False
        actions = rng.integers(0, 4, (3, singles[0].task.n_agents))
        terminations, truncations = envs.step(actions)[2:4]
        for row, single in enumerate(singles):
            if mode == AutoresetMode.NEXT_STEP and ended[row]:
                single.reset()
            else:
                single.step(dict(zip(single.possible_agents, actions[row].tolist(), strict=True)))
                if mode == AutoresetMode.SAME_STEP and not single.agents:
                    single.reset()
        ended = terminations | truncations
        ends += int(ended.sum())
    assert ends > 3

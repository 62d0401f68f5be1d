"""The adapters for Stable-Baselines3: rows are environments, seeds and time-outs arrive."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

from mapp_env import mapp_v0
from mapp_env.central_env import CentralEnv

stable_baselines3 = pytest.importorskip("stable_baselines3")
pytest.importorskip("supersuit")

with warnings.catch_warnings():  # SuperSuit's own imports warn
    warnings.simplefilter("ignore")
    from mapp_env.adapters.sb3_returns import EpisodeReturns
    from mapp_env.adapters.sb3_shared import SharedVecEnv, make_sb3_shared
    from mapp_env.adapters.sb3_vec import MappSb3VecEnv, make_sb3_vec

from stable_baselines3 import DQN, PPO  # noqa: E402
from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.vec_env import (  # noqa: E402
    DummyVecEnv,
    VecMonitor,
    VecNormalize,
)

# Short episodes with few landmarks: in a test, some are solved and some run into the limit.
SETTINGS: list[dict[str, Any]] = [
    {"n_landmarks": 2, "max_cycles": 12},
    {
        "n_landmarks": 1,
        "max_cycles": 9,
        "observation": "geodesic",
        "central_action": "joint",
        "allow_wait": True,
    },
    {"n_agents": 1, "n_landmarks": 1, "max_cycles": 25, "observation": "planes"},
]
ENDINGS = {"TimeLimit.truncated", "terminal_observation"}


def batched_actions(envs: Any, rng: np.random.Generator) -> np.ndarray:
    """Return random actions for every row."""
    space = envs.action_space
    if isinstance(space, gymnasium.spaces.Discrete):
        return rng.integers(space.n, size=envs.num_envs)
    return rng.integers(space.nvec, size=(envs.num_envs, len(space.nvec)))


@pytest.mark.parametrize("settings", SETTINGS, ids=["multi", "joint", "planes"])
def test_engine_is_stable_baselines_own_batch(
    settings: dict[str, Any], same: Callable[[Any, Any], None]
) -> None:
    """The engine gives, bit for bit, what SB3's DummyVecEnv gives of single environments.

    Rewards, ends, last observations and time-outs included, over episodes that end both ways.
    """
    envs = make_sb3_vec(4, **settings)
    single = {"central_action": "multi", **settings}
    reference = DummyVecEnv([lambda: CentralEnv(**single)] * 4)
    assert envs.observation_space == reference.observation_space
    assert envs.action_space == reference.action_space
    reference._seeds = list(envs.seed(7))
    same(envs.reset(), reference.reset())
    rng, ends = np.random.default_rng(0), set()
    for _ in range(150):
        actions = batched_actions(envs, rng)
        found, wanted = envs.step(actions), reference.step(actions)
        same(list(found[:3]), list(wanted[:3]))
        for done, info, own in zip(found[2], found[3], wanted[3], strict=True):
            if not done:
                assert not info
                continue
            same({name: info[name] for name in ENDINGS}, {name: own[name] for name in ENDINGS})
            same(info["metrics"], own["metrics"])
            ends.add(info["TimeLimit.truncated"])
            assert info["TimeLimit.truncated"] is not info["metrics"]["success"]
    assert ends == {False, True}


def test_engine_counts_episodes_as_monitor_does() -> None:
    """Returns and lengths in infos["episode"] are those of SB3's VecMonitor."""
    envs = make_sb3_vec(6, n_landmarks=2, max_cycles=12)
    envs.seed(1)
    twin = make_sb3_vec(6, n_landmarks=2, max_cycles=12)
    twin.seed(1)
    monitor = VecMonitor(twin)  # puts its own "episode" in the place of the engine's
    envs.reset()
    monitor.reset()
    rng, count = np.random.default_rng(3), 0
    for _ in range(80):
        actions = batched_actions(envs, rng)
        _, _, dones, infos = envs.step(actions)
        _, _, _, wanted = monitor.step(actions)
        for index in np.flatnonzero(dones):
            own, theirs = infos[index]["episode"], wanted[index]["episode"]
            assert own.keys() == theirs.keys()
            assert (own["r"], own["l"]) == (theirs["r"], theirs["l"])
            count += 1
    assert count > 20


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_sb3_vec(3, n_landmarks=2, max_cycles=12),
        lambda: make_sb3_shared(2, n_landmarks=2, max_cycles=12, observation="own_first"),
    ],
    ids=["engine", "shared"],
)
def test_seeds_decide_episodes(make: Callable[[], Any], same: Callable[[Any, Any], None]) -> None:
    """Equal seeds give equal episodes, other seeds others, and a reset without a seed goes on."""

    def play(seed: int) -> list[Any]:
        envs, rng = make(), np.random.default_rng(5)
        envs.seed(seed)
        seen = [envs.reset()]
        for _ in range(40):
            seen.append(envs.step(batched_actions(envs, rng))[:3])
        seen.append(envs.reset())
        return seen

    first, again, other = play(0), play(0), play(1)
    same(first, again)
    assert not np.array_equal(first[0], other[0])
    assert not np.array_equal(first[0], first[-1])
    envs = make()
    assert not set(envs.seed(0)) & set(envs.seed(1))
    assert envs.seed(None) != envs.seed(None)


def test_engine_takes_problems() -> None:
    """set_options gives the landmarks of each row to the next reset, and to that one alone."""
    envs = make_sb3_vec(2, n_landmarks=3)
    envs.seed(0)
    landmarks = np.array([[0, 1, 2], [42, 43, 44]])
    envs.set_options({"landmarks": landmarks})
    assert envs.reset()[:, 3:6].tolist() == landmarks.tolist()
    assert envs.reset()[:, 3:6].tolist() != landmarks.tolist()


def test_engine_keeps_nothing_of_what_it_gives() -> None:
    """Writing into what was returned changes nothing; infos of unfinished rows refuse it."""
    envs = make_sb3_vec(2)
    envs.seed(0)
    before = envs.reset()
    kept = before.copy()
    before[:] = -1
    observations, _, _, infos = envs.step(np.zeros((2, 3), np.int64))
    assert (observations[:, 3:8] == kept[:, 3:8]).all()
    with pytest.raises(TypeError):
        infos[0]["mark"] = 1


def test_engine_shows_its_rows() -> None:
    """With render_mode="rgb_array" SB3 tiles the rows' pictures; without, there are none."""
    envs = make_sb3_vec(2, render_mode="rgb_array")
    envs.reset()
    one, two = envs.get_images()
    assert one.shape == two.shape
    assert envs.render().shape == (2 * one.shape[0], one.shape[1], 3)


def test_shared_rows_are_agents(same: Callable[[Any, Any], None]) -> None:
    """Row i * N + a is agent a of environment i, last observations and time-outs included."""
    settings: dict[str, Any] = {"n_landmarks": 2, "max_cycles": 12, "observation": "geodesic"}
    envs = make_sb3_shared(3, **settings)
    assert envs.num_envs == 9
    seeds = envs.seed(4)
    singles = [mapp_v0.parallel_env(**settings) for _ in range(3)]
    views = []
    for index, single in enumerate(singles):
        assert len(set(seeds[3 * index : 3 * index + 3])) == 1
        views.extend(single.reset(seed=seeds[3 * index])[0].values())
    same(envs.reset(), np.stack(views))
    rng, ends = np.random.default_rng(0), set()
    for _ in range(120):
        actions = rng.integers(4, size=9)
        observations, rewards, dones, infos = envs.step(actions)
        for index, single in enumerate(singles):
            rows = slice(3 * index, 3 * index + 3)
            names = single.possible_agents
            chosen = dict(zip(names, actions[rows].tolist(), strict=True))
            seen, reward, terminated, truncated, _ = single.step(chosen)
            assert rewards[rows].tolist() == list(reward.values())
            ended = terminated["agent_0"] or truncated["agent_0"]
            assert dones[rows].tolist() == [ended] * 3
            late = [info["TimeLimit.truncated"] for info in infos[rows]]
            assert late == list(truncated.values())
            assert [("terminal_observation" in info) for info in infos[rows]] == [ended] * 3
            if ended:
                last = [info["terminal_observation"] for info in infos[rows]]
                same(last, list(seen.values()))
                seen, _ = single.reset()
                ends.add(truncated["agent_0"])
            same(observations[rows], np.stack(list(seen.values())))
    assert ends == {False, True}
    envs.close()


def test_stable_baselines_checks_the_central_environment() -> None:
    """SB3's own check_env finds nothing to say against Central-v0."""
    check_env(gymnasium.make("mapp_env/Central-v0").unwrapped, warn=True)


def learn(kind: str, seed: int) -> tuple[list[float], list[np.ndarray]]:
    """Train for a moment; return the returns of the episodes and the weights."""
    settings: dict[str, Any] = {"n_landmarks": 2, "max_cycles": 12}
    small: dict[str, Any] = {"seed": seed, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}
    if kind == "DQN":
        envs: Any = make_sb3_vec(4, central_action="joint", **settings)
        model: Any = DQN("MlpPolicy", envs, learning_starts=40, batch_size=16, **small)
    else:
        envs = (
            make_sb3_vec(6, **settings)
            if kind == "PPO"
            else VecMonitor(make_sb3_shared(2, observation="geodesic", **settings))
        )
        envs = VecNormalize(envs, norm_obs=False)
        model = PPO("MlpPolicy", envs, n_steps=16, batch_size=32, n_epochs=1, **small)
    watch = EpisodeReturns()
    model.learn(300, callback=watch)
    weights = [value.numpy().copy() for value in model.policy.state_dict().values()]
    return watch.returns, weights


@pytest.mark.parametrize("kind", ["PPO", "DQN", "shared PPO"])
def test_trainings_are_reproducible(kind: str, same: Callable[[Any, Any], None]) -> None:
    """Two trainings with one seed end with the same weights, one with another seed does not."""
    returns, weights = learn(kind, 0)
    assert len(returns) >= 10
    assert all(total < 0 for total in returns)
    same((returns, weights), learn(kind, 0))
    assert learn(kind, 1)[0] != returns


def test_clock_stops_a_training() -> None:
    """EpisodeReturns stops at the first step after its seconds are over."""
    model = PPO("MlpPolicy", make_sb3_vec(2), n_steps=8, batch_size=16, device="cpu")
    watch = EpisodeReturns(seconds=0.0)
    model.learn(10_000, callback=watch)
    assert model.num_timesteps == 2
    assert watch.elapsed >= 0.0


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: make_sb3_vec(2, autoreset_mode="NextStep"), "autoreset_mode"),
        (lambda: make_sb3_vec(0), "num_envs"),
        (lambda: make_sb3_vec(2).set_options([{}, {}]), "options"),
        (lambda: make_sb3_vec(2).set_attr("max_cycles", 3), "max_cycles"),
        (lambda: make_sb3_vec(2).env_method("state"), "state"),
        (lambda: make_sb3_vec(2).seed(-1), "seed"),
        (lambda: make_sb3_shared(2).seed(-1), "seed"),
        (lambda: make_sb3_shared(0), "num_envs"),
        (lambda: make_sb3_shared(1, num_cpus=2), "num_cpus"),
        (lambda: make_sb3_shared(1, render_mode="ansi"), "render_mode"),
        (lambda: SharedVecEnv(make_sb3_shared(1).venv, 2), "n_agents"),
        (lambda: make_sb3_shared(1).set_attr("max_cycles", 3), "max_cycles"),
        (lambda: make_sb3_shared(1).env_method("state"), "state"),
    ],
)
def test_refusals_name_the_argument(call: Callable[[], Any], named: str) -> None:
    """What cannot be meant is refused with a ValueError that names it."""
    with pytest.raises(ValueError, match=named):
        call()


def test_rows_have_no_attributes_of_their_own() -> None:
    """get_attr gives the engine's attribute for each row; unknown names are an AttributeError."""
    envs: MappSb3VecEnv = make_sb3_vec(3)
    assert envs.get_attr("render_mode") == [None] * 3
    assert envs.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    assert not envs.has_attr("nothing_of_this_name")
    assert envs.env_is_wrapped(gymnasium.Wrapper, indices=1) == [False]

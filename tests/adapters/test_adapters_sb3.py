"""The adapters for Stable-Baselines3: rows are environments, seeds and time-outs arrive."""

from __future__ import annotations

import copy
import itertools
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

from mapp_env import mapp_v0
from mapp_env.envs.central_env import CentralEnv

stable_baselines3 = pytest.importorskip("stable_baselines3")
pytest.importorskip("supersuit")

with warnings.catch_warnings():  # SuperSuit's own imports warn
    warnings.simplefilter("ignore")
    from mapp_env.adapters.sb3_returns import EpisodeReturns
    from mapp_env.adapters.sb3_shared import SharedVecEnv, make_sb3_shared
    from mapp_env.adapters.sb3_vec import MappSb3VecEnv, make_sb3_vec

from stable_baselines3 import DQN, PPO  # noqa: E402
from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.vec_env import (  # noqa: E402
    DummyVecEnv,
    VecEnvWrapper,
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


FORMS: dict[str, Callable[..., Any]] = {
    "multi": lambda **more: make_sb3_vec(3, n_landmarks=2, max_cycles=12, **more),
    "joint": lambda **more: make_sb3_vec(
        3, central_action="joint", n_landmarks=2, max_cycles=12, **more
    ),
    "shared": lambda **more: make_sb3_shared(2, n_landmarks=2, max_cycles=12, **more),
}


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
    with pytest.warns(UserWarning, match="overwritten"):
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


def test_reset_in_mid_episode_counts_anew() -> None:
    """Return and length of an episode begin with it, also where a reset cut the last one short."""
    envs = make_sb3_vec(2, n_landmarks=40, max_cycles=12)
    envs.reset()
    for _ in range(5):
        envs.step(np.zeros((2, 3), int))
    envs.reset()
    total = np.zeros(2)
    for _ in range(12):
        _, rewards, dones, infos = envs.step(np.zeros((2, 3), int))
        total += rewards
    assert dones.all()
    assert [info["episode"]["l"] for info in infos] == [12, 12]
    assert [info["episode"]["r"] for info in infos] == total.tolist()


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
    kept = landmarks.copy()
    landmarks[:] = 7  # what was given is the caller's
    assert envs.reset()[:, 3:6].tolist() == kept.tolist()
    assert envs.reset()[:, 3:6].tolist() != kept.tolist()
    envs.set_options([{"landmarks": [0, (0, 1), 2]}, {"landmarks": kept[1]}])
    assert envs.reset()[:, 3:6].tolist() == kept.tolist()


@pytest.mark.parametrize("copier", ["pickle", "deepcopy"])
@pytest.mark.parametrize("form", FORMS)
def test_copies_continue_identically(
    form: str, copier: str, same: Callable[[Any, Any], None]
) -> None:
    """A copy made in mid-episode, stepped first, goes on as the original does, masks included."""
    envs = FORMS[form]()
    envs.seed(5)
    envs.reset()

    def play(envs: Any, n_steps: int) -> list[Any]:
        rng, seen = np.random.default_rng(1), []
        for _ in range(n_steps):
            *result, infos = envs.step(batched_actions(envs, rng))
            lengths = [info.get("episode", {}).get("l") for info in infos]
            seen.append((result, envs.action_masks(), lengths))
        return seen

    play(envs, 5)
    twin = pickle.loads(pickle.dumps(envs)) if copier == "pickle" else copy.deepcopy(envs)
    first = copy.deepcopy(play(twin, 40))
    same(first, play(envs, 40))


@pytest.mark.parametrize("form", FORMS)
def test_what_is_returned_is_the_callers(form: str, same: Callable[[Any, Any], None]) -> None:
    """Writing into whatever was returned changes nothing later, and each info is its row's own."""
    clean, dirty = FORMS[form](), FORMS[form]()
    rng, ended = np.random.default_rng(0), 0
    for envs in (clean, dirty):
        envs.seed(0)
    same(clean.reset(), dirty.reset())
    for _ in range(40):
        actions = batched_actions(clean, rng)
        results = [envs.step(actions.copy()) for envs in (clean, dirty)]
        for info in (*results[0][3], *results[1][3]):
            info.get("episode", {}).pop("t", None)  # seconds
        same(*results)
        observations, rewards, dones, infos = results[1]
        ended += int(dones.sum())
        for row, info in enumerate(infos):
            info["row"] = row
            for value in list(info.values()):
                if isinstance(value, dict):
                    value.clear()
                elif isinstance(value, np.ndarray):
                    value.fill(0)
        assert [info["row"] for info in infos] == list(range(clean.num_envs))
        observations.fill(-1)
        rewards.fill(-1)
        dones.fill(True)
        same(clean.action_masks(), dirty.action_masks())
        dirty.action_masks().fill(False)
    assert ended > 6


class AddsKeys(VecEnvWrapper):
    """Keep each row's own reward in its info, as imitation's RewardVecEnvWrapper does."""

    def reset(self) -> np.ndarray:
        """Start the episodes."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Step, and write into every info."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for info, reward in zip(infos, rewards, strict=True):
            info["original_env_rew"] = reward
        return observations, -rewards, dones, infos


@pytest.mark.parametrize("form", ["multi", "shared"])
def test_wrappers_may_add_to_infos(form: str) -> None:
    """A training learns through a wrapper that writes each row's reward into its info."""
    envs = AddsKeys(FORMS[form]())
    seen: list[bool] = []

    def look(known: dict[str, Any], _: dict[str, Any]) -> bool:
        infos, rewards = known["infos"], known["rewards"]
        seen.append([info["original_env_rew"] for info in infos] == (-rewards).tolist())
        return True

    PPO("MlpPolicy", envs, n_steps=16, batch_size=24, seed=0, device="cpu").learn(100, look)
    assert len(seen) > 10
    assert all(seen)


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
    watch.seconds = 1000.0
    model.learn(40, callback=watch)  # the clock begins anew
    assert model.num_timesteps >= 40


@pytest.mark.parametrize("allow_wait", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_masks_say_what_bumps(form: str, allow_wait: bool) -> None:
    """An action is masked if and only if it would leave an agent that moves where it is."""
    envs = FORMS[form](allow_wait=allow_wait)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.action_masks()
    envs.seed(2)
    envs.reset()
    rng = np.random.default_rng(0)
    moves = mapp_v0.parallel_env().task.grid.moves
    n_actions = 4 + allow_wait

    def free_of(cells: np.ndarray) -> np.ndarray:
        free = moves[cells] != cells[..., None]
        return np.concatenate([free, np.ones((*cells.shape, int(allow_wait)), bool)], axis=-1)

    for _ in range(30):
        masks = np.stack(envs.env_method("action_masks"))
        assert masks.dtype == bool
        assert np.array_equal(masks, envs.action_masks())
        assert np.array_equal(envs.get_attr("action_masks", indices=1)[0](), masks[1])
        if form == "shared":
            cells = np.array([env.par_env.state()[:3] for env in envs.venv.vec_envs], int)
            expected = free_of(cells).reshape(6, n_actions)
        else:
            free = free_of(last_cells(envs))  # (B, N, A)
            if form == "multi":
                expected = free.reshape(3, 3 * n_actions)
            else:
                every = np.array(list(itertools.product(range(n_actions), repeat=3)))
                expected = np.array([[row[[0, 1, 2], j].all() for j in every] for row in free])
        assert np.array_equal(masks, expected)
        for info in envs.step(batched_actions(envs, rng))[3]:
            if "action_mask" in info:
                info.pop("action_mask")[:] = 0  # what was given is the caller's


def last_cells(envs: MappSb3VecEnv) -> np.ndarray:
    """Return the agents' cells in every row, shape (B, N)."""
    return np.array([envs.engine._rows.scene(row).cells for row in range(envs.num_envs)])


@pytest.mark.parametrize("form", FORMS)
def test_maskable_ppo_never_bumps(form: str) -> None:
    """sb3-contrib's MaskablePPO finds the masks, learns with them, and takes no masked action."""
    sb3_contrib = pytest.importorskip("sb3_contrib")
    envs = FORMS[form]()
    model = sb3_contrib.MaskablePPO(
        "MlpPolicy", envs, n_steps=16, batch_size=24, n_epochs=1, seed=0, device="cpu"
    )
    model.learn(100)
    observations = envs.reset()
    for _ in range(30):
        masks = np.stack(envs.env_method("action_masks"))
        actions, _ = model.predict(observations, action_masks=masks)
        if form == "multi":
            chosen = masks.reshape(3, 3, 4)[np.arange(3)[:, None], np.arange(3), actions]
        else:
            chosen = masks[np.arange(len(actions)), actions]
        assert chosen.all()
        observations = envs.step(actions)[0]


def test_central_environment_has_masks() -> None:
    """CentralEnv.action_masks says the same as the batch's, and asks for a reset first."""
    from sb3_contrib.common.maskable.utils import is_masking_supported

    for central_action in ("multi", "joint"):
        env = CentralEnv(central_action=central_action)
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.action_masks()
        assert is_masking_supported(gymnasium.make("mapp_env/Central-v0"))
        envs = make_sb3_vec(1, central_action=central_action)
        env.reset(seed=envs.seed(3)[0])
        envs.reset()
        rng = np.random.default_rng(1)
        for _ in range(20):
            assert np.array_equal(env.action_masks(), envs.action_masks()[0])
            actions = batched_actions(envs, rng)
            env.step(actions[0])
            envs.step(actions)


def test_evaluations_read_the_episodes() -> None:
    """evaluate_policy gives returns of the task's own reward, whatever VecNormalize does to it."""
    envs = make_sb3_vec(4, n_landmarks=2, max_cycles=12)
    model = PPO("MlpPolicy", envs, n_steps=16, batch_size=32, seed=0, device="cpu")
    returns, lengths = evaluate_policy(
        model, VecNormalize(envs), n_eval_episodes=8, return_episode_rewards=True
    )
    assert all(total == round(total) for total in returns)
    assert max(lengths) <= 12
    assert len(returns) == 8


@pytest.mark.parametrize("form", ["multi", "shared"])
def test_success_is_logged(form: str) -> None:
    """Ended rows say is_success, from which SB3 makes its success rate."""
    envs = FORMS[form]()
    envs.seed(0)
    envs.reset()
    rng, seen = np.random.default_rng(0), set()
    for _ in range(150):
        _, _, dones, infos = envs.step(batched_actions(envs, rng))
        for row, info in enumerate(infos):
            assert ("is_success" in info) == dones[row]
            if dones[row]:
                assert info["is_success"] is not info["TimeLimit.truncated"]
                seen.add(info["is_success"])
    assert seen == {False, True}


def test_shared_environments_take_problems() -> None:
    """set_options gives the landmarks to the next reset of all environments, and to that alone."""
    envs = make_sb3_shared(2, n_landmarks=3)
    envs.seed(0)
    landmarks = np.array([0, 1, 42])
    envs.set_options({"landmarks": landmarks})
    landmarks[:] = 7  # what was given is the caller's
    assert (envs.reset()[:, 3:6] == [0, 1, 42]).all()
    assert not (envs.reset()[:, 3:6] == [0, 1, 42]).all()
    assert (envs.reset()[:, :3] == envs.reset()[0, :3]).all()


def test_agents_that_share_a_network_see_who_they_are() -> None:
    """Without a word on observations the agents of a team see different things once they part."""
    envs = make_sb3_shared(1)
    envs.reset()
    seen = envs.step(np.array([0, 1, 2]))[0]
    assert len(np.unique(seen, axis=0)) == 3


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: make_sb3_vec(2, autoreset_mode="NextStep"), "autoreset_mode"),
        (lambda: make_sb3_vec(0), "num_envs"),
        (lambda: make_sb3_vec(2).set_options([{}, {}]), "options"),
        (lambda: make_sb3_vec(2).set_options([{"landmarks": [0, 1, 2, 3, 5]}]), "options"),
        (lambda: make_sb3_vec(2).set_options(np.zeros((2, 5), int)), "options"),
        (lambda: make_sb3_vec(1).set_options([{"landmarks": None}]), r"options\[0\]"),
        (lambda: make_sb3_vec(1).set_options([{"landmarks": [1] * 5}]), r"options\[0\]"),
        (lambda: make_sb3_vec(1).set_options([{"landmarks": [0, 1, 2, 3, 5], "x": 1}]), "alone"),
        (lambda: make_sb3_vec(2).set_options({"reset_mask": np.ones(2, bool)}), "reset_mask"),
        (lambda: make_sb3_vec(2, render_mode="ansi"), "render_mode"),
        (lambda: make_sb3_shared(2).set_options([{}, {}]), "options"),
        (lambda: make_sb3_vec(2).set_attr("n_agents", 2), "n_agents"),
        (lambda: make_sb3_vec(2).set_attr("max_cycles", 0), "max_cycles"),
        (lambda: make_sb3_vec(2).set_attr("max_cycles", 3, indices=[0]), "indices"),
        (lambda: make_sb3_vec(2).env_method("state"), "state"),
        (lambda: make_sb3_vec(2).seed(-1), "seed"),
        (lambda: make_sb3_shared(2).seed(-1), "seed"),
        (lambda: make_sb3_shared(0), "num_envs"),
        (lambda: make_sb3_shared(1, render_mode="ansi"), "render_mode"),
        (lambda: SharedVecEnv(make_sb3_shared(1).venv, 2), "n_agents"),
        (lambda: make_sb3_shared(1).set_attr("n_agents", 2), "n_agents"),
        (lambda: make_sb3_shared(1).set_attr("max_cycles", 0), "max_cycles"),
        (lambda: make_sb3_shared(1).set_attr("max_cycles", 3, indices=[0, 2]), "indices"),
        (lambda: make_sb3_shared(1).env_method("state"), "state"),
    ],
)
def test_refusals_name_the_argument(call: Callable[[], Any], named: str) -> None:
    """What cannot be meant is refused with a ValueError that names it."""
    with pytest.raises(ValueError, match=named):
        call()


@pytest.mark.parametrize("wrapped", [False, True], ids=["bare", "wrapped"])
@pytest.mark.parametrize("form", FORMS)
def test_max_cycles_may_be_set(form: str, wrapped: bool) -> None:
    """set_attr and an assignment change the limit of all rows, from each row's next reset on."""
    made: dict[str, Any] = {"n_landmarks": 40, "max_cycles": 12}
    envs: Any = (
        make_sb3_shared(2, **made)
        if form == "shared"
        else make_sb3_vec(3, central_action=form, **made)
    )
    outer = VecNormalize(envs, norm_obs=False) if wrapped else envs
    outer.reset()
    rows = range(envs.num_envs)
    outer.set_attr("max_cycles", 5, indices=None if wrapped else rows)
    assert outer.get_attr("max_cycles") == [5] * envs.num_envs
    ends = [step for step in range(1, 24) if outer.step(np.zeros(_shape(envs), int))[2].all()]
    assert ends == [12, 17, 22]  # the first episode had begun
    envs.max_cycles = 3
    outer.reset()
    ends = [step for step in range(1, 7) if outer.step(np.zeros(_shape(envs), int))[2].all()]
    assert ends == [3, 6]


def _shape(envs: Any) -> tuple[int, ...]:
    """Return the shape of a batch of actions."""
    return (envs.num_envs, *envs.action_space.shape)


def test_rows_have_no_attributes_of_their_own() -> None:
    """get_attr gives the engine's attribute for each row; unknown names are an AttributeError."""
    envs: MappSb3VecEnv = make_sb3_vec(3)
    assert envs.get_attr("render_mode") == [None] * 3
    assert envs.metadata["render_fps"] == make_sb3_shared(1).metadata["render_fps"] == 5
    assert envs.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    assert envs.get_attr("action_space") == [envs.action_space] * 3
    assert envs.get_attr("observation_space") == [envs.observation_space] * 3
    assert not envs.has_attr("nothing_of_this_name")
    assert envs.env_is_wrapped(gymnasium.Wrapper, indices=1) == [False]


@pytest.mark.parametrize("form", FORMS)
def test_masks_of_some_rows_are_theirs(form: str) -> None:
    """Masks by row are those of the rows asked for, in their order, and the caller's."""
    envs = FORMS[form]()
    envs.seed(3)
    envs.reset()
    for _ in range(3):
        envs.step(batched_actions(envs, np.random.default_rng(1)))
    masks = envs.action_masks()
    kept = masks.copy()
    for indices in ([1], [2, 0], 1):
        rows = [indices] if isinstance(indices, int) else indices
        found = envs.env_method("action_masks", indices=indices)
        assert np.array_equal(np.stack(found), kept[rows])
    masks[:] = ~masks
    assert np.array_equal(envs.action_masks(), kept)


def test_a_callback_can_be_used_again() -> None:
    """Each call of learn has all the CPU seconds of the callback, from its own first step on."""
    model = PPO("MlpPolicy", make_sb3_vec(2), n_steps=8, batch_size=16, device="cpu")
    watch = EpisodeReturns(seconds=0.2)
    for _ in range(2):
        model.learn(10**9, callback=watch)
        assert watch.elapsed >= 0.2
        assert model.num_timesteps > 2  # two rows: more than one step


def test_two_rows_of_two_landmarks() -> None:
    """A list of options means a problem for each row, also where an array could mean pairs."""
    envs = make_sb3_vec(2, n_landmarks=2)
    envs.set_options([{"landmarks": [0, 6]}, {"landmarks": [42, 20]}])
    assert envs.reset()[:, 3:5].tolist() == [[0, 6], [42, 20]]


@pytest.mark.parametrize("form", FORMS)
def test_unknown_options_are_named(form: str, same: Callable[[Any, Any], None]) -> None:
    """A reset warns of an option that is a typo, and draws problems as if it had not been given."""
    envs, twin = FORMS[form](), FORMS[form]()
    for each in (envs, twin):
        each.seed(4)
    envs.set_options({"landmark": [0, 6]})
    with pytest.warns(UserWarning, match=r"'landmark' \(did you mean 'landmarks'\?\)"):
        observations = envs.reset()
    same(observations, twin.reset())

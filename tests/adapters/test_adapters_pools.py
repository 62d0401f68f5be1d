"""Stable-Baselines3's forms play pools, landmark actions and the way home as the rules' model."""

from __future__ import annotations

import copy
import pickle
import random
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from model import OBSERVATIONS, Model, lively_action
from model_pools import Batch, Game, random_game, random_landmarks

import mapp_env
from mapp_env.envs.central_env import CentralEnv

pytest.importorskip("stable_baselines3")
pytest.importorskip("supersuit")

with warnings.catch_warnings():  # SuperSuit's own imports warn
    warnings.simplefilter("ignore")
    from mapp_env.adapters.sb3_shared import make_sb3_shared
    from mapp_env.adapters.sb3_vec import make_sb3_vec

from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv

N_ROWS = 4
GAMES = range(0, 36, 2)


def arguments(game: Game, **changes: Any) -> dict[str, Any]:
    """Return what an environment of a game is made with."""
    pool = [mapp_env.Grid.from_text("\n".join(rows) + "\n") for rows in game.pool]
    return {"grid": pool, **game.settings(**changes)}


def words_of(seed: int) -> Callable[[], int]:
    """Return what gives the words of an environment that is reset with this seed."""
    generator = np.random.default_rng(seed)
    return lambda: int(generator.integers(2**64, dtype=np.uint64))


def check_view(array: Any, expected: Any) -> None:
    """Hold an observation to be the model's."""
    assert array.dtype == np.float32
    expected = np.array(expected, np.float32)
    assert array.shape == expected.shape
    np.testing.assert_allclose(array, expected, rtol=3e-7, atol=0)


def team_view(model: Model, kind: str) -> Any:
    """Return what a meta-agent sees."""
    if kind == "global":
        return model.global_observation()
    return [model.observation(kind, agent) for agent in range(model.n_agents)]


@pytest.mark.parametrize("seed", GAMES)
def test_engine_plays_the_model(seed: int) -> None:
    """The engine's VecEnv: views, rewards, ends, last views, metrics and masks of every row."""
    game, kind, rng = random_game(seed), OBSERVATIONS[seed // 2 % 5], random.Random(seed)
    envs = make_sb3_vec(N_ROWS, observation=kind, **arguments(game))
    batch = Batch(game, [words_of(int(one)) for one in envs.seed(seed)], "SameStep")
    views = envs.reset()
    for row in range(N_ROWS):
        batch.draw(row)
    ends = 0
    for step in range(60):
        if step == 30:  # given grids hold for one reset
            grids = [rng.randrange(len(game.pool)) for _ in range(N_ROWS)]
            envs.set_options({"grid": grids})
            views = envs.reset()
            for row in range(N_ROWS):
                batch.draw(row, grids[row])
        for row, model in enumerate(batch.models):
            check_view(views[row], team_view(model, kind))
            own = [model.action_mask(agent) for agent in range(game.n_agents)]
            assert envs.action_masks()[row].tolist() == np.ravel(own).astype(bool).tolist()
        joint = [lively_action(model, rng) for model in batch.models]
        views, rewards, dones, infos = envs.step(np.array(joint))
        for row in range(N_ROWS):
            reward, terminated, truncated, model, _ = batch.step(row, joint[row])
            assert rewards[row] == np.float32(reward)
            assert dones[row] == (terminated or truncated)
            if not dones[row]:
                continue
            ends += 1
            check_view(infos[row]["terminal_observation"], team_view(model, kind))
            assert infos[row]["TimeLimit.truncated"] is truncated
            assert infos[row]["is_success"] is terminated
            assert infos[row]["metrics"] == model.metrics()
            assert infos[row]["episode"]["l"] == model.steps
    assert ends >= 1


@pytest.mark.parametrize("seed", GAMES)
def test_shared_rows_play_the_model(seed: int) -> None:
    """Agents that share a policy: each row is an agent of a team, on the team's own grid."""
    game, kind, rng = random_game(seed), OBSERVATIONS[seed // 2 % 5], random.Random(seed)
    n_agents = game.n_agents
    envs = make_sb3_shared(N_ROWS, observation=kind, **arguments(game))
    seeds = envs.seed(seed)[::n_agents]
    batch = Batch(game, [words_of(int(one)) for one in seeds], "SameStep")
    views = envs.reset()
    for row in range(N_ROWS):
        batch.draw(row)
    ends = 0
    for _ in range(40):
        for row, model in enumerate(batch.models):
            for agent in range(n_agents):
                check_view(views[row * n_agents + agent], model.observation(kind, agent))
                mask = envs.action_masks()[row * n_agents + agent].tolist()
                assert mask == [bool(one) for one in model.action_mask(agent)]
        joint = [lively_action(model, rng) for model in batch.models]
        views, rewards, dones, infos = envs.step(np.ravel(joint))
        for row in range(N_ROWS):
            reward, terminated, truncated, model, _ = batch.step(row, joint[row])
            for agent in range(n_agents):
                place = row * n_agents + agent
                assert rewards[place] == np.float32(reward)
                assert dones[place] == (terminated or truncated)
                if dones[place]:
                    ends += 1
                    last = infos[place]["terminal_observation"]
                    check_view(last, model.observation(kind, agent))
                    assert infos[place]["is_success"] is terminated
                    assert infos[place]["TimeLimit.truncated"] is truncated
    assert ends >= 1


SETTINGS: dict[str, Any] = {
    "grid": [mapp_env.make_grid(), mapp_env.Grid.from_text("...\n.D.\n...\n.#.\n")],
    "n_agents": 2,
    "n_landmarks": 2,
    "max_cycles": 12,
}
FORMS: dict[str, dict[str, Any]] = {
    "moves": {"central_action": "multi", "return_home": True},
    "joint": {"central_action": "joint", "observation": "planes"},
    "landmarks": {"actions": "landmarks", "observation": "distances", "return_home": True},
}


@pytest.mark.parametrize("form", FORMS)
def test_engine_is_stable_baselines_own_batch(form: str, same: Any) -> None:
    """Bit for bit what SB3's DummyVecEnv gives of single environments over the same pool."""
    settings = {**SETTINGS, **FORMS[form]}
    envs = make_sb3_vec(4, **settings)
    single = {"central_action": "multi", **settings}
    reference = DummyVecEnv([lambda: CentralEnv(**single)] * 4)
    assert envs.observation_space == reference.observation_space
    assert envs.action_space == reference.action_space
    reference._seeds = list(envs.seed(7))
    same(envs.reset(), reference.reset())
    envs.action_space.seed(0)
    ends = set()
    for _ in range(150):
        actions = np.array([envs.action_space.sample() for _ in range(4)])
        found, wanted = envs.step(actions), reference.step(actions)
        same(list(found[:3]), list(wanted[:3]))
        for done, info, own in zip(found[2], found[3], wanted[3], strict=True):
            if done:
                for name in ("terminal_observation", "TimeLimit.truncated", "metrics"):
                    same(info[name], own[name])
                ends.add(info["TimeLimit.truncated"])
    assert ends == {False, True}


def test_engine_takes_problems_of_a_pool() -> None:
    """set_options: landmarks on a grid for all, grids of each row, and a list of rows' options."""
    envs = make_sb3_vec(2, **SETTINGS)
    envs.seed(0)
    rng, rows = random.Random(0), tuple(SETTINGS["grid"][1].to_text().split())
    cells = [random_landmarks(rng, rows, 2) for _ in range(2)]
    envs.set_options({"grid": 1, "landmarks": list(cells[0])})
    assert envs.reset()[:, 2:4].tolist() == [list(cells[0])] * 2
    envs.set_options([{"grid": 1, "landmarks": list(one)} for one in cells])
    views = envs.reset()
    assert views[:, 2:4].tolist() == [list(one) for one in cells]
    assert views[:, :2].tolist() == [[SETTINGS["grid"][1].depot] * 2] * 2
    envs.set_options([{"grid": 0, "landmarks": [0, 48]}, {"grid": 1, "landmarks": [0, (0, 1)]}])
    views = envs.reset()
    assert views[:, 2:4].tolist() == [[0, 48], [0, 1]]
    assert views[:, 0].tolist() == [grid.depot for grid in SETTINGS["grid"]]
    for wrong in (
        [{"grid": 0, "landmarks": [0, 48]}],
        [{"grid": 2, "landmarks": [0, 1]}] * 2,
        [{"landmarks": [0, 1]}] * 2,
        [{"grid": 1, "landmarks": [0, 48]}] * 2,
    ):
        with pytest.raises(ValueError, match="options"):
            envs.set_options(wrong)


@pytest.mark.parametrize("copier", ["pickle", "deepcopy"])
@pytest.mark.parametrize("form", FORMS)
def test_copies_continue_identically(form: str, copier: str, same: Any) -> None:
    """A copy made in mid-episode over a pool, stepped first, goes on as the original does."""
    envs = make_sb3_vec(3, **{**SETTINGS, **FORMS[form]})
    envs.seed(5)
    envs.reset()

    def play(envs: Any) -> list[Any]:
        envs.action_space.seed(3)
        seen = []
        for _ in range(40):
            actions = np.array([envs.action_space.sample() for _ in range(3)])
            seen.append((envs.step(actions)[:3], envs.action_masks()))
        return copy.deepcopy(seen)

    play(envs)
    twin = pickle.loads(pickle.dumps(envs)) if copier == "pickle" else copy.deepcopy(envs)
    first = play(twin)
    same(first, play(envs))


@pytest.mark.parametrize(
    "form",
    [pytest.param(form, marks=[] if form == "landmarks" else [pytest.mark.slow]) for form in FORMS],
)
def test_trainers_run(form: str) -> None:
    """PPO, and DQN where joint actions are numbered, train some steps on a pool."""
    settings = {**SETTINGS, **FORMS[form]}
    trainer, more = (DQN, {"learning_starts": 20}) if form == "joint" else (PPO, {"n_steps": 16})
    model = trainer("MlpPolicy", make_sb3_vec(4, **settings), seed=0, **more)
    model.learn(128)
    shared = make_sb3_shared(
        2, **{**SETTINGS, **{k: v for k, v in FORMS[form].items() if k != "central_action"}}
    )
    PPO("MlpPolicy", shared, n_steps=16, batch_size=32, seed=0).learn(64)


def test_pictures_of_a_pool_have_one_size() -> None:
    """SB3 tiles, and records, the pictures of rows on grids of any size; none is cut or changed."""
    grids = [mapp_env.Grid(np.zeros(shape, bool)) for shape in ((2, 9), (7, 3), (12, 1))]
    envs = make_sb3_vec(2, **{**SETTINGS, "grid": grids, "render_mode": "rgb_array"})
    shapes, drawn = set(), set()
    for wanted in ([0, 1], [2, 2], [1, 0], [0, 0]):
        envs.set_options({"grid": wanted})
        envs.reset()
        padded, plain = envs.get_images(), envs.engine.render()
        for sheet, picture in zip(padded, plain, strict=True):
            height, width = picture.shape[:2]
            assert np.array_equal(sheet[:height, :width], picture)
            assert (sheet[height:] == 255).all()
            assert (sheet[:, width:] == 255).all()
            shapes.add(sheet.shape)
            drawn.add(picture.shape)
        assert envs.render().shape[2] == 3
    assert len(shapes) == 1
    assert len(drawn) == 3
    assert shapes == {tuple(np.max(list(drawn), axis=0).tolist())}

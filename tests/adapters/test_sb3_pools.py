"""Stable-Baselines3's forms on a pool: grids in infos, options of each row, masks of landmarks."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import mapp_env
from mapp_env import mapp_v0

pytest.importorskip("stable_baselines3")
pytest.importorskip("supersuit")

with warnings.catch_warnings():  # SuperSuit's own imports warn
    warnings.simplefilter("ignore")
    from mapp_env.adapters.sb3_shared import make_sb3_shared
    from mapp_env.adapters.sb3_vec import make_sb3_vec

YARD = mapp_env.Grid.from_text("...\n.D.\n...\n.#.\n")
LINE = mapp_env.Grid.from_text("....D...")
POOL = [mapp_env.make_grid(), YARD, LINE]
SETTINGS: dict[str, Any] = {
    "grid": POOL,
    "n_agents": 2,
    "n_landmarks": 2,
    "max_cycles": 9,
    "observation": "distances",
    "actions": "landmarks",
}
FORMS: dict[str, Callable[..., Any]] = {
    "rows are teams": lambda **more: make_sb3_vec(6, **{**SETTINGS, **more}),
    "rows are agents": lambda **more: make_sb3_shared(6, **{**SETTINGS, **more}),
}


def random_actions(envs: Any, rng: np.random.Generator) -> np.ndarray:
    """Return an action of those that the mask advises, for every agent of every row."""
    masks = envs.action_masks().reshape(envs.num_envs, -1, 3)
    actions = (rng.random(masks.shape) * masks).argmax(axis=-1)
    return actions if envs.action_space.shape else actions[:, 0]


@pytest.mark.parametrize("form", FORMS)
def test_infos_name_the_grid_that_was_played(form: str) -> None:
    """reset_infos and every step's infos have the number that a single environment says.

    On an episode's last step it is that of the episode that ended, not of the next one.
    """
    envs = FORMS[form]()
    seeds = envs.seed(5)
    team = envs.num_envs // 6
    singles = [mapp_v0.parallel_env(**SETTINGS) for _ in range(6)]
    current = [env.reset(seed=seed)[1] for env, seed in zip(singles, seeds[::team], strict=True)]
    envs.reset()
    grids = [infos["agent_0"]["grid"] for infos in current for _ in range(team)]
    assert [info["grid"] for info in envs.reset_infos] == grids
    rng, changes = np.random.default_rng(0), 0
    for _ in range(40):
        actions = random_actions(envs, rng)
        _, _, dones, infos = envs.step(actions)
        assert [info["grid"] for info in infos] == grids
        for index, env in enumerate(singles):
            chosen = actions.reshape(6, 2)[index].tolist()
            told = env.step(dict(zip(env.possible_agents, chosen, strict=True)))[-1]
            assert dones[index * team] == (not env.agents)
            if not env.agents:
                told = env.reset()[1]
            rows = slice(index * team, (index + 1) * team)
            changes += grids[rows] != [told["agent_0"]["grid"]] * team
            grids[rows] = [told["agent_0"]["grid"]] * team
    assert changes > 10


def test_one_grid_is_not_named() -> None:
    """Without a pool no info has a grid, and those of rows that go on are empty."""
    for envs in (make_sb3_vec(2), make_sb3_shared(1)):
        envs.reset()
        assert not any("grid" in info for info in envs.reset_infos)
        infos = envs.step(np.zeros((envs.num_envs, *envs.action_space.shape), int))[3]
        assert not any("grid" in info for info in infos)
    named = make_sb3_vec(2, grid=[YARD])
    named.reset()
    assert named.reset_infos == [{"grid": 0}] * 2


def test_each_row_has_options_of_its_own() -> None:
    """A list says where each row plays: on what grid, on which landmarks, or which problem."""
    envs = make_sb3_vec(3, **{**SETTINGS, "observation": "global", "actions": "moves"})
    envs.seed(0)
    envs.set_options([{"grid": index} for index in (2, 0, 1)])
    observations = envs.reset()
    assert [info["grid"] for info in envs.reset_infos] == [2, 0, 1]
    assert observations[:, 0].tolist() == [POOL[index].depot for index in (2, 0, 1)]
    envs.set_options(
        [
            {"grid": 1, "landmarks": [0, (3, 2)]},
            {"problem": mapp_env.Problem(LINE, (7, 1), 2, starts=(0, 3))},
            {"grid": 0, "landmarks": np.array([48, 0])},
        ]
    )
    observations = envs.reset()
    assert [info["grid"] for info in envs.reset_infos] == [1, 2, 0]
    assert observations[:, :4].astype(int).tolist() == [
        [4, 4, 0, 11],
        [0, 3, 7, 1],
        [24, 24, 48, 0],
    ]
    drawn = {tuple(info["grid"] for info in envs.reset_infos) for _ in range(8) if [envs.reset()]}
    assert len(drawn) > 1  # the options were of one reset


def test_shared_rows_take_a_grid() -> None:
    """set_options puts all environments on one grid of the pool, for the next reset alone."""
    envs = make_sb3_shared(5, **SETTINGS)
    envs.seed(0)
    envs.set_options({"grid": 2})
    envs.reset()
    assert [info["grid"] for info in envs.reset_infos] == [2] * 10
    envs.reset()
    assert len({info["grid"] for info in envs.reset_infos}) > 1


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ([{"grid": 0}, {"grid": 3}], r"options\[1\]\['grid'\] must be an integer in 0\.\.2"),
        ([{"grid": 0}, {"grid": True}], r"options\[1\]\['grid'\]"),
        ([{"grid": 0}, {"grid": 0, "landmarks": [0, 6]}], r"options\[0\].*all rows with 'grid'"),
        ([{"landmarks": [0, 6]}] * 2, r"options\[0\]: options\['landmarks'\] needs"),
        ([{"grid": 1, "landmarks": [0, 6]}, {"grid": 1, "landmarks": [0, 99]}], r"options\[1\]"),
        ([{"problem": None}] * 2, r"options\[0\] must fix"),
        ([{"grid": 0}], "a list of 2 dicts"),
        ([{"grid": 0}, 5], r"options\[0\]|options\[1\]"),
    ],
)
def test_rows_refusals_name_the_row(options: Any, named: str) -> None:
    """What a row cannot be reset with is refused when it is said, by the row's number."""
    with pytest.raises(ValueError, match=named):
        make_sb3_vec(2, **SETTINGS).set_options(options)


@pytest.mark.parametrize("return_home", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_maskable_ppo_walks_to_landmarks(form: str, return_home: bool) -> None:
    """sb3-contrib's MaskablePPO has K + 1 actions an agent, and chooses no visited landmark."""
    sb3_contrib = pytest.importorskip("sb3_contrib")
    envs = FORMS[form](return_home=return_home)
    space = envs.action_space
    assert (space.nvec.tolist() if space.shape else space.n) == ([3, 3] if space.shape else 3)
    model = sb3_contrib.MaskablePPO(
        "MlpPolicy", envs, n_steps=16, batch_size=24, n_epochs=1, seed=0, device="cpu"
    )
    model.learn(200)
    observations = envs.reset()
    per_row = envs.num_envs, len(space.nvec) if space.shape else 1, 3
    hidden = 0
    for _ in range(30):
        masks = np.stack(envs.env_method("action_masks"))
        unvisited = observations[..., -2:].reshape(*per_row[:2], 2) == 1
        assert np.array_equal(masks.reshape(per_row)[..., :2], unvisited)
        assert masks.reshape(per_row)[..., 2].all()
        hidden += (~masks).sum()
        actions, _ = model.predict(observations, action_masks=masks)
        chosen = np.take_along_axis(masks.reshape(per_row), actions.reshape(*per_row[:2], 1), 2)
        assert chosen.all()
        observations = envs.step(actions)[0]
    assert hidden > 0


@pytest.mark.parametrize("form", FORMS)
def test_return_home_ends_at_home(form: str) -> None:
    """Rows in which all walk home end solved, later than their last visit."""
    envs = FORMS[form](return_home=True, max_cycles=60)
    envs.seed(1)
    envs.reset()
    rng, late = np.random.default_rng(2), 0
    for _ in range(80):
        for info, done in zip(*reversed(envs.step(random_actions(envs, rng))[2:]), strict=True):
            if done and info["is_success"]:
                metrics = info["metrics"]
                assert metrics["makespan"] > metrics["cover_time"]
                late += 1
    assert late > 6

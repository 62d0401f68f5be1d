"""The official tests of PettingZoo, Gymnasium and SuperSuit, with every warning a failure."""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib.util
import json
import pickle
import subprocess
import sys
import warnings
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env
from model import OBSERVATIONS

import mapp_env
from mapp_env import mapp_v0

with warnings.catch_warnings():  # these import PettingZoo's own environments the deprecated way
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
    from pettingzoo.test import max_cycles_test as official_max_cycles_test
    from pettingzoo.test.render_test import render_test as official_render_test
    from pettingzoo.test.state_test import state_test as official_state_test

COUNTS = (1, 3, 7)

over_the_grid = pytest.mark.parametrize(
    "settings",
    [
        pytest.param(
            {"observation": kind, "n_agents": count, "allow_wait": wait},
            id=f"{kind}-{count}-{'wait' if wait else 'move'}",
        )
        for kind in OBSERVATIONS
        for count in COUNTS
        for wait in (False, True)
    ],
)


@pytest.fixture(autouse=True)
def warnings_are_failures() -> Iterator[None]:
    """Turn every warning inside these tests into an error, whatever the configuration says."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@over_the_grid
def test_parallel_api(settings: dict[str, Any]) -> None:
    """PettingZoo's parallel_api_test passes without a warning."""
    parallel_api_test(mapp_v0.parallel_env(**settings), num_cycles=40)


@over_the_grid
def test_aec_api(settings: dict[str, Any]) -> None:
    """PettingZoo's api_test, the stricter one, passes on the AEC face without a warning."""
    api_test(mapp_v0.env(**settings), num_cycles=60)


@over_the_grid
def test_seeding(settings: dict[str, Any]) -> None:
    """PettingZoo's seed_test and parallel_seed_test find equal environments for equal seeds."""
    seed_test(functools.partial(mapp_v0.env, **settings), num_cycles=30)
    parallel_seed_test(functools.partial(mapp_v0.parallel_env, **settings), num_cycles=30)


@over_the_grid
def test_state(settings: dict[str, Any]) -> None:
    """PettingZoo's state_test finds every state inside state_space, on both faces."""
    official_state_test(mapp_v0.env(**settings), mapp_v0.parallel_env(**settings), num_cycles=60)


@over_the_grid
def test_gymnasium_checker(settings: dict[str, Any]) -> None:
    """Gymnasium's check_env accepts Central-v0 as gymnasium.make returns it, and unwrapped."""
    env = gymnasium.make("mapp_env/Central-v0", **settings)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.spec is not None
    env.reset(seed=3)
    for _ in range(20):  # through the passive checker and the order enforcer
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()


@over_the_grid
def test_spaces_hold_every_observation(settings: dict[str, Any]) -> None:
    """Whole episodes stay inside the declared spaces, on the parallel and the batched face."""
    env = mapp_v0.parallel_env(**settings)
    rng = np.random.default_rng(0)
    observations, _ = env.reset(seed=5)
    spaces = {agent: env.observation_space(agent) for agent in env.possible_agents}
    while env.agents:
        for agent, observation in observations.items():
            assert spaces[agent].contains(observation)
            assert observation.dtype == np.float32
            assert np.isfinite(observation).all()
        actions = {agent: rng.integers(env.action_space(agent).n) for agent in env.agents}
        observations, *_ = env.step(actions)
    venv = mapp_env.make_vec(3, **settings)
    batch, _ = venv.reset(seed=5)
    for _ in range(60):
        assert venv.observation_space.contains(batch)
        assert all(venv.single_observation_space.contains(row) for row in batch)
        nvec = venv.single_action_space.nvec
        batch, *_ = venv.step(rng.integers(nvec, size=venv.action_space.shape))


@pytest.mark.parametrize("max_agents", [3])
def test_max_cycles(max_agents: int) -> None:
    """PettingZoo's max_cycles_test: both faces end exactly at the limit."""
    settings = {"n_agents": max_agents, "n_landmarks": 30}  # too many to cover in its 4 steps
    module = SimpleNamespace(
        parallel_env=functools.partial(mapp_v0.parallel_env, **settings),
        env=functools.partial(mapp_v0.env, **settings),
    )
    official_max_cycles_test(module)


def test_rendering() -> None:
    """PettingZoo's render_test passes for every mode that the metadata names."""
    modes = (
        mapp_v0.parallel_env.metadata["render_modes"]
        if hasattr(mapp_v0.parallel_env, "metadata")
        else mapp_v0.parallel_env().metadata["render_modes"]
    )
    assert set(modes) == {"human", "rgb_array", "ansi"}
    if importlib.util.find_spec("pygame") is None:
        pytest.skip("the window needs pygame-ce")
    official_render_test(mapp_v0.env)


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="this PettingZoo has no registry")
def test_pettingzoo_registry() -> None:
    """pettingzoo.make builds the same environment as the module, with its arguments."""
    made = pettingzoo.make("parallel", "mapp_env/mapp-v0", n_agents=2, n_landmarks=4)
    own = mapp_v0.parallel_env(n_agents=2, n_landmarks=4)
    assert type(made.unwrapped) is type(own.unwrapped)
    for env in (made, own):
        env.reset(seed=9)
    assert made.state().tolist() == own.state().tolist()
    assert made.state().shape == (10,)


@pytest.mark.parametrize("mode", [None, "sync"])
def test_gymnasium_registry(mode: str | None) -> None:
    """gymnasium.make and gymnasium.make_vec build Central-v0 by its id, with its arguments."""
    single = gymnasium.make("mapp_env/Central-v0", n_landmarks=4)
    assert isinstance(single.action_space, gymnasium.spaces.Discrete)
    assert single.action_space.n == 4**3
    assert single.observation_space.shape == (11,)
    several = gymnasium.make_vec(
        "mapp_env/Central-v0", num_envs=2, vectorization_mode=mode, n_landmarks=4
    )
    observations, _ = several.reset(seed=0)
    assert observations.shape == (2, 11)
    for _ in range(60):
        observations, rewards, *_ = several.step(several.action_space.sample())
    assert rewards.shape == (2,)
    several.close()
    single.close()


IN_A_WORKER = """
import gymnasium
if __name__ == "__main__":
    central, several = (f"mapp_env:mapp_env/{name}-v0" for name in ("Central", "Tuple"))
    assert not [name for name in gymnasium.registry if name.startswith("mapp_env")]
    envs = gymnasium.vector.AsyncVectorEnv([lambda: gymnasium.make(central)], context="spawn")
    print(envs.reset(seed=0)[0].shape)
    envs.close()
    print(gymnasium.make(central).spec.id, gymnasium.make(several).spec.id)
"""


def test_ids_are_known_where_only_gymnasium_is_imported() -> None:
    """With the module in front, ids work in a fresh process, and in workers that are spawned."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", IN_A_WORKER],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["(1,", "13)", "mapp_env/Central-v0", "mapp_env/Tuple-v0"]


def spec_through_json(spec: Any) -> Any:
    """Return a spec written as JSON and read again."""
    return type(spec).from_json(spec.to_json())


def test_specs_with_a_grid_are_json() -> None:
    """Made anew from its spec's JSON text, an environment on a grid of one's own has that grid."""
    grid = mapp_env.Grid.from_text("..#\n...\n.#.", depot=5)
    arguments: dict[str, Any] = {"grid": grid, "n_agents": 2, "n_landmarks": 3}
    for name in ("mapp_env/Central-v0", "mapp_env/Tuple-v0"):
        env = gymnasium.make(name, **arguments)
        twin = gymnasium.make(spec_through_json(env.spec))
        assert twin.unwrapped.task == env.unwrapped.task
    for mode in (None, "sync"):
        envs = gymnasium.make_vec("mapp_env/Central-v0", 2, vectorization_mode=mode, **arguments)
        twins = gymnasium.make_vec(spec_through_json(envs.spec))
        one = twins if mode is None else twins.envs[0].unwrapped
        assert (one.task.grid, one.task.n_agents, twins.num_envs) == (grid, 2, 2)
    fields = json.loads(json.dumps(dataclasses.asdict(mapp_env.Problem(grid, (0, 8)))))
    assert fields["grid"] == {"text": "..#\n..D\n.#."}
    assert mapp_v0.parallel_env(grid=fields["grid"], n_landmarks=3).task.grid == grid
    for wrong in ({}, {"text": "x"}, {"text": 3}, {"text": "D.", "depot": 1}):
        with pytest.raises(ValueError, match="grid"):
            mapp_v0.parallel_env(grid=wrong)


def test_seven_agents_have_a_multidiscrete_action() -> None:
    """Up to 6 agents share one number, from 7 on the action is one number per agent."""
    six = gymnasium.make("mapp_env/Central-v0", n_agents=6)
    seven = gymnasium.make("mapp_env/Central-v0", n_agents=7)
    asked = gymnasium.make("mapp_env/Central-v0", n_agents=2, central_action="multi")
    assert six.action_space == gymnasium.spaces.Discrete(4**6)
    assert seven.action_space.nvec.tolist() == [4] * 7
    assert asked.action_space.nvec.tolist() == [4] * 2


@pytest.mark.parametrize("allow_wait", [False, True])
@pytest.mark.parametrize("form", ["joint", "multi", "tuple", "joint batch", "multi batch"])
def test_masks_are_what_actions_are_drawn_with(form: str, allow_wait: bool) -> None:
    """What the documentation says draws actions of each Gymnasium face draws none that bumps."""
    settings = {"n_landmarks": 30, "allow_wait": allow_wait}
    kind = form.split()[0]
    batched = form.endswith("batch")
    rng = np.random.default_rng(0)
    if batched:
        env: Any = mapp_env.make_vec(2, central_action=kind, **settings)
    elif kind == "tuple":
        env = gymnasium.make("mapp_env/Tuple-v0", observation="global", **settings)
    else:
        env = gymnasium.make("mapp_env/Central-v0", central_action=kind, **settings)
    env.action_space.seed(0)
    observation, info = env.reset(seed=0)
    for _ in range(40):
        mask = info.get("action_mask")
        if form == "multi batch":
            actions = (rng.random(mask.shape) * mask).argmax(axis=-1)
        elif kind == "joint":
            joint = info["joint_action_mask"]
            actions = env.action_space.sample(tuple(joint) if batched else joint)
        else:
            mask = env.unwrapped.action_masks if kind == "tuple" else mask
            actions = env.action_space.sample(tuple(mask))
        before = cells_in(observation)
        observation, *_, info = env.step(actions)
        moves = agents_moves(actions, kind, 4 + allow_wait)
        assert ((cells_in(observation) != before) | (moves == 4)).all()


def cells_in(observation: Any) -> np.ndarray:
    """Return the three agents' cells in a global observation, or in those of a tuple or a batch."""
    return np.asarray(observation[0] if isinstance(observation, tuple) else observation)[..., :3]


def agents_moves(actions: Any, kind: str, n_actions: int) -> np.ndarray:
    """Return each of three agents' action, of a joint action or of a batch of them."""
    if kind != "joint":
        return np.asarray(actions)
    places = np.unravel_index(np.asarray(actions), (n_actions,) * 3)
    return np.stack(places, axis=-1)


def test_supersuit_vectorises() -> None:
    """SuperSuit's vectoriser and concatenation step the parallel face with the right rewards."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # SuperSuit's own imports warn
        supersuit = pytest.importorskip("supersuit")
        env = supersuit.pettingzoo_env_to_vec_env_v1(mapp_v0.parallel_env())
        venv = supersuit.concat_vec_envs_v1(env, 2, num_cpus=1, base_class="gymnasium")
        observations, _ = venv.reset(seed=0)
        assert observations.shape == (6, 13)
        ends = 0
        for _ in range(120):
            actions = np.array([venv.action_space.sample() for _ in range(6)])
            observations, rewards, terminations, truncations, _ = venv.step(actions)
            assert rewards.shape == (6,)
            assert len(set(rewards[:3])) == len(set(rewards[3:])) == 1
            assert (rewards <= 0).all()
            assert len(set((terminations | truncations)[:3])) == 1
            ends += int(terminations[0] or truncations[0])
        assert ends >= 2
        venv.close()


def play(env: Any, rng: np.random.Generator, steps: int) -> list[Any]:
    """Step ``env`` with actions from ``rng``; return everything it returned."""
    seen = []
    for _ in range(steps):
        seen.append(env.step(rng.integers(4, size=env.action_space.shape or (3,))))
    return seen


@pytest.mark.parametrize("large", [False, True], ids=["paper", "large"])
@pytest.mark.parametrize("copier", ["pickle", "deepcopy"])
@pytest.mark.parametrize("face", ["parallel", "aec", "central", "tuple", "vector"])
def test_copies_continue_identically(face: str, copier: str, large: bool, same: Any) -> None:
    """A pickled or deep copy made in mid-episode plays on, and draws on, exactly as the original.

    Stepping the copy first would move the original if the two shared any state.
    """

    def copied(env: Any) -> Any:
        return pickle.loads(pickle.dumps(env)) if copier == "pickle" else copy.deepcopy(env)

    settings: dict[str, Any] = {"max_cycles": 30}
    if large:  # distances are then kept per landmark, and change with the problem
        text = "\n".join(["." * 66] * 65) + "\n"
        settings.update(
            grid=mapp_env.Grid.from_text(text), reward="geodesic", observation="geodesic"
        )
    if face in ("parallel", "aec"):
        make = mapp_v0.parallel_env if face == "parallel" else mapp_v0.env
        env = make(render_mode="ansi", **settings)

        def run(env: Any, steps: int) -> list[Any]:
            rng, seen = np.random.default_rng(1), []
            for _ in range(steps):
                if not env.agents:
                    seen.append(env.reset())
                if face == "parallel":
                    seen.append(env.step({a: int(rng.integers(4)) for a in env.agents}))
                else:
                    seen.append(env.last())
                    ended = env.terminations[env.agent_selection]
                    ended = ended or env.truncations[env.agent_selection]
                    env.step(None if ended else int(rng.integers(4)))
            return seen

    else:
        env = {
            "central": lambda: gymnasium.make(
                "mapp_env/Central-v0", central_action="multi", **settings
            ),
            "tuple": lambda: gymnasium.make("mapp_env/Tuple-v0", **settings),
            "vector": lambda: mapp_env.make_vec(4, **settings),
        }[face]()

        def run(env: Any, steps: int) -> list[Any]:
            rng, seen = np.random.default_rng(1), []
            for _ in range(steps):
                seen.extend(play(env, rng, 1))
                if face != "vector" and (seen[-1][2] or seen[-1][3]):
                    seen.append(env.reset())
            return seen

    env.reset(seed=4)
    run(env, 10)
    env.unwrapped.max_cycles = 20
    twin = copied(env)
    first = copy.deepcopy(run(twin, 75))
    same(first, copy.deepcopy(run(env, 75)))


def test_make_vec_takes_the_form_of_actions() -> None:
    """gymnasium.make_vec hands central_action on: by default that of the single environment."""
    for given, kind in ((None, "Discrete"), ("joint", "Discrete"), ("multi", "MultiDiscrete")):
        options = {} if given is None else {"central_action": given}
        envs = gymnasium.make_vec(
            "mapp_env/Central-v0", num_envs=2, vectorization_mode="vector_entry_point", **options
        )
        assert type(envs.unwrapped.single_action_space).__name__ == kind


def test_agents_read_before_stay_as_they_were() -> None:
    """A list of agents that somebody keeps is not emptied, nor does changing it lose an agent."""
    env = mapp_v0.parallel_env(max_cycles=1, n_landmarks=40)
    env.reset(seed=0)
    before = env.agents
    env.step(dict.fromkeys(env.agents, 0))
    assert before == env.possible_agents
    assert env.agents == []
    env.reset()
    env.agents.clear()
    assert len(env.possible_agents) == 3

"""Options of a reset: what is known is done, what is unknown is named in a warning."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest

import mapp_env
from mapp_env import mapp_v0
from mapp_env.engine.options import BATCH_OPTIONS, OPTIONS
from mapp_env.envs.arguments import AutoresetMode

FACES: dict[str, Callable[[], Any]] = {
    "parallel": mapp_v0.parallel_env,
    "AEC": mapp_v0.env,
    "central": lambda: gymnasium.make("mapp_env/Central-v0"),
    "tuple": lambda: gymnasium.make("mapp_env/Tuple-v0"),
    "vector": lambda: mapp_env.make_vec(2),
    "Gymnasium's own batch": lambda: gymnasium.make_vec("mapp_env/Central-v0", num_envs=2),
}
CELLS = [0, 6, 20, 42, 48]


def state(env: Any) -> np.ndarray:
    """Return what an episode began with."""
    if hasattr(env, "num_envs"):
        return np.array(env.step(np.zeros(env.action_space.shape, int))[0])
    return np.array(env.unwrapped.state())


@pytest.mark.parametrize(
    ("key", "meant"),
    [("landmark", "'landmarks'"), ("problems", "'problem'"), ("Landmarks", "'landmarks'"),
     ("xyz", None), (3, None), (("landmarks",), None)],
    ids=repr,
)  # fmt: skip
@pytest.mark.parametrize("face", FACES)
def test_unknown_options_are_named(face: str, key: Any, meant: str | None) -> None:
    """A reset warns of a key that it does not know, says which ones it does, and goes on."""
    env, twin = FACES[face](), FACES[face]()
    with pytest.warns(UserWarning, match="unknown") as caught:
        env.reset(seed=3, options={key: CELLS})
    (message,) = [str(each.message) for each in caught]
    assert repr(key) in message
    known = BATCH_OPTIONS if hasattr(env, "num_envs") else OPTIONS
    assert message.endswith(f"known are {', '.join(map(repr, known))}")
    assert ("did you mean" in message) is (meant is not None)
    assert meant is None or f"did you mean {meant}" in message
    twin.reset(seed=3)
    assert np.array_equal(state(env), state(twin))


@pytest.mark.parametrize("face", FACES)
def test_known_options_are_taken_in_silence(face: str) -> None:
    """No warning comes of what is known, of nothing, or of what PettingZoo's own test passes."""
    problem = mapp_env.Problem(mapp_env.make_grid(), tuple(CELLS))
    env = FACES[face]()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for options in (None, {}, {"landmarks": CELLS}, {"problem": problem}, {"options": 1}):
            env.reset(seed=0, options=options)
        if hasattr(env, "num_envs"):
            env.reset(options={"landmarks": CELLS, "reset_mask": np.array([True, False])})


@pytest.mark.parametrize("face", FACES)
def test_a_warning_that_is_an_error_resets_nothing(face: str) -> None:
    """Where warnings are errors, the next reset is as if the refused one had not been."""
    env, twin = FACES[face](), FACES[face]()
    for each in (env, twin):
        each.reset(seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match="'options'"):
            env.reset(seed=2, options={"options": {"landmarks": CELLS}})
    for each in (env, twin):
        each.reset()
    assert np.array_equal(state(env), state(twin))


@pytest.mark.parametrize("mode", list(AutoresetMode), ids=lambda mode: mode.name)
def test_autoreset_modes_in_either_spelling(mode: AutoresetMode) -> None:
    """A mode is itself, its value or its name; another spelling is refused."""
    for given in (mode, mode.value, mode.name):
        assert mapp_env.make_vec(1, autoreset_mode=given).autoreset_mode is mode
        assert mapp_env.make_vec(1, autoreset_mode=given).metadata["autoreset_mode"] is mode
    with pytest.raises(ValueError, match=rf"autoreset_mode .*{mode.value}.*{mode.name}"):
        mapp_env.make_vec(1, autoreset_mode=mode.name.lower())

"""Policies that other packages bring along: how a command finds one, and lets it play.

The package knows rules and solvers, no learners. A loader is named by text and imported only when
a policy is asked for; by default it is that of the baselines that are developed beside the package.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.central_env import CentralEnv
from mapp_env.plan import Plan, replay
from mapp_env.problem import Problem
from mapp_env.validation import describe

__all__ = ["DEFAULT_LOADER", "load_policy", "play_policy"]

DEFAULT_LOADER = "baselines.policy:load_policy"

Act = Callable[[NDArray[np.float32]], Any]


def load_policy(name: str, loader: str = DEFAULT_LOADER) -> Act:
    """Return what a policy does: global observations (B, N + 2K) to actions (B, N).

    Parameters
    ----------
    name : str
        Of the policy, as the loader knows it.
    loader : str
        ``MODULE:FUNCTION``; the function takes the name, and what it returns has a method ``act``.

    Raises
    ------
    ValueError
        If the loader is not written so or refuses the name.
    ImportError
        If there is no such loader.
    """
    module, _, function = loader.partition(":")
    if not module or not function.isidentifier():
        raise ValueError(f"--policy-loader must be MODULE:FUNCTION, got {describe(loader)}")
    try:
        load = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        hint = (
            ': install the repository in editable mode, pip install -e ".[baselines]"'
            if loader == DEFAULT_LOADER
            else ""
        )
        raise ImportError(f"policies are loaded by {loader}, but: {error}{hint}") from error
    act: Act = load(name).act
    return act


def play_policy(act: Act, problem: Problem, max_cycles: int) -> Plan:
    """Return what the rules make of a policy's episode.

    Raises
    ------
    ValueError
        If the policy cannot play such a problem, or its actions are none.
    """
    env = CentralEnv(
        problem.grid,
        problem.n_agents,
        len(problem.landmarks),
        max_cycles,
        central_action="multi",
    )
    observation, _ = env.reset(seed=0, options={"landmarks": problem.landmarks})
    actions, over = [], False
    while not over:
        actions.append(np.asarray(act(observation[None]))[0])
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        over = terminated or truncated
    return replay(replace(problem, max_cycles=max_cycles), np.array(actions))

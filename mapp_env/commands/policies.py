"""Policies from other packages: loading and running them.

The package knows rules and solvers, no learners. A loader is named by text and imported only when
a policy is asked for; by default it is that of the baselines that are developed beside the package.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mapp_env.envs.central_env import CentralEnv
from mapp_env.grid import Grid, tell_apart
from mapp_env.plans.plan import Plan, replay
from mapp_env.problem import Problem
from mapp_env.validation import describe

DEFAULT_LOADER = "baselines.policy:load_policy"


class Policy(Protocol):
    """What a loader returns; with a ``grid`` if it was trained on just one."""

    def act(self, observations: NDArray[np.float32], /) -> Any:
        """Return actions (B, N) for global observations (B, N + 2K)."""


def load_policy(name: str, loader: str = DEFAULT_LOADER) -> Policy:
    """Return what a loader, written ``MODULE:FUNCTION``, makes of a policy's name.

    While another than the default one loads, it and what it imports may also lie in the working
    directory, if nowhere else.

    Raises a ValueError if the loader is not written so, fails on the name or returns no policy; an
    ImportError if there is no such loader.
    """
    module, _, function = loader.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), function)):
        raise ValueError(f"--policy-loader must be MODULE:FUNCTION, got {describe(loader)}")
    own = loader == DEFAULT_LOADER
    with contextlib.nullcontext() if own else _working_folder_last():
        try:
            with _refusing(
                f"--policy-loader {loader} cannot be imported", ImportError, AttributeError
            ):
                load = getattr(importlib.import_module(module), function)
        except (ImportError, AttributeError) as error:
            hint = ': install the repository in editable mode, pip install -e ".[baselines]"'
            raise ImportError(
                f"policies are loaded by {loader}, but: {error}{hint if own else ''}"
            ) from error
        with _refusing(f"--policy {describe(name)}: {loader} refuses it"):
            policy: Policy = load(name)
    if not callable(getattr(policy, "act", None)):
        raise ValueError(
            f"--policy-loader must return something with act(), {loader} returns {describe(policy)}"
        )
    return policy


@contextlib.contextmanager
def _refusing(what: str, *others: type[Exception]) -> Iterator[None]:
    """Say that a loader or a policy fails, whatever it raises: the fault is not ours."""
    try:
        yield
    except others:
        raise
    except Exception as error:
        reason = str(error) if isinstance(error, ValueError) else repr(error)
        raise ValueError(f"{what}: {reason}") from error


@contextlib.contextmanager
def _working_folder_last() -> Iterator[None]:
    """Search the working folder for modules, after all others and not for long.

    What happens to lie there and is called torch.py must not be taken for the library.
    """
    folder = os.getcwd()
    if folder in sys.path:
        yield
        return
    sys.path.append(folder)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):  # the loader may have removed it
            sys.path.remove(folder)


def play_policy(policy: Policy, problem: Problem, max_cycles: int) -> Plan:
    """Return what the rules make of a policy's episode.

    Raises a ValueError if the policy was trained on another grid, cannot play such a problem, or
    its actions are none.
    """
    with _refusing("--policy cannot play this problem"):
        grid = getattr(policy, "grid", None)  # one that names none plays on any
    if isinstance(grid, Grid) and grid != problem.grid:
        raise ValueError(
            "--policy cannot play this problem: it must be for this grid, or for any, and is for "
            f"another grid; here {tell_apart(problem.grid, grid)}"
        )
    env = CentralEnv(
        problem.grid, problem.n_agents, len(problem.landmarks), max_cycles, central_action="multi"
    )
    observation, _ = env.reset(seed=0, options={"problem": replace(problem, max_cycles=None)})
    actions, over = [], False
    while not over:
        with _refusing("--policy cannot play this problem"):
            found = np.asarray(policy.act(observation[None]))
        if found.shape != (1, problem.n_agents) or found.dtype.kind not in "iu":
            raise ValueError(
                f"--policy must act with integers of shape (1, {problem.n_agents}), got shape "
                f"{found.shape}, dtype {found.dtype}"
            )
        actions.append(found[0].astype(np.int64))
        observation, _, terminated, truncated, _ = env.step(actions[-1])
        over = terminated or truncated
    return replay(replace(problem, max_cycles=max_cycles), np.array(actions))

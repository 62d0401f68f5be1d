"""Policies from other packages: loading and running them.

The package knows rules and solvers, no learners. A loader is named by text and imported only when
a policy is asked for; by default it is that of the baselines that are developed beside the package.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from mapp_env.engine.observation import Observation
from mapp_env.engine.task import ACTIONS
from mapp_env.evaluation.episodes import play_episodes
from mapp_env.evaluation.policies import Policy, refusing
from mapp_env.evaluation.problems import group_problems
from mapp_env.plans.plan import Plan, replay
from mapp_env.problem import Problem
from mapp_env.validation import describe

DEFAULT_LOADER = "baselines.policy:load_policy"
ENVIRONMENT = ("observation", "actions", "allow_wait")  # options of a policy's environment
OBSERVATIONS = tuple(kind.name.lower() for kind in Observation)


def add_policy_options(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add the options that say who plays, and what it sees; those not given are ``None``."""
    add = parser.add_argument
    note = "" if required else "in place of a plan: "
    add(
        "--policy",
        required=required,
        metavar="NAME",
        help=f"{note}a trained policy that plays, by its name or run folder",
    )
    add(
        "--policy-loader",
        metavar="MODULE:FUNCTION",
        help="what turns the name into something with act(observations (B, ...)) -> actions "
        f"(B, N) (default {DEFAULT_LOADER}, from an editable installation)",
    )
    add(
        "--observation",
        choices=OBSERVATIONS,
        help=f"what the policy sees (default {OBSERVATIONS[0]}: (B, N + 2K))",
    )
    add(
        "--actions",
        choices=ACTIONS,
        help=f"what it acts with: moves, or landmarks to walk towards (default {ACTIONS[0]})",
    )
    # None, not False, where it was not given: as of all options.
    add("--allow-wait", action="store_true", default=None, help="agents may wait: action 4")


def policy_of(arguments: argparse.Namespace) -> Policy:
    """Return the policy that the options name; see :func:`load_policy`."""
    return load_policy(arguments.policy, arguments.policy_loader or DEFAULT_LOADER)


def environment_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of the environment that the options tell."""
    given = {name: getattr(arguments, name) for name in ENVIRONMENT}
    return {name: value for name, value in given.items() if value is not None}


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
            with refusing(
                f"--policy-loader {loader} cannot be imported", ImportError, AttributeError
            ):
                load = getattr(importlib.import_module(module), function)
        except (ImportError, AttributeError) as error:
            hint = ': install the repository in editable mode, pip install -e ".[baselines]"'
            raise ImportError(
                f"policies are loaded by {loader}, but: {error}{hint if own else ''}"
            ) from error
        with refusing(f"--policy {describe(name)}: {loader} refuses it"):
            policy: Policy = load(name)
    if not callable(getattr(policy, "act", None)):
        raise ValueError(
            f"--policy-loader must return something with act(), {loader} returns {describe(policy)}"
        )
    return policy


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


def play_policy(
    policy: Policy, problem: Problem, max_cycles: int, environment: dict[str, Any]
) -> Plan:
    """Return what the rules make of a policy's episode.

    ``environment`` is as :func:`environment_of` gives it. Raises a ValueError if the policy was
    trained on another grid, cannot play such a problem, or its actions are none.
    """
    (group,) = group_problems([problem], [max_cycles])
    episodes = play_episodes(policy, group, environment, n_kept=1)
    return replay(replace(problem, max_cycles=max_cycles), episodes.actions[: episodes.steps[0], 0])

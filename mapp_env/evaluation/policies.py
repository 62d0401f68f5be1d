"""Policies: anything that commands the agents, asked here and nowhere else, and distrusted."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapp_env.grid import Grid, tell_apart
from mapp_env.validation import as_array, describe

Acting: TypeAlias = Callable[[NDArray[np.float32]], Any]


class Policy(Protocol):
    """What commands the agents; with a ``grid`` if it plays on just one."""

    def act(self, observations: NDArray[np.float32], /) -> Any:
        """Return actions (B, N) for observations (B, ...)."""


@contextlib.contextmanager
def refusing(what: str, *others: type[Exception]) -> Iterator[None]:
    """Say that a policy fails, whatever it raises (but ``others``): the fault is not ours."""
    try:
        yield
    except others:
        raise
    except Exception as error:
        reason = str(error) if isinstance(error, ValueError) else repr(error)
        raise ValueError(f"{what}: {reason}") from error


def acting(policy: object) -> Acting:
    """Return what is asked for actions: a policy's ``act``, or a function itself.

    Raises a ValueError if it is neither.
    """
    with refusing("policy has an act() that cannot be looked up"):
        act = getattr(policy, "act", policy)
    if not callable(act):
        raise ValueError(
            "policy must have act(observations), or be a function of observations, got "
            f"{describe(policy)}"
        )
    found: Acting = act
    return found


def check_grid(policy: object, grid: Grid) -> None:
    """Raise a ValueError for a policy of another grid; one that names none plays on any."""
    with refusing("policy cannot play this problem"):
        own = getattr(policy, "grid", None)
    if isinstance(own, Grid) and own != grid:
        raise ValueError(
            f"policy must be one of this grid, or of any, got one of another grid; here "
            f"{tell_apart(grid, own)}"
        )


def ask(
    act: Acting, observations: NDArray[np.float32], n_agents: int, n_actions: int
) -> NDArray[np.int64]:
    """Return a policy's actions (B, N) for observations (B, ...).

    Raises a ValueError if the policy raises anything, or what it returns has another shape or is no
    such action.
    """
    with refusing("policy cannot play this problem"):
        found = as_array(act(observations))
    shape = len(observations), n_agents
    if found.shape != shape or found.dtype.kind not in "iu":
        raise ValueError(
            f"policy must act with integers of shape {shape}, got shape {found.shape}, dtype "
            f"{found.dtype}"
        )
    if found.min() < 0 or found.max() >= n_actions:
        wrong = found[(found < 0) | (found >= n_actions)][0]
        raise ValueError(f"policy must act with integers in 0..{n_actions - 1}, got {wrong}")
    return found.astype(np.int64)

"""What every solver hands back: routes in landmarks and what it has proven about their cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from mapp_env.problem import Problem

__all__ = ["Routes", "Solution", "Solver"]

Routes = tuple[tuple[int, ...], ...]
"""For each agent the landmark cells that it visits, in order; an agent may have none."""


@dataclass(frozen=True)
class Solution:
    """A solver's answer; :func:`mapp_env.solve` turns it into a plan.

    Attributes
    ----------
    routes : tuple of tuple of int
        For each agent its landmark cells in order; every landmark of the problem once.
    bound : int
        A proven lower bound of the objective: no plan of the problem costs less.
    optimal : bool
        Whether the routes cost exactly ``bound``.
    """

    routes: Routes
    bound: int
    optimal: bool


class Solver(Protocol):
    """What every solver's function looks like; further keyword arguments have defaults."""

    def __call__(
        self, problem: Problem, objective: str, *, time_limit: float | None = None, seed: int = 0
    ) -> Solution:
        """Return routes for a problem, short in ``objective``."""
        ...

"""What every solver hands back: routes in landmarks and what it has proven about their cost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from mapp_env.problem import Problem

__all__ = ["Routes", "Solution", "Solver", "solution_of"]

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


def solution_of(
    problem: Problem, routes: Iterable[Iterable[int]], cost: int, bound: int
) -> Solution:
    """Return routes through nodes of a distance matrix as a solution.

    Parameters
    ----------
    problem : Problem
        What was solved.
    routes : iterable of iterable of int
        Nodes in order: node ``k + 1`` is the problem's landmark ``k``. There may be fewer routes
        than agents.
    cost, bound : int
        What the routes cost in the objective, and a proven lower bound of it.
    """
    found = [tuple(problem.landmarks[node - 1] for node in route) for route in routes]
    idle = problem.n_agents - len(found)
    return Solution((*found, *[()] * idle), bound, cost == bound)


class Solver(Protocol):
    """What every solver's function looks like; further keyword arguments have defaults."""

    def __call__(
        self, problem: Problem, objective: str, *, time_limit: float | None = None, seed: int = 0
    ) -> Solution:
        """Return routes for a problem, short in ``objective``."""
        ...

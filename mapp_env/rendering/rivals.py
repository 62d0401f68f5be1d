"""Plans of one problem that are shown together: what may be, and how far each is from optimal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from mapp_env.plans.plan import Plan
from mapp_env.problem import Problem
from mapp_env.validation import describe

__all__ = ["MAX_PLANS", "Gap", "check_plans", "gaps"]

MAX_PLANS = 12


class Gap(NamedTuple):
    """How far a plan is from a proven optimum."""

    gap: float  # (cost - optimum) / optimum
    optimum: float


def gaps(plans: Mapping[str, Plan]) -> dict[str, dict[str, Gap]]:
    """Return for each plan how far it is from those that are proven optimal, by objective.

    Raises
    ------
    ValueError
        If a plan costs less than what is said to be the optimum.
    """
    optima = {plan.objective: plan.cost for plan in plans.values() if plan.status == "optimal"}
    found: dict[str, dict[str, Gap]] = {}
    for label, plan in plans.items():
        found[label] = {}
        for objective, optimum in optima.items():
            cost = getattr(plan, objective)
            if cost < optimum:
                raise ValueError(
                    f"plans[{describe(label)}] has {objective.replace('_', ' ')} {cost}, below "
                    f"{optimum}, which another plan has as the proven optimum"
                )
            if plan.success and (plan.status, plan.objective) != ("optimal", objective):
                found[label][objective] = Gap((cost - optimum) / optimum, optimum)
    return found


def check_plans(problem: object, plans: object) -> None:
    """Refuse what is no mapping of labels to plans of the problem.

    Raises
    ------
    ValueError
        That names the argument, or the label of the plan.
    """
    if not isinstance(problem, Problem):
        raise ValueError(f"problem must be a mapp_env.Problem, got {describe(problem)}")
    if not isinstance(plans, Mapping) or not 1 <= len(plans) <= MAX_PLANS:
        raise ValueError(
            f"plans must be a mapping of 1 to {MAX_PLANS} labels to plans, got {describe(plans)}"
        )
    for label, plan in plans.items():
        if not isinstance(label, str):
            raise ValueError(f"plans must have strings as labels, got {describe(label)}")
        if not isinstance(plan, Plan):
            raise ValueError(
                f"plans[{describe(label)}] must be a mapp_env.Plan, got {describe(plan)}"
            )
        own = plan.problem
        same = own is None or (
            own.grid == problem.grid and set(own.landmarks) == set(problem.landmarks)
        )
        if not same or len(plan.tours) != problem.n_agents:
            raise ValueError(f"plans[{describe(label)}] is a plan of another problem")

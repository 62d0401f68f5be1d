"""Plans of one problem that are shown together: what may be, and how far each is from optimal."""

from __future__ import annotations

from collections.abc import Mapping

from mapp_env.plan import Plan
from mapp_env.problem import Problem
from mapp_env.validation import describe

__all__ = ["MAX_PLANS", "check_plans", "gaps"]

MAX_PLANS = 12


def gaps(plans: Mapping[str, Plan]) -> dict[str, str]:
    """Return for each plan how far it is from those that are proven optimal, in words.

    Raises
    ------
    ValueError
        If a plan costs less than what is said to be the optimum.
    """
    optima = {plan.objective: plan.cost for plan in plans.values() if plan.status == "optimal"}
    notes = {}
    for label, plan in plans.items():
        parts = []
        for objective, optimum in optima.items():
            name = objective.replace("_", " ")
            cost = getattr(plan, objective)
            if cost < optimum:
                raise ValueError(
                    f"plans[{describe(label)}] has {name} {cost}, below {optimum}, which another "
                    "plan has as the proven optimum"
                )
            if plan.success and (plan.status, plan.objective) != ("optimal", objective):
                gap = (cost - optimum) / optimum
                parts.append(f"{name}: gap {gap:.1%} to the optimum {optimum:g}")
        notes[label] = ", ".join(parts)
    return notes


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

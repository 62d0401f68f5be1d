"""Plans of one problem side by side: what may be, how far each is from optimal, and as a GIF."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from mapp_env.plans.plan import Plan
from mapp_env.problem import Problem
from mapp_env.rendering import icons
from mapp_env.rendering.animation import save_gif, scenes
from mapp_env.rendering.palette import INK, PAPER, blend
from mapp_env.rendering.rgb_array import Frame, paste, rgb_array
from mapp_env.validation import check_count, describe

MAX_PLANS = 12

BETWEEN = 12  # pixels between two panels
INSET = 12  # pixels left of a caption
LINE = 20  # pixels of a caption's line
CAPTION = 2 * LINE + 12
QUIET = blend(INK, PAPER, 0.65)


def animate_plans(
    path: str | os.PathLike[str],
    problem: Problem,
    plans: Mapping[str, Plan],
    fps: float = 4,
    hold: float = 2.0,
    loop: bool = True,
    max_side: int = 384,
) -> int:
    """Play plans of one problem side by side and write them as an animated GIF.

    Above each stand its label and, once it is done, what it cost; if another of the plans is
    proven optimal, its gap to that one: (cost - optimum) / optimum. All start together, and those
    that are done wait for the others.

    Parameters
    ----------
    path : str or os.PathLike
        The file; replaced if it is there.
    problem : Problem
        What they are plans of.
    plans : mapping of str to Plan
        1 to 12, by what they are called: ``{"policy": ..., "optimum": ...}``.
    fps, hold, loop
        As in :func:`~mapp_env.rendering.save_animation`.
    max_side : int
        Pixels that the longer side of one grid may take, 16 to 1024.

    Returns
    -------
    int
        Size of the file in bytes.

    Raises
    ------
    ValueError
        If an argument is invalid, a plan is not one of this problem or costs less than the
        proven optimum, the animation would be too large, or the file cannot be written.
    """
    check_plans(problem, plans)
    side = check_count("max_side", max_side, 16, 1024)
    found = gaps(plans)
    panels = [
        _panel(problem, plan, label, _outcome(plan, found[label].get("cover_time")), side)
        for label, plan in plans.items()
    ]
    return save_gif(path, _together(panels), fps, hold, loop)


def _outcome(plan: Plan, gap: Gap | None) -> str:
    """Return what stands above a plan that is done."""
    if not plan.success:
        return "not every landmark is visited"
    proven = " (proven)" if plan.status == "optimal" and plan.objective == "cover_time" else ""
    behind = "" if gap is None else f" (gap {gap.gap:.1%})"
    return f"cover time {plan.cover_time}{proven or behind}, total distance {plan.total_distance}"


def _panel(problem: Problem, plan: Plan, label: str, outcome: str, side: int) -> Iterator[Frame]:
    """Yield the frames of one plan."""
    last = len(plan.actions)
    for step, scene in enumerate(scenes(problem, plan.actions)):
        frame = rgb_array(scene, side)
        yield np.vstack([_caption(label, outcome if step == last else "", frame.shape[1]), frame])


def _caption(label: str, outcome: str, width: int) -> Frame:
    """Return a strip with two lines of text, cut off where they are too wide."""
    strip = np.empty((CAPTION, width, 3), np.uint8)
    strip[:] = INK
    for line, (string, colour) in enumerate(((label, PAPER), (outcome, QUIET))):
        if string:
            icon = icons.text(string, LINE, colour)[:, : width - 2 * INSET]
            top = 6 + line * LINE
            paste(strip, icon, top + icon.shape[0] / 2, INSET + icon.shape[1] / 2)
    return strip


def _together(panels: list[Iterator[Frame]]) -> Iterator[Frame]:
    """Yield frames with all panels beside each other until the last of them ends."""
    shown = [next(panel) for panel in panels]
    gap = np.full((shown[0].shape[0], BETWEEN, 3), PAPER, np.uint8)
    while True:
        yield np.hstack([part for frame in shown for part in (gap, frame)][1:])
        later = [next(panel, None) for panel in panels]
        if all(frame is None for frame in later):
            return
        shown = [old if new is None else new for old, new in zip(shown, later, strict=True)]


# -- what is compared ----------------------------------------------------


class Gap(NamedTuple):
    """How far a plan is from a proven optimum."""

    gap: float  # (cost - optimum) / optimum
    optimum: float


def gaps(plans: Mapping[str, Plan]) -> dict[str, dict[str, Gap]]:
    """Return for each plan how far it is from those that are proven optimal, by objective.

    Raises a ValueError if a plan costs less than what is said to be the optimum.
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
    """Refuse, with a ValueError, what is no mapping of labels to plans of the problem."""
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
        own = plan.problem or problem
        same = own.grid == problem.grid and set(own.landmarks) == set(problem.landmarks)
        same = same and own.start_cells == problem.start_cells
        if not same or len(plan.tours) != problem.n_agents:
            raise ValueError(f"plans[{describe(label)}] is a plan of another problem")

"""What commands draw into a file: the name's ending says what."""

from __future__ import annotations

import os
from typing import Any, Protocol

from numpy.typing import ArrayLike

from mapp_env.files import check_writable
from mapp_env.plans.plan import Plan
from mapp_env.problem import Problem
from mapp_env.validation import describe

ANIMATIONS, FIGURES = (".gif",), (".png", ".svg", ".pdf")
PICTURES = (*ANIMATIONS, *FIGURES)
DEFAULT_FPS = 4.0


class Writer(Protocol):
    """Draws a plan into a file."""

    def __call__(self, problem: Problem, plan: Plan, regrets: ArrayLike | None = None) -> int:
        """Draw it, and what each step lost, if that is given; return how many bytes that took."""
        ...


def check_file(option: str, out: str) -> str:
    """Return what a path leads to; raise ValueError, for the option, if no file can be there."""
    try:
        return check_writable(out)
    except ValueError as error:
        raise ValueError(f"{option} {error}") from error


def picture_writer(option: str, out: str, fps: float | None = None) -> Writer:
    """Return what draws a plan into the file ``out``.

    What stands in the way is said here, before anybody searches for a plan. ``option`` is what
    messages call the file; ``fps``, frames a second, is for animations.

    Raises a ValueError if nothing can be drawn there; an ImportError if it is a figure and
    matplotlib is not there.
    """
    suffix = os.path.splitext(out)[1].lower()
    if suffix not in PICTURES:
        raise ValueError(f"{option} must end in {', '.join(PICTURES)}, got {describe(out)}")
    if suffix in FIGURES and fps is not None:
        raise ValueError("--fps is for animations: it does not go with a figure")
    check_file(option, out)
    if suffix in ANIMATIONS:
        from mapp_env.rendering import save_animation

        rate = DEFAULT_FPS if fps is None else fps

        def animate(problem: Problem, plan: Plan, regrets: ArrayLike | None = None) -> int:
            if regrets is None:
                return save_animation(out, problem, plan.actions, rate)
            return save_animation(out, problem, plan.actions, rate, regrets=regrets)

        return animate

    from mapp_env.rendering import draw_plan, save_figure

    def draw_figure(problem: Problem, plan: Plan, regrets: ArrayLike | None = None) -> int:
        # As no axes were given, the figure is all of one.
        figure: Any = draw_plan(problem, plan, regrets=regrets).figure
        return save_figure(figure, out)

    return draw_figure

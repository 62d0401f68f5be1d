"""Draw an episode: an animated GIF, or a figure of all routes.

For example:
  the proven optimum of a random problem, as an animation
    python -m mapp_env render --out episode.gif
  the routes as a figure, for the least total distance
    python -m mapp_env render --out routes.png --landmarks 0 6 20 42 48 --objective total_distance
  five agents in a building with rooms
    python -m mapp_env render --out rooms.gif --grid rooms --n-landmarks 20 --n-agents 5
  random moves, for fifty steps at most
    python -m mapp_env render --out random.gif --plan random
  a plan that plan.save() wrote
    python -m mapp_env render --out plan.png --plan plan.json
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from gymnasium.utils import seeding

from mapp_env.commands.problem_options import (
    add_problem_options,
    problem_of,
    refuse_problem_options,
)
from mapp_env.files import check_writable
from mapp_env.plan import OBJECTIVES, Plan, replay
from mapp_env.problem import Problem
from mapp_env.solvers import solve
from mapp_env.validation import MAX_SEED, check_count, describe

__all__ = ["add_arguments", "run"]

ANIMATIONS, FIGURES = (".gif",), (".png", ".svg", ".pdf")
FPS, STEPS = 4.0, 50
MAX_STEPS = 1_999  # an animation may have one frame more


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--out",
        required=True,
        metavar="FILE",
        help="where to write: .gif an animation; .png, .svg or .pdf a figure (needs matplotlib)",
    )
    parser.add_argument(
        "--plan",
        default="optimum",
        metavar="PLAN",
        help="what is played: optimum (proven up to 20 landmarks, else the best found), random, "
        "or a plan file, which brings its problem along (default optimum)",
    )
    parser.add_argument(
        "--objective",
        choices=OBJECTIVES,
        help="what the optimum minimises (default cover_time)",
    )
    parser.add_argument(
        "--max-cycles", type=int, metavar="T", help=f"steps of random at most (default {STEPS})"
    )
    parser.add_argument(
        "--fps", type=float, metavar="F", help=f"frames a second of a GIF (default {FPS:g})"
    )
    add_problem_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Draw, and print what was written and what the plan costs.

    Raises
    ------
    ValueError
        If an option cannot be used, or the file cannot be written.
    ImportError
        If a figure is asked for and matplotlib is not there.
    """
    out = arguments.out
    suffix = os.path.splitext(out)[1].lower()
    if suffix not in (*ANIMATIONS, *FIGURES):
        raise ValueError(
            f"--out must end in {', '.join((*ANIMATIONS, *FIGURES))}, got {describe(out)}"
        )
    if suffix in FIGURES and arguments.fps is not None:
        raise ValueError("--fps is for animations: it does not go with a figure")
    check_writable(out)
    # What is missing, too, is said before a search, not after it.
    draw = _animate if suffix in ANIMATIONS else _figure_writer()
    problem, plan = _plan_of(arguments)
    size = draw(out, problem, plan, FPS if arguments.fps is None else arguments.fps)
    print(f"wrote {out}: {size} bytes")
    print(_costs(problem, plan))


def _plan_of(arguments: argparse.Namespace) -> tuple[Problem, Plan]:
    """Return what is played, and on what."""
    source = arguments.plan
    if arguments.objective is not None and source != "optimum":
        raise ValueError("--objective is for --plan optimum")
    if arguments.max_cycles is not None and source != "random":
        raise ValueError("--max-cycles is for --plan random")
    if source not in ("optimum", "random"):
        refuse_problem_options(arguments, "a plan file, which brings its problem along")
        if arguments.seed is not None:
            raise ValueError("--seed does not go with a plan file")
        plan = Plan.load(source)
        if plan.problem is None:
            raise ValueError(f"{source}: has no problem")
        return plan.problem, plan
    problem = problem_of(arguments)
    seed = check_count("--seed", 0 if arguments.seed is None else arguments.seed, 0, MAX_SEED)
    if source == "optimum":
        return problem, solve(problem, arguments.objective or "cover_time", seed=seed)
    limit = STEPS if arguments.max_cycles is None else arguments.max_cycles
    problem = replace(problem, max_cycles=check_count("--max-cycles", limit, 1, MAX_STEPS))
    generator, _ = seeding.np_random(seed)
    return problem, replay(problem, generator.integers(0, 4, (limit, problem.n_agents)))


def _animate(out: str, problem: Problem, plan: Plan, fps: float) -> int:
    from mapp_env.rendering import save_animation

    return save_animation(out, problem, plan.actions, fps)


def _figure_writer() -> Callable[[str, Problem, Plan, float], int]:
    from mapp_env.rendering import draw_plan, save_figure

    def write(out: str, problem: Problem, plan: Plan, _fps: float) -> int:
        figure: Any = draw_plan(problem, plan).figure  # as no axes were given, not a part of one
        return save_figure(figure, out)

    return write


def _costs(problem: Problem, plan: Plan) -> str:
    if not plan.success:
        visited = sum(map(len, plan.claims))
        return f"not solved: {visited} of {len(problem.landmarks)} landmarks visited"
    costs = ", ".join(f"{name.replace('_', ' ')} {getattr(plan, name)}" for name in OBJECTIVES)
    if plan.status == "optimal":
        return f"{costs}; the {plan.objective.replace('_', ' ')} is proven optimal"
    if plan.bound is not None:
        return f"{costs}; the {plan.objective.replace('_', ' ')} is at least {plan.bound}"
    return costs

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
  a trained policy, by its name or run folder
    python -m mapp_env render --out policy.gif --policy pretrained --landmarks 0 6 20 42 48
  the same as a figure, the moves marked that the optimum would not have made
    python -m mapp_env render --out policy.png --policy pretrained --n-landmarks 5 --show-regret
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from mapp_env.commands import problem_options, reports
from mapp_env.commands.pictures import DEFAULT_FPS, PICTURES, picture_writer
from mapp_env.commands.policies import (
    ENVIRONMENT,
    add_policy_options,
    environment_of,
    play_policy,
    policy_of,
)
from mapp_env.plans.plan import OBJECTIVES, Plan, replay
from mapp_env.problem import Problem
from mapp_env.solvers import regrets, solve
from mapp_env.solvers.oracle.decisions import MAX_REGRET_LANDMARKS
from mapp_env.validation import check_count

STEPS = 50
MAX_STEPS = 1_999  # an animation may have one frame more


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add(
        "--out",
        required=True,
        metavar="FILE",
        help=f"where to draw: {', '.join(PICTURES)}; all but an animation need matplotlib",
    )
    add(
        "--plan",
        metavar="PLAN",
        help="what is played: optimum (proven up to 20 landmarks, else the best found), random, "
        "or a plan file, which brings its problem along (default optimum)",
    )
    add_policy_options(parser, required=False)
    add("--objective", choices=OBJECTIVES, help="what the optimum minimises (default cover_time)")
    add(
        "--max-cycles",
        type=int,
        metavar="T",
        help=f"steps of random or of a policy at most (default {STEPS})",
    )
    add(
        "--fps", type=float, metavar="F", help=f"frames a second of a GIF (default {DEFAULT_FPS:g})"
    )
    add(
        "--show-regret",
        action="store_true",
        help="mark what the agents did in steps after which even the optimum is longer than it "
        f"was; up to {MAX_REGRET_LANDMARKS} landmarks",
    )
    reports.add_json_option(parser)
    problem_options.add_problem_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Draw, and print what was written and what the plan costs.

    Raises a ValueError if an option cannot be used or a file cannot be written; an ImportError if a
    library that was asked for is not there.
    """
    draw = picture_writer("--out", arguments.out, arguments.fps)
    problem, plan = _plan_of(arguments)
    lost = _regrets_of(problem, plan) if arguments.show_regret else None
    size = draw(problem, plan, lost)
    record = {"out": arguments.out, "bytes": size, "landmarks": list(problem.landmarks)}
    if problem.starts is not None:
        record["starts"] = list(problem.starts)
    wrote = f"wrote {arguments.out}: {size} bytes"
    lines = [wrote, reports.costs_line(problem, plan), reports.landmarks_line(problem)]
    lines += reports.starts_lines(problem)
    if lost is not None:
        record["regrets"] = lost.tolist()
        steps = (f"{step + 1} ({lost[step]})" for step in np.flatnonzero(lost))
        lines.append(f"steps lost: {lost.sum()}, by step: {', '.join(steps) or 'none'}")
    reports.print_report(arguments, {**record, **reports.costs_record(plan)}, lines)


def _regrets_of(problem: Problem, plan: Plan) -> NDArray[np.int64]:
    """Return what each step of a plan lost."""
    count = len(problem.landmarks)
    if count > MAX_REGRET_LANDMARKS:
        raise ValueError(
            f"--show-regret is for up to {MAX_REGRET_LANDMARKS} landmarks, here are {count}"
        )
    return regrets(problem, plan.actions)


def _plan_of(arguments: argparse.Namespace) -> tuple[Problem, Plan]:
    """Return what is played, and on what."""
    if arguments.policy is not None and arguments.plan is not None:
        raise ValueError("--policy is in place of a plan: it does not go with --plan")
    source = "policy" if arguments.policy is not None else arguments.plan or "optimum"
    if arguments.objective is not None and source != "optimum":
        raise ValueError("--objective is for --plan optimum")
    if arguments.max_cycles is not None and source not in ("random", "policy"):
        raise ValueError("--max-cycles is for --plan random and --policy")
    for name in ("policy_loader", *ENVIRONMENT):
        if getattr(arguments, name) is not None and source != "policy":
            raise ValueError(f"--{name.replace('_', '-')} is for --policy")
    if source not in ("optimum", "random", "policy"):
        return _read_plan(arguments, source)
    problem = problem_options.problem_of(arguments)
    seed = problem_options.seed_of(arguments)
    if source == "optimum":
        return problem, solve(problem, arguments.objective or "cover_time", seed=seed)
    limit = STEPS if arguments.max_cycles is None else arguments.max_cycles
    limit = check_count("--max-cycles", limit, 1, MAX_STEPS)
    if source == "policy":
        environment = environment_of(arguments)
        return problem, play_policy(policy_of(arguments), problem, limit, environment)
    problem = replace(problem, max_cycles=limit)
    generator, _ = seeding.np_random(seed)
    return problem, replay(problem, generator.integers(0, 4, (limit, problem.n_agents)))


def _read_plan(arguments: argparse.Namespace, file: str) -> tuple[Problem, Plan]:
    problem_options.refuse_problem_options(arguments, "a plan file, which brings its problem along")
    if arguments.seed is not None:
        raise ValueError("--seed does not go with a plan file")
    try:
        plan = Plan.load(file)
    except ValueError as error:
        raise ValueError(f"--plan {error}") from error
    if plan.problem is None:
        raise ValueError(f"--plan {file}: has no problem")
    return plan.problem, plan

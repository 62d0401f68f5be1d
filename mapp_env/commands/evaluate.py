"""Judge a policy on many problems beside the proven optimum of each.

For example:
  a trained policy, by its name or run folder, on 100 problems of the default grid
    python -m mapp_env evaluate --policy pretrained
  on problem files in a folder, as Problem.save writes them, whatever their grids and sizes
    python -m mapp_env evaluate --policy pretrained --problems problems
  a policy of one's own, made by load(name) in mine.py, that sees what no map's size changes
    python -m mapp_env evaluate --policy a --policy-loader mine:load --observation geodesic
  one that must bring everybody home, in a building with rooms
    python -m mapp_env evaluate --policy a --policy-loader mine:load --grid rooms --return-home
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapp_env.commands.policies import add_policy_options, environment_of, policy_of
from mapp_env.commands.problem_options import (
    N_AGENTS,
    N_LANDMARKS,
    add_problem_options,
    grid_of,
    problem_of,
    refuse_problem_options,
    seed_of,
)
from mapp_env.commands.reports import add_json_option, print_report, words
from mapp_env.evaluation import evaluate
from mapp_env.evaluation.problems import load_problems
from mapp_env.evaluation.summary import losses_line, summarise
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.problem import Problem, sample_problems

N_PROBLEMS = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add_policy_options(parser)
    add(
        "--objective",
        choices=OBJECTIVES,
        help="what a problem's cost is (default cover_time; makespan with --return-home)",
    )
    add("--return-home", action="store_true", help="an episode goes on until all are home")
    add(
        "--max-cycles",
        type=int,
        metavar="T",
        help="steps at most (default: a problem's own, or enough for one agent alone)",
    )
    add_json_option(parser)
    add_problem_options(parser)
    group = parser.add_argument_group("many problems")
    group.add_argument(
        "--problems",
        metavar="FOLDER",
        help="a folder of problem files (*.json), in place of all options that say what a problem "
        "is",
    )
    group.add_argument(
        "--n-problems", type=int, metavar="P", help=f"how many to draw (default {N_PROBLEMS})"
    )


def run(arguments: argparse.Namespace) -> None:
    """Let the policy play, and print how it did.

    Raises a ValueError if an option cannot be used, or the policy cannot play; an ImportError if
    there is no such loader.
    """
    problems = _problems_of(arguments)
    policy = policy_of(arguments)
    home = arguments.return_home
    objective = arguments.objective or ("makespan" if home else "cover_time")
    options = {"max_cycles": arguments.max_cycles, "return_home": home, **environment_of(arguments)}
    found = evaluate(policy, problems, objective, **options)
    figures = summarise(found)
    record: dict[str, Any] = {"objective": objective, **_plain(figures)}
    record |= {"n_problems": len(problems)}
    record["problems"] = {name: _listed(values) for name, values in found.items()}
    print_report(arguments, record, _lines(objective, problems, found, figures))


def _problems_of(arguments: argparse.Namespace) -> list[Problem]:
    """Return what is played."""
    if arguments.problems is not None:
        reason = "a folder of problems"
        refuse_problem_options(arguments, reason)
        for name in ("n_problems", "seed"):
            if getattr(arguments, name) is not None:
                raise ValueError(f"--{name.replace('_', '-')} does not go with {reason}")
        return load_problems(arguments.problems)
    if arguments.problem is not None or arguments.landmarks is not None:
        if arguments.n_problems is not None:
            raise ValueError(
                "--n-problems is how many to draw: it does not go with a problem that is given"
            )
        return [problem_of(arguments)]
    if arguments.starts is not None:
        raise ValueError("--starts is for a problem that is given, by --landmarks or a file")
    grid = grid_of(arguments)
    n_problems, n_landmarks, n_agents = (
        default if given is None else given
        for given, default in (
            (arguments.n_problems, N_PROBLEMS),
            (arguments.n_landmarks, N_LANDMARKS),
            (arguments.n_agents, N_AGENTS),
        )
    )
    rows = sample_problems(grid, n_problems, n_landmarks, seed_of(arguments))
    return [Problem(grid, row, n_agents) for row in rows.tolist()]


def _lines(
    objective: str,
    problems: list[Problem],
    found: dict[str, NDArray[Any]],
    figures: dict[str, float],
) -> list[str]:
    """Return the same for people."""
    name, solved, optimum = words(objective), found["solved"], found["optimum"]
    sizes = (
        _range([len(problem.landmarks) for problem in problems], "landmark"),
        _range([problem.n_agents for problem in problems], "agent"),
        _count(len({problem.grid for problem in problems}), "grid"),
    )
    lines = [
        f"{_count(len(problems), 'problem')} of {sizes[0]} and {sizes[1]}, {sizes[2]}",
        f"solved {100 * figures['solved']:.2f} %",
    ]
    if not solved.all():
        first = int((~solved).argmax())
        lines[-1] += (
            f"; of the others {100 * found['visited'][~solved].mean():.1f} % of the landmarks were "
            f"visited, the first is problem {first}: {_landmarks(problems[first])}"
        )
    if solved.any():
        lines.append(f"{name} {figures['cost']:.2f}, optimum {figures['optimum']:.2f}")
        if math.isnan(figures["gap"]):
            lines[-1] = f"{name} {figures['cost']:.2f}, at least {figures['bound']:.2f}"
        else:
            worst = int(np.where(np.isnan(found["gap"]), -1.0, found["gap"]).argmax())
            lines += [
                f"gap {100 * figures['gap']:.2f} %, optimal {100 * figures['optimal']:.2f} %",
                f"largest gap {100 * figures['worst_gap']:.2f} %: problem {worst}, {name} "
                f"{found['cost'][worst]:.0f}, optimum {optimum[worst]:.0f}, "
                f"{_landmarks(problems[worst])}",
            ]
    if not math.isnan(figures["regret"]):
        lines.append(losses_line(figures))
    return lines


def _count(number: int, thing: str) -> str:
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


def _range(numbers: list[int], thing: str) -> str:
    low, high = min(numbers), max(numbers)
    return _count(low, thing) if low == high else f"{low} to {_count(high, thing)}"


def _landmarks(problem: Problem) -> str:
    return f"landmarks {' '.join(map(str, problem.landmarks))}"


def _plain(figures: dict[str, float]) -> dict[str, float | None]:
    """Return figures as JSON holds them: what is infinite or unknown is null."""
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


def _listed(values: NDArray[Any]) -> list[Any]:
    """Return results as JSON holds them."""
    if values.dtype.kind != "f":
        listed: list[Any] = values.tolist()
        return listed
    return [value if math.isfinite(value) else None for value in values.tolist()]

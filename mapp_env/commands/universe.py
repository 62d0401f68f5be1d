"""Solve every problem of a grid: how many there are, and how long the optimum is.

For example:
  all 658,008 problems of the default grid
    python -m mapp_env universe
  four landmarks and two agents, in one objective, for a program
    python -m mapp_env universe --n-landmarks 4 --n-agents 2 --objective makespan --json
  three landmarks in a small building with rooms
    python -m mapp_env universe --grid rooms --rows 9 --cols 9 --n-landmarks 3
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from mapp_env.commands.problem_options import N_AGENTS, N_LANDMARKS, add_grid_options, grid_of
from mapp_env.commands.reports import add_json_option, print_report, words
from mapp_env.grid import Grid
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.solvers import solve_universe

BAR = 40  # letters of the longest bar


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--objective", choices=OBJECTIVES, help="what is minimised (default: each in turn)"
    )
    add_json_option(parser)
    group = parser.add_argument_group("the universe")
    add_grid_options(group)
    add = group.add_argument
    add(
        "--n-landmarks",
        type=int,
        default=N_LANDMARKS,
        metavar="K",
        help=f"of each problem (default {N_LANDMARKS})",
    )
    add("--n-agents", type=int, default=N_AGENTS, metavar="N", help=f"default {N_AGENTS}")


def run(arguments: argparse.Namespace) -> None:
    """Solve all problems and print their optima; raise ValueError if there are none or too many."""
    grid = grid_of(arguments)
    objectives = OBJECTIVES if arguments.objective is None else (arguments.objective,)
    records = {
        name: _statistics(grid, arguments.n_landmarks, arguments.n_agents, name)
        for name in objectives
    }
    n_problems = records[objectives[0]]["n_problems"]
    lines = [
        f"{n_problems:,} problems of {arguments.n_landmarks} landmarks and "
        f"{arguments.n_agents} agents on {grid.rows}x{grid.cols} cells, "
        f"{len(grid.reachable)} of which may hold a landmark"
    ]
    for name, record in records.items():
        lines += ["", *_lines(name, record)]
    top = {
        "grid": grid.to_text(),
        "n_landmarks": arguments.n_landmarks,
        "n_agents": arguments.n_agents,
        "n_problems": n_problems,
    }
    print_report(arguments, {**top, "objectives": records}, lines)


def _statistics(grid: Grid, n_landmarks: int, n_agents: int, objective: str) -> dict[str, Any]:
    """Return what is known of all optima in one objective, ready for JSON."""
    start = time.perf_counter()
    landmarks, optimum = solve_universe(grid, n_landmarks, n_agents, objective)
    seconds = time.perf_counter() - start
    costs, counts = np.unique(optimum, return_counts=True)
    return {
        "n_problems": len(optimum),
        "seconds": seconds,
        "mean": float(optimum.mean()),
        "min": int(costs[0]),
        "max": int(costs[-1]),
        "hardest": landmarks[optimum.argmax()].tolist(),
        "histogram": {str(cost): int(n) for cost, n in zip(costs, counts, strict=True)},
    }


def _lines(objective: str, record: dict[str, Any]) -> list[str]:
    """Return the statistics for people, with a bar for each cost."""
    lines = [
        f"{words(objective)}: mean {record['mean']:.3f}, {record['min']} to {record['max']}; "
        f"solved in {record['seconds']:.2f} s",
        f"one of the largest: landmarks {' '.join(map(str, record['hardest']))}",
    ]
    most = max(record["histogram"].values())
    for cost, count in record["histogram"].items():
        bar = "#" * round(BAR * count / most)
        lines.append(f"{cost:>5} {count:>9,} {100 * count / record['n_problems']:6.2f} % {bar}")
    return [line.rstrip() for line in lines]

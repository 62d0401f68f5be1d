"""Solve a problem: routes, their costs, and what is proven about them.

For example:
  the proven optimum of a problem of the default grid
    python -m mapp_env solve --landmarks 0 6 20 42 48
  everybody home as soon as possible, as a figure and as a file that Plan.load reads
    python -m mapp_env solve --objective makespan --picture routes.png --out plan.json
  a map of one's own, landmarks by row and column
    python -m mapp_env solve --grid office.map --landmarks 3,4 10,2 --n-agents 2
  agents in the middle of an episode: where each stands, and the landmarks that are left
    python -m mapp_env solve --starts 27 5,2 --landmarks 0 6 48
  sixty landmarks of a warehouse, with a second to search
    python -m mapp_env solve --grid warehouse --n-landmarks 60 --time-limit 1
"""

from __future__ import annotations

import argparse

from mapp_env.commands.pictures import PICTURES, check_file, picture_writer
from mapp_env.commands.problem_options import add_problem_options, problem_of, seed_of
from mapp_env.commands.reports import (
    add_json_option,
    costs_line,
    landmarks_line,
    print_report,
    starts_lines,
)
from mapp_env.plans.plan import OBJECTIVES, Plan
from mapp_env.problem import Problem
from mapp_env.records import MAX_PLAN_BYTES, labelled, write_record
from mapp_env.solvers import METHODS, solve


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    add(
        "--objective",
        choices=OBJECTIVES,
        default=OBJECTIVES[0],
        help=f"what is minimised (default {OBJECTIVES[0]})",
    )
    add(
        "--method",
        choices=METHODS,
        default=METHODS[0],
        help="exact proves the optimum of up to 20 landmarks, search takes any number, pyvrp needs "
        f"the package of that name (default {METHODS[0]}: exact, else search)",
    )
    add("--time-limit", type=float, metavar="SECONDS", help="that a search may take")
    add("--out", metavar="FILE", help="where to write the plan: a JSON file")
    add("--picture", metavar="FILE", help=f"where to draw it: {', '.join(PICTURES)}")
    add_json_option(parser)
    add_problem_options(parser)


def run(arguments: argparse.Namespace) -> None:
    """Solve, and print, write and draw what was asked for.

    Raises a ValueError if an option cannot be used or a file cannot be written; an ImportError if a
    library that was asked for is not there.
    """
    out = None if arguments.out is None else check_file("--out", arguments.out)
    draw = None
    if arguments.picture is not None:
        if out == check_file("--picture", arguments.picture):
            raise ValueError("--picture must be another file than --out")
        draw = picture_writer("--picture", arguments.picture)
    problem = problem_of(arguments)
    n_agents = problem.n_agents
    options = (arguments.objective, arguments.method, arguments.time_limit)
    plan = solve(problem, *options, seed_of(arguments))
    # A plan longer than a file holds can still be printed and drawn.
    record = plan.to_record() if arguments.json or arguments.out is not None else {}
    if draw is not None:
        draw(problem, plan)  # first, as more can stand in its way
    if arguments.out is not None:
        write_record(arguments.out, "plan", record, MAX_PLAN_BYTES)
    lines = [
        costs_line(problem, plan),
        landmarks_line(problem),
        *starts_lines(problem),
        *(f"agent {agent}: {_tour_in_words(problem, plan, agent)}" for agent in range(n_agents)),
        f"by {plan.solver} in {1000 * plan.seconds:.1f} ms",
        *(f"wrote {name}" for name in (arguments.out, arguments.picture) if name is not None),
    ]
    print_report(arguments, labelled("plan", record), lines)


def _tour_in_words(problem: Problem, plan: Plan, agent: int) -> str:
    at_depot = problem.start_cells[agent] == problem.grid.depot
    stays = f"stays at {'the depot' if at_depot else 'its start'}"
    return " ".join(map(str, plan.tours[agent])) or stays

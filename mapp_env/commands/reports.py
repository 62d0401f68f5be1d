"""What commands print: lines for people, or one JSON object for programs."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from typing import Any

from mapp_env.plans.plan import OBJECTIVES, Plan, json_costs
from mapp_env.problem import Problem


class OutputError(Exception):
    """A report that cannot be written."""


def add_json_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--json`` to a command's parser."""
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object in place of text"
    )


def print_report(
    arguments: argparse.Namespace, record: dict[str, Any], lines: Sequence[str]
) -> None:
    """Print what a command found out, as the user asked for it.

    Raises an OutputError if it cannot be written; BrokenPipeError if nobody reads it.
    """
    try:
        print(json.dumps(record, allow_nan=False) if arguments.json else "\n".join(lines))
        if sys.stdout is not None:  # as it is where it was closed before the start
            sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"the standard output cannot be written: {error}") from error


def words(name: str) -> str:
    """Return a name as people write it."""
    return name.replace("_", " ")


def costs_line(problem: Problem, plan: Plan) -> str:
    """Return a plan's costs, and what is proven about them."""
    if not plan.success:
        visited = sum(map(len, plan.claims))
        return f"not solved: {visited} of {len(problem.landmarks)} landmarks visited"
    costs = ", ".join(f"{words(name)} {getattr(plan, name)}" for name in OBJECTIVES)
    if plan.status == "optimal":
        return f"{costs}; the {words(plan.objective)} is proven optimal"
    if plan.bound is not None:
        return f"{costs}; the {words(plan.objective)} is at least {plan.bound}"
    return costs


def landmarks_line(problem: Problem) -> str:
    """Return the landmarks' cells, which a user who had them drawn does not know."""
    return f"landmarks: {' '.join(map(str, problem.landmarks))}"


def starts_lines(problem: Problem) -> list[str]:
    """Return the agents' first cells in a line; none if they all start on the depot."""
    if set(problem.start_cells) == {problem.grid.depot}:
        return []
    return [f"starts: {' '.join(map(str, problem.start_cells))}"]


def costs_record(plan: Plan) -> dict[str, Any]:
    """Return the same for programs; a cost that is infinite is null."""
    return {
        "success": plan.success,
        **json_costs(plan),
        "objective": plan.objective,
        "status": plan.status,
        "bound": plan.bound,
    }

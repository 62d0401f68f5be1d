"""The options that say which problem a command is about."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence

import numpy as np

from mapp_env.draws import draw_landmarks
from mapp_env.grid import Grid
from mapp_env.grids import generator_names, grid_names, make_grid
from mapp_env.problem import MAX_LANDMARKS, Problem, sample_problems
from mapp_env.validation import check_count, describe

MAX_DRAWN = 2**63 - 1  # largest seed of what is drawn
GRID, N_LANDMARKS, N_AGENTS = "paper-7x7", 5, 3
GRID_OPTIONS = ("grid", "depot", "rows", "cols", "grid_seed")
OPTIONS = ("problem", *GRID_OPTIONS, "landmarks", "n_landmarks", "n_agents", "starts")


def add_grid_options(group: argparse._ArgumentGroup) -> None:
    """Add the options that say which grid; those not given are ``None``."""
    add = group.add_argument
    add(
        "--grid",
        metavar="GRID",
        help=f"a bundled grid ({', '.join(grid_names())}), a generator "
        f"({', '.join(generator_names())}) or a map file (default {GRID})",
    )
    add(
        "--depot",
        type=_cell,
        metavar="CELL",
        help="of a map file that has none, or in place of its own (default: the free cell nearest "
        "to the centre)",
    )
    add("--rows", type=int, metavar="R", help="rows of a generated grid")
    add("--cols", type=int, metavar="C", help="columns of a generated grid")
    add("--grid-seed", type=int, metavar="S", help="which of the generated grids (default 0)")


def add_problem_options(parser: argparse.ArgumentParser) -> None:
    """Add the options to a command's parser; those not given are ``None``."""
    group = parser.add_argument_group("the problem")
    add = group.add_argument
    add(
        "--problem",
        metavar="FILE",
        help="a problem file, as Problem.save writes it, in place of the options below",
    )
    add_grid_options(group)
    add(
        "--landmarks",
        nargs="+",
        type=_cell,
        metavar="CELL",
        help="their cells, as numbers (row * columns + column) or ROW,COL (default: drawn)",
    )
    add("--n-landmarks", type=int, metavar="K", help=f"how many to draw (default {N_LANDMARKS})")
    add(
        "--n-agents",
        type=int,
        metavar="N",
        help=f"default {N_AGENTS}, or as many as there are starts",
    )
    add(
        "--starts",
        nargs="+",
        type=_cell,
        metavar="CELL",
        help="where each agent stands at first, written as landmarks are (default: on the depot)",
    )
    add("--seed", type=int, metavar="S", help="of all that is drawn, but for the grid (default 0)")


def problem_of(arguments: argparse.Namespace) -> Problem:
    """Return the problem that the options describe; raise ValueError if there is none."""
    if arguments.problem is not None:
        refuse_problem_options(arguments, "a problem file", but="problem")
        try:
            return Problem.load(arguments.problem)
        except ValueError as error:
            raise ValueError(f"--problem {error}") from error
    grid = grid_of(arguments)
    starts, n_agents, landmarks = arguments.starts, arguments.n_agents, arguments.landmarks
    if n_agents is None:
        n_agents = N_AGENTS if starts is None else len(starts)
    if landmarks is None:
        count = N_LANDMARKS if arguments.n_landmarks is None else arguments.n_landmarks
        landmarks = _draw(grid, count, seed_of(arguments), starts)
    elif arguments.n_landmarks is not None:
        raise ValueError("--n-landmarks is how many to draw: it does not go with --landmarks")
    return Problem(grid, landmarks, n_agents, starts=starts)


def _draw(grid: Grid, count: int, seed: int, starts: Sequence[object] | None) -> list[int]:
    """Return drawn landmarks, none of them a start; raise ValueError if there is no room."""
    if starts is None:
        return list(map(int, sample_problems(grid, 1, n_landmarks=count, seed=seed)[0]))
    taken = [grid.cell(f"starts[{index}]", cell) for index, cell in enumerate(starts)]
    candidates = np.setdiff1d(grid.reachable, np.array(taken, np.int32))
    count = check_count("--n-landmarks", count, 1, min(len(candidates), MAX_LANDMARKS))
    landmarks = np.empty(count, np.int32)
    word = np.random.default_rng(seed).integers(2**64, dtype=np.uint64)
    draw_landmarks(word, candidates, landmarks)
    return list(map(int, landmarks))


def seed_of(arguments: argparse.Namespace) -> int:
    """Return the seed of all that is drawn but the grid; raise ValueError if it is none."""
    return check_count("--seed", 0 if arguments.seed is None else arguments.seed, 0, MAX_DRAWN)


def refuse_problem_options(arguments: argparse.Namespace, reason: str, but: str = "") -> None:
    """Raise ValueError if an option other than ``but`` was given: none goes with ``reason``."""
    for name in OPTIONS:
        if name != but and getattr(arguments, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')} does not go with {reason}")


def grid_of(arguments: argparse.Namespace) -> Grid:
    """Return the grid that the options describe; raise ValueError if there is none."""
    name = GRID if arguments.grid is None else arguments.grid
    bundled, generators = grid_names(), generator_names()
    given = {"rows": arguments.rows, "cols": arguments.cols, "seed": arguments.grid_seed}
    options = {option: value for option, value in given.items() if value is not None}
    if "seed" in options:
        check_count("--grid-seed", options["seed"], 0, MAX_DRAWN)
    if arguments.depot is not None and name in (*generators, *bundled):
        raise ValueError(f"--depot is for map files, not for {describe(name)}")
    if options and name not in generators:
        raise ValueError(
            "--rows, --cols and --grid-seed are for generated grids "
            f"(--grid {' | '.join(generators)}), not for {describe(name)}"
        )
    if name in (*generators, *bundled):
        return make_grid(name, **options)
    if not os.path.lexists(name):
        raise ValueError(
            f"--grid must be one of {', '.join((*bundled, *generators))} or a map file, and there "
            f"is no file {describe(name)}"
        )
    try:
        return Grid.load(name, arguments.depot)
    except ValueError as error:
        raise ValueError(f"--grid {error}") from error


def _cell(text: str) -> int | tuple[int, ...]:
    """Return a cell written as its number, or as row and column."""
    parts = text.split(",")
    if len(parts) > 2 or not all(re.fullmatch(r"[0-9]{1,9}", part) for part in parts):
        raise argparse.ArgumentTypeError(f"{describe(text)} is neither a number nor ROW,COL")
    numbers = tuple(map(int, parts))
    return numbers[0] if len(numbers) == 1 else numbers

"""Plans of one problem side by side: what a policy did beside what could have been done."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping

from matplotlib.figure import Figure

from mapp_env.files import check_writable
from mapp_env.plans.plan import Plan
from mapp_env.problem import Problem
from mapp_env.rendering.figures import DPI, Panel, costs_of, draw_plan, save_figure
from mapp_env.rendering.palette import INK, to_hex
from mapp_env.rendering.side_by_side import Gap, check_plans, gaps

MAX_LABEL = 60  # characters
COLUMNS = 3
LARGE_SIDE = 7.0  # inches, of a map with many cells
ABOVE = 0.85  # inches, for three lines
HEADING = 36.0  # points above the map, of the label


def compare_plans(
    problem: Problem, plans: Mapping[str, Plan], path: str | os.PathLike[str] | None = None
) -> Figure:
    """Draw plans of one problem side by side.

    Above each stand its label, its three costs and, if another of the plans is proven optimal,
    its gap to that one: (cost - optimum) / optimum. A plan that leaves landmarks has no gap.

    Parameters
    ----------
    problem : Problem
        What they are plans of.
    plans : mapping of str to Plan
        1 to 12, by what they are called: ``{"policy": ..., "optimum": ...}``.
    path : str or os.PathLike, optional
        Where to write the figure as well: a ``.png``, ``.svg`` or ``.pdf`` file.

    Returns
    -------
    matplotlib.figure.Figure
        One axes for each plan, in their order; unknown to pyplot.

    Raises
    ------
    ValueError
        If an argument is invalid, a plan is not one of this problem or costs less than the
        proven optimum, or the file cannot be written.
    """
    check_plans(problem, plans)
    if path is not None:
        check_writable(path)
    behind = gaps(plans)
    panel = Panel(problem.grid, problem.n_agents, LARGE_SIDE, ABOVE)
    columns = min(len(plans), COLUMNS)
    rows = math.ceil(len(plans) / columns)
    width, height = panel.size
    figure = Figure(figsize=(columns * width, rows * height), dpi=DPI)
    for index, (label, plan) in enumerate(plans.items()):
        row, col = divmod(index, columns)
        ax = panel.add_axes(figure, col * width, (rows - 1 - row) * height)
        # Line by line, as a title's lines all look alike.
        draw_plan(problem, plan, ax, f"{costs_of(plan)}\n{_in_words(behind[label])}")
        ax.annotate(
            label if len(label) <= MAX_LABEL else f"{label[: MAX_LABEL - 3]}...",
            (0.5, 1.0),
            xycoords="axes fraction",
            xytext=(0, HEADING),
            textcoords="offset points",
            ha="center",
            va="bottom",
            fontsize=13,
            fontweight="bold",
            color=to_hex(INK),
            parse_math=False,
        )
    if path is not None:
        save_figure(figure, path)
    return figure


def _in_words(behind: Mapping[str, Gap]) -> str:
    return ", ".join(
        f"{objective.replace('_', ' ')}: gap {gap:.1%} to the optimum {optimum:g}"
        for objective, (gap, optimum) in behind.items()
    )

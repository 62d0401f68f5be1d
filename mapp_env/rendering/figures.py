"""A plan as a figure, in the manner of the paper's Fig. 4: each agent's route with its arrows."""

from __future__ import annotations

import io
import math
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mapp_env.files import FileError, check_writable, write_bytes
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.rendering.animation import check_regrets
from mapp_env.rendering.ground import NOT_VISITED, Signs, draw_ground
from mapp_env.rendering.palette import INK, LOST, WALL, agent_colour, to_hex
from mapp_env.rendering.routes import DASHES, draw_lost_moves, draw_routes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import ArrayLike

    from mapp_env.grid import Grid
    from mapp_env.plans.plan import Plan
    from mapp_env.problem import Problem

FORMATS = (".png", ".svg", ".pdf")
MAX_BYTES = 1 << 28

MAX_CELL, MAX_SMALL_SIDE, MAX_LARGE_SIDE, MIN_WIDTH = 0.75, 5.25, 9.0, 5.9  # inches
MARGIN = 0.15  # inches
DPI = 120
LEGEND_COLUMNS = 3


def draw_plan(
    problem: Problem,
    plan: Plan,
    ax: Axes | None = None,
    title: str | None = None,
    regrets: ArrayLike | None = None,
) -> Axes:
    """Draw the tours of a plan.

    A colour and a train of arrows for each agent: a full line to its last claim, a dashed one home.
    Routes keep to the right, and those that share a corridor run side by side, so that each can
    be followed both ways. The legend gives the length of every tour. Landmarks are red flags,
    as before a visit; those that the plan leaves out stand in a hatched frame. Where agents start
    elsewhere than on the depot stands a disc of their colours.

    Parameters
    ----------
    problem : Problem
        The grid and the landmarks.
    plan : Plan
        What is drawn on them.
    ax : matplotlib.axes.Axes, optional
        Where to draw; by default a new figure, unknown to pyplot, that ``ax.figure`` gives.
    title : str, optional
        By default the plan's costs; an empty string for none.
    regrets : array_like of int, shape (T,), optional
        Steps lost by each of ``plan.actions``, as :func:`~mapp_env.solvers.regrets` gives them:
        what the agents did in those that lost some is marked, also where no tour leads.

    Returns
    -------
    matplotlib.axes.Axes
        Where it was drawn.

    Raises
    ------
    ValueError
        If there is not one regret for each step.
    """
    grid = problem.grid
    lost = None if regrets is None else check_regrets(regrets, len(plan.actions))
    if ax is None:
        more = 0 if lost is None else LEGEND_COLUMNS
        panel = Panel(grid, len(plan.tours) + more)
        ax = panel.add_axes(Figure(figsize=panel.size, dpi=DPI))
    _prepare(ax, grid)
    points = _points_per_cell(ax, grid)
    claimed = {cell for cells in plan.claims for cell in cells}
    draw_ground(ax, grid)
    signs = Signs(ax, grid, points)
    signs.tint([grid.depot], of_depot=True)
    signs.tint(problem.landmarks)
    if lost is not None:
        draw_lost_moves(ax, problem, plan, lost, points)
    draw_routes(ax, grid, plan, points)
    signs.house(grid.depot)
    for start in sorted(set(problem.start_cells) - {grid.depot}):
        signs.disc(start, [n for n, cell in enumerate(problem.start_cells) if cell == start])
    for cell in problem.landmarks:
        if cell not in claimed:
            signs.frame(cell)
        signs.flag(cell)
    _draw_legend(ax, plan, len(claimed) < len(problem.landmarks), lost)
    title = costs_of(plan) if title is None else title
    if title:
        ax.set_title(title, fontsize=11, color=to_hex(INK))
    return ax


@dataclass(frozen=True)
class Panel:
    """The room that a plan takes in a figure, in inches.

    Laid out by hand: matplotlib's layout engines leave large gaps around axes that keep their cells
    square.
    """

    grid: Grid
    n_agents: int  # entries of the legend
    large_side: float = MAX_LARGE_SIDE  # of the map, if it has many cells
    above: float = 0.4  # for the title

    @property
    def map_size(self) -> tuple[float, float]:
        """Width and height of the map alone."""
        longest = max(self.grid.rows, self.grid.cols)
        side = MAX_SMALL_SIDE if longest <= 12 else self.large_side
        cell = min(MAX_CELL, side / longest)
        return cell * self.grid.cols, cell * self.grid.rows

    @property
    def below(self) -> float:
        """Height of the legend."""
        return 0.15 + 0.19 * (math.ceil(self.n_agents / LEGEND_COLUMNS) + 1)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of all."""
        across, down = self.map_size
        return max(across, MIN_WIDTH) + 2 * MARGIN, self.above + down + self.below

    def add_axes(self, figure: Figure, left: float = 0.0, bottom: float = 0.0) -> Axes:
        """Return new axes for the map, in a panel with its corner at a point of a figure."""
        width, height = figure.get_size_inches()
        across, down = self.map_size
        left += (self.size[0] - across) / 2
        bottom += self.below
        return figure.add_axes((left / width, bottom / height, across / width, down / height))


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> int:
    """Write a figure, whole or not at all.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
        What is written.
    path : str or os.PathLike
        The file, ``.png``, ``.svg`` or ``.pdf``; replaced if it is there.

    Returns
    -------
    int
        Size of the file in bytes.

    Raises
    ------
    ValueError
        If the file cannot be written.
    """
    check_writable(path)
    suffix = os.path.splitext(os.fspath(path))[1].lower()
    if suffix not in FORMATS:
        raise FileError(f"{os.fspath(path)}: must end in {', '.join(FORMATS)}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix[1:])
    data = buffer.getvalue()
    write_bytes(path, data, MAX_BYTES)
    return len(data)


def _prepare(ax: Axes, grid: Grid) -> None:
    ax.set_xlim(-0.5, grid.cols - 0.5)
    ax.set_ylim(grid.rows - 0.5, -0.5)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_edgecolor(to_hex(WALL))
        spine.set_linewidth(2.0)


def _points_per_cell(ax: Axes, grid: Grid) -> float:
    """Return the side of a cell in points, which the widths of lines are given in."""
    box = ax.get_window_extent()
    pixels = min(box.width / grid.cols, box.height / grid.rows)
    return max(float(pixels) * 72 / ax.figure.dpi, 0.1)


def _draw_legend(
    ax: Axes, plan: Plan, some_unvisited: bool, lost: tuple[int, ...] | None = None
) -> None:
    entries: list[Line2D | Patch] = []
    for agent, tour in enumerate(plan.tours):
        colour = to_hex(agent_colour(agent))
        length = len(tour) - 1
        if length > 0:
            label = f"agent {agent}: {length} step{'s' if length > 1 else ''}"
            entries.append(Line2D([], [], color=colour, linewidth=2.4, label=label))
        else:
            label = f"agent {agent}: claims nothing"
            dot: dict[str, Any] = {"linestyle": "none", "marker": "s", "markersize": 5}
            entries.append(Line2D([], [], color=colour, label=label, **dot))
    nothing = Line2D([], [], linestyle="none", label=" ")
    entries += [nothing] * (-len(entries) % LEGEND_COLUMNS)
    ink = to_hex(INK)
    entries.append(Line2D([], [], color=ink, linewidth=1.6, label="to the last landmark"))
    entries.append(Line2D([], [], color=ink, linewidth=1.6, linestyle=DASHES, label="way home"))
    entries.append(Patch(label="not visited", **NOT_VISITED) if some_unvisited else nothing)
    if lost is not None:
        label = f"steps lost: {sum(lost)}, in {sum(step > 0 for step in lost)} of {len(lost)}"
        entries += [Line2D([], [], color=to_hex(LOST), linewidth=8, label=label), nothing, nothing]
    # Matplotlib fills column by column; people read row by row.
    by_column = [entry for col in range(LEGEND_COLUMNS) for entry in entries[col::LEGEND_COLUMNS]]
    ax.legend(
        handles=by_column,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=LEGEND_COLUMNS,
        frameon=False,
        fontsize=9,
        columnspacing=1.0,
        handlelength=1.8,
    )


def costs_of(plan: Plan) -> str:
    """Return a plan's three costs in words, the one that is proven optimal marked."""
    if not plan.success:
        return "not every landmark is visited"
    parts = []
    for name in OBJECTIVES:
        proven = " (optimal)" if plan.status == "optimal" and plan.objective == name else ""
        parts.append(f"{name.replace('_', ' ')} {getattr(plan, name)}{proven}")
    return ", ".join(parts)

"""A plan as a figure, in the manner of the paper's Fig. 4: each agent's route with its arrows."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch, PathPatch, Polygon, Rectangle
from matplotlib.path import Path

from mapp_env.rendering.palette import (
    DEPOT,
    DEPOT_CELL,
    FLAG,
    FLAG_CELL,
    FLOOR,
    GRID_LINE,
    INK,
    WALL,
    agent_colour,
    blend,
    to_hex,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mapp_env.grid import Grid
    from mapp_env.plan import Plan
    from mapp_env.problem import Problem

__all__ = ["draw_plan"]

MAX_CELL, MAX_SMALL_SIDE, MAX_LARGE_SIDE, MIN_WIDTH = 0.75, 5.25, 7.5, 5.9  # inches
OUTLINED_SIDE = 64  # grids up to this side have their cells outlined
LEAST_ICON, MOST_ICON = 11.0, 44.0  # points, of flags and depot
ARROWS_APART = 13.0  # points, at least
HOME_PALER = 0.3
DASHES = (0, (2.4, 1.8))
LEGEND_COLUMNS = 3
NOT_VISITED: dict[str, Any] = {
    "facecolor": to_hex(FLAG_CELL),
    "edgecolor": to_hex(FLAG),
    "hatch": "////",
    "linewidth": 1.4,
}

Point: TypeAlias = tuple[float, float]  # across and down, in cells; whole numbers are middles
Move: TypeAlias = tuple[int, int]


def draw_plan(
    problem: Problem, plan: Plan, ax: Axes | None = None, title: str | None = None
) -> Axes:
    """Draw the tours of a plan.

    One colour and one train of arrows an agent: a full line to its last claim, a dashed one home.
    Routes keep to the right, and those that share a corridor run side by side, so that each can
    be followed both ways. The legend gives the length of every tour. Landmarks are red flags,
    as before a visit; those that the plan leaves out stand in a hatched frame.

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

    Returns
    -------
    matplotlib.axes.Axes
        Where it was drawn.
    """
    grid = problem.grid
    if ax is None:
        ax = _new_axes(grid, len(plan.tours))
    _prepare(ax, grid)
    points = _points_per_cell(ax, grid)
    icon = min(max(0.8, LEAST_ICON / points), MOST_ICON / points)
    claimed = {cell for cells in plan.claims for cell in cells}
    _draw_ground(ax, grid)
    if points >= LEAST_ICON:
        _draw_tint(ax, grid, [grid.depot], to_hex(DEPOT_CELL))
        _draw_tint(ax, grid, problem.landmarks, to_hex(FLAG_CELL))
    _draw_house(ax, grid, icon)
    for cell in problem.landmarks:
        if cell not in claimed:
            _draw_frame(ax, grid, cell, max(icon, 1.0))
        _draw_flag(ax, grid, cell, icon)

    lanes = _lanes(plan.tours)
    n_lanes = max(lanes) + 1
    spacing = min(0.13, 0.42 / n_lanes)
    width = min(max(0.5 * spacing * points, 0.9), 2.4)
    narrow = spacing * points < 1.5 * width
    every = max(round(ARROWS_APART / points), 1)
    for agent, tour in enumerate(plan.tours):
        if len(tour) < 2:
            continue
        middles = [_middle(grid, cell) for cell in tour]
        if narrow:
            # Lanes wider than a corridor have no room to turn in: move the tour as a whole.
            offset = (lanes[agent] - (n_lanes - 1) / 2) * 1.5 * width / points
            corners, leaves = _shift(grid, middles, offset)
        else:
            corners, leaves = _keep_right(middles, (lanes[agent] + 0.5) * spacing)
        # Without a claim all of the tour is a way home.
        claims = plan.claims[agent]
        turn = len(tour) - 1 - tour[::-1].index(claims[-1]) if claims else 0
        route = _Route(agent, lanes[agent], corners, leaves, turn)
        _draw_route(ax, route, width)
        _draw_arrows(ax, route, width, every)
    _draw_legend(ax, plan, len(claimed) < len(problem.landmarks))
    title = _costs(plan) if title is None else title
    if title:
        ax.set_title(title, fontsize=11, color=to_hex(INK))
    return ax


def _new_axes(grid: Grid, n_agents: int) -> Axes:
    # Laid out by hand, in inches: matplotlib's layout engines leave large gaps around axes that
    # keep their cells square.
    longest = max(grid.rows, grid.cols)
    cell = min(MAX_CELL, (MAX_SMALL_SIDE if longest <= 12 else MAX_LARGE_SIDE) / longest)
    across, down = cell * grid.cols, cell * grid.rows
    margin, above = 0.15, 0.4
    below = 0.25 + 0.21 * (math.ceil(n_agents / LEGEND_COLUMNS) + 1)
    width, height = max(across, MIN_WIDTH) + 2 * margin, above + down + below
    figure = Figure(figsize=(width, height), dpi=120)
    return figure.add_axes(
        ((width - across) / 2 / width, below / height, across / width, down / height)
    )


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


def _draw_ground(ax: Axes, grid: Grid) -> None:
    ax.imshow(
        grid.walls,
        cmap=ListedColormap([to_hex(FLOOR), to_hex(WALL)]),
        vmin=0,
        vmax=1,
        interpolation="nearest",
        extent=(-0.5, grid.cols - 0.5, grid.rows - 0.5, -0.5),
        zorder=0,
    )
    if max(grid.rows, grid.cols) <= OUTLINED_SIDE:
        free = ~grid.walls
        lines = [
            ((col + 0.5, row - 0.5), (col + 0.5, row + 0.5))
            for row, col in np.argwhere(free[:, 1:] & free[:, :-1]).tolist()
        ] + [
            ((col - 0.5, row + 0.5), (col + 0.5, row + 0.5))
            for row, col in np.argwhere(free[1:] & free[:-1]).tolist()
        ]
        ax.add_collection(
            LineCollection(lines, colors=to_hex(GRID_LINE), linewidths=0.6, zorder=1),
            autolim=False,
        )


def _draw_tint(ax: Axes, grid: Grid, cells: Iterable[int], colour: str) -> None:
    for cell in cells:
        across, down = _middle(grid, cell)
        ax.add_patch(Rectangle((across - 0.5, down - 0.5), 1, 1, facecolor=colour, zorder=0.5))


def _draw_house(ax: Axes, grid: Grid, size: float) -> None:
    across, down = _middle(grid, grid.depot)

    def at(*points: Point) -> list[Point]:
        return [(across + size * (x - 0.5), down + size * (y - 0.5)) for x, y in points]

    roof = at((0.06, 0.50), (0.50, 0.10), (0.94, 0.50))
    walls = at((0.20, 0.48), (0.80, 0.48), (0.80, 0.88), (0.20, 0.88))
    door = at((0.42, 0.60), (0.58, 0.60), (0.58, 0.88), (0.42, 0.88))
    for shape, colour in ((roof, DEPOT), (walls, DEPOT), (door, DEPOT_CELL)):
        ax.add_patch(Polygon(shape, facecolor=to_hex(colour), linewidth=0, zorder=2))


def _draw_frame(ax: Axes, grid: Grid, cell: int, size: float) -> None:
    across, down = _middle(grid, cell)
    corner = (across - size / 2, down - size / 2)
    ax.add_patch(Rectangle(corner, size, size, zorder=2.1, **NOT_VISITED))


def _draw_flag(ax: Axes, grid: Grid, cell: int, size: float) -> None:
    across, down = _middle(grid, cell)
    left, top, foot = across - 0.20 * size, down - 0.40 * size, down + 0.40 * size
    pole = to_hex(INK)
    cloth = [(left, top), (left + 0.55 * size, top + 0.21 * size), (left, top + 0.42 * size)]
    ax.add_patch(Polygon(cloth, facecolor=to_hex(FLAG), linewidth=0, zorder=2.2))
    ax.add_patch(
        Rectangle(
            (left - 0.03 * size, top - 0.04 * size),
            0.06 * size,
            foot - top + 0.04 * size,
            facecolor=pole,
            linewidth=0,
            zorder=2.3,
        )
    )
    ax.add_patch(
        Ellipse((left, foot), 0.28 * size, 0.10 * size, facecolor=pole, linewidth=0, zorder=2.3)
    )


def _lanes(tours: tuple[tuple[int, ...], ...]) -> list[int]:
    """Return a lane for each agent, such that no two on one lane make the same move.

    An agent takes the innermost lane that is free along all of its tour, so that routes which meet
    nobody stay near the middle of their corridors.
    """
    lanes: list[int] = []
    moves_on: list[set[Move]] = []
    for tour in tours:
        moves = set(pairwise(tour))
        lane = next(
            (lane for lane, taken in enumerate(moves_on) if not moves & taken), len(moves_on)
        )
        if lane == len(moves_on):
            moves_on.append(set())
        moves_on[lane] |= moves
        lanes.append(lane)
    return lanes


@dataclass(frozen=True)
class _Route:
    """A tour as a line."""

    agent: int
    lane: int
    corners: list[Point]
    leaves: list[int]  # for each cell of the tour the corner from which the line leaves it
    turn: int  # the index in the tour of the last claim

    @property
    def colours(self) -> tuple[str, str]:
        """Of the way out and of the way home."""
        colour = agent_colour(self.agent)
        return to_hex(colour), to_hex(blend(colour, FLOOR, HOME_PALER))


def _draw_route(ax: Axes, route: _Route, width: float) -> None:
    out, home = route.colours
    cut = route.leaves[route.turn]
    for corners, colour, dashes in (
        (route.corners[cut:], home, DASHES),
        (route.corners[: cut + 1], out, "solid"),
    ):
        ax.add_patch(
            PathPatch(
                Path(corners),
                facecolor="none",
                edgecolor=colour,
                linewidth=width,
                linestyle=dashes,
                joinstyle="round",
                capstyle="round" if dashes == "solid" else "butt",
                zorder=4,
            )
        )


def _draw_arrows(ax: Axes, route: _Route, width: float, every: int) -> None:
    """Draw an arrow on every so many moves, counted from the end."""
    # Heads on neighbouring lanes are kept apart: beyond the middle of a move on one, before it on
    # the next.
    share = 0.34 if route.lane % 2 else 0.66
    out, home = route.colours
    heads: defaultdict[tuple[str, str], list[Point]] = defaultdict(list)
    for move in range(len(route.leaves) - 2, -1, -every):
        leave = route.leaves[move]
        start, end = route.corners[leave], route.corners[leave + 1]
        across, down = end[0] - start[0], end[1] - start[1]
        sign = ("<" if across < 0 else ">") if abs(across) > abs(down) else "^v"[down > 0]
        place = (start[0] + share * across, start[1] + share * down)
        heads[sign, home if move >= route.turn else out].append(place)
    for (sign, colour), places in heads.items():
        ax.plot(
            [across for across, _ in places],
            [down for _, down in places],
            marker=sign,
            markersize=2.0 * width + 2.0,
            color=colour,
            markeredgewidth=0,
            linestyle="none",
            zorder=4.2,
        )


def _shift(grid: Grid, middles: list[Point], offset: float) -> tuple[list[Point], list[int]]:
    """Move a route as a whole, yet not off the grid; returns what :func:`_keep_right` does."""
    corners = [
        (
            min(max(across + offset, -0.5), grid.cols - 0.5),
            min(max(down + offset, -0.5), grid.rows - 0.5),
        )
        for across, down in middles
    ]
    return corners, list(range(len(corners)))


def _keep_right(middles: list[Point], offset: float) -> tuple[list[Point], list[int]]:
    """Move a route to the right of its direction, as traffic does.

    Parameters
    ----------
    middles : list of (float, float), length M
        The middles of neighbouring cells.
    offset : float
        How far to move, in cells.

    Returns
    -------
    list of (float, float)
        The corners of the moved route.
    list of int, length M
        At which corner the route leaves each cell.
    """
    # Down grows downwards, so the right of a heading (a, d) is (-d, a).
    headings = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(middles)]
    corners: list[Point] = []
    starts: list[int] = []
    for (across, down), into, out in zip(
        middles, [headings[0], *headings], [*headings, headings[-1]], strict=True
    ):
        if into == (-out[0], -out[1]):  # turns back: around the end of the corridor's middle line
            for heading in (into, out):
                corners.append(
                    (
                        across + offset * (into[0] - heading[1]),
                        down + offset * (into[1] + heading[0]),
                    )
                )
        else:
            straight = into == out
            right = (-into[1], into[0]) if straight else (-into[1] - out[1], into[0] + out[0])
            corners.append((across + offset * right[0], down + offset * right[1]))
        starts.append(len(corners) - 1)
    return corners, starts


def _middle(grid: Grid, cell: int) -> Point:
    row, col = divmod(cell, grid.cols)
    return float(col), float(row)


def _draw_legend(ax: Axes, plan: Plan, some_unvisited: bool) -> None:
    entries: list[Line2D | Patch] = []
    for agent, tour in enumerate(plan.tours):
        colour = to_hex(agent_colour(agent))
        length = len(tour) - 1
        if length > 0:
            label = f"agent {agent}: {length} step{'s' if length > 1 else ''}"
            entries.append(Line2D([], [], color=colour, linewidth=2.4, label=label))
        else:
            label = f"agent {agent}: claims nothing"
            entries.append(
                Line2D(
                    [], [], color=colour, linestyle="none", marker="s", markersize=5, label=label
                )
            )
    nothing = Line2D([], [], linestyle="none", label=" ")
    entries += [nothing] * (-len(entries) % LEGEND_COLUMNS)
    ink = to_hex(INK)
    entries.append(Line2D([], [], color=ink, linewidth=1.6, label="to the last landmark"))
    entries.append(Line2D([], [], color=ink, linewidth=1.6, linestyle=DASHES, label="way home"))
    entries.append(Patch(label="not visited", **NOT_VISITED) if some_unvisited else nothing)
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


def _costs(plan: Plan) -> str:
    if not plan.success:
        return "not every landmark is visited"
    parts = []
    for name in ("cover_time", "makespan", "total_distance"):
        proven = " (optimal)" if plan.status == "optimal" and plan.objective == name else ""
        parts.append(f"{name.replace('_', ' ')} {getattr(plan, name)}{proven}")
    return ", ".join(parts)

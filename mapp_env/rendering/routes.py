"""The routes of a figure: a line and a train of arrows for each agent, beside one another."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from matplotlib.patches import PathPatch
from matplotlib.path import Path

from mapp_env.engine.state import WAIT
from mapp_env.rendering.ground import Point, middle_of
from mapp_env.rendering.palette import FLOOR, LOST, agent_colour, blend, to_hex

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from mapp_env.grid import Grid
    from mapp_env.plans.plan import Plan
    from mapp_env.problem import Problem

ARROWS_APART = 20.0  # points, at least
LEAST_WIDTH, MOST_WIDTH = 0.9, 2.4  # points, of a line
LANES = 0.42  # cells, from the middle of a corridor to where the outermost lane ends
LANE = 0.13  # cells, of a lane where there is room for more
LEAST_LANE = 2.4  # points, of a lane if there is room for it
HOME_PALER = 0.3
MARKER = 0.4  # cells, the width of a mark
DASHES = (0, (2.4, 1.8))


def draw_routes(ax: Axes, grid: Grid, plan: Plan, points: float) -> None:
    """Draw the tours of a plan; ``points`` is the side of a cell, in the unit of lines' widths."""
    lanes = _lanes(plan.tours)
    n_lanes = max(lanes) + 1
    spacing = min(max(LANE, LEAST_LANE / points), LANES / n_lanes)
    width = min(max(0.5 * spacing * points, LEAST_WIDTH), MOST_WIDTH)
    narrow = spacing * points < 1.3 * width
    for agent, tour in enumerate(plan.tours):
        if len(tour) < 2:
            continue
        middles = [middle_of(grid, cell) for cell in tour]
        if narrow:
            # Lanes wider than a corridor have no room to turn in: move the tour as a whole.
            offset = (lanes[agent] - (n_lanes - 1) / 2) * 1.5 * width / points
            corners, leaves = _shift(grid, middles, offset)
        else:
            corners, leaves = _keep_right(middles, (lanes[agent] + 0.5) * spacing)
        # Without a claim all of the tour is a way home.
        claims = plan.claims[agent]
        turn = len(tour) - 1 - tour[::-1].index(claims[-1]) if claims else 0
        route = _Route(agent, lanes[agent], middles, corners, leaves, turn)
        _draw_line(ax, route, width)
        _draw_arrows(ax, route, width, points)


def draw_lost_moves(
    ax: Axes, problem: Problem, plan: Plan, regrets: Sequence[int], points: float
) -> None:
    """Mark what all agents did in the steps that lost something, as with a marker pen."""
    grid = problem.grid
    at = list(problem.start_cells)
    for joint_action, lost in zip(plan.actions, regrets, strict=True):
        for agent, action in enumerate(joint_action):
            cell = at[agent]
            if action != WAIT:
                at[agent] = int(grid.moves[cell, action])
            if lost > 0:
                (across, down), end = middle_of(grid, cell), middle_of(grid, at[agent])
                ax.plot(
                    [across, end[0] + 1e-6],  # a line of no length is not drawn
                    [down, end[1]],
                    color=to_hex(LOST),
                    linewidth=MARKER * points,
                    solid_capstyle="round",
                    zorder=3,
                )


def _lanes(tours: tuple[tuple[int, ...], ...]) -> list[int]:
    """Return a lane for each agent, such that no two on one lane make the same move.

    An agent takes the innermost lane that is free along all of its tour, so that routes which meet
    nobody stay near the middle of their corridors.
    """
    lanes: list[int] = []
    moves_on: list[set[tuple[int, int]]] = []
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
    middles: list[Point]  # of the tour's cells
    corners: list[Point]
    leaves: list[int]  # for each cell of the tour the corner from which the line leaves it
    turn: int  # the index in the tour of the last claim

    @property
    def colours(self) -> tuple[str, str]:
        """Of the way out and of the way home."""
        colour = agent_colour(self.agent)
        return to_hex(colour), to_hex(blend(colour, FLOOR, HOME_PALER))


def _draw_line(ax: Axes, route: _Route, width: float) -> None:
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


def _draw_arrows(ax: Axes, route: _Route, width: float, points: float) -> None:
    """Draw arrows on the moves, counted from the end; where cells are small, not on each."""
    every = max(math.ceil(ARROWS_APART / points), 1)
    size = 2.0 * width + 2.0
    half = size / 2 / points
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
        # At the same place of a move wherever the line turns: an agent that makes a move twice has
        # one arrow there.
        middle, next_middle = route.middles[move : move + 2]
        axis = 0 if abs(across) > abs(down) else 1
        along = middle[axis] + share * (next_middle[axis] - middle[axis])
        low, high = sorted((start[axis], end[axis]))
        if not low + half <= along <= high - half:  # not on a corner
            along = (low + high) / 2
        heads[sign, home if move >= route.turn else out].append(
            (along, start[1]) if axis == 0 else (start[0], along)
        )
    for (sign, colour), places in heads.items():
        ax.plot(
            *zip(*places, strict=True),
            marker=sign,
            markersize=size,
            color=colour,
            markeredgewidth=0,
            linestyle="none",
            zorder=4.2,
        )


def _shift(grid: Grid, middles: list[Point], offset: float) -> tuple[list[Point], list[int]]:
    """Move a route as a whole, yet not off the grid; returns what :func:`_keep_right` does."""
    right, bottom = grid.cols - 0.5, grid.rows - 0.5
    corners = [
        (min(max(across + offset, -0.5), right), min(max(down + offset, -0.5), bottom))
        for across, down in middles
    ]
    return corners, list(range(len(corners)))


def _keep_right(middles: list[Point], offset: float) -> tuple[list[Point], list[int]]:
    """Move a route through middles of neighbouring cells to the right, as traffic does.

    Returns the corners of the moved route, and for each cell at which of them it leaves the cell.
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
                away = (into[0] - heading[1], into[1] + heading[0])
                corners.append((across + offset * away[0], down + offset * away[1]))
        else:
            straight = into == out
            right = (-into[1], into[0]) if straight else (-into[1] - out[1], into[0] + out[0])
            corners.append((across + offset * right[0], down + offset * right[1]))
        starts.append(len(corners) - 1)
    return corners, starts

"""What lies under the routes of a figure: floor and walls, and the signs that stand on them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.patches import Ellipse, Polygon, Rectangle, Wedge
from matplotlib.patheffects import Normal, Stroke

from mapp_env.rendering import palette
from mapp_env.rendering.palette import to_hex

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Patch

    from mapp_env.grid import Grid

OUTLINED_SIDE = 64  # grids up to this side have their cells outlined
LEAST_FLAG, LEAST_HOUSE, MOST_SIGN = 13.0, 15.0, 44.0  # points
LEAST_TINT = 8.0  # points, of a cell that is tinted
HALO = 2.2  # points, of the light line around a sign
NOT_VISITED: dict[str, Any] = {
    "facecolor": to_hex(palette.FLAG_CELL),
    "edgecolor": to_hex(palette.FLAG),
    "hatch": "////",
    "linewidth": 1.4,
}

Point: TypeAlias = tuple[float, float]  # across and down, in cells; whole numbers are middles


def middle_of(grid: Grid, cell: int) -> Point:
    """Return the middle of a cell, across and down."""
    row, col = divmod(cell, grid.cols)
    return float(col), float(row)


def draw_ground(ax: Axes, grid: Grid) -> None:
    """Draw floor and walls, and the outlines of cells that are not too small for them."""
    ax.imshow(
        grid.walls,
        cmap=ListedColormap([to_hex(palette.FLOOR), to_hex(palette.WALL)]),
        vmin=0,
        vmax=1,
        interpolation="nearest",
        extent=(-0.5, grid.cols - 0.5, grid.rows - 0.5, -0.5),
        zorder=0,
    )
    if max(grid.rows, grid.cols) <= OUTLINED_SIDE:
        free = ~grid.walls
        upright, level = free[:, 1:] & free[:, :-1], free[1:] & free[:-1]
        lines = [
            ((col + 0.5, row - 0.5), (col + 0.5, row + 0.5)) for row, col in np.argwhere(upright)
        ] + [((col - 0.5, row + 0.5), (col + 0.5, row + 0.5)) for row, col in np.argwhere(level)]
        outlines = LineCollection(lines, colors=to_hex(palette.GRID_LINE), linewidths=0.6, zorder=1)
        ax.add_collection(outlines, autolim=False)


@dataclass(frozen=True)
class Signs:
    """The signs of a figure: the house on the depot, the flags on the landmarks, discs on starts.

    They stand above the routes, within a light line, as a route that runs into a flag is still
    seen to, but a flag under a bundle of routes is not. On cells that are smaller than a legible
    sign they reach over their neighbours, yet not over the border of the grid.
    """

    ax: Axes
    grid: Grid
    points: float  # side of a cell

    def tint(self, cells: Iterable[int], of_depot: bool = False) -> None:
        """Tint cells that are large enough for it, under everything else."""
        if self.points < LEAST_TINT:
            return
        colour = to_hex(palette.DEPOT_CELL if of_depot else palette.FLAG_CELL)
        for cell in cells:
            across, down = middle_of(self.grid, cell)
            corner = (across - 0.5, down - 0.5)
            self.ax.add_patch(Rectangle(corner, 1, 1, facecolor=colour, linewidth=0, zorder=0.5))

    def house(self, cell: int) -> None:
        """Draw the depot."""
        size = self._size(LEAST_HOUSE)
        across, down = self._place(cell, size)

        def at(*points: Point) -> list[Point]:
            return [(across + size * (x - 0.5), down + size * (y - 0.5)) for x, y in points]

        roof = at((0.06, 0.50), (0.50, 0.10), (0.94, 0.50), (0.80, 0.50))
        walls = at((0.80, 0.88), (0.20, 0.88), (0.20, 0.50))
        door = at((0.42, 0.60), (0.58, 0.60), (0.58, 0.88), (0.42, 0.88))
        outline = Polygon(roof + walls, facecolor=to_hex(palette.DEPOT), linewidth=0, zorder=5)
        self._add(outline, True)
        self._add(Polygon(door, facecolor=to_hex(palette.DEPOT_CELL), linewidth=0, zorder=5.1))

    def flag(self, cell: int) -> None:
        """Draw a landmark."""
        size = self._size(LEAST_FLAG)
        across, down = self._place(cell, size)
        left, top, foot = across - 0.20 * size, down - 0.40 * size, down + 0.40 * size
        cloth = [(left, top), (left + 0.55 * size, top + 0.21 * size), (left, top + 0.42 * size)]
        pole = (left - 0.03 * size, top - 0.04 * size)
        length = foot - top + 0.04 * size
        ink: dict[str, Any] = {"facecolor": to_hex(palette.INK), "linewidth": 0, "zorder": 5.3}
        self._add(Polygon(cloth, facecolor=to_hex(palette.FLAG), linewidth=0, zorder=5.2), True)
        self._add(Rectangle(pole, 0.06 * size, length, **ink), True)
        self._add(Ellipse((left, foot), 0.28 * size, 0.10 * size, **ink))

    def disc(self, cell: int, agents: Sequence[int]) -> None:
        """Draw a start: a disc with a sector for each agent that begins there."""
        size = 0.6 * self._size(LEAST_FLAG)
        place = self._place(cell, size)
        self._add(Ellipse(place, size, size, facecolor=to_hex(palette.PAPER), zorder=4.9), True)
        for turn, agent in enumerate(agents):
            angles = 360 * turn / len(agents) - 90, 360 * (turn + 1) / len(agents) - 90
            colour = to_hex(palette.agent_colour(agent))
            self._add(Wedge(place, size / 2, *angles, facecolor=colour, linewidth=0, zorder=5))

    def frame(self, cell: int) -> None:
        """Mark a landmark that is not visited, exactly on its cell."""
        size = max(self._size(LEAST_FLAG), 1.0)
        across, down = middle_of(self.grid, cell)
        corner = (across - size / 2, down - size / 2)
        self.ax.add_patch(Rectangle(corner, size, size, zorder=2.1, **NOT_VISITED))

    def _size(self, least: float) -> float:
        """Return the side of a sign in cells: most of a cell, within what is legible."""
        return min(max(0.8, least / self.points), MOST_SIGN / self.points)

    def _place(self, cell: int, size: float) -> Point:
        """Return the point nearest to a cell's middle where a sign is not cut off."""
        across, down = middle_of(self.grid, cell)
        half = size / 2 - 0.5
        return (
            _between(half, across, self.grid.cols - 1 - half),
            _between(half, down, self.grid.rows - 1 - half),
        )

    def _add(self, patch: Patch, with_halo: bool = False) -> None:
        if with_halo:
            halo = Stroke(linewidth=HALO, foreground=to_hex(palette.PAPER))
            patch.set_path_effects([halo, Normal()])
        patch.set_clip_on(False)
        self.ax.add_patch(patch)


def _between(low: float, value: float, high: float) -> float:
    """Return the nearest to ``value`` of a range; its middle if the range is empty."""
    return (low + high) / 2 if low > high else min(max(value, low), high)

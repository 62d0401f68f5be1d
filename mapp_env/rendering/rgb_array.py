"""The scene as pixels: walls, depot, flags, agents and their trails above a status bar."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mapp_env.engine.scene import TRAIL_MOVES, Scene
from mapp_env.rendering import icons, palette
from mapp_env.rendering.palette import Colour, agent_colour, blend

if TYPE_CHECKING:
    from mapp_env.grid import Grid

MAX_SIDE = 1024  # default pixels of the longer side of the grid, margins and bar not counted
MAX_CELL = 72
MIN_AREA = (240, 72)  # least width and height above the bar: a tiny grid has its bar, too
MARGIN = 4
BAR = 32
TEXT = 20
DETAILED_CELL = 12  # from here on cells are outlined and tinted
# On smaller cells flags, house and agents keep a legible size and cover several cells.
SMALL_ICON = 21
SMALL_DISC = 17
MIN_DISC = 9

Frame: TypeAlias = NDArray[np.uint8]  # (height, width, 3)
_Place: TypeAlias = tuple[float, float, int]  # an agent's middle, down and right, and its diameter


def rgb_array(scene: Scene, max_side: int = MAX_SIDE) -> Frame:
    """Draw a scene as pixels.

    Flags are red until visited, then pale with a check mark. Agents are discs with their number;
    on a shared cell they stand side by side. Trails fade with age, and each agent keeps to its own
    lane, so that shared corridors show every trail. The size depends only on the grid, the number
    of landmarks and the step limit, so it is constant during an episode.

    Parameters
    ----------
    scene : Scene
        The moment to show.
    max_side : int
        Pixels that the longer side of the grid may take; cells are made smaller for it, down to one
        pixel. On grids with a side of more than 1024 cells several share a pixel, if need be.

    Returns
    -------
    ndarray of uint8, shape (height, width, 3)
        A fresh array; height and width are even, as video encoders want.
    """
    told = scene.lost is not None
    sizes = len(scene.landmarks), scene.max_cycles, max_side
    layout = _layout(*scene.grid.walls.shape, *sizes, told)
    frame = _background(scene.grid, layout).copy()
    _draw_flag_cells(frame, layout, scene)
    _draw_lost_moves(frame, layout, scene)
    _draw_trails(frame, layout, scene)
    _draw_depot_and_flags(frame, layout, scene)
    _draw_agents(frame, layout, scene)
    _draw_status(frame, layout, scene)
    return frame


def pad_frames(frames: Sequence[Frame], scenes: Iterable[tuple[int, int, int, int]]) -> list[Frame]:
    """Return frames, each at the top left of a sheet of the size that all of them fit on.

    So do the frames of ``scenes`` to come: rows, columns, number of landmarks and step limit of
    each. Videos need frames of one size, also where each episode is on another grid.
    """
    sides = [frame.shape[:2] for frame in frames]
    for scene in scenes:
        layout = _layout(*scene, MAX_SIDE, False)  # an episode does not know what it lost
        sides.append((layout.height + BAR, layout.width))
    sheet = np.empty((*np.max(sides, axis=0), 3), np.uint8)
    sheet[:] = palette.PAPER
    padded = []
    for frame in frames:
        padded.append(sheet.copy())
        padded[-1][: frame.shape[0], : frame.shape[1]] = frame
    return padded


@dataclass(frozen=True)
class _Layout:
    """Where things are in the frame, in pixels."""

    cell: int
    left: int
    top: int
    width: int
    height: int  # without the bar
    cols: int
    merged: int  # rows, and columns, of cells that share a pixel; 1 unless `cell` is 1

    @property
    def detailed(self) -> bool:
        """Whether cells are large enough to be outlined, tinted and filled by one icon."""
        return self.cell >= DETAILED_CELL

    @property
    def icon(self) -> int:
        """Side of a flag or a house."""
        return round(0.86 * self.cell) if self.detailed else SMALL_ICON

    @property
    def least_disc(self) -> int:
        """Diameter below which agents are moved apart instead of being drawn smaller."""
        return MIN_DISC if self.detailed else SMALL_DISC

    def corner(self, cell: int) -> tuple[int, int]:
        """Return the top and the left of a cell."""
        row, col = divmod(cell, self.cols)
        return (
            self.top + row // self.merged * self.cell,
            self.left + col // self.merged * self.cell,
        )

    def centre(self, cell: int) -> tuple[float, float]:
        """Return the middle of a cell, down and to the right."""
        row, col = divmod(cell, self.cols)
        scale = self.cell / self.merged
        return self.top + (row + 0.5) * scale, self.left + (col + 0.5) * scale

    def inside(self, cell: int, size: int) -> tuple[float, float]:
        """Return the point nearest to a cell's middle where an icon is not cut off by the frame."""
        down, right = self.centre(cell)
        half = size / 2
        return min(max(down, half), self.height - half), min(max(right, half), self.width - half)


@lru_cache(maxsize=64)
def _layout(
    rows: int, cols: int, n_landmarks: int, max_cycles: int, max_side: int, told: bool
) -> _Layout:
    longer = max(rows, cols)
    cell = max(min(MAX_CELL, max_side // longer), 1)
    merged = math.ceil(longer / max_side) if longer > MAX_SIDE else 1
    # The widest texts that the bar will ever show in this episode.
    texts = _status_texts(max_cycles, max_cycles, n_landmarks, n_landmarks)
    if told:
        texts += (f" {_lost_text(max_cycles)} ",)
    bar_width = sum(icons.text(part, TEXT, palette.PAPER).shape[1] for part in texts) + 2 * BAR
    across, down = (math.ceil(side / merged) * cell for side in (cols, rows))
    width = max(across + 2 * MARGIN, bar_width, MIN_AREA[0])
    height = max(down + 2 * MARGIN, MIN_AREA[1])
    width, height = width + width % 2, height + height % 2
    left_edge, top = (width - across) // 2, (height - down) // 2
    return _Layout(cell, left_edge, top, width, height, cols, merged)


@lru_cache(maxsize=8)
def _background(grid: Grid, layout: _Layout) -> Frame:
    """Return what stays the same during an episode; not to be written into."""
    frame = np.empty((layout.height + BAR, layout.width, 3), dtype=np.uint8)
    frame[:] = palette.WALL  # beyond the border agents bump just as into walls
    frame[layout.height :] = palette.INK
    cell = layout.cell
    colours = np.where(grid.walls[:, :, None], palette.WALL, palette.FLOOR).astype(np.uint8)
    if layout.merged > 1:
        colours = _merge(colours, layout.merged)
    picture = colours.repeat(cell, axis=0).repeat(cell, axis=1)
    area = frame[layout.top :, layout.left :][: picture.shape[0], : picture.shape[1]]
    area[:] = picture
    if layout.detailed:
        free = ~grid.walls
        for row, col in np.argwhere(free[:, 1:] & free[:, :-1]):
            area[row * cell : (row + 1) * cell, (col + 1) * cell] = palette.GRID_LINE
        for row, col in np.argwhere(free[1:] & free[:-1]):
            area[(row + 1) * cell, col * cell : (col + 1) * cell] = palette.GRID_LINE
        _tint(frame, layout, grid.depot, palette.DEPOT_CELL)
    frame.flags.writeable = False
    return frame


def _merge(colours: Frame, merged: int) -> Frame:
    """Return the mean colours of squares of so many rows and columns, smaller at the far edges."""
    sums, counts = colours.astype(np.uint32), np.ones(colours.shape[:2], np.uint32)
    for axis in (0, 1):
        firsts = np.arange(0, colours.shape[axis], merged)
        sums, counts = (np.add.reduceat(part, firsts, axis=axis) for part in (sums, counts))
    return (sums // counts[:, :, None]).astype(np.uint8)


def _draw_flag_cells(frame: Frame, layout: _Layout, scene: Scene) -> None:
    """Tint the landmarks' cells, which shows even under a crowd of agents."""
    if layout.detailed:
        for cell, visited in zip(scene.landmarks, scene.visited, strict=True):
            _tint(frame, layout, cell, palette.FLAG_VISITED_CELL if visited else palette.FLAG_CELL)


def _draw_depot_and_flags(frame: Frame, layout: _Layout, scene: Scene) -> None:
    plate = not layout.detailed
    house = icons.house(layout.icon, plate)
    paste(frame, house, *layout.inside(scene.grid.depot, layout.icon))
    # Unvisited flags come last: where icons are larger than cells, they matter more.
    for visited, cell in sorted(zip(scene.visited, scene.landmarks, strict=True), reverse=True):
        flag = icons.flag(layout.icon, bool(visited), plate)
        paste(frame, flag, *layout.inside(cell, layout.icon))


def _draw_lost_moves(frame: Frame, layout: _Layout, scene: Scene) -> None:
    """Mark the moves, as far back as trails go, of steps that lost something."""
    half = max(round(0.2 * layout.cell), 2)
    for trail in scene.trails:
        corners = [layout.centre(cell) for cell in trail]
        # A trail need not go back to the start.
        latest = (scene.lost or ())[::-1]
        for lost, (end, start) in zip(latest, pairwise(corners[::-1]), strict=False):
            if lost > 0:
                top, bottom = sorted((int(start[0]), int(end[0])))
                left, right = sorted((int(start[1]), int(end[1])))
                frame[top - half : bottom + half, left - half : right + half] = palette.LOST


def _draw_trails(frame: Frame, layout: _Layout, scene: Scene) -> None:
    n_agents = len(scene.trails)
    spacing = min(0.12 * layout.cell, 0.7 * layout.cell / n_agents)
    thick = max(round(0.5 * spacing), 2)
    for agent, trail in enumerate(scene.trails):
        # Moving every corner by the same amount down and to the right keeps a trail connected
        # and parallel to all others.
        lane = round((agent - (n_agents - 1) / 2) * spacing) - thick // 2
        colour = agent_colour(agent)
        recent = trail[-TRAIL_MOVES - 1 :]
        corners = [layout.centre(cell) for cell in recent]
        for age, (start, end) in enumerate(pairwise(corners)):
            if start == end:
                continue
            top, bottom = sorted((int(start[0]) + lane, int(end[0]) + lane))
            left, right = sorted((int(start[1]) + lane, int(end[1]) + lane))
            faded = blend(palette.FLOOR, colour, 0.45 + 0.55 * (age + 1) / len(recent))
            frame[max(top, 0) : bottom + thick, max(left, 0) : right + thick] = faded


def _draw_agents(frame: Frame, layout: _Layout, scene: Scene) -> None:
    for agent, (down, right, size) in enumerate(_agent_places(layout, scene.cells)):
        paste(frame, icons.disc(size, agent_colour(agent), str(agent)), down, right)


def _agent_places(layout: _Layout, cells: tuple[int, ...]) -> list[_Place]:
    """Return where each agent is drawn, such that no two cover one another.

    Agents on one cell share it side by side where that leaves them large enough; else they stand
    on the nearest free places around it.
    """
    groups: defaultdict[int, list[int]] = defaultdict(list)
    for agent, cell in enumerate(cells):
        groups[cell].append(agent)
    places: dict[int, _Place] = {}
    crowded: list[int] = []
    for cell, agents in groups.items():
        per_row = math.ceil(math.sqrt(len(agents)))
        pitch = 0.94 * layout.cell / per_row
        size = int(min(0.66 * layout.cell, pitch))
        if size < layout.least_disc:
            crowded += agents
            continue
        down, right = layout.centre(cell)
        n_rows = math.ceil(len(agents) / per_row)
        for index, agent in enumerate(agents):
            row, col = divmod(index, per_row)
            in_row = min(per_row, len(agents) - row * per_row)
            places[agent] = (
                down + (row - (n_rows - 1) / 2) * pitch,
                right + (col - (in_row - 1) / 2) * pitch,
                size,
            )
    for agent in sorted(crowded):
        places[agent] = _nearest_free_place(layout, cells[agent], list(places.values()))
    return [places[agent] for agent in range(len(cells))]


def _nearest_free_place(layout: _Layout, cell: int, taken: list[_Place]) -> _Place:
    """Return the place of least size nearest to a cell's middle that covers none of ``taken``."""
    size = layout.least_disc
    down, right = layout.inside(cell, size)
    half = size / 2
    for step_down, step_right in _rings():
        place = (down + step_down * size, right + step_right * size, size)
        in_frame = (
            half <= place[0] <= layout.height - half and half <= place[1] <= layout.width - half
        )
        if in_frame and not any(_overlap(place, other) for other in taken):
            return place
    return (down, right, size)


@lru_cache(maxsize=1)
def _rings() -> tuple[tuple[int, int], ...]:
    """Return the points of a lattice, the nearest to the origin first."""
    reach = range(-12, 13)
    points = ((down, right) for down in reach for right in reach)
    return tuple(sorted(points, key=lambda point: (point[0] ** 2 + point[1] ** 2, point)))


def _overlap(place: _Place, other: _Place) -> bool:
    apart = (place[2] + other[2]) / 2
    return abs(place[0] - other[0]) < apart and abs(place[1] - other[1]) < apart


def _status_texts(step: int, max_cycles: int, n_visited: int, n_landmarks: int) -> tuple[str, ...]:
    return f"step {step} / {max_cycles}", f"landmarks {n_visited} / {n_landmarks}"


def _lost_text(lost: int) -> str:
    return f"steps lost {lost}"


def _draw_status(frame: Frame, layout: _Layout, scene: Scene) -> None:
    n_visited, n_landmarks = sum(scene.visited), len(scene.landmarks)
    left, right = _status_texts(scene.step, scene.max_cycles, n_visited, n_landmarks)
    middle = layout.height + (BAR + 3) / 2
    icon = icons.text(left, TEXT, palette.PAPER)
    paste(frame, icon, middle, BAR / 2 + icon.shape[1] / 2)
    done = blend(palette.CHECK, palette.PAPER, 0.55)
    icon = icons.text(right, TEXT, done if n_visited == n_landmarks else palette.PAPER)
    paste(frame, icon, middle, layout.width - BAR / 2 - icon.shape[1] / 2)
    if scene.lost is not None:
        icon = icons.text(_lost_text(sum(scene.lost)), TEXT, palette.LOST)
        paste(frame, icon, middle, layout.width / 2)
    # A thin line above the texts that fills up with the steps.
    share = min(scene.step / max(scene.max_cycles, 1), 1.0)
    line = frame[layout.height : layout.height + 3]
    line[:] = blend(palette.INK, palette.PAPER, 0.25)
    line[:, : round(share * layout.width)] = blend(palette.INK, palette.PAPER, 0.75)


def _tint(frame: Frame, layout: _Layout, cell: int, colour: Colour) -> None:
    top, left = layout.corner(cell)
    frame[top + 1 : top + layout.cell, left + 1 : left + layout.cell] = colour


def paste(frame: Frame, icon: icons.Icon, down: float, right: float) -> None:
    """Lay an icon over the frame with its middle at a point; what is outside is cut off."""
    height, width = icon.shape[:2]
    top, left = round(down - height / 2), round(right - width / 2)
    cut_top, cut_left = max(-top, 0), max(-left, 0)
    below = frame[top + cut_top : top + height, left + cut_left : left + width]
    icon = icon[cut_top:, cut_left:][: below.shape[0], : below.shape[1]]
    alpha = icon[:, :, 3:].astype(np.uint16)
    below[:] = (icon[:, :, :3] * alpha + below * (255 - alpha) + 127) // 255

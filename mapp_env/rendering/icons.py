"""Small antialiased pictures with transparency: agents, flags, the depot and text.

Every icon is drawn once with Pillow at a multiple of its size, scaled down and kept, so that a
frame is only copying. Pillow is imported by the first icon drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapp_env.rendering import palette
from mapp_env.rendering.palette import Colour, blend, ink_on

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw
    from PIL.ImageFont import FreeTypeFont, ImageFont

OVERSAMPLING = 4

Icon = NDArray[np.uint8]  # (height, width, 4): red, green, blue, alpha; read-only, as it is shared


@lru_cache(maxsize=256)
def disc(size: int, colour: Colour, label: str) -> Icon:
    """Return an agent: a disc with its number, without the number where it would not be legible."""

    def draw(pen: ImageDraw, s: float) -> None:
        pen.ellipse((0, 0, s - 1, s - 1), fill=palette.PAPER)
        rim = max(0.05 * s, OVERSAMPLING)
        pen.ellipse((rim, rim, s - 1 - rim, s - 1 - rim), fill=colour)
        if size >= 13:
            font = _font(0.56 * s if len(label) == 1 else 0.48 * s)
            middle, ink = (s / 2, s / 2 + 0.01 * s), ink_on(colour)
            pen.text(middle, label, fill=ink, font=font, anchor="mm", stroke_width=0.018 * s)

    return _icon(size, size, draw)


@lru_cache(maxsize=64)
def flag(size: int, visited: bool, plate: bool = False) -> Icon:
    """Return a landmark: a red flag, or a pale one with a check mark once it is visited.

    ``plate`` puts it on a round ground, for grids whose cells are too small to be tinted.
    """
    cloth = palette.FLAG_VISITED if visited else palette.FLAG
    ground = palette.FLAG_VISITED_CELL if visited else palette.FLAG_CELL
    pole = blend(palette.INK, palette.FLAG_VISITED_CELL, 0.45) if visited else palette.INK

    def draw(pen: ImageDraw, s: float) -> None:
        inset = 0.0
        if plate:
            _draw_plate(pen, s, cloth, ground)
            inset = 0.12 * s
        s -= 2 * inset

        def at(across: float, down: float) -> tuple[float, float]:
            return inset + across * s, inset + down * s

        pen.ellipse((*at(0.16, 0.81), *at(0.44, 0.91)), fill=pole)
        pen.polygon([at(0.30, 0.12), at(0.82, 0.33), at(0.30, 0.54)], fill=cloth)
        thick = max(0.055 * s, 1.2 * OVERSAMPLING)
        pen.line([at(0.30, 0.09), at(0.30, 0.86)], fill=pole, width=round(thick))
        if visited:
            thick = max(0.10 * s, 1.5 * OVERSAMPLING)
            check = [at(0.48, 0.70), at(0.60, 0.82), at(0.84, 0.52)]
            pen.line(check, fill=palette.CHECK, width=round(thick), joint="curve")

    return _icon(size, size, draw)


@lru_cache(maxsize=16)
def house(size: int, plate: bool = False) -> Icon:
    """Return the depot: a house; for ``plate`` see :func:`flag`."""

    def draw(pen: ImageDraw, s: float) -> None:
        if plate:
            _draw_plate(pen, s, palette.DEPOT, palette.DEPOT_CELL)
        pen.rectangle((0.22 * s, 0.46 * s, 0.78 * s, 0.86 * s), fill=palette.DEPOT)
        roof = [(0.08 * s, 0.5 * s), (0.5 * s, 0.12 * s), (0.92 * s, 0.5 * s)]
        pen.polygon(roof, fill=palette.DEPOT)
        pen.rectangle((0.42 * s, 0.60 * s, 0.58 * s, 0.86 * s), fill=palette.DEPOT_CELL)

    return _icon(size, size, draw)


@lru_cache(maxsize=256)
def text(string: str, height: int, colour: Colour) -> Icon:
    """Return a line of text, ``height`` pixels from ascender to descender."""
    font = _font(0.8 * height * OVERSAMPLING)
    width = -int(-font.getlength(string) // OVERSAMPLING)

    def draw(pen: ImageDraw, s: float) -> None:
        middle = (0, s / 2)
        pen.text(middle, string, fill=colour, font=font, anchor="lm", stroke_width=0.01 * s)

    return _icon(width, height, draw)


def _draw_plate(pen: ImageDraw, s: float, rim: Colour, ground: Colour) -> None:
    pen.ellipse((0, 0, s - 1, s - 1), fill=ground, outline=rim, width=OVERSAMPLING)


def _icon(width: int, height: int, draw: Callable[[ImageDraw, float], None]) -> Icon:
    """Draw with a pen on a transparent canvas of ``OVERSAMPLING`` times the height; scale down."""
    from PIL import Image, ImageDraw

    canvas = Image.new("RGBA", (width * OVERSAMPLING, height * OVERSAMPLING), (0, 0, 0, 0))
    draw(ImageDraw.Draw(canvas), height * OVERSAMPLING)
    icon = np.array(canvas.reduce(OVERSAMPLING))
    icon.flags.writeable = False
    return icon


@lru_cache(maxsize=32)
def _font(size: float) -> FreeTypeFont | ImageFont:
    from PIL import ImageFont

    # Pillow's own font: the same picture on every machine, whatever fonts it has.
    return ImageFont.load_default(size)

"""The colours shared by all pictures: an agent looks the same in a frame and in a figure."""

from __future__ import annotations

from typing import TypeAlias

Colour: TypeAlias = tuple[int, int, int]

FLOOR: Colour = (250, 248, 243)
GRID_LINE: Colour = (228, 224, 215)
WALL: Colour = (59, 65, 77)
INK: Colour = (33, 37, 46)
PAPER: Colour = (255, 255, 255)

DEPOT: Colour = (92, 74, 50)
DEPOT_CELL: Colour = (246, 228, 190)

FLAG: Colour = (215, 38, 61)
FLAG_CELL: Colour = (252, 224, 225)
FLAG_VISITED: Colour = (150, 168, 155)
FLAG_VISITED_CELL: Colour = (228, 238, 229)
CHECK: Colour = (30, 122, 70)
LOST: Colour = (255, 221, 72)  # as of a marker pen: moves of a step that lost something

# The first five are from Okabe and Ito's colour-blind-safe set, without the vermilion, which looks
# like a flag. The others were searched for: the smallest Oklab distance between any two agents is
# 0.13 for normal sight and 0.076 under simulated deuteranopia and protanopia (Machado 2009), and
# all keep away from the floor, the walls and the red flags.
AGENTS: tuple[Colour, ...] = (
    (0, 114, 178),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (86, 180, 233),
    (85, 34, 17),
    (0, 0, 187),
    (68, 0, 102),
    (0, 102, 17),
    (153, 119, 255),
    (136, 238, 102),
    (170, 119, 0),
    (85, 68, 238),
    (136, 34, 119),
    (119, 102, 102),
    (0, 221, 204),
)


def agent_colour(agent: int) -> Colour:
    """Return the colour of an agent; sixteen are distinct."""
    return AGENTS[agent % len(AGENTS)]


def blend(colour: Colour, other: Colour, share: float) -> Colour:
    """Mix two colours, ``share`` of the second in the first."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(colour, other, strict=True))
    return red, green, blue


def to_hex(colour: Colour) -> str:
    """Write a colour as ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def ink_on(colour: Colour) -> Colour:
    """Return the text colour, light or dark, that is legible on ``colour``."""
    red, green, blue = colour
    return INK if 0.299 * red + 0.587 * green + 0.114 * blue > 150 else PAPER

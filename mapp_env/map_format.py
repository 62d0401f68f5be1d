"""The two text formats of a grid: plain rows of characters, and MovingAI's ``.map`` files.

Plain rows use ``#``, ``@``, ``T`` or ``O`` for a wall, ``.`` or ``G`` for a free cell and ``D`` for
the depot (at most one). A ``.map`` file (Sturtevant 2012, doi:10.1109/TCIAIG.2012.2197681) has the
same rows below a header of ``type``, ``height``, ``width`` and ``map`` lines, and may also use
``S`` (swamp, free) and ``W`` (water, a wall).
"""

from __future__ import annotations

import codecs
import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.files import read_bytes
from mapp_env.validation import describe

MAX_SIDE = 512
"""Largest number of rows or columns of a grid."""

MAX_FILE_BYTES = 1 << 20
"""Largest map file that is read: a 512 x 512 map takes about a quarter of it."""

WALLS = "#@TO"
FREE = ".G"
DEPOT = "D"
HEADER_KEYS = ("type", "height", "width")


class MapError(ValueError):
    """A map text or file that cannot be used; the message names the source and the line."""


class ParsedMap(NamedTuple):
    """What a map text says."""

    walls: NDArray[np.bool_]  # (rows, cols)
    depot: int | None  # cell, if the text marks one


def read_map(source: str) -> ParsedMap:
    """Read a map file of at most ``MAX_FILE_BYTES`` bytes.

    Raises a MapError if the file cannot be opened, is not a regular file, is too large or is
    malformed.
    """
    data = read_bytes(source, MAX_FILE_BYTES, "a map file", MapError)
    data = data.removeprefix(codecs.BOM_UTF8)  # as editors of some systems write it
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        found = "UTF-16's byte order mark" if utf16 else f"the byte 0x{data[error.start]:02x}"
        raise MapError(f"{source}:{line}: holds {found}, which is not ASCII text") from error
    return parse_map(text, source)


def parse_map(text: str, source: str = "text") -> ParsedMap:
    """Turn a map text, plain or MovingAI, into walls and a depot; messages call it ``source``.

    Empty lines at either end are ignored, and so are blanks after rows, unless they make up a
    column. Raises a MapError if the text is malformed, which names the line, counted from 1.
    """
    if len(text) > MAX_FILE_BYTES:
        raise MapError(f"{source}: has {len(text)} characters, a map may have {MAX_FILE_BYTES}")
    lines = re.split(r"\r\n|\r|\n", text.removeprefix("\ufeff"))
    if not all(line.endswith((" ", "\t")) for line in lines if line):
        lines = [line.rstrip(" \t") or line for line in lines]
    rows = [index for index, line in enumerate(lines) if line]
    if not rows:
        raise MapError(f"{source}:1: holds no rows")
    first, last = rows[0], rows[-1] + 1
    if lines[first].split()[:1] == ["type"]:
        height, width, first = _read_header(lines, first, source)
        if last - first != height:
            raise MapError(f"{source}:{last}: has {last - first} rows, its header says {height}")
        return _read_rows(lines[first:last], first, source, FREE + "S", WALLS + "W", width)
    return _read_rows(lines[first:last], first, source, FREE, WALLS, None)


def _read_header(lines: list[str], first: int, source: str) -> tuple[int, int, int]:
    """Return height, width and the index of the first row below a MovingAI header."""
    values: dict[str, str] = {}
    for index in range(first, min(len(lines), first + 8)):
        words = lines[index].split()
        if words == ["map"]:
            missing = [key for key in HEADER_KEYS if key not in values]
            if missing:
                raise MapError(f"{source}:{index + 1}: header lacks {missing[0]!r}")
            sides = []
            for key in ("height", "width"):
                digits = values[key]
                number = int(digits) if digits.isdecimal() and len(digits) < 10 else 0
                if not 1 <= number <= MAX_SIDE:
                    raise MapError(
                        f"{source}:{index + 1}: {key} must be in 1..{MAX_SIDE}, "
                        f"got {describe(values[key])}"
                    )
                sides.append(number)
            return sides[0], sides[1], index + 1
        if len(words) != 2 or words[0] not in HEADER_KEYS or words[0] in values:
            raise MapError(
                f"{source}:{index + 1}: expected a header line 'type', 'height', 'width' "
                f"(each once) or 'map', got {describe(lines[index])}"
            )
        values[words[0]] = words[1]
    raise MapError(f"{source}:{first + 1}: header has no 'map' line")


def _read_rows(
    rows: list[str], first: int, source: str, free: str, walls: str, width: int | None
) -> ParsedMap:
    """Turn rows of characters into walls and a depot; ``first`` rows of the text came before."""
    width = len(rows[0]) if width is None else width
    if not 1 <= width <= MAX_SIDE:
        raise MapError(f"{source}:{first + 1}: has {width} columns, allowed are 1..{MAX_SIDE}")
    if len(rows) > MAX_SIDE:
        raise MapError(f"{source}:{first + MAX_SIDE + 1}: has more than {MAX_SIDE} rows")
    wall = np.zeros((len(rows), width), dtype=np.bool_)
    depot: int | None = None
    allowed = free + walls + DEPOT
    for index, row in enumerate(rows):
        line = first + index + 1
        if len(row) != width:
            raise MapError(f"{source}:{line}: has {len(row)} columns, expected {width}")
        for col, letter in enumerate(row):
            if letter not in allowed:
                raise MapError(
                    f"{source}:{line}: column {col + 1} is {letter!r}, allowed are {allowed!r}"
                )
        wall[index] = [letter in walls for letter in row]
        if DEPOT in row:
            if depot is not None or row.count(DEPOT) > 1:
                raise MapError(f"{source}:{line}: has a second depot {DEPOT!r}, one is allowed")
            depot = index * width + row.index(DEPOT)
    return ParsedMap(wall, depot)

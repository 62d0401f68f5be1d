"""The two text formats of a grid: plain rows of characters, and MovingAI's ``.map`` files.

Plain rows use ``#``, ``@``, ``T`` or ``O`` for a wall, ``.`` or ``G`` for a free cell and ``D`` for
the depot (at most one). A ``.map`` file (Sturtevant 2012, doi:10.1109/TCIAIG.2012.2197681) has the
same rows below a header of ``type``, ``height``, ``width`` and ``map`` lines, and may also use
``S`` (swamp, free), ``W`` (water, a wall) and ``E``: in maps of the League of Robot Runners, ``E``
and ``S`` are where robots pick up and deliver, which are free cells. Callers may say otherwise.
"""

from __future__ import annotations

import codecs
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapp_env.files import read_bytes
from mapp_env.validation import describe

MAX_SIDE = 2048
"""Largest number of rows or columns of a grid."""

MAX_FILE_BYTES = 8 << 20
"""Largest map file that is read: a 2048 x 2048 map takes about half of it."""

WALLS = "#@TO"
FREE = ".G"
DEPOT = "D"
MORE_FREE, MORE_WALLS = "SE", "W"  # below a header
HEADER_KEYS = ("type", "height", "width")
HEADER_LINES = 8  # among which the "map" line is looked for
BLANKS = (" ", "\t")


class MapError(ValueError):
    """A map text or file that cannot be used; the message names the source and the line."""


class ParsedMap(NamedTuple):
    """What a map text says."""

    walls: NDArray[np.bool_]  # (rows, cols)
    depot: int | None  # cell, if the text marks one


class Letters(NamedTuple):
    """What the letters of a map mean; those of ``free`` and ``walls`` differ."""

    free: str = ""
    walls: str = ""
    depot: str = DEPOT

    def changed(self, free: str, walls: str) -> Letters:
        """Return these letters with some that now mean a free cell, or a wall."""
        new = free + walls

        def kept(letters: str) -> str:
            return "".join(letter for letter in letters if letter not in new)

        return Letters(kept(self.free) + free, kept(self.walls) + walls, kept(self.depot))


DEFAULT_LETTERS = Letters()


def check_letters(free: object, walls: object) -> Letters:
    """Return the letters that a caller names in place of the usual ones, in ASCII's order.

    Raises a ValueError unless each argument is None or holds letters of ASCII that can be seen, and
    they share none.
    """
    named: list[str] = []
    for name, value in (("free", free), ("walls", walls)):
        letters: list[Any] = (
            list(value) if isinstance(value, str | set | frozenset | tuple | list) else [value]
        )
        if value is not None and not all(
            isinstance(letter, str) and len(letter) == 1 and "!" <= letter <= "~"
            for letter in letters
        ):
            raise ValueError(
                f"{name} must be letters of ASCII other than blanks, such as 'EX', got "
                f"{describe(value)}"
            )
        named.append("" if value is None else "".join(sorted(set(letters))))
    if both := [letter for letter in named[0] if letter in named[1]]:
        raise ValueError(f"free and walls must differ, got {both[0]!r} in both")
    return Letters(*named)


def read_map(source: str, letters: Letters = DEFAULT_LETTERS) -> ParsedMap:
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
    return parse_map(text, source, letters)


def parse_map(text: str, source: str = "text", letters: Letters = DEFAULT_LETTERS) -> ParsedMap:
    """Turn a map text, plain or MovingAI, into walls and a depot; messages call it ``source``.

    Empty lines at either end are ignored, and so are blanks after rows, unless they make up a
    column. ``letters``, from :func:`check_letters`, mean what they say whatever the format.

    Raises a MapError if the text is malformed, which names the line, counted from 1.
    """
    if len(text) > MAX_FILE_BYTES:
        raise MapError(f"{source}: has {len(text)} characters, a map may have {MAX_FILE_BYTES}")
    text = text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
    body = text.lstrip("\n")
    above = len(text) - len(body)  # empty lines
    n_lines = body.rstrip("\n").count("\n") + 1
    if not body:
        raise MapError(f"{source}:1: holds no rows")
    # No more than a good map has: of millions of lines, the others need not be taken apart.
    lines = body.split("\n", MAX_SIDE + HEADER_LINES)
    if not all(line.endswith(BLANKS) for line in lines[:n_lines] if line):
        lines = [line.rstrip(" \t") or line for line in lines]
    plain = Letters(FREE, WALLS).changed(letters.free, letters.walls)
    if lines[0].split(maxsplit=1)[:1] != ["type"]:
        return _read_rows(lines[:n_lines], above, source, plain, None)
    height, width, first = _read_header(lines, above, source)
    if n_lines - first != height:
        raise MapError(
            f"{source}:{above + n_lines}: has {n_lines - first} rows, its header says {height}"
        )
    below = Letters(FREE + MORE_FREE, WALLS + MORE_WALLS).changed(letters.free, letters.walls)
    return _read_rows(lines[first:n_lines], above + first, source, below, width)


def _read_header(lines: list[str], above: int, source: str) -> tuple[int, int, int]:
    """Return height, width and how many lines a MovingAI header has, below ``above`` others."""
    values: dict[str, str] = {}
    for index, line in enumerate(lines[:HEADER_LINES]):
        where = f"{source}:{above + index + 1}"
        words = line.split(maxsplit=2)
        if words == ["map"]:
            missing = [key for key in HEADER_KEYS if key not in values]
            if missing:
                raise MapError(f"{where}: header lacks {missing[0]!r}")
            sides = []
            for key in ("height", "width"):
                digits = values[key]
                number = int(digits) if digits.isdecimal() and len(digits) < 10 else 0
                if not 1 <= number <= MAX_SIDE:
                    raise MapError(
                        f"{where}: {key} must be in 1..{MAX_SIDE}, got {describe(values[key])}"
                    )
                sides.append(number)
            return sides[0], sides[1], index + 1
        if len(words) != 2 or words[0] not in HEADER_KEYS or words[0] in values:
            raise MapError(
                f"{where}: expected a header line 'type', 'height', 'width' "
                f"(each once) or 'map', got {describe(line)}"
            )
        values[words[0]] = words[1]
    raise MapError(f"{source}:{above + 1}: header has no 'map' line")


def _read_rows(
    rows: list[str], above: int, source: str, letters: Letters, width: int | None
) -> ParsedMap:
    """Turn rows of characters into walls and a depot; ``above`` lines of the text came before."""
    width = len(rows[0]) if width is None else width
    if not 1 <= width <= MAX_SIDE:
        raise MapError(f"{source}:{above + 1}: has {width} columns, allowed are 1..{MAX_SIDE}")
    if len(rows) > MAX_SIDE:
        raise MapError(f"{source}:{above + MAX_SIDE + 1}: has more than {MAX_SIDE} rows")
    ragged = next((index for index, row in enumerate(rows) if len(row) != width), None)
    # Which of `letters` each cell has, by its place there and counted from 1; 0 for any other.
    kind_of = np.zeros(128, np.uint8)
    for kind, some in enumerate(letters, 1):
        kind_of[[ord(letter) for letter in some]] = kind
    codes = np.frombuffer("".join(rows[:ragged]).encode("utf-32-le", "surrogatepass"), "<u4")
    kinds = kind_of[np.minimum(codes, 127)]  # 127 is no letter
    # The first fault in reading order: before a ragged row, and in a line letters before depots.
    depots = np.flatnonzero(kinds == 3)
    unknown = None if kinds.all() else divmod(int(np.argmin(kinds)), width)
    second = None if len(depots) < 2 else int(depots[1]) // width
    if unknown is not None and (second is None or unknown[0] <= second):
        row, col = unknown
        raise MapError(
            f"{source}:{above + row + 1}: column {col + 1} is {rows[row][col]!r}, "
            f"allowed are {''.join(letters)!r}"
        )
    if second is not None:
        raise MapError(
            f"{source}:{above + second + 1}: has a second depot {DEPOT!r}, one is allowed"
        )
    if ragged is not None:
        raise MapError(
            f"{source}:{above + ragged + 1}: has {len(rows[ragged])} columns, expected {width}"
        )
    walls = kinds.reshape(-1, width) == 2
    return ParsedMap(walls, int(depots[0]) if len(depots) else None)

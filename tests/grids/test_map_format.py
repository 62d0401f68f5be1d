"""Map texts: what a fast reader makes of them is what one that looks at each letter does."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from mapp_env import Grid, MapError
from mapp_env.map_format import parse_map

HEADER = "type octile\nheight {}\nwidth {}\nmap\n"


def slow_parse(rows: list[str], above: int, width: int, free: str, walls: str) -> object:
    """Return walls and depot of rows of letters, or where in the text the first fault is."""
    cells: list[bool] = []
    depot = None
    for line, row in enumerate(rows, above + 1):
        if len(row) != width:
            return f"text:{line}: has {len(row)} columns, expected {width}"
        depots_before = depot is not None
        for col, letter in enumerate(row, 1):
            if letter not in free + walls + "D":
                return (
                    f"text:{line}: column {col} is {letter!r}, allowed are {free + walls + 'D'!r}"
                )
            if letter == "D" and depot is None:
                depot = len(cells)
            cells.append(letter in walls)
        if row.count("D") > (0 if depots_before else 1):
            return f"text:{line}: has a second depot 'D', one is allowed"
    return np.array(cells).reshape(len(rows), width).tolist(), depot


def fast_parse(text: str) -> object:
    """Return what :func:`slow_parse` does, as the package reads it."""
    try:
        parsed = parse_map(text)
    except MapError as error:
        return str(error)
    return parsed.walls.tolist(), parsed.depot


LETTERS = (
    ".#",
    ".#@TOG",
    ".....#D",
    "." * 30 + "D",
    "." * 30 + "x",
    ".#SWE",
    ".é#",
    ".\xae#",  # 128 more than a full stop
    ".D\0#",
    ".\ud800",
)


def test_random_texts_are_read_as_by_a_slow_reader() -> None:
    """20,000 texts, good and bad, with a header and without: the same cells or message."""
    rng = random.Random(4)
    good = 0
    faults = {"columns, expected": 0, "column": 0, "depot": 0}
    for _ in range(20_000):
        letters = rng.choice(LETTERS)
        width = rng.randint(1, 7)
        rows = ["".join(rng.choices(letters, k=width)) for _ in range(rng.randint(1, 7))]
        if rng.random() < 0.2:
            rows[rng.randrange(len(rows))] += rng.choice(letters)
        above = rng.randint(0, 3)
        body = rng.choice(["\n", "\r\n", "\r"]).join(rows) + "\n" * rng.randint(0, 3)
        if rng.random() < 0.5:
            wanted = slow_parse(rows, above + 4, width, ".GSE", "#@TOW")
            text = HEADER.format(len(rows), width) + body
        else:
            wanted = slow_parse(rows, above, len(rows[0]), ".G", "#@TO")
            text = body
        assert fast_parse("\n" * above + text) == wanted, text
        good += not isinstance(wanted, str)
        for fault in faults:
            faults[fault] += isinstance(wanted, str) and fault in wanted
    assert good > 2_000
    assert min(faults.values()) > 500


@pytest.mark.parametrize("shape", [(2048, 2048), (1, 2048), (2048, 1), (656, 1491)])
def test_large_texts_are_read_back(shape: tuple[int, int], tmp_path: Path) -> None:
    """A grid's text is the grid, up to the largest sides, as a string and as a file."""
    walls = np.random.default_rng(5).random(shape) < 0.3
    walls.flat[walls.size // 3] = False
    grid = Grid(walls, walls.size // 3)
    again = Grid.from_text(grid.to_text())
    assert again == grid
    assert hash(again) == hash(grid)
    assert (again.walls == walls).all()
    assert again.depot == grid.depot
    lines = grid.to_text().split("\n")
    assert [line.count("#") for line in lines] == walls.sum(1).tolist()
    path = tmp_path / "large.map"
    path.write_text(HEADER.format(*shape) + grid.to_text().replace("#", "@"), newline="\r\n")
    assert Grid.load(path) == grid


def test_the_last_letter_of_a_large_text_is_looked_at() -> None:
    """An unknown letter in the last cell of 2048 x 2048 is named by line and column."""
    text = "\n".join(["." * 2048] * 2047 + ["." * 2047 + "x"])
    with pytest.raises(MapError, match=r"^text:2048: column 2048 is 'x', allowed are '\.G#@TOD'$"):
        Grid.from_text(text)


def test_letters_mean_what_the_caller_says(tmp_path: Path) -> None:
    """``free`` and ``walls`` overrule the format for the letters they hold, and for no others."""
    rows = "ES.@\nGDWT"
    text = HEADER.format(2, 4) + rows
    (tmp_path / "a.map").write_text(text)

    def closed(**letters: object) -> str:
        """Return the letters read as walls, from the string and from the file."""
        grid = Grid.from_text(text, **letters)
        assert Grid.load(tmp_path / "a.map", **letters) == grid
        found = rows.replace("\n", "")
        return "".join(letter for letter, wall in zip(found, grid.walls.flat, strict=True) if wall)

    assert closed() == "@WT"
    assert closed(walls="E") == "E@WT"
    assert closed(walls={"E", "S"}, free=["W", "T"]) == "ES@"
    assert closed(free="", walls=()) == "@WT"
    assert closed(free=".SEGD", walls="@WT") == "@WT"
    assert Grid.from_text(text).depot == 5
    assert Grid.from_text(text, walls="D", depot=(0, 1)).walls.flat[5]
    assert Grid.from_text("ab\ncd", free="ad", walls=frozenset("bc")).to_text() == "D#\n#."
    with pytest.raises(MapError, match=r"text:1: column 2 is '\?', allowed are 'Gx#@TO\.D'"):
        Grid.from_text("x?.", free="x", walls=".")


@pytest.mark.parametrize("name", ["free", "walls"])
@pytest.mark.parametrize(
    "value", [3, " ", "a b", "\t", "é", ["ab"], [""], [3], {"a": 1}, b"a"], ids=repr
)
def test_letters_that_are_none(name: str, value: object, tmp_path: Path) -> None:
    """Blanks, letters outside ASCII, words and other types are refused by name, before reading."""
    for call in (
        lambda: Grid.from_text("D.", **{name: value}),
        lambda: Grid.load(tmp_path / "missing.map", **{name: value}),
    ):
        with pytest.raises(
            ValueError, match=rf"^{name} must be letters of ASCII other than blanks"
        ):
            call()


def test_a_letter_is_free_or_a_wall() -> None:
    """A letter named as both is refused."""
    with pytest.raises(ValueError, match=r"^free and walls must differ, got 'E' in both"):
        Grid.from_text("D.", free="SE", walls="TE")

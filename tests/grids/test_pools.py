"""Many grids at once: the same for ever, within their ranges, all names alike; and from files."""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from mapp_env import Grid, MapError, load_grids, make_grid, make_grids

NAMES = ("maze", "random", "rooms", "warehouse")

DIGESTS = {
    "maze": "3655ca1e4ed15935",
    "random": "bd9da17c8f4905a2",
    "rooms": "807b0d1bedff9350",
    "warehouse": "bfd35eb5943a9fd5",
    "all": "844be8ac91185344",
}
"""SHA-256 (first 16 digits) of the texts of 25 grids with seed 3."""


def digest(grids: tuple[Grid, ...]) -> str:
    """Return what tells pools apart."""
    return hashlib.sha256("\n\n".join(grid.text for grid in grids).encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", [*NAMES, "all"])
def test_pools_are_pinned(name: str) -> None:
    """The same arguments give the same grids: always, on every machine."""
    assert digest(make_grids(NAMES if name == "all" else name, 25, seed=3)) == DIGESTS[name]


@pytest.mark.parametrize("arguments", [{}, {"rows": 9, "density": (0.1, 0.3), "min_landmarks": 12}])
def test_a_pool_begins_alike_whatever_its_size(arguments: dict[str, object]) -> None:
    """Grid i of n is grid i of any other n, and of the same call again; of no other seed."""
    long = make_grids(NAMES, 60, seed=7, **arguments)
    assert make_grids(NAMES, 60, seed=7, **arguments) == long
    for n in (1, 2, 17):
        assert make_grids(NAMES, n, seed=7, **arguments) == long[:n]
    other = make_grids(NAMES, 60, seed=8, **arguments)
    assert len(set(long) & set(other)) < 6
    assert len(set(long)) > 50


def test_a_pool_leaves_the_global_state_alone() -> None:
    """Neither draws from NumPy's global generator nor sets it."""
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    make_grids(NAMES, 5)
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


def kind_of(grid: Grid) -> str:
    """Return which generator has made a 13 x 13 grid: all loops, no density, rooms of three."""
    if grid.depot // 13 == 12:
        return "warehouse"
    n_walls = int(grid.walls.sum())
    if n_walls == grid.walls[1::2, 1::2].sum() == 36:
        return "maze"
    return "rooms" if n_walls else "random"


def test_all_names_are_equally_likely() -> None:
    """Of 4,000 grids each name has a quarter; with weights, its share; without weight, none."""
    for names, shares in (
        (NAMES, dict.fromkeys(NAMES, 0.25)),
        (("maze", "rooms", "maze"), {"maze": 2 / 3, "rooms": 1 / 3}),
        ({"rooms": 3, "warehouse": 0, "maze": 1}, {"rooms": 0.75, "maze": 0.25}),
    ):
        options = {"random": {"density": 0}, "maze": {"loops": 1}, "rooms": {"room": 3}}
        chosen = {}
        for name in names:
            chosen |= options.get(name, {})
        grids = make_grids(names, 4_000, rows=13, cols=13, **chosen)
        counts = Counter(map(kind_of, grids))
        assert set(counts) == set(shares)
        for name, share in shares.items():
            # Six standard deviations of a binomial.
            assert abs(counts[name] - 4_000 * share) < 6 * (4_000 * share * (1 - share)) ** 0.5


def test_sides_are_drawn_from_the_whole_range() -> None:
    """Rows and columns take every value of their ranges, both ends included, and no others."""
    for name in ("random", "rooms"):
        grids = make_grids(name, 400, rows=(5, 8), cols=(9, 11))
        assert Counter(grid.walls.shape for grid in grids).keys() == set(
            itertools.product(range(5, 9), range(9, 12))
        )
    sides = {grid.walls.shape for grid in make_grids("warehouse", 200, rows=(2, 7), cols=6)}
    assert sides == {(6, 6), (7, 6)}
    sides = {grid.walls.shape for grid in make_grids("maze", 200, rows=(2, 8), cols=(7, 8))}
    assert sides == {(3, 7), (5, 7), (7, 7)}
    assert make_grids("maze", 1, rows=8, cols=10)[0].walls.shape == (8, 10)
    every = make_grids(NAMES, 300)
    for side in (0, 1):
        found = {grid.walls.shape[side] for grid in every}
        assert (min(found), max(found)) == (7, 24)


def test_every_grid_has_room() -> None:
    """All free cells are reached, and hold as many landmarks as asked for, or the documented 15."""
    for grid in make_grids(NAMES, 400):
        assert grid.reachable.size == np.count_nonzero(~grid.walls) - 1
        assert grid.reachable.size >= 15
    least = [g.reachable.size for g in make_grids(NAMES, 400, rows=7, cols=7)]
    assert min(least) >= 15
    roomy = make_grids(NAMES, 400, rows=(6, 8), cols=(6, 8), min_landmarks=27)
    assert 27 <= min(grid.reachable.size for grid in roomy) < 30
    assert make_grids("random", 30, rows=2, cols=2, min_landmarks=3, density=0)[0].n_cells == 4


def test_options_are_ranges_or_values() -> None:
    """One value is the generator's own; a range is heeded; defaults differ from grid to grid."""
    for grid in make_grids("random", 40, rows=10, cols=10, density=0):
        assert not grid.walls.any()
    shares = [g.walls.mean() for g in make_grids("random", 300, rows=20, cols=20)]
    assert min(shares) < 0.03
    assert 0.14 < np.median(shares) < 0.21
    assert max(shares) > 0.33
    shares = [
        g.walls.mean() for g in make_grids("random", 300, rows=20, cols=20, density=(0.1, 0.2))
    ]
    assert min(shares) < 0.11
    assert 0.19 < max(shares) < 0.25
    # A perfect maze is a tree; with all loops, pillars alone are left.
    for grid in make_grids("maze", 20, rows=9, cols=9, loops=1):
        assert grid.walls.sum() == 16
    trees = make_grids(("maze", "rooms"), 60, rows=9, cols=9, loops=0.0, room=9)
    assert {int(grid.walls.sum()) for grid in trees} == {0, 81 - 49}
    lengths = set()
    for grid in make_grids("warehouse", 60, rows=6, cols=40, shelf_length=(3, 5), aisle=1, gaps=0):
        row = "".join("#" if wall else "." for wall in grid.walls[2])
        lengths |= {len(shelf) for shelf in row.split(".") if shelf}
    assert lengths == {3, 4, 5}
    aisles = set()
    for grid in make_grids("warehouse", 60, rows=9, cols=40, gaps=0):
        row = "".join("#" if wall else "." for wall in grid.walls[grid.walls.any(1)][0])
        aisles |= {len(aisle) for aisle in row.strip(".").split("#") if aisle}
    assert aisles == {1, 2}


def test_bundled_grids_are_as_they_are() -> None:
    """A bundled name has its share in a mixture, whatever sides and options are asked for."""
    grids = make_grids(("paper-7x7", "maze"), 100, rows=9, cols=9, loops=0.2)
    paper = make_grid("paper-7x7")
    assert 30 < sum(grid == paper for grid in grids) < 70
    assert all(grid == paper or grid.walls.shape == (9, 9) for grid in grids)
    assert make_grids("paper-7x7", 2) == (paper, paper)


RANDOM = {"names": "random", "n": 3}

REFUSED: list[tuple[dict[str, object], str]] = [
    ({"names": "towers"}, r"^names must be one of 'paper-7x7', 'maze', .*; got 'towers'"),
    ({"names": ("maze", 3)}, r"^names must be one of .*; got 3"),
    ({"names": ()}, r"^names must be the name of a grid, a sequence .*, got \(\)"),
    ({"names": None}, r"^names must be the name of a grid, .* got None"),
    ({"names": {"maze": -1}}, r"^names\['maze'\] must be a number in 0\.\.1e\+09, got -1"),
    ({"names": {"maze": float("nan")}}, r"^names\['maze'\] must be a number .* got nan"),
    ({"names": {"maze": 0, "rooms": 0.0}}, "^names must have a weight above 0, got"),
    ({"n": 0}, r"^n must be an integer in 1\.\.1000000, got 0"),
    ({"n": 2.0}, r"^n must be an integer in 1\.\.1000000, got 2\.0"),
    ({"n": 1_000_001}, "^n must be an integer"),
    ({"rows": (9, 8)}, r"^rows must be a range \(low, high\) with low <= high, got \(9, 8\)"),
    ({"rows": (0, 8)}, r"^rows must be an integer in 1\.\.2048, got 0"),
    ({"cols": (7, 2049)}, r"^cols must be an integer in 1\.\.2048, got 2049"),
    ({"cols": 2049}, r"^cols must be an integer in 1\.\.2048, got 2049"),
    ({"cols": (7, 8, 9)}, r"^cols must be one value or a range \(low, high\), got \(7, 8, 9\)"),
    ({"cols": (7,)}, "^cols must be one value or a range"),
    ({"cols": (7, 8.0)}, r"^cols must be an integer .* got 8\.0"),
    ({"cols": "7"}, "^cols must be an integer .* got '7'"),
    ({"rows": 1}, "^rows must reach 2, the least of 'random'; got 1"),
    ({"names": ("random", "warehouse"), "rows": (2, 5)}, "^rows must reach 6, .* 'warehouse'; got"),
    ({"seed": -1}, "^seed must be an integer in 0"),
    ({"seed": 2**128}, "^seed must be an integer in 0"),
    ({"min_landmarks": 0}, r"^min_landmarks must be an integer in 1\.\.4194303, got 0"),
    ({"min_landmarks": 24 * 24}, "^rows and cols must leave room for min_landmarks=576: 100 draws"),
    ({"names": "paper-7x7", "min_landmarks": 41}, "^min_landmarks must be at most 40, .* got 41"),
    ({"density": 0.41}, r"^density must be a number in 0\.\.0\.4, got 0\.41"),
    ({"density": (0.3, 0.2)}, r"^density must be a range \(low, high\) .* got \(0\.3, 0\.2\)"),
    ({"names": "rooms", "room": (2, 1025)}, r"^room must be an integer in 2\.\.1024, got 1025"),
    ({"names": "rooms", "room": (2.0, 3)}, r"^room must be an integer .* got 2\.0"),
    (
        {"names": ("random", "rooms"), "loops": 0.1},
        r"^make_grids\(\('random', 'rooms'\)\) takes .*min_landmarks, density, room; got 'loops'",
    ),
    ({"names": "paper-7x7", "sides": 3}, r"^make_grids\('paper-7x7'\) takes rows, .* got 'sides'"),
]


@pytest.mark.parametrize(("changed", "message"), REFUSED)
def test_bad_arguments_of_a_pool(changed: dict[str, object], message: str) -> None:
    """The message names the argument, the value and what is allowed."""
    with pytest.raises(ValueError, match=message):
        make_grids(**(RANDOM | changed))


def write_maps(folder: Path) -> dict[str, Grid]:
    """Write maps, and other files, into a folder and one below it; return the maps by path."""
    (folder / "more").mkdir()
    grids = {}
    for index, name in enumerate(("b.map", "a.map", "c.txt", "more/d.map")):
        grid = make_grid("random", rows=5, cols=6 + index, seed=index)
        (folder / name).write_text(grid.to_text())
        grids[name] = grid
    (folder / "README.md").write_text("no map")
    (folder / "x.map").mkdir()
    return grids


def test_maps_of_a_folder_a_pattern_and_a_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders and patterns are read in the order of paths, lists in their own."""
    grids = write_maps(tmp_path)

    def of(*names: str) -> tuple[Grid, ...]:
        return tuple(grids[name] for name in names)

    assert load_grids(str(tmp_path / "*.map")) == of("a.map", "b.map")
    assert load_grids(tmp_path / "*.map") == of("a.map", "b.map")
    assert load_grids(f"{tmp_path}/[bc].*") == of("b.map", "c.txt")
    assert load_grids(f"{tmp_path}/**/*.map") == of("a.map", "b.map", "more/d.map")
    assert load_grids(tmp_path / "c.txt") == of("c.txt")
    listed = [tmp_path / "b.map", str(tmp_path / "more/d.map"), tmp_path / "b.map"]
    assert load_grids(listed) == load_grids(tuple(listed)) == of("b.map", "more/d.map", "b.map")
    (tmp_path / "x.map").rmdir()
    assert load_grids(tmp_path) == load_grids(f"{tmp_path}/") == of("a.map", "b.map")
    monkeypatch.chdir(tmp_path)
    assert load_grids("*.map") == load_grids(".") == of("a.map", "b.map")
    (tmp_path / "[a].map").write_text("D....")
    assert load_grids("[a].map") == (Grid.from_text("D...."),)


def test_depot_and_letters_hold_for_all_files(tmp_path: Path) -> None:
    """What Grid.load takes is passed on for each file."""
    for name in ("a.map", "b.map"):
        (tmp_path / name).write_text("E?.\n...")
    with pytest.raises(MapError, match=r"a\.map:1: column 1 is 'E'"):
        load_grids(tmp_path)
    grid = Grid([[False, True, False], [False] * 3], depot=5)
    assert load_grids(tmp_path, depot=(1, 2), free="E", walls="?") == (grid, grid)
    with pytest.raises(ValueError, match=r"a\.map: depot must be a free cell, got 1"):
        load_grids(tmp_path, depot=1, free="E", walls="?")
    with pytest.raises(ValueError, match=r"^free must be letters"):
        load_grids(tmp_path, free=3)


@pytest.mark.parametrize(
    "paths", ["*.map", "nowhere", "", "folder", [], (), None, 3, {"a.map"}], ids=repr
)
def test_nothing_to_load(paths: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What names no file is refused, and the message says what it was."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "a.txt").write_text("D.")
    with pytest.raises(ValueError, match=r"^paths must be a folder .*; got") as caught:
        load_grids(paths)  # type: ignore[arg-type]
    assert repr(paths) in str(caught.value)


def test_a_bad_file_among_others_is_named(tmp_path: Path) -> None:
    """The message names the one file that cannot be used."""
    write_maps(tmp_path)
    (tmp_path / "bad.map").write_text("..\nD?")
    with pytest.raises(MapError, match=r"bad\.map:2: column 2 is '\?'"):
        load_grids(f"{tmp_path}/?*.map")
    (tmp_path / "bad.map").unlink()
    with pytest.raises(MapError, match=r"x\.map: is not a regular file"):
        load_grids(tmp_path)
    for bad in (tmp_path / "missing.map", 3, None):
        with pytest.raises(ValueError, match=r"missing\.map|path must be a str"):
            load_grids([tmp_path / "a.map", bad])  # type: ignore[list-item]

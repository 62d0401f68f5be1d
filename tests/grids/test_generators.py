"""Generated grids: connected, as asked for, and the same for ever."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

import mapp_env
from mapp_env import Grid, make_grid
from mapp_env.grids import generator_names, grid_names
from mapp_env.grids.generators import GENERATORS

NAMES = ("maze", "random", "rooms", "warehouse")

DIGESTS = {
    "maze": "893bdf96fba7311b",
    "random": "66be3b6fbb7ad1c9",
    "rooms": "77250e339eb1315d",
    "warehouse": "78bdf9c5e2e94cb6",
}
"""SHA-256 (first 16 digits) of the text of 20 x 27 grids with seeds 0 to 4."""


def test_manhattan_distances_are_those_of_rows_and_columns() -> None:
    """They heed no wall, are at most the steps of a path, and cells off the grid are refused."""
    grid = make_grid("rooms", rows=9, cols=14)
    cells = [0, 9 * 14 - 1, grid.depot]
    found = grid.manhattan_from(cells)
    for line, cell in zip(found.tolist(), cells, strict=True):
        row, col = divmod(cell, 14)
        assert line == [abs(row - r) + abs(col - c) for r in range(9) for c in range(14)]
    steps = grid.distances_from(cells)
    assert (found <= np.where(steps < 0, 1000, steps)).all()
    with pytest.raises(ValueError, match=r"cells must be a cell in 0\.\.125"):
        grid.manhattan_from([126])


def assert_connected(grid: Grid) -> None:
    """Check that every free cell is reached from the depot by a search of this test's own."""
    seen = np.zeros(grid.walls.shape, np.bool_)
    seen.flat[grid.depot] = True
    while True:
        more = seen.copy()
        more[1:] |= seen[:-1]
        more[:-1] |= seen[1:]
        more[:, 1:] |= seen[:, :-1]
        more[:, :-1] |= seen[:, 1:]
        more &= ~grid.walls
        if (more == seen).all():
            break
        seen = more
    assert (seen == ~grid.walls).all()
    assert grid.reachable.size > 0


@pytest.mark.parametrize("name", NAMES)
def test_every_cell_is_reachable(name: str) -> None:
    """For sizes and seeds of all kinds there is a depot and a way from it to all free cells."""
    rng = np.random.default_rng(3)
    for seed in range(60):
        rows, cols = rng.integers(6, 40, 2).tolist()
        grid = make_grid(name, rows=rows, cols=cols, seed=seed)
        assert grid.walls.shape == (rows, cols)
        assert_connected(grid)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("random", {"rows": 2, "cols": 2}),
        ("random", {"rows": 10, "cols": 512, "density": 0.2}),
        ("random", {"rows": 40, "cols": 40, "density": 0.4}),
        ("random", {"rows": 20, "cols": 20, "density": 0}),
        ("rooms", {"rows": 3, "cols": 3}),
        ("rooms", {"rows": 50, "cols": 50, "room": 2}),
        ("rooms", {"rows": 50, "cols": 9, "room": 4}),
        ("rooms", {"rows": 30, "cols": 30, "room": 256}),
        ("maze", {"rows": 3, "cols": 3}),
        ("maze", {"rows": 3, "cols": 512}),
        ("maze", {"rows": 30, "cols": 31, "loops": 0.0}),
        ("maze", {"rows": 30, "cols": 31, "loops": 1}),
        ("warehouse", {"rows": 6, "cols": 6}),
        ("warehouse", {"rows": 6, "cols": 512, "shelf_length": 256, "aisle": 8}),
        ("warehouse", {"rows": 60, "cols": 60, "gaps": 0.0, "aisle": 3}),
        ("warehouse", {"rows": 60, "cols": 60, "gaps": 1.0}),
    ],
)
def test_extreme_options(name: str, options: dict[str, float]) -> None:
    """The smallest and largest options give connected grids of the size asked for."""
    for seed in range(10):
        grid = make_grid(name, seed=seed, **options)
        assert grid.walls.shape == (options["rows"], options["cols"])
        assert_connected(grid)


@pytest.mark.parametrize("name", NAMES)
def test_largest_grids(name: str) -> None:
    """2048 x 1024 cells are made, and connected."""
    grid = make_grid(name, rows=2048, cols=1024, seed=1)
    assert grid.walls.shape == (2048, 1024)
    assert grid.reachable.size + 1 == int((~grid.walls).sum())


@pytest.mark.parametrize("name", NAMES)
def test_generated_grids_are_pinned(name: str) -> None:
    """The same arguments give the same grid: always, on every machine."""
    text = "\n\n".join(make_grid(name, rows=20, cols=27, seed=s).to_text() for s in range(5))
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == DIGESTS[name]


@pytest.mark.parametrize("name", NAMES)
def test_seeds_give_different_grids(name: str) -> None:
    """Twenty seeds give twenty grids; the default seed is 0, and the global state is left alone."""
    np.random.seed(5)  # noqa: NPY002
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    assert len({make_grid(name, seed=seed) for seed in range(20)}) == 20
    assert make_grid(name) == make_grid(name, seed=0) == GENERATORS[name]()
    assert make_grid(name, seed=2**128 - 1) != make_grid(name)
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


@pytest.mark.parametrize("name", ["maze", "random", "rooms"])
def test_depot_is_central(name: str) -> None:
    """The depot is the free cell nearest to the centre."""
    for seed in range(20):
        grid = make_grid(name, rows=24, cols=33, seed=seed)
        assert grid.depot == Grid(grid.walls).depot


def test_random_density() -> None:
    """Walls are as many as asked for, and few more."""
    for density in (0.0, 0.1, 0.25):
        share = make_grid("random", rows=100, cols=100, density=density).walls.mean()
        assert density <= share <= density + 0.01


def test_rooms_are_rooms() -> None:
    """Closing the doors leaves rectangles, none shorter than a room nor thrice as long."""
    for seed in range(5):
        grid = make_grid("rooms", rows=60, cols=60, seed=seed, room=5)
        walls = grid.walls.copy()
        # A door has walls, or the edge, on two opposite sides; rooms are wider than that.
        padded = np.pad(walls, 1, constant_values=True)
        beside = padded[1:-1, :-2] & padded[1:-1, 2:]
        above = padded[:-2, 1:-1] & padded[2:, 1:-1]
        doors = ~walls & (beside | above)
        assert doors.sum() > 10
        walls |= doors
        rooms = 0
        left = ~walls
        while left.any():
            row, col = np.unravel_index(np.argmax(left), left.shape)
            height = int(np.argmin(np.append(left[row:, col], False)))
            width = int(np.argmin(np.append(left[row, col:], False)))
            room = left[row : row + height, col : col + width]
            assert room.all()
            assert 5 <= height <= 16
            assert 5 <= width <= 16
            room[:] = False
            rooms += 1
        assert rooms > 16


def test_maze_without_loops_has_one_way() -> None:
    """A perfect maze is a tree: one link less than cells; loops only take walls away."""
    for seed in range(5):
        perfect = make_grid("maze", rows=31, cols=41, seed=seed, loops=0)
        free = ~perfect.walls
        links = int((free[1:] & free[:-1]).sum() + (free[:, 1:] & free[:, :-1]).sum())
        assert links == free.sum() - 1
        looped = make_grid("maze", rows=31, cols=41, seed=seed, loops=0.2)
        assert not (looped.walls & free).any()
        assert looped.walls.sum() < perfect.walls.sum()


def test_warehouse_has_shelves_and_aisles() -> None:
    """Without gaps every shelf is 2 x 8, the edges are free and the depot is at the last row."""
    grid = make_grid("warehouse", gaps=0.0)
    walls = grid.walls
    for edge in (walls[0], walls[-1], walls[:, 0], walls[:, -1]):
        assert not edge.any()
    assert divmod(grid.depot, grid.cols) == (grid.rows - 1, grid.cols // 2)
    assert walls.sum() % 16 == 0
    corners = walls & ~np.roll(walls, 1, 0) & ~np.roll(walls, 1, 1)
    shelves = np.argwhere(corners)
    assert len(shelves) == walls.sum() // 16 > 40
    for row, col in shelves:
        assert walls[row : row + 2, col : col + 8].all()
    thinner = make_grid("warehouse", gaps=0.3).walls
    assert not (thinner & ~walls).any()
    assert 0.55 < thinner.sum() / walls.sum() < 0.85


def test_names() -> None:
    """Bundled grids and generators are told apart; an unknown name lists both."""
    assert generator_names() == NAMES
    assert not set(NAMES) & set(grid_names())
    assert mapp_env.make_grid() == make_grid("paper-7x7")
    with pytest.raises(ValueError, match=r"paper-7x7.*maze.*random.*rooms.*warehouse.*'towers'"):
        make_grid("towers")


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("random", {"rows": 2049}, r"rows must be an integer in 2\.\.2048, got 2049"),
        ("random", {"cols": 1}, r"cols must be an integer in 2\.\.2048, got 1"),
        ("rooms", {"rows": 8.0}, r"rows must be an integer in 3\.\.2048, got 8\.0"),
        ("maze", {"cols": 2}, r"cols must be an integer in 3\.\.2048, got 2"),
        ("warehouse", {"rows": True}, r"rows must be an integer in 6\.\.2048, got True"),
        ("maze", {"seed": -1}, "seed must be an integer in 0"),
        ("maze", {"seed": None}, "seed must be an integer in 0"),
        ("random", {"density": 0.41}, r"density must be a number in 0\.\.0\.4, got 0\.41"),
        ("random", {"density": float("nan")}, "density must be a number .* got nan"),
        ("random", {"density": "0.2"}, "density must be a number .* got '0.2'"),
        ("random", {"density": 10**400}, r"density must be a number in 0\.\.0\.4"),
        ("random", {"density": True}, "density must be a number .* got True"),
        ("rooms", {"room": 1}, r"room must be an integer in 2\.\.1024, got 1"),
        ("maze", {"loops": -0.1}, r"loops must be a number in 0\.\.1, got -0\.1"),
        ("warehouse", {"gaps": 1.5}, r"gaps must be a number in 0\.\.1, got 1\.5"),
        ("warehouse", {"aisle": 0}, r"aisle must be an integer in 1\.\.8, got 0"),
        ("warehouse", {"shelf_length": 1}, "shelf_length must be an integer"),
        (
            "rooms",
            {"density": 0.2},
            r"make_grid\('rooms'\) takes rows, cols, seed, room; .*density",
        ),
        ("paper-7x7", {"rows": 7}, r"make_grid\('paper-7x7'\) takes no options; got 'rows'"),
    ],
)
def test_bad_arguments_are_refused(name: str, options: dict[str, object], message: str) -> None:
    """The message names the argument, the value and what is allowed."""
    with pytest.raises(ValueError, match=message):
        make_grid(name, **options)


def test_hopeless_density_is_refused() -> None:
    """Where no draw is connected, as on a long strip, the message says what to change."""
    for rows in (2, 40):
        with pytest.raises(ValueError, match="use a smaller density or another seed"):
            make_grid("random", rows=rows, cols=512, density=0.4)


ODD = {
    "maze": [
        {"rows": 3 + seed % 9, "cols": 3 + seed % 7, "loops": seed / 200, "seed": seed}
        for seed in range(200)
    ],
    "random": [
        {"rows": 2 + seed % 5, "cols": 2 + seed % 7, "density": seed % 41 / 100, "seed": seed}
        for seed in range(400)
    ],
    "rooms": [
        {"rows": 3 + seed % 19, "cols": 3 + seed % 23, "room": 2 + seed % 5, "seed": seed}
        for seed in range(200)
    ],
    "warehouse": [
        {
            "rows": 6 + seed % 13,
            "cols": 6 + seed % 17,
            "shelf_length": 2 + seed % 9,
            "aisle": 1 + seed % 8,
            "gaps": seed % 5 / 10,
            "seed": seed,
        }
        for seed in range(200)
    ],
}
"""Small grids, with options from one end to the other."""

ODD_DIGESTS = {
    "maze": "12fcf1ced4876561",
    "random": "690d923a73a9caab",
    "rooms": "41dc373c51459cc4",
    "warehouse": "f1cb54471dcad32b",
}


@pytest.mark.parametrize("name", NAMES)
def test_small_grids_of_all_options_are_pinned(name: str) -> None:
    """Also where there is hardly room, the same arguments give the same grid for ever."""
    texts = []
    for options in ODD[name]:
        try:
            texts.append(make_grid(name, **options).to_text())
        except ValueError as error:
            assert "use a smaller density or another seed" in str(error)  # noqa: PT017
            texts.append("refused")
    assert texts.count("refused") < len(texts) / 10
    found = hashlib.sha256("\n\n".join(texts).encode()).hexdigest()[:16]
    assert found == ODD_DIGESTS[name]


@pytest.mark.parametrize(("rows", "cols", "density"), [(7, 11, 0.1), (5, 5, 0.07), (10, 10, 0.036)])
def test_random_walls_are_the_nearest_number(rows: int, cols: int, density: float) -> None:
    """Walls are as many as come nearest to the density, or more where cells are cut off."""
    counts = [
        int(make_grid("random", rows=rows, cols=cols, density=density, seed=seed).walls.sum())
        for seed in range(20)
    ]
    assert min(counts) == round(density * rows * cols)


def test_the_smallest_grids_have_room_for_a_landmark() -> None:
    """However few cells are free, one besides the depot can be reached."""
    for rows, cols in ((2, 2), (2, 3), (3, 2)):
        for seed in range(60):
            grid = make_grid("random", rows=rows, cols=cols, density=0.4, seed=seed)
            assert_connected(grid)

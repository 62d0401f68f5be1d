"""Files of problems, plans and distances: what is written is read back, and nothing else."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import vrplib

import mapp_env
from mapp_env import FileError, Grid, Plan, Problem, make_grid, replay, solve
from mapp_env.commands import main
from mapp_env.files import (
    check_writable,
    parse_json,
    read_bytes,
    remove_unfinished,
    write_bytes,
    write_text,
)
from mapp_env.records import MAX_PLAN_BYTES, MAX_PROBLEM_BYTES
from mapp_env.rendering import compare_plans, save_animation
from mapp_env.solvers import save_vrplib
from mapp_env.solvers.solution import landmark_distances

# With claims at step 1 and on cell 0, which Python takes for True and False.
PROBLEM = Problem(make_grid(), (48, 0, 6, 25), 2, max_cycles=40)


def random_plan(rng: np.random.Generator) -> Plan:
    """Return a plan of a random problem, solved or only played."""
    walls = rng.random((rng.integers(2, 9), rng.integers(2, 9))) < 0.2
    walls[0, 0] = False
    walls[0, 1] = False
    grid = Grid(walls, 0)
    count = int(rng.integers(1, min(6, grid.reachable.size) + 1))
    landmarks = rng.choice(grid.reachable, count, replace=False).tolist()
    problem = Problem(grid, landmarks, int(rng.integers(1, 4)), [None, 7][rng.integers(2)])
    objective = mapp_env.plans.plan.OBJECTIVES[rng.integers(3)]
    if rng.integers(2):
        return solve(problem, objective)
    return replay(problem, rng.integers(0, 5, (rng.integers(30), problem.n_agents)), objective)


# -- there and back ------------------------------------------------------


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    """Problems and plans of all kinds come back equal, infinite costs included."""
    rng = np.random.default_rng(0)
    infinite = 0
    for _ in range(100):
        plan = random_plan(rng)
        plan.save(tmp_path / "plan.json")
        loaded = Plan.load(str(tmp_path / "plan.json"))
        assert loaded == plan
        assert loaded.seconds == plan.seconds
        assert loaded.problem == plan.problem
        infinite += not loaded.success
        assert isinstance(plan.problem, Problem)
        plan.problem.save(tmp_path / "problem.json")
        assert Problem.load(tmp_path / "problem.json") == plan.problem
    assert 5 < infinite < 60
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plan.json", "problem.json"]


def test_files_are_plain_json(tmp_path: Path) -> None:
    """Any JSON reader finds the grid as text, and null for a cost that is infinite."""
    replay(PROBLEM, [[0, 0]]).save(tmp_path / "plan.json")
    fields = json.loads((tmp_path / "plan.json").read_text("ascii"))
    assert fields["problem"]["grid"] == PROBLEM.grid.to_text()
    assert fields["cover_time"] is None
    assert (fields["format"], fields["version"]) == ("mapp_env plan", 2)


def test_the_largest_grid_fits(tmp_path: Path) -> None:
    """A problem on a 2048 x 2048 grid is within the caps."""
    grid = Grid(np.zeros((2048, 2048), bool))
    problem = Problem(grid, (0, 2048 * 2048 - 1), 1)
    problem.save(tmp_path / "problem.json")
    assert Problem.load(tmp_path / "problem.json") == problem
    plan = solve(problem)
    plan.save(tmp_path / "plan.json")
    assert Plan.load(tmp_path / "plan.json") == plan


def corridor_end() -> Problem:
    """Return a problem for 16 agents: dead ends off the far end of the longest corridor."""
    walls = np.zeros((512, 512), bool)
    walls[1::2] = True
    walls[1::4, -1] = walls[3::4, 0] = False
    walls[508:] = True
    walls[507:, :32:2] = False
    return Problem(Grid(walls, 0), range(511 * 512, 511 * 512 + 32, 2), 16)


def test_what_is_solved_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The plan of agents that walk 130,000 cells and back is printed, written alike, and read."""
    problem = corridor_end()
    problem.save(tmp_path / "problem.json")
    out = tmp_path / "plan.json"
    command = ["solve", "--problem", str(tmp_path / "problem.json"), "--json", "--out", str(out)]
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(out.read_text())
    plan = Plan.load(out)
    assert (plan.problem, plan.status) == (problem, "optimal")
    assert sum(map(len, plan.tours)) > 2_500_000


def to_and_fro(n_cells: int) -> Plan:
    """Return a plan with one tour of an odd number of cells."""
    problem = Problem(Grid.from_text("D...\n...."), (2,), 1)
    return replay(problem, [[1], [0]] * (n_cells // 2 - 2) + [[1], [1]])


def test_long_tours_are_kept_as_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Above a number of cells a file holds moves; both forms are read, whatever the length."""
    monkeypatch.setattr(mapp_env.plans.plan, "MAX_LISTED_CELLS", 9)
    path = tmp_path / "plan.json"
    for n_cells in (7, 9, 11, 13):
        plan = to_and_fro(n_cells)
        cells = list(plan.tours[0])
        moves = "10" * (n_cells // 2 - 2) + "1100"
        assert len(cells) == n_cells
        plan.save(path)
        fields = json.loads(path.read_text())
        assert fields["tours"] == [moves if n_cells > 9 else cells]
        for tour in (cells, moves):
            path.write_text(json.dumps({**fields, "tours": [tour]}))
            assert Plan.load(path) == plan


@pytest.mark.parametrize(
    "moves",
    ["", "1100", "101100 ", "1011004", "10110", "1011001", "110100", "131020", "1010101100",
     "1" * 100, "0" * 100, "3" * 100, "2" * 100],
)  # fmt: skip
def test_no_other_moves_are_read(moves: str, tmp_path: Path) -> None:
    """Moves that are not the tour's, leave the grid or are no moves at all are refused."""
    path = tmp_path / "plan.json"
    plan = to_and_fro(7)
    plan.save(path)
    fields = json.loads(path.read_text())
    path.write_text(json.dumps({**fields, "tours": ["101100"]}))
    assert Plan.load(path) == plan
    path.write_text(json.dumps({**fields, "tours": [moves]}))
    with pytest.raises(FileError, match=r"plan\.json: "):
        Plan.load(path)


def test_tours_are_all_of_one_form(tmp_path: Path) -> None:
    """A list of cells beside a string of moves is refused."""
    path = tmp_path / "plan.json"
    replay(Problem(Grid.from_text("D...\n...."), (2, 4), 2), [[1, 3], [1, 1]]).save(path)
    fields = json.loads(path.read_text())
    assert fields["tours"] == [[0, 1, 2, 1, 0], [0, 4, 0]]
    path.write_text(json.dumps({**fields, "tours": ["1100", "32"]}))
    Plan.load(path)
    for tours in (["1100", [0, 4, 0]], [[0, 1, 2, 1, 0], "32"], ["1100"], ["1100", "32", ""]):
        path.write_text(json.dumps({**fields, "tours": tours}))
        with pytest.raises(FileError, match="field 'tours"):
            Plan.load(path)


def test_no_file_is_longer_than_an_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan of as many steps as an episode may have is kept; of one more, not written or read."""
    assert mapp_env.plans.plan.MAX_CYCLES == 1_000_000
    monkeypatch.setattr(mapp_env.plans.plan, "MAX_CYCLES", 6)
    path = tmp_path / "plan.json"
    problem = Problem(Grid.from_text("D."), (1,), 1)
    plan = replay(problem, [[4]] * 6)
    plan.save(path)
    assert Plan.load(path) == plan
    text = path.read_text()
    with pytest.raises(FileError, match="has 7 steps, a file holds 6"):
        replay(problem, [[4]] * 7).save(path)
    assert path.read_text() == text
    path.write_text(text.replace('["444444"]', '["4444444"]'))
    with pytest.raises(FileError, match="'actions' must be of at most 6 steps, got 7"):
        Plan.load(path)


# -- what strangers may send ---------------------------------------------


def fields_of(kind: str, folder: Path) -> dict[str, Any]:
    """Return the fields of a good file of a kind."""
    path = folder / "good.json"
    if kind == "plan":
        solve(PROBLEM).save(path)
    else:
        PROBLEM.save(path)
    fields: dict[str, Any] = json.loads(path.read_text())
    return fields


def load(kind: str, path: Path) -> object:
    """Load a file as what it should be."""
    return Plan.load(path) if kind == "plan" else Problem.load(path)


def leaves(value: object, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the path to every value inside a JSON value, containers included."""
    found = [path] if path else []
    if isinstance(value, dict):
        for key, item in value.items():
            found += leaves(item, (*path, key))
    if isinstance(value, list):
        for index, item in enumerate(value):
            found += leaves(item, (*path, index))
    return found


def changed(value: Any, path: tuple[Any, ...], new: str) -> str:
    """Return JSON text with the value at ``path`` replaced by the text ``new``."""
    copy = json.loads(json.dumps(value))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = "@@"
    return json.dumps(copy).replace('"@@"', new)


WRONG_VALUES = (
    "true", "false", "NaN", "Infinity", "-Infinity", "1e999", "-1", "1.5", "0.0", '""', '"x"',
    "[]", "{}", "9007199254740993", "[[[[]]]]", '{"a": 1}', "99999999999999999999999999",
)  # fmt: skip


@pytest.mark.parametrize("kind", ["problem", "plan"])
def test_no_value_can_be_replaced(kind: str, tmp_path: Path) -> None:
    """Whatever value of a file is replaced by a strange one, the file is refused.

    But for two that say nothing about the plan: its time and its solver's name.
    """
    fields = fields_of(kind, tmp_path)
    path = tmp_path / "bad.json"
    refused = 0
    for place in leaves(fields):
        inner = fields
        for key in place:
            inner = inner[key]
        for value in WRONG_VALUES:
            if place == ("seconds",) and value in ("1.5", "0.0"):
                continue
            if place == ("solver",) and value in ('""', '"x"'):
                continue
            if json.dumps(inner) == value:
                continue
            path.write_text(changed(fields, place, value))
            with pytest.raises(FileError, match=r"bad\.json"):
                load(kind, path)
            refused += 1
    assert refused > 100


@pytest.mark.parametrize("kind", ["problem", "plan"])
def test_fields_are_exactly_these(kind: str, tmp_path: Path) -> None:
    """A missing field, an unknown one and one that comes twice are refused, inner ones too."""
    fields = fields_of(kind, tmp_path)
    path = tmp_path / "bad.json"
    for place in leaves(fields):
        if not isinstance(place[-1], str):
            continue
        copy = json.loads(json.dumps(fields))
        inner = copy
        for key in place[:-1]:
            inner = inner[key]
        value = inner.pop(place[-1])
        path.write_text(json.dumps(copy))
        with pytest.raises(FileError, match="lacks the field"):
            load(kind, path)
        inner[place[-1]] = value
        inner["@@"] = value
        path.write_text(json.dumps(copy).replace("@@", str(place[-1])))
        with pytest.raises(FileError, match="same key twice"):
            load(kind, path)
        path.write_text(json.dumps(copy))
        with pytest.raises(FileError, match="unknown field '@@'"):
            load(kind, path)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity", "1e999", "-1e400"])
def test_json_has_no_such_numbers(value: str, tmp_path: Path) -> None:
    """What is no finite number is refused as no JSON, before any field is looked at."""
    (tmp_path / "bad.json").write_text(f'{{"x": [{value}]}}')
    with pytest.raises(FileError, match="is not strict JSON"):
        Plan.load(tmp_path / "bad.json")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        '{"a": 1, "a": 1}',
        "[NaN]",
        "[-Infinity]",
        "1e999",
        "[" * 100_000,
        "\ufeff{}",
        "{} 1",
    ],
)
def test_strict_json_is_refused_as_the_caller_says(text: str) -> None:
    """Whatever is wrong is an error of the type asked for that names the place."""

    class OwnError(ValueError):
        pass

    for data in (text, text.encode()):
        with pytest.raises(OwnError, match=r"^some place: "):
            parse_json(data, "some place", OwnError)
    with pytest.raises(OwnError, match=r"^some place: is not strict JSON"):
        parse_json(b'"\xff"', "some place", OwnError)
    assert parse_json('{"a": [1, 2.5, null]}', "some place") == {"a": [1, 2.5, None]}


HOSTILE: dict[str, bytes] = {
    "nothing": b"",
    "blank": b"   ",
    "a list": b"[]",
    "null": b"null",
    "a number": b"1",
    "cut off": b'{"format": "mapp_env plan", "version": 1',
    "two objects": b"{} {}",
    "not UTF-8": b"\xff\xfe{}",
    "byte order mark": b"\xef\xbb\xbf{}",
    "zeros": bytes(1000),
    "deep list": b"[" * 500_000,
    "deep object": b'{"a":' * 200_000,
    "deep and closed": b'{"format": ' + b"[" * 900 + b"]" * 900 + b"}",
    "deeper and closed": b'{"format": ' + b"[" * 100_000 + b"]" * 100_000 + b"}",
    "huge number": b'{"format": ' + b"9" * 500_000 + b"}",
    "comment": b'{"format": "mapp_env plan" /* 1 */}',
    "other kind": b'{"format": "mapp_env tour", "version": 1}',
    "no version": b'{"format": "mapp_env plan"}',
    "later version": b'{"format": "mapp_env plan", "version": 3}',
    "lone surrogate": b'{"format": "\\ud800"}',
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("kind", ["problem", "plan"])
def test_hostile_files_are_refused(kind: str, name: str, tmp_path: Path) -> None:
    """Each is a FileError that names the path."""
    path = tmp_path / "hostile.json"
    path.write_bytes(HOSTILE[name])
    with pytest.raises(FileError, match=r"hostile\.json") as caught:
        load(kind, path)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("part", ["[],", "{},", '"",', '{"a":1},', "[" * 400 + "]" * 400 + ","])
@pytest.mark.parametrize("kind", ["problem", "plan"])
def test_files_of_many_parts_are_refused(kind: str, part: str, tmp_path: Path) -> None:
    """What no file of a kind holds, millions of lists, objects or strings, is not even parsed."""
    path = tmp_path / "hostile.json"
    path.write_text(f'{{"format": "mapp_env {kind}", "x": [{part * 1000}0]}}')
    with pytest.raises(FileError, match="has more than 1000 brackets, colons and quotes"):
        load(kind, path)


@pytest.mark.parametrize("kind", ["problem", "plan"])
def test_odd_files_are_refused(kind: str, tmp_path: Path) -> None:
    """A pipe, a folder, a device, a missing and a huge file are refused."""
    os.mkfifo(tmp_path / "pipe")
    with open(tmp_path / "huge", "wb") as file:
        file.truncate(1 << 34)
    cap = MAX_PLAN_BYTES if kind == "plan" else MAX_PROBLEM_BYTES
    (tmp_path / "large").write_bytes(b" " * (cap + 1))
    names = ["pipe", "huge", "large", "missing", "", "nul\0byte", "/dev/zero"]
    for name in names:
        with pytest.raises(FileError):
            load(kind, tmp_path / name)
    with pytest.raises(FileError, match="path must be"):
        load(kind, 3)  # type: ignore[arg-type]


@pytest.mark.parametrize(("kind", "limit"), [("problem", 8 << 20), ("plan", 24 << 20)])
def test_files_have_a_size(kind: str, limit: int, tmp_path: Path) -> None:
    """A file of exactly eight mebibytes, or 24 for a plan, is read; one of a byte more is not."""
    fields = fields_of(kind, tmp_path)
    path = tmp_path / "large.json"
    path.write_text(json.dumps(fields).ljust(limit))
    load(kind, path)
    path.write_text(json.dumps(fields).ljust(limit + 1))
    with pytest.raises(FileError, match=rf"has {limit + 1} bytes, a {kind} file may have {limit}"):
        load(kind, path)


@pytest.mark.parametrize("kind", ["problem", "plan"])
def test_a_byte_order_mark_is_named(kind: str, tmp_path: Path) -> None:
    """A good file is refused below a byte order mark, which JSON has not; the message says so."""
    fields = fields_of(kind, tmp_path)
    (tmp_path / "bad.json").write_text(json.dumps(fields), encoding="utf-8-sig")
    with pytest.raises(FileError, match=r"bad\.json: is not strict JSON: Unexpected UTF-8 BOM"):
        load(kind, tmp_path / "bad.json")


def test_numbers_are_those_that_every_reader_keeps(tmp_path: Path) -> None:
    """The largest number is 2**53 - 1, where no rule of the plan forbids it."""
    path = tmp_path / "plan.json"
    plan = dataclasses.replace(replay(PROBLEM, [[0, 0]]), bound=2**53 - 1, seconds=2**53 - 1)
    plan.save(path)
    assert Plan.load(path).bound == 2**53 - 1
    fields = json.loads(path.read_text())
    for name in ("bound", "seconds"):
        path.write_text(json.dumps({**fields, name: 2**53}))
        with pytest.raises(FileError, match=rf"'{name}' must be .* in 0\.\.9007199254740991"):
            Plan.load(path)


def test_a_file_says_what_it_is(tmp_path: Path) -> None:
    """A problem is not read as a plan, nor the other way round."""
    solve(PROBLEM).save(tmp_path / "plan.json")
    PROBLEM.save(tmp_path / "problem.json")
    with pytest.raises(FileError, match="'format' must be one of mapp_env problem"):
        Problem.load(tmp_path / "plan.json")
    with pytest.raises(FileError, match="'format' must be one of mapp_env plan"):
        Plan.load(tmp_path / "problem.json")


def test_flipped_bytes_never_crash(tmp_path: Path) -> None:
    """Whatever bytes are flipped, a file loads to a plan that verifies, or raises FileError."""
    solve(PROBLEM).save(tmp_path / "plan.json")
    good = (tmp_path / "plan.json").read_bytes()
    rng = np.random.default_rng(3)
    path = tmp_path / "flipped.json"
    refused = 0
    for _ in range(1500):
        data = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            data[rng.integers(len(data))] = rng.choice(
                [*b'0123456789"{}[],:-.eE ', rng.integers(256)]
            )
        path.write_bytes(data)
        try:
            plan = Plan.load(path)
        except FileError:
            refused += 1
        else:
            plan.verify()
    assert refused > 1000


def test_a_file_that_cannot_be_read_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If a regular file opens but reading fails, the message still names it."""
    path = tmp_path / "problem.json"
    PROBLEM.save(path)

    class Broken(io.BytesIO):
        def read(self, *_: object) -> bytes:
            raise OSError("bad disk")

    monkeypatch.setattr(os, "fdopen", lambda *_, **__: Broken())
    with pytest.raises(FileError, match=r"problem\.json: cannot be read: bad disk"):
        Problem.load(path)


def test_a_file_that_grows_is_refused() -> None:
    """A file that turns out to hold more than it said is refused, not cut.

    Linux says of its own that they are empty.
    """
    path = "/proc/self/status"
    if not os.path.isfile(path) or os.stat(path).st_size > 0:
        pytest.skip("needs Linux")
    assert len(read_bytes(path, 1 << 20, "a file", FileError)) > 100
    with pytest.raises(FileError, match="has more than 100 bytes, which a file may have"):
        read_bytes(path, 100, "a file", FileError)


def test_a_tampered_plan_is_refused(tmp_path: Path) -> None:
    """A file that states a better cost than its actions give is refused."""
    fields = fields_of("plan", tmp_path)
    path = tmp_path / "bad.json"
    for name in ("cover_time", "makespan", "total_distance", "bound"):
        path.write_text(json.dumps({**fields, name: fields[name] - 1}))
        with pytest.raises(FileError, match=r"bad\.json: plan: "):
            Plan.load(path)


# -- writing -------------------------------------------------------------


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If writing fails at any stage, the file before it is whole and nothing else is left."""
    path = tmp_path / "problem.json"
    PROBLEM.save(path)
    before = path.read_bytes()

    def broken(*_: object) -> None:
        raise OSError("no room")

    for name in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, broken)
            with pytest.raises(FileError, match="no room"):
                Problem(make_grid(), (0,)).save(path)
        assert path.read_bytes() == before
        assert list(tmp_path.iterdir()) == [path]


def test_only_regular_files_are_replaced(tmp_path: Path) -> None:
    """A folder or a pipe is not replaced, a link keeps its place, a missing folder is named."""
    os.mkfifo(tmp_path / "pipe")
    for target in (tmp_path, tmp_path / "pipe", tmp_path / "missing" / "problem.json"):
        with pytest.raises(FileError):
            PROBLEM.save(target)
    (tmp_path / "link").symlink_to(tmp_path / "problem.json")
    PROBLEM.save(tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert Problem.load(tmp_path / "problem.json") == PROBLEM
    with pytest.raises(FileError, match="path must be"):
        PROBLEM.save(3)  # type: ignore[arg-type]
    with pytest.raises(FileError, match="allowed are 3"):
        write_text(tmp_path / "text", "four", 3)
    assert not (tmp_path / "text").exists()


def draw(path: Path) -> None:
    """Draw a plan as a figure."""
    compare_plans(PROBLEM, {"optimum": solve(PROBLEM)}, path)


WRITERS: dict[str, Callable[[Path], object]] = {
    "problem.json": PROBLEM.save,
    "plan.json": lambda path: solve(PROBLEM).save(path),
    "problem.vrp": lambda path: save_vrplib(PROBLEM, path),
    "routes.png": draw,
    "episode.gif": lambda path: save_animation(path, PROBLEM, [[0, 1]]),
}


@contextlib.contextmanager
def file_mode_mask(mask: int) -> Iterator[None]:
    """Set the mask of new files' modes for a while."""
    before = os.umask(mask)
    try:
        yield
    finally:
        os.umask(before)


@contextlib.contextmanager
def ordinary_user() -> Iterator[Path]:
    """Give a folder to an ordinary user, and be one for a while: root may do everything."""
    root = os.getuid() == 0
    with tempfile.TemporaryDirectory() as folder:
        if root:
            os.chown(folder, 65534, 65534)
            os.setresuid(65534, 65534, 0)
        try:
            yield Path(folder)
        finally:
            if root:
                os.setresuid(0, 0, 0)


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_keeps_its_mode(name: str, tmp_path: Path) -> None:
    """A new file has the mode that the user's mask leaves, one that was there keeps its own."""
    path = tmp_path / name
    for mask in (0o077, 0o002):
        with file_mode_mask(mask):
            WRITERS[name](path)
        assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask
        path.unlink()
    for mode in (0o600, 0o664, 0o200):
        path.write_text("before")
        path.chmod(mode)
        with file_mode_mask(0o022):
            WRITERS[name](path)
        assert stat.S_IMODE(path.stat().st_mode) == mode
        assert path.stat().st_size > 10
        path.unlink()


@pytest.mark.parametrize("name", WRITERS)
def test_what_may_not_be_written_is_refused(name: str, tmp_path: Path) -> None:
    """A file that its owner may not write stays as it is, whoever asks."""
    path = tmp_path / name
    path.write_text("before")
    path.chmod(0o444)
    with pytest.raises(FileError, match=rf"{name}\W*: is there and may not be written: .* 0444"):
        WRITERS[name](path)
    assert path.read_text() == "before"
    assert stat.S_IMODE(path.stat().st_mode) == 0o444
    assert list(tmp_path.iterdir()) == [path]


def test_what_others_may_not_read_is_never_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor is the file that takes the place of one of mode 600, at any moment of its making."""
    path = tmp_path / "problem.json"
    path.write_text("before")
    path.chmod(0o600)
    modes = []

    def look(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            result = function(*arguments, **options)
            modes.extend(stat.S_IMODE(item.stat().st_mode) for item in tmp_path.iterdir())
            return result

        return call

    with file_mode_mask(0o000), monkeypatch.context() as patch:
        for call in ("open", "chown", "chmod", "fsync", "replace"):
            patch.setattr(os, call, look(getattr(os, call)))
        PROBLEM.save(path)
    assert len(modes) > 8
    assert set(modes) == {0o600}


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
def test_a_file_keeps_its_owner(tmp_path: Path) -> None:
    """What root writes in the place of a user's file is still that user's."""
    path = tmp_path / "problem.json"
    path.write_text("before")
    os.chown(path, 65534, 65533)
    path.chmod(0o640)
    PROBLEM.save(path)
    status = path.stat()
    assert (status.st_uid, status.st_gid, stat.S_IMODE(status.st_mode)) == (65534, 65533, 0o640)


def test_a_folder_that_cannot_be_read_is_written_into() -> None:
    """In a drop box, where one may put files and not look, a file is written and replaced."""
    with ordinary_user() as folder:
        drop = folder / "drop"
        drop.mkdir()
        drop.chmod(0o333)
        for problem in (Problem(make_grid(), (0,)), PROBLEM):
            problem.save(drop / "problem.json")
            assert Problem.load(drop / "problem.json") == problem
        drop.chmod(0o777)
        assert [path.name for path in drop.iterdir()] == ["problem.json"]


def test_a_folder_that_cannot_be_synced_is_written_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a folder cannot be forced to the disk, as on some shares, a file is written."""
    fsync = os.fsync

    def of_files(handle: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(22, "Invalid argument")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", of_files)
    for _ in range(2):
        PROBLEM.save(tmp_path / "problem.json")
    assert Problem.load(tmp_path / "problem.json") == PROBLEM


def test_a_file_and_its_name_are_forced_to_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The content before it takes its name, then the folder: no crash of a machine undoes it."""
    path = tmp_path / "problem.json"
    synced = []
    fsync = os.fsync

    def watch(handle: int) -> None:
        size = os.fstat(handle).st_size
        synced.append("folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else (size, path.exists()))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", watch)
    PROBLEM.save(path)
    assert synced == [(path.stat().st_size, False), "folder"]


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs Linux")
def test_a_stream_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What /dev/stdout leads to, a log or a pipe, is refused by name and stays what it is."""
    log = tmp_path / "log.txt"
    log.write_text("years of work\n")
    reader, writer = os.pipe()
    with log.open("a") as stream, open(writer, "w") as pipe:
        (tmp_path / "first").symlink_to(f"/dev/fd/{stream.fileno()}")
        (tmp_path / "out").symlink_to("first")
        paths = [f"/proc/self/fd/{handle.fileno()}" for handle in (stream, pipe)]
        paths += [f"/dev/fd/{handle.fileno()}" for handle in (stream, pipe)]
        for path in (*paths, str(tmp_path / "out"), "/dev/null"):
            with pytest.raises(FileError, match=rf"{path}\W*: is there and not a regular file"):
                PROBLEM.save(path)
            with pytest.raises(FileError, match="not a regular file"):
                check_writable(path)
            if path != "/dev/null":
                assert main(["solve", "--landmarks", "0", "--out", path]) == 2
                assert "--out" in capsys.readouterr().err
    os.close(reader)
    assert log.read_text() == "years of work\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["first", "log.txt", "out"]


def test_links_are_followed(tmp_path: Path) -> None:
    """A chain of links leads to a file, or to where one comes to be; one in a circle is refused."""
    (tmp_path / "far").mkdir()
    (tmp_path / "there").symlink_to("far")
    (tmp_path / "far" / "next").symlink_to("../there/problem.json")
    (tmp_path / "link").symlink_to(tmp_path / "far" / "next")
    for _ in range(2):
        PROBLEM.save(tmp_path / "link")
        assert not (tmp_path / "far" / "problem.json").is_symlink()
        assert Problem.load(tmp_path / "far" / "problem.json") == PROBLEM
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "far" / "next").is_symlink()
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    with pytest.raises(FileError, match=r"cannot be written: .*symbolic links"):
        PROBLEM.save(tmp_path / "a")
    assert (tmp_path / "a").is_symlink()
    os.link(tmp_path / "far" / "problem.json", tmp_path / "kept.json")
    Problem(make_grid(), (0,)).save(tmp_path / "link")
    assert Problem.load(tmp_path / "kept.json") == PROBLEM


def test_only_what_writers_left_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a writer that was killed has left goes; whatever else there is stays."""
    foreign = (".problem.tmp", ".0123456789abcdef.tmp.txt", "0123456789abcdef.tmp", ".lock")
    for name in foreign:
        (tmp_path / name).write_text("mine")
    (tmp_path / ".fedcba9876543210.tmp").mkdir()
    (tmp_path / ".0123456789abcdef.tmp").symlink_to("elsewhere")
    before = sorted(tmp_path.iterdir())

    def killed(*_: object) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", killed)
        patch.setattr(os, "unlink", killed)
        with pytest.raises(SystemExit):
            write_bytes(tmp_path / "problem.json", b"half", 10)
    assert len(list(tmp_path.iterdir())) == len(before) + 1
    remove_unfinished(tmp_path)
    assert sorted(tmp_path.iterdir()) == before


def test_a_broken_plan_is_not_saved(tmp_path: Path) -> None:
    """What would not load is not written."""
    by_hand = Plan(((24, 25, 24), ()), ((25,), ()), 1, 2, 3, problem=Problem(make_grid(), (25,), 2))
    with pytest.raises(ValueError, match="total_distance is stated as 3"):
        by_hand.save(tmp_path / "plan.json")
    assert list(tmp_path.iterdir()) == []


def test_a_plan_by_hand_is_saved_as_played(tmp_path: Path) -> None:
    """Without actions, and with NumPy's integers, a plan is saved; it loads with its actions."""
    tours = (tuple(np.array([24, 25, 24])), ())
    by_hand = Plan(
        tours, ((np.int64(25),), ()), 1, 2, 2, problem=Problem(make_grid(), (25,), 2), bound=1
    )
    by_hand.save(tmp_path / "plan.json")
    loaded = Plan.load(tmp_path / "plan.json")
    assert (loaded.tours, loaded.claims, loaded.bound) == (by_hand.tours, by_hand.claims, 1)
    assert loaded.claim_steps == ((1,), ())
    assert replay(by_hand.problem, loaded.joint_actions()).tours == tours


# -- distances for other solvers -----------------------------------------


def test_vrplib_is_read_by_an_independent_reader(tmp_path: Path) -> None:
    """The vrplib package reads the matrix, the demands and the depot that were written."""
    rng = np.random.default_rng(4)
    for n_landmarks in (1, 2, 17, 256):
        walls = rng.random((20, 30)) < 0.2
        walls[10, 15] = False
        grid = Grid(walls, (10, 15))
        landmarks = rng.choice(grid.reachable, n_landmarks, replace=False).tolist()
        problem = Problem(grid, landmarks, 4)
        save_vrplib(problem, tmp_path / "problem.vrp")
        instance = vrplib.read_instance(tmp_path / "problem.vrp")
        expected = landmark_distances(problem)
        np.testing.assert_array_equal(instance["edge_weight"], expected)
        cells = [grid.depot, *landmarks]
        np.testing.assert_array_equal(expected, grid.distances[np.ix_(cells, cells)])
        assert instance["edge_weight_type"] == "EXPLICIT"
        assert instance["edge_weight_format"] == "FULL_MATRIX"
        assert instance["dimension"] == n_landmarks + 1
        assert instance["vehicles"] == 4
        assert instance["demand"].tolist() == [0] + [1] * n_landmarks
        assert instance["depot"].tolist() == [0]


def test_vrplib_fields_survive_a_reader_that_knows_tsplib_alone(tmp_path: Path) -> None:
    """Where an unknown line is more of the field above, as for tsplib95, only the comment grows."""
    save_vrplib(PROBLEM, tmp_path / "problem.vrp")
    text = (tmp_path / "problem.vrp").read_text()
    known = "NAME|COMMENT|TYPE|DIMENSION|CAPACITY|EDGE_WEIGHT_TYPE|EDGE_WEIGHT_FORMAT"
    fields = dict(
        re.findall(rf"^({known}) : (.*?)\n(?=(?:{known}) :|\w+_SECTION)", text, re.M | re.S)
    )
    assert fields.pop("COMMENT").endswith("\nVEHICLES : 2")
    assert fields == {
        "NAME": "mapp_env",
        "TYPE": "CVRP",
        "DIMENSION": "5",
        "CAPACITY": "4",
        "EDGE_WEIGHT_TYPE": "EXPLICIT",
        "EDGE_WEIGHT_FORMAT": "FULL_MATRIX",
    }


@pytest.mark.parametrize("n_agents", [1, 3])
def test_a_vehicle_has_room_for_all(tmp_path: Path, n_agents: int) -> None:
    """In VRPLIB's format no capacity keeps one vehicle from visiting every landmark."""
    problem = Problem(make_grid(), (0, 6, 20, 42, 48), n_agents)
    mapp_env.solvers.save_vrplib(problem, tmp_path / "a.vrp")
    lines = (tmp_path / "a.vrp").read_text().splitlines()
    (capacity,) = (int(line.split(":")[1]) for line in lines if line.startswith("CAPACITY"))
    start, end = lines.index("DEMAND_SECTION"), lines.index("DEPOT_SECTION")
    demands = [int(line.split()[1]) for line in lines[start + 1 : end]]
    assert demands == [0, 1, 1, 1, 1, 1]
    assert capacity >= sum(demands)


def test_no_file_is_written_that_is_too_large_to_be_read(tmp_path: Path) -> None:
    """Exactly as many bytes as may be read are written; of one more nothing is, by name."""
    target = tmp_path / "a.txt"
    write_text(target, "x" * 100, 100)
    assert target.stat().st_size == 100
    for text in ("y" * 101, "é" * 51):
        with pytest.raises(FileError, match=r"a\.txt: would have 10[12] bytes, allowed are 100"):
            write_text(target, text, 100)
        assert target.read_text() == "x" * 100

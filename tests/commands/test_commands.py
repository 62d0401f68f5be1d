"""The commands solve, universe and info; policies and problem files in all of them."""

from __future__ import annotations

import importlib
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import types
from collections import Counter
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mapp_env
from mapp_env import compiled
from mapp_env.commands import info, main, solve, universe
from mapp_env.plans import replay
from mapp_env.solvers import exact

REPOSITORY = Path(__file__).resolve().parents[2]
LANDMARKS = (0, 6, 20, 42, 48)
CELLS = [str(cell) for cell in LANDMARKS]
PROBLEM = mapp_env.Problem(mapp_env.make_grid(), LANDMARKS)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder that the test runs in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return what a command prints."""
    assert main(list(words)) == 0
    return capsys.readouterr().out


def record(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    """Return the one JSON object that a command prints."""
    return json.loads(printed(capsys, *words, "--json"))


# -- solve -------------------------------------------------------------------------------------


@pytest.mark.parametrize("objective", ["cover_time", "makespan", "total_distance"])
def test_solve_prints_the_optimum(capsys: pytest.CaptureFixture[str], objective: str) -> None:
    """Costs, proof and every agent's tour are those of the function solve."""
    lines = printed(capsys, "solve", "--landmarks", *CELLS, "--objective", objective).splitlines()
    plan = mapp_env.solve(PROBLEM, objective)
    words = objective.replace("_", " ")
    assert lines[0] == (
        f"cover time {plan.cover_time}, makespan {plan.makespan}, total distance "
        f"{plan.total_distance}; the {words} is proven optimal"
    )
    tours = [" ".join(map(str, tour)) or "stays at the depot" for tour in plan.tours]
    assert lines[1] == f"landmarks: {' '.join(CELLS)}"
    assert lines[2:5] == [f"agent {agent}: {tour}" for agent, tour in enumerate(tours)]
    assert re.fullmatch(r"by exact in \d+\.\d ms", lines[5])


def test_solve_from_any_starts(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Starts are cells or rows and columns, are printed, and set the number of agents."""
    problem = mapp_env.Problem(mapp_env.make_grid(), (0, 48), 3, starts=(3, 47, 24))
    plan = mapp_env.solve(problem)
    line = ["solve", "--landmarks", "0", "48", "--starts", "0,3", "47", "24"]
    lines = printed(capsys, *line).splitlines()
    assert lines[1:3] == ["landmarks: 0 48", "starts: 3 47 24"]
    assert lines[3] == f"agent 0: {' '.join(map(str, plan.tours[0]))}"
    assert lines[4] == f"agent 1: {' '.join(map(str, plan.tours[1]))}"
    assert lines[5] == "agent 2: stays at the depot"
    found = record(capsys, *line, "--out", "plan.json", "--picture", "a.png")
    assert found["problem"]["starts"] == [3, 47, 24]
    assert mapp_env.Plan.load("plan.json") == plan
    drawn = record(capsys, "render", "--out", "a.gif", "--plan", "plan.json")
    assert drawn["starts"] == [3, 47, 24]
    lines = printed(capsys, "solve", "--landmarks", "0", "--starts", "1", "48").splitlines()
    assert lines[4] == "agent 1: stays at its start"
    assert {path.name for path in folder.iterdir()} == {"plan.json", "a.png", "a.gif"}


def test_drawn_landmarks_are_no_starts(capsys: pytest.CaptureFixture[str]) -> None:
    """Landmarks drawn beside starts are none of them, are seeded, and fill all room there is."""
    line = ["solve", "--starts", "0", "1,4", "24", "--n-landmarks", "12", "--time-limit", "0.01"]
    drawn = []
    for seed in range(20):
        found = record(capsys, *line, "--seed", str(seed))
        drawn.append(found["problem"]["landmarks"])
        assert len(set(drawn[-1]) - {0, 11, 24}) == 12
    assert len(set(map(tuple, drawn))) == 20
    assert record(capsys, *line, "--seed", "3")["problem"]["landmarks"] == drawn[3]
    room = mapp_env.make_grid().reachable.size - 2
    found = record(capsys, *line, "--n-landmarks", str(room))
    assert len(found["problem"]["landmarks"]) == room


def test_solve_writes_what_it_prints(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The plan file is the JSON object printed, and loads as the plan; the picture is there."""
    options = ["--landmarks", *CELLS, "--out", "plan.json", "--picture", "a.gif"]
    found = record(capsys, "solve", *options)
    written = json.loads((folder / "plan.json").read_text())
    assert written == found
    plan = mapp_env.Plan.load("plan.json")
    assert plan == mapp_env.solve(PROBLEM)
    with Image.open("a.gif") as image:
        assert image.n_frames == plan.cover_time + 1


@pytest.mark.parametrize("picture", ["a.gif", "a.png"])
def test_each_thing_is_done_once(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, picture: str
) -> None:
    """However a plan is printed, written and drawn, it is found once and played once."""
    done: Counter[str] = Counter()

    def counted(module: types.ModuleType, name: str) -> None:
        real = getattr(module, name)

        def count(*arguments: object) -> object:
            done[name] += 1
            return real(*arguments)

        monkeypatch.setattr(module, name, count)

    mapp_env.replay(PROBLEM, [[0, 0, 0]])  # the last episode, which is kept, is another one
    counted(exact, "route_tables")
    counted(replay, "play_row")
    options = ["--landmarks", *CELLS, "--out", "plan.json", "--picture", picture]
    assert record(capsys, "solve", *options)["cover_time"] == 12
    assert done == {"route_tables": 1, "play_row": 1}
    assert mapp_env.Plan.load("plan.json").cost == 12


def test_a_plan_too_long_for_a_file_is_printed(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What no file holds is printed all the same, and refused where a file or JSON is asked for."""
    monkeypatch.setattr("mapp_env.plans.plan.MAX_CYCLES", 5)  # in place of a million steps
    assert "cover time 12" in printed(capsys, "solve", "--landmarks", *CELLS)
    for words in (("--json",), ("--out", "plan.json")):
        assert main(["solve", "--landmarks", *CELLS, *words]) == 2
        assert "12 steps, a file holds 5" in capsys.readouterr().err
    assert not (folder / "plan.json").exists()


def test_a_problem_file_is_a_problem(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A saved problem, with agents and a grid of its own, is solved and drawn as it is."""
    grid = mapp_env.make_grid("rooms", rows=9, cols=11, seed=1)
    problem = mapp_env.Problem(grid, grid.reachable[[2, 30]].tolist(), 1)
    problem.save("problem.json")
    cost = mapp_env.solve(problem).cost
    assert record(capsys, "solve", "--problem", "problem.json")["cover_time"] == cost
    drawn = record(capsys, "render", "--problem", "problem.json", "--out", "a.gif")
    assert (drawn["cover_time"], drawn["status"]) == (cost, "optimal")
    assert drawn["bytes"] == (folder / "a.gif").stat().st_size


def test_a_map_files_depot_is_chosen(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """--depot puts the depot of a map file somewhere else; grids that bring one refuse it."""
    (folder / "yard.txt").write_text("..#\n..#\n...\n", encoding="ascii")
    options = ["solve", "--grid", "yard.txt", "--landmarks", "8", "--n-agents", "1"]
    far = record(capsys, *options, "--depot", "0,0")
    assert (far["cover_time"], far["tours"][0][0]) == (4, 0)
    assert record(capsys, *options, "--depot", "7")["cover_time"] == 1
    assert main(["solve", "--depot", "0"]) == 2
    assert "--depot is for map files, not for 'paper-7x7'" in capsys.readouterr().err


def test_a_search_says_what_is_not_proven(capsys: pytest.CaptureFixture[str]) -> None:
    """Beyond exact sizes, and where it is asked for, the solver and the bound are named."""
    options = ["--grid", "warehouse", "--n-landmarks", "40", "--time-limit", "0.2"]
    found = record(capsys, "solve", *options)
    assert found["solver"] == "search"
    assert found["bound"] <= found["cover_time"]
    assert (
        record(capsys, "solve", "--landmarks", *CELLS, "--method", "search")["solver"] == "search"
    )


# -- universe ----------------------------------------------------------------------------------


def test_universe_counts_every_problem(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The histogram of a small grid is that of solving each of its problems by itself."""
    (folder / "map.txt").write_text("...\nD#.\n...\n", encoding="ascii")
    grid = mapp_env.Grid.load("map.txt")
    options = ["--grid", "map.txt", "--n-landmarks", "3", "--n-agents", "2"]
    found = record(capsys, "universe", *options)
    sets = list(itertools.combinations(grid.reachable.tolist(), 3))
    assert found["n_problems"] == len(sets)
    for objective in ("cover_time", "makespan", "total_distance"):
        costs = [
            int(mapp_env.solve(mapp_env.Problem(grid, cells, 2), objective).cost) for cells in sets
        ]
        about = found["objectives"][objective]
        assert about["histogram"] == {str(cost): n for cost, n in sorted(Counter(costs).items())}
        assert (about["min"], about["max"]) == (min(costs), max(costs))
        assert about["mean"] == pytest.approx(np.mean(costs))
        assert costs[sets.index(tuple(about["hardest"]))] == max(costs)


def test_universe_draws_its_histogram(capsys: pytest.CaptureFixture[str]) -> None:
    """For people: shares that add up to all, and a bar as long as the count of the commonest."""
    text = printed(capsys, "universe", "--n-landmarks", "2", "--objective", "cover_time")
    assert text.startswith("780 problems of 2 landmarks and 3 agents on 7x7 cells")
    rows = re.findall(r"^ +(\d+) +([\d,]+) +([\d.]+) %(?: (#+))?$", text, re.MULTILINE)
    counts = [int(count.replace(",", "")) for _, count, _, _ in rows]
    assert sum(counts) == 780
    for count, (_, _, share, bar) in zip(counts, rows, strict=True):
        assert float(share) == pytest.approx(100 * count / 780, abs=0.006)
        assert len(bar) == round(40 * count / max(counts))


# -- info --------------------------------------------------------------------------------------


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    """--version says what is installed."""
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"mapp_env {mapp_env.__version__}\n"


OWN_VERSION = """
from mapp_env import compiled
from mapp_env.commands import info, main
info._accelerator = str  # importing torch takes seconds
main(["info", "--json"])
print(compiled._SOURCES)
main(["--version"])
"""


def test_a_copy_says_its_own_version(tmp_path: Path) -> None:
    """A copy in a folder or a zip is not what is installed: it says, and compiles, what it is."""
    package = tmp_path / "folder" / "mapp_env"
    shutil.copytree(
        Path(mapp_env.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    top = package / "__init__.py"
    text = top.read_text(encoding="utf-8")
    assert text.count(f'"{mapp_env.__version__}"') == 1
    text = text.replace(f'"{mapp_env.__version__}"', '"9.8.7"')
    top.write_text(text, encoding="utf-8")
    shutil.make_archive(str(package.parent), "zip", package.parent)
    sources = set()
    for place in (package.parent, package.parent.with_suffix(".zip")):
        done = subprocess.run(
            [sys.executable, "-c", OWN_VERSION],
            env={**os.environ, "PYTHONPATH": str(place), "NUMBA_DISABLE_JIT": "1"},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=True,
        )
        *found, digest, said = done.stdout.splitlines()
        assert said == "mapp_env 9.8.7"
        assert json.loads("".join(found))["versions"]["mapp-env"] == "9.8.7"
        sources.add(digest)
    assert len(sources) == 1
    assert compiled._SOURCES not in sources


def test_info_tells_what_is_installed(capsys: pytest.CaptureFixture[str]) -> None:
    """Versions are the installed ones, the cache is where compiled code is, and torch has a say."""
    mapp_env.solve(PROBLEM)
    found = record(capsys, "info")
    assert found["versions"]["mapp-env"] == mapp_env.__version__
    for name in ("numpy", "numba", "gymnasium", "pettingzoo"):
        assert found["versions"][name] == metadata.version(name)
    code = found["compiled_code"]
    files = [path for place in code["cache"] for path in Path(place).glob("*.nb[ci]")]
    assert 0 < code["files"] <= len(files)
    assert 0 < code["bytes"] <= sum(path.stat().st_size for path in files)
    assert metadata.version("torch") in found["device"]["accelerator_for_learners"]
    text = printed(capsys, "info")
    assert all(str(value) in text for value in found["versions"].values())


def test_info_without_torch_or_compiler(tmp_path: Path) -> None:
    """Where torch is not installed it says so; where nothing is compiled there is no cache."""
    code = (
        "import sys; from importlib import metadata; real = metadata.version\n"
        "def version(name):\n"
        "    if name == 'torch': raise metadata.PackageNotFoundError(name)\n"
        "    return real(name)\n"
        "metadata.version = version\n"
        "from mapp_env.commands import main; sys.exit(main(['info', '--json']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(REPOSITORY)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    found = json.loads(done.stdout)
    assert found["extras"]["torch"] is None
    assert found["device"]["accelerator_for_learners"] is None
    assert found["compiled_code"] == {"compiled": False, "cache": [], "files": 0, "bytes": 0}


# -- policies ----------------------------------------------------------------------------------


class Walker:
    """A policy that walks right for ever; its name is how many agents it is for."""

    def __init__(self, name: str) -> None:
        self.n_agents = int(name)

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return (B, N) actions."""
        return np.full((len(observations), self.n_agents), 1)


@pytest.fixture
def loader(monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a loader of policies."""
    module = types.ModuleType("walkers")
    module.load = Walker  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "walkers", module)
    return "walkers:load"


def test_a_policy_plays(folder: Path, capsys: pytest.CaptureFixture[str], loader: str) -> None:
    """Any policy's episode is what the rules make of its actions, to the limit if it fails."""
    options = ["--policy", "3", "--policy-loader", loader, "--max-cycles", "7", "--out", "a.gif"]
    assert "not solved: 1 of 2" in printed(capsys, "render", *options, "--landmarks", "26", "0")
    with Image.open(folder / "a.gif") as image:
        assert image.n_frames == 8
    found = record(capsys, "render", *options, "--landmarks", "26")
    assert (found["success"], found["cover_time"]) == (True, 2)


# Libraries that are loaded when they are needed; `python -m` itself lets others be shadowed.
PLANTED = ("baselines", "matplotlib", "PIL", "pygame", "pyvrp", "safetensors", "torch", "tyro")


@pytest.fixture
def strangers(folder: Path) -> Path:
    """Return the working folder, in which modules lie that are called like libraries."""
    for name in PLANTED:
        (folder / f"{name}.py").write_text("raise SystemExit('not the library')\n", "ascii")
    return folder


def test_nothing_is_imported_from_the_working_folder(strangers: Path) -> None:
    """Neither way of starting takes a module that lies there for a library, nor does a child."""
    script, module = [Path(sys.executable).parent / "mapp"], [sys.executable, "-m", "mapp_env"]
    render = ["render", "--policy", "pretrained", "--landmarks", *CELLS, "--out", "a.png"]
    told = []
    for words in ([*script, "info", "--json"], [*module, *render]):
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stderr) == (0, ""), words
        told.append(done.stdout)
    assert metadata.version("torch") in json.loads(told[0])["device"]["accelerator_for_learners"]


def test_a_loader_lies_in_the_working_directory(strangers: Path) -> None:
    """The console script finds a module beside it, but takes nothing there for a library."""
    folder = strangers
    (folder / "steps.py").write_text("RIGHT = 1\n", encoding="ascii")
    (folder / "strollers.py").write_text(
        "import PIL, safetensors\n"
        "class load:\n"
        "    def __init__(self, name): from steps import RIGHT; self.moves = [RIGHT] * 3\n"
        "    def act(self, observations): return [self.moves] * len(observations)\n",
        encoding="ascii",
    )
    script = Path(sys.executable).parent / "mapp"
    options = ["--out", "a.gif", "--policy", "x", "--policy-loader", "strollers:load"]
    done = subprocess.run([script, "render", *options, "--landmarks", "26"], capture_output=True)
    assert done.returncode == 0, done.stderr


def test_a_loader_leaves_the_search_path_as_it_was(
    folder: Path, loader: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """When a loader is done, or has failed, the working folder is searched no more."""
    before = sys.path.copy()
    for name in ("3", "three"):
        main(["render", "--policy", name, "--policy-loader", loader, "--out", "a.gif"])
        assert sys.path == before
    capsys.readouterr()


def test_the_pretrained_policy_plays(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By default policies come from the baselines: the pretrained one never beats the optimum."""
    options = ["--policy", "pretrained", "--out", "a.gif", "--landmarks", *CELLS]
    found = record(capsys, "render", *options)
    assert found["success"]
    assert found["cover_time"] >= mapp_env.solve(PROBLEM).cost


def test_a_policy_of_another_grid_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, loader: str
) -> None:
    """One moved wall is another grid, an equal map file is not; what names no grid plays on any."""
    text = mapp_env.make_grid().to_text()
    (folder / "same.txt").write_text(text.replace("#", "@"), encoding="ascii")
    (folder / "other.txt").write_text(text.replace("...#...", "..#...."), encoding="ascii")
    options = ["render", "--out", "a.gif", "--landmarks", *CELLS, "--grid"]
    record(capsys, *options, "same.txt", "--policy", "pretrained")
    assert main([*options, "other.txt", "--policy", "pretrained"]) == 2
    assert re.fullmatch(
        "error: --policy .* another grid; here cell 44 is a wall, not free, and 1 more differ\n",
        capsys.readouterr().err,
    )
    walker = ["--policy", "3", "--policy-loader", loader, "--max-cycles", "2"]
    for grid in (None, "any", np.zeros(3)):
        monkeypatch.setattr(Walker, "grid", grid, raising=False)
        record(capsys, *options, "other.txt", *walker)
    monkeypatch.setattr(Walker, "grid", property(lambda walker: 1 // 0))
    assert main([*options, "other.txt", *walker]) == 2
    assert "--policy cannot play this problem: ZeroDivisionError" in capsys.readouterr().err


# -- refusals ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("solve --method exact --n-landmarks 30", "20 landmarks"),
        ("solve --method guess", "--method"),
        ("solve --objective speed", "--objective"),
        ("solve --time-limit 0", "--time-limit must be a positive number"),
        ("solve --time-limit nan", "--time-limit must be a positive number"),
        ("solve --out no/plan.json", "--out .*cannot be written"),
        ("solve --out=", "--out '': is there and not a regular file"),
        ("solve --picture a.bmp", r"--picture must end in \.gif.*got 'a.bmp'"),
        ("solve --picture no/a.gif", "cannot be written"),
        ("solve --problem nope.json", "--problem .*cannot be opened as a problem file"),
        ("solve --problem bad.json", "--problem bad.json: is not strict JSON"),
        ("solve --problem bad.json --grid rooms", "--grid does not go with a problem file"),
        ("solve --problem bad.json --landmarks 1", "--landmarks does not go with a problem file"),
        (
            "render --out a.gif --plan bad.json --problem bad.json",
            "--problem does not go",
        ),
        ("render --out a.gif --plan random --policy 3", "does not go with --plan"),
        ("render --out a.gif --policy 3 --objective makespan", "is for --plan optimum"),
        ("render --out a.gif --policy 3 --policy-loader walkers", "must be MODULE:FUNCTION"),
        ("render --out a.gif --policy 3 --policy-loader nowhere:load", "No module named 'nowhere'"),
        ("render --out a.gif --policy 3 --policy-loader walkers:fly", "no attribute 'fly'"),
        ("render --out a.gif --policy 2 --policy-loader walkers:load", "--policy must act with"),
        ("render --out a.gif --policy 2 --policy-loader .walkers:load", "MODULE:FUNCTION"),
        ("render --out a.gif --policy 2 --policy-loader math:pi", "--policy '2': .*not callable"),
        ("render --out a.gif --policy 2 --policy-loader math:sqrt", "must be real number"),
        ("render --out a.gif --policy 2 --policy-loader os:getenv", "with act.., .* returns None"),
        ("render --out a.gif --policy-loader walkers:load", "--policy-loader is for --policy"),
        (
            "render --out a.gif --seed 9223372036854775808",
            r"--seed must be .*775807",
        ),
        ("solve --starts 24 24 --n-agents 3", "--starts must hold 3 cells"),
        ("solve --landmarks 0 6 --starts 3 6", r"starts\[1\] must not be a landmark"),
        ("solve --landmarks 0 6 --starts 3 8", r"starts\[1\] must be a free cell"),
        ("solve --starts 3 49", r"starts\[1\] must be a cell in 0\.\.48"),
        ("solve --starts a", "--starts: 'a' is neither a number nor ROW,COL"),
        ("solve --starts 0 --n-landmarks 40", r"--n-landmarks must be an integer in 1\.\.39"),
        ("solve --problem bad.json --starts 1", "--starts does not go with a problem file"),
        ("render --out a.gif --plan bad.json --starts 1", "--starts does not go with a plan file"),
        ("solve --landmarks 1 --seed 9223372036854775808", "--seed must be an integer"),
        ("solve --grid rooms --grid-seed -1", "--grid-seed must be an integer"),
        ("solve --out a.gif --picture a.gif", "--picture must be another file than --out"),
        ("solve --out a.json --picture /proc/a.gif", "/proc/a.gif"),
        ("render --out a.gif --policy nope", "pretrained, pretrained-distilled"),
        ("render --out a.gif --policy pretrained --n-landmarks 3", "--policy cannot play this"),
        ("solve --grid no/such.map", "no file 'no/such.map'"),
        ("solve --grid bad.json", "--grid bad.json:1: "),
        ("render --out a.gif --policy 2 --policy-loader broken:load", "broken:load cannot be imp"),
        ("universe --n-landmarks 9", "273,438,880 problems"),
        ("universe --n-landmarks 0", "--n-landmarks must be"),
        ("universe --n-agents 17", "--n-agents must be"),
        ("universe --landmarks 3", "--landmarks"),
        ("info --surprise", "--surprise"),
    ],
)
@pytest.mark.usefixtures("loader")
def test_refusals_are_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], line: str, words: str
) -> None:
    """Whatever is wrong gives exit status 2, one line that says what, and no file."""
    (folder / "bad.json").write_text("{", encoding="ascii")
    (folder / "broken.py").write_text("open('no/weights')\n", encoding="ascii")
    try:
        status = main(line.split())
    except SystemExit as leaving:  # argparse's own way
        status = int(leaving.code or 0)
    streams = capsys.readouterr()
    assert (status, streams.out) == (2, "")
    assert re.fullmatch(rf"error: [^\n]*({words})[^\n]*\n", streams.err), streams.err
    names = {path.name for path in folder.iterdir()}
    assert names - {"__pycache__"} == {"bad.json", "broken.py"}


@pytest.mark.parametrize(
    ("redirected", "status", "told"),
    [
        (">/dev/full", 2, "error: the standard output cannot be written: .*"),
        (">&-", 0, ""),
        ("0 2>&-", 2, ""),
    ],
)
def test_closed_and_full_streams(redirected: str, status: int, told: str) -> None:
    """A full disk is said; a closed stream is none to write into, and no other takes its part."""
    line = f"{shlex.quote(sys.executable)} -m mapp_env solve --landmarks 0 {redirected}"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (status, "")
    assert re.fullmatch(told, done.stderr.strip()), done.stderr


def test_names_of_any_letters_are_printed(folder: Path) -> None:
    """A file's name that the terminal cannot show is printed with escapes."""
    done = subprocess.run(
        [sys.executable, "-m", "mapp_env", "solve", "--landmarks", "0", "--out", "\xe9.json"],
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "wrote \\xe9.json" in done.stdout
    assert (folder / "\xe9.json").is_file()


def test_without_the_baselines_policies_say_what_to_install(tmp_path: Path) -> None:
    """The installed package alone has no policies: the line names what brings them."""
    code = (
        "import sys; sys.modules['baselines'] = None; from mapp_env.commands import main;"
        "sys.exit(main(['render', '--out', 'a.gif', '--policy', 'pretrained']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert re.fullmatch(r"error: policies are loaded by .*editable mode.*\n", done.stderr)


# -- what documents say ------------------------------------------------------------------------

PAGE = (REPOSITORY / "docs" / "command_line.md").read_text(encoding="utf-8")


def test_the_console_script_is_the_module(tmp_path: Path) -> None:
    """The installed `mapp` does what `python -m mapp_env` does, under its own name."""
    script = Path(sys.executable).parent / "mapp"
    told = subprocess.run([script, "--help"], capture_output=True, text=True, check=True).stdout
    assert told.startswith("usage: mapp ")
    module = [sys.executable, "-m", "mapp_env", "--help"]
    told = subprocess.run(module, capture_output=True, text=True, check=True).stdout
    assert told.startswith("usage: python -m mapp_env ")


def test_commands_of_the_page_and_the_helps_work(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every command that the page or a help shows runs, and prints what the page says."""
    (folder / "office.map").write_text(
        "type octile\nheight 5\nwidth 12\nmap\n" + 5 * f"{12 * '.'}\n", encoding="ascii"
    )
    lines = re.findall(r"^mapp (.*)$", PAGE, re.MULTILINE)
    for module in (solve, universe, info):
        lines += re.findall(r"^ *python -m mapp_env (.*)$", module.__doc__ or "", re.MULTILINE)
    assert len(lines) >= 16
    outputs = {}
    for line in dict.fromkeys(lines):
        if "--policy" not in line or line.startswith("evaluate"):  # others are played above
            assert main(line.replace("10,2", "4,2").split()) == 0, line
            outputs[line] = capsys.readouterr().out
    for line, promise in re.findall(r"^mapp ([^\n]*)\n```\n\n```text\n(.*?)```", PAGE, re.M | re.S):
        seconds = r"\d+\.\d+ m?s"
        assert re.sub(seconds, "", outputs[line]) == re.sub(seconds, "", promise)


# -- options have their effect -----------------------------------------------------------------


def test_time_limit_and_seed_reach_the_search(capsys: pytest.CaptureFixture[str]) -> None:
    """With next to no time the search's first plan is printed, and each seed has its own."""
    grid = mapp_env.make_grid("warehouse")
    cells = mapp_env.sample_problems(grid, 1, n_landmarks=40, seed=2)[0].tolist()
    problem = mapp_env.Problem(grid, cells)
    options = ["--grid", "warehouse", "--method", "search", "--landmarks", *map(str, cells)]
    tours = []
    for seed in (3, 4):
        words = ["--time-limit", "1e-9", "--seed", str(seed)]
        found = record(capsys, "solve", *options, *words)
        plan = mapp_env.solve(problem, method="search", time_limit=1e-9, seed=seed)
        assert found["tours"] == [list(tour) for tour in plan.tours]
        tours.append(found["tours"])
    assert tours[0] != tours[1]


@pytest.mark.parametrize("suffix", [".gif", ".GIF", ".Png"])
def test_endings_are_of_any_case(
    folder: Path, capsys: pytest.CaptureFixture[str], suffix: str
) -> None:
    """A picture's name may end in capitals."""
    found = record(capsys, "render", "--out", f"a{suffix}", "--landmarks", "26")
    assert found["bytes"] == (folder / f"a{suffix}").stat().st_size


def test_a_policy_has_all_the_steps_asked_for(
    folder: Path, capsys: pytest.CaptureFixture[str], loader: str
) -> None:
    """More steps than an environment's own limit are played, and all claims are counted."""
    options = ["--policy", "3", "--policy-loader", loader, "--max-cycles", "60", "--out", "a.gif"]
    cells = ["--landmarks", "25", "26", "0"]
    assert "not solved: 2 of 3 landmarks" in printed(capsys, "render", *options, *cells)
    with Image.open(folder / "a.gif") as image:
        assert image.n_frames == 61


def test_random_play_moves(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Random agents take the environment's four actions, all of them, and never wait."""
    rendering = importlib.import_module("mapp_env.rendering")
    played, real = [], rendering.save_animation

    def save(path: str, problem: mapp_env.Problem, actions: Any, fps: float) -> int:
        played.append(np.array(actions))
        return real(path, problem, actions, fps)

    monkeypatch.setattr(rendering, "save_animation", save)
    for seed in range(3):
        options = ["--plan", "random", "--landmarks", *CELLS, "--seed", str(seed)]
        assert main(["render", "--out", "a.gif", *options]) == 0
    assert set(np.concatenate(played).ravel().tolist()) == {0, 1, 2, 3}


def test_an_interruption_is_told_by_the_exit_status(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C ends a command with 130, as shells expect it."""

    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(solve, "problem_of", interrupted)
    assert main(["solve"]) == 130


@pytest.mark.parametrize("name", ["maze", "random", "rooms", "warehouse"])
def test_generated_grids_have_the_rows_and_columns_asked_for(
    capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """--rows and --cols mean what they say, and --grid-seed says which grid of that size."""
    for seed in ("0", "1"):
        sides = ["--rows", "6", "--cols", "9", "--grid-seed", seed]
        found = record(capsys, "universe", "--grid", name, *sides, "--n-landmarks", "1")
        grid = mapp_env.make_grid(name, rows=6, cols=9, seed=int(seed))
        assert found["grid"] == grid.to_text()

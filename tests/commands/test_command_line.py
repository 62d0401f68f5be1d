"""The command line: what it writes and prints, and the one line that refuses."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mapp_env
from mapp_env.commands import COMMANDS, main, render

REPOSITORY = Path(__file__).resolve().parents[2]
LANDMARKS = ["0", "6", "20", "42", "48"]


def command(arguments: list[str], folder: Path, code: str = "") -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, or some code in place of it."""
    environ = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    start = ["-c", code] if code else ["-m", "mapp_env"]
    return subprocess.run(
        [sys.executable, *start, *arguments],
        cwd=folder,
        env=environ,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder that the test runs in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


# -- in a process of its own -------------------------------------------------------------------


def test_an_animation_end_to_end(tmp_path: Path) -> None:
    """The optimum is written as a GIF with a frame a step; size and costs are printed."""
    done = command(["render", "--out", "a.gif", "--landmarks", *LANDMARKS], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    optimum = mapp_env.solve(mapp_env.Problem(mapp_env.make_grid(), tuple(map(int, LANDMARKS))))
    assert done.stdout.splitlines() == [
        f"wrote a.gif: {(tmp_path / 'a.gif').stat().st_size} bytes",
        f"cover time {optimum.cover_time}, makespan {optimum.makespan}, total distance "
        f"{optimum.total_distance}; the cover time is proven optimal",
        f"landmarks: {' '.join(LANDMARKS)}",
    ]
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == optimum.cover_time + 1


def test_a_refusal_end_to_end(tmp_path: Path) -> None:
    """What cannot be done is one line on the standard error stream, exit status 2, no file."""
    done = command(["render", "--out", "a.gif", "--landmarks", "24"], tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"error: landmarks\[0\] must not be the depot, got 24\n", done.stderr)
    assert not list(tmp_path.iterdir())


def test_help_teaches(tmp_path: Path) -> None:
    """The help names every command, and of each every option, with examples."""
    done = command(["--help"], tmp_path)
    assert done.returncode == 0
    for module in COMMANDS:
        name = module.__name__.rpartition(".")[2]
        assert f"\n    {name} " in done.stdout
    done = command(["render", "--help"], tmp_path)
    assert done.returncode == 0
    assert "python -m mapp_env render --out episode.gif" in done.stdout
    assert all(f"{name}" in done.stdout for name in ("--plan", "--grid", "--seed", "warehouse"))


WITHOUT_DOCSTRINGS = """
import runpy, sys
for line in sys.argv[1:]:
    sys.argv = line.split()
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as end:
        assert not end.code, line
"""


def test_programs_start_without_docstrings(tmp_path: Path) -> None:
    """With PYTHONOPTIMIZE=2, which drops all docstrings, every program starts and has a help."""
    lines = ["mapp_env/__main__.py --version", "mapp_env/__main__.py --help"]
    for module in COMMANDS:
        lines.append(f"mapp_env/__main__.py {module.__name__.rpartition('.')[2]} --help")
    # The others need torch or a trainer, some of which do not load without docstrings themselves.
    scripts = ("rollout", "batched_rollout", "beside_optimum")
    lines += [f"examples/{script}.py --help" for script in scripts]
    lines += [f"benchmarks/{script}.py --help" for script in ("env_speed", "solvers")]
    done = subprocess.run(
        [
            sys.executable,
            "-OO",
            "-c",
            WITHOUT_DOCSTRINGS,
            *lines,
            "tests/engine/golden/make.py --help",
        ],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"mapp_env {mapp_env.__version__}\nusage: ")
    assert done.stdout.count("usage: ") == len(lines)


def test_a_figure_needs_matplotlib_and_says_so(tmp_path: Path) -> None:
    """Without matplotlib a figure is refused with what to install; an animation needs none."""
    code = (
        "import sys; sys.modules['matplotlib'] = None; from mapp_env.commands import main;"
        "assert main(['render', '--out', 'a.gif']) == 0; sys.exit(main(sys.argv[1:]))"
    )
    done = command(["render", "--out", "a.png"], tmp_path, code)
    assert done.returncode == 2
    assert (
        done.stderr
        == 'error: draw_plan needs matplotlib 3.8 or later: pip install "matplotlib>=3.8"\n'
    )
    assert [path.name for path in tmp_path.iterdir()] == ["a.gif"]


def test_no_picture_no_library(tmp_path: Path) -> None:
    """The commands are loaded without a drawing library, and an animation without matplotlib."""
    code = (
        "import sys; from mapp_env.commands import main;"
        "assert not {'PIL', 'matplotlib', 'torch'} & set(sys.modules);"
        "main(['render', '--out', 'a.gif']); assert 'matplotlib' not in sys.modules"
    )
    assert command([], tmp_path, code).returncode == 0


def test_nobody_listens(tmp_path: Path) -> None:
    """Output that nobody reads is no error: the file is there all the same."""
    code = (
        "import os, subprocess, sys; reading, writing = os.pipe(); os.close(reading);"
        "done = subprocess.run([sys.executable, '-m', 'mapp_env', 'render', '--out', 'a.gif'],"
        " stdout=writing, stderr=subprocess.PIPE); assert done.stderr == b'', done.stderr;"
        "sys.exit(done.returncode)"
    )
    done = command([], tmp_path, code)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "a.gif").stat().st_size > 0


# -- what is drawn -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.png", "a.svg", "a.pdf", "A.PNG", "a.GIF"])
def test_the_ending_says_what_is_written(folder: Path, name: str) -> None:
    """The file is of the format that its name ends in, whatever the case."""
    assert main(["render", "--out", name]) == 0
    start = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF", ".gif": b"GIF89a"}
    assert (folder / name).read_bytes().startswith(start[Path(name).suffix.lower()])


@pytest.mark.parametrize("objective", ["cover_time", "makespan", "total_distance"])
def test_the_objective_is_minimised(
    folder: Path, capsys: pytest.CaptureFixture[str], objective: str
) -> None:
    """The optimum is that of the objective asked for."""
    options = ["--landmarks", *LANDMARKS, "--objective", objective]
    assert main(["render", "--out", "a.gif", *options]) == 0
    problem = mapp_env.Problem(mapp_env.make_grid(), tuple(map(int, LANDMARKS)))
    words = objective.replace("_", " ")
    cost = int(mapp_env.solve(problem, objective).cost)
    assert re.search(rf"{words} {cost}\b.*; the {words} is proven optimal", capsys.readouterr().out)


def test_cells_are_numbers_or_rows_and_columns(folder: Path) -> None:
    """A landmark's cell may be given either way."""
    for name, cells in (("a.gif", ["6", "47"]), ("b.gif", ["0,6", "6,5"])):
        assert main(["render", "--out", name, "--landmarks", *cells]) == 0
    assert (folder / "a.gif").read_bytes() == (folder / "b.gif").read_bytes()


def test_random_play_is_seeded_and_limited(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Random moves depend on the seed alone and end at the limit, solved or not."""
    for name, seed in (("a.gif", "1"), ("b.gif", "1"), ("c.gif", "2")):
        options = ["--plan", "random", "--max-cycles", "6", "--seed", seed]
        assert main(["render", "--out", name, *options, "--landmarks", *LANDMARKS]) == 0
    assert (folder / "a.gif").read_bytes() == (folder / "b.gif").read_bytes()
    assert (folder / "a.gif").read_bytes() != (folder / "c.gif").read_bytes()
    with Image.open(folder / "a.gif") as image:
        assert image.n_frames == 7
    assert re.search(r"not solved: [0-4] of 5 landmarks visited", capsys.readouterr().out)


def test_a_plan_file_brings_its_problem(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A saved plan is drawn on its own grid, with its own agents and landmarks."""
    grid = mapp_env.make_grid("warehouse", rows=12, cols=20)
    plan = mapp_env.solve(mapp_env.Problem(grid, grid.reachable[[3, 50, 80]].tolist(), 2))
    plan.save(folder / "plan.json")
    assert main(["render", "--out", "a.gif", "--plan", "plan.json"]) == 0
    assert f"cover time {plan.cover_time}, makespan {plan.makespan}" in capsys.readouterr().out
    with Image.open(folder / "a.gif") as image:
        assert image.n_frames == plan.cover_time + 1


@pytest.mark.parametrize(
    "options",
    [
        ["--grid", "rooms", "--rows", "16", "--cols", "20", "--grid-seed", "3"],
        ["--grid", "maze", "--rows", "9", "--cols", "9", "--n-landmarks", "7"],
        ["--grid", "map.txt", "--landmarks", "1,2", "0", "--n-agents", "2"],
    ],
    ids=lambda options: options[1],
)
def test_any_grid_is_drawn(folder: Path, options: list[str]) -> None:
    """Generated grids and map files are drawn like the bundled one."""
    (folder / "map.txt").write_text("...\nD#.\n", encoding="ascii")
    assert main(["render", "--out", "a.gif", *options]) == 0
    with Image.open(folder / "a.gif") as image:
        assert image.n_frames > 1


def test_seed_draws_the_landmarks_not_the_grid(folder: Path) -> None:
    """Another seed draws other landmarks on the same walls; another grid seed, other walls."""
    pictures = []
    for seed, grid_seed in (("0", "0"), ("1", "0"), ("0", "1")):
        options = ["--grid", "random", "--rows", "12", "--cols", "12"]
        seeds = ["--seed", seed, "--grid-seed", grid_seed]
        assert main(["render", "--out", "a.gif", *options, *seeds]) == 0
        with Image.open(folder / "a.gif") as image:
            pixels = np.array(image.convert("RGB"))
            pictures.append((pixels == (59, 65, 77)).all(axis=2)[:-60])  # the walls
    assert (pictures[0] != pictures[1]).mean() < 0.01  # but for what stands on them
    assert (pictures[0] != pictures[2]).mean() > 0.1


# -- refusals ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--out", "a.bmp"], r"--out must end in \.gif, \.png, \.svg, \.pdf, got 'a.bmp'"),
        (["--out", "gif"], "--out must end in"),
        (["--out", "no/a.gif"], "cannot be written"),
        (["--out", "dir.gif"], "not a regular file"),
        (["--grid", "nope"], "--grid must be one of paper-7x7, .*rooms.*no file 'nope'"),
        (["--grid", "bad.txt"], "bad.txt"),
        (["--grid", "rooms", "--rows", "9999"], r"--rows must be an integer in 3\.\.2048"),
        (["--rows", "9"], "--rows, --cols and --grid-seed are for generated grids"),
        (["--n-agents", "0"], r"--n-agents must be an integer in 1\.\.16"),
        (["--n-landmarks", "65"], "--n-landmarks must be at most"),
        (["--n-landmarks", "3", "--landmarks", "1"], "--n-landmarks .*does not go with"),
        (["--landmarks", "1", "1"], "landmarks"),
        (["--landmarks", "1,2,3"], "neither a number nor ROW,COL"),
        (["--landmarks", "9" * 5000], "neither a number nor ROW,COL"),
        (["--landmarks", "999999999"], "landmarks"),
        (["--seed", "-1"], "seed"),
        (["--seed", "x"], "--seed"),
        (["--plan", "nope.json"], "cannot be opened as a plan file"),
        (["--plan", "bad.json"], "bad.json: is not strict JSON"),
        (["--plan", "bad.json", "--n-agents", "2"], "--n-agents does not go with a plan file"),
        (["--plan", "bad.json", "--seed", "2"], "--seed does not go with a plan file"),
        (["--plan", "random", "--objective", "makespan"], "--objective is for --plan optimum"),
        (["--max-cycles", "5"], "--max-cycles is for --plan random"),
        (["--plan", "random", "--max-cycles", "0"], "--max-cycles must be an integer"),
        (
            ["--plan", "random", "--max-cycles", "5000"],
            r"--max-cycles must be .* 1\.\.1999, got 5000",
        ),
        (["--objective", "speed"], "--objective"),
        (["--fps", "0"], "fps must be a number"),
        (["--fps", "4", "--out", "a.png"], "--fps is for animations"),
        (["--surprise"], "--surprise"),
    ],
    ids=lambda value: " ".join(value)[:60] if isinstance(value, list) else "",
)
def test_refusals_are_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], words: str
) -> None:
    """Whatever is wrong gives exit status 2, one line that says what, and no file."""
    (folder / "bad.txt").write_text("..x\n", encoding="ascii")
    (folder / "bad.json").write_text("{", encoding="ascii")
    (folder / "dir.gif").mkdir()
    before = sorted(folder.iterdir())
    try:
        status = main(["render", "--out", "a.gif", *options])
    except SystemExit as leaving:  # argparse's own way
        status = int(leaving.code or 0)
    printed = capsys.readouterr()
    assert (status, printed.out) == (2, "")
    assert re.fullmatch(rf"error: [^\n]*({words})[^\n]*\n", printed.err), printed.err
    assert len(printed.err) < 600
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("line", [[], ["nope"], ["render"]], ids=str)
def test_an_incomplete_line_points_to_the_help(
    capsys: pytest.CaptureFixture[str], line: list[str]
) -> None:
    """A missing or unknown command, or a missing option, is one line that names the help."""
    with pytest.raises(SystemExit) as leaving:
        main(line)
    assert leaving.value.code == 2
    assert re.fullmatch(r"error: [^\n]+ --help\)\n", capsys.readouterr().err)


# -- what documents say ------------------------------------------------------------------------

PAGE = (REPOSITORY / "docs" / "pictures.md").read_text(encoding="utf-8")


def command_lines(text: str) -> list[str]:
    """Return the options of every render command that stands on a line of its own."""
    return re.findall(r"^ *python -m mapp_env (render .*)$", text, re.MULTILINE)


def test_commands_of_the_page_and_the_help_work(folder: Path) -> None:
    """Every command that the page or the help shows runs and writes the file that it names."""
    mapp_env.solve(mapp_env.Problem(mapp_env.make_grid(), (0, 48))).save("plan.json")
    (folder / "docs" / "images").mkdir(parents=True)
    lines = command_lines(PAGE) + command_lines(render.__doc__ or "")
    assert len(lines) >= 8
    for line in lines:
        words = line.split()
        target = folder / words[words.index("--out") + 1]
        assert not target.exists(), "no two write the same file"
        assert main(words) == 0, line
        assert target.stat().st_size > 0


def test_the_pages_code_runs(folder: Path) -> None:
    """The page's Python runs by itself and writes its picture."""
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    done = command([], folder, block)
    assert done.returncode == 0, done.stderr
    assert (folder / "comparison.png").stat().st_size > 0


def test_pictures_of_the_documents_are_small() -> None:
    """Each committed picture is below 150 kB, and the page shows a command for each of its own."""
    pictures = sorted((REPOSITORY / "docs" / "images").iterdir())
    assert len(pictures) >= 5
    for picture in pictures:
        assert picture.stat().st_size < 150_000, picture.name
    for name in re.findall(r"\]\(images/(.*?)\)", PAGE):
        made = f"--out docs/images/{name}", f"--animation docs/images/{name}", f'"{name}"'
        assert any(words in PAGE for words in made), name

"""What the README and the docs say is so: commands agree, examples run, names exist."""

from __future__ import annotations

import datetime
import importlib
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"
DOCUMENTS = [REPOSITORY / "README.md", *sorted(DOCS.glob("*.md"))]
EXAMPLES = {
    "quickstart.py": [],
    "rollout.py": ["--out", "{folder}/rollout.gif"],
    "batched_rollout.py": ["--num-envs", "256", "--steps", "120"],
    "beside_optimum.py": ["--problems", "20"],
    "sb3_shared.py": ["--seconds", "1", "--problems", "5"],
    "sb3_central.py": ["--seconds", "1", "--problems", "5"],
    "sb3_vec.py": ["--seconds", "1", "--problems", "5"],
    "epymarl_style.py": ["--seconds", "1", "--problems", "5"],
    "many_maps.py": ["--seconds", "1", "--problems", "5", "--maps", "20"],
    "torchrl_vdn.py": ["--steps", "80", "--updates-per-batch", "1", "--problems", "5"],
}
# Run by hand: what they need does not install beside the rest, or they start many trainings (which
# tests/house/test_ray.py does as well). Their docstrings say how.
EXAMPLES_APART = {
    "benchmarl_task.py": ".venv-benchmarl/bin/pip install",
    "rllib_ppo.py": ".venv-rllib/bin/pip install",
    "tianshou_dqn.py": ".venv-tianshou/bin/pip install",
    "ray_seeds.py": "python examples/ray_seeds.py --out runs/compare --seeds 5",
    "ray_tune.py": "python examples/ray_tune.py --trials 8",
}


def run(command: list[str], folder: Path) -> str:
    """Run a script away from the repository and return what it prints."""
    environ = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        command, cwd=folder, env=environ, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def python_blocks(path: Path) -> list[str]:
    """Return the Python code blocks of a document."""
    return re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


def test_ci_runs_the_readmes_test_command() -> None:
    """.ci/run holds the README's test command letter by letter, and checks that it does."""
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    commands = [line for line in readme.splitlines() if line.endswith("-m pytest -n 2")]
    assert len(commands) == 1
    script = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8")
    assert f"command='{commands[0]}'" in script
    assert 'bash -c "$command"' in script


def test_every_example_is_run() -> None:
    """No example is left out of the test below, but those that say where they run instead."""
    paths = {path.name: path for path in (REPOSITORY / "examples").glob("*.py")}
    assert set(paths) == {*EXAMPLES, *EXAMPLES_APART}
    for name, command in EXAMPLES_APART.items():
        assert command in paths[name].read_text(encoding="utf-8")


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_example_runs(name: str, tmp_path: Path) -> None:
    """Each example runs from anywhere and prints something."""
    arguments = [argument.format(folder=tmp_path) for argument in EXAMPLES[name]]
    assert run([sys.executable, str(REPOSITORY / "examples" / name), *arguments], tmp_path).strip()


@pytest.mark.parametrize(
    "name",
    ["sb3_central.py", "sb3_shared.py", "sb3_vec.py", "epymarl_style.py", "many_maps.py"],
)
def test_trainings_refuse_before_they_train(name: str, tmp_path: Path) -> None:
    """What could not be reported on is refused in one line before a minute is spent on it."""
    script = str(REPOSITORY / "examples" / name)
    for option in ("--seconds", "--problems"):
        done = subprocess.run(
            [sys.executable, script, option, "0"], cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 1
        assert done.stderr.startswith(f"error: {option} must be")


def test_rollout_writes_an_animation(tmp_path: Path) -> None:
    """The rollout's file is a GIF with a picture for the reset and one for each step."""
    target = tmp_path / "episode.gif"
    script = REPOSITORY / "examples" / "rollout.py"
    output = run([sys.executable, str(script), "--out", str(target)], tmp_path)
    with Image.open(target) as image:
        assert image.format == "GIF"
        steps = re.search(r"'cover_time': (\d+)", output)
        assert steps is not None
        assert f"{int(steps[1]) + 1} pictures" in output
        assert image.n_frames == int(steps[1]) + 1


def test_readmes_ten_lines_are_the_example() -> None:
    """The README's first block is examples/quickstart.py, and has at most ten lines of code."""
    example = (REPOSITORY / "examples" / "quickstart.py").read_text(encoding="utf-8")
    block = python_blocks(REPOSITORY / "README.md")[0]
    assert example.split('"""\n\n', 1)[1] == block
    assert len([line for line in block.splitlines() if line]) <= 10


def test_readmes_code_runs(tmp_path: Path) -> None:
    """Every Python block of the README runs by itself."""
    for index, block in enumerate(python_blocks(REPOSITORY / "README.md")):
        script = tmp_path / f"block_{index}.py"
        script.write_text(block, encoding="utf-8")
        run([sys.executable, str(script)], tmp_path)


@pytest.mark.parametrize("path", DOCUMENTS[1:], ids=lambda path: path.name)
def test_pages_code_runs(path: Path, tmp_path: Path) -> None:
    """A page's Python blocks run one after the other, and print what their comments say."""
    blocks = python_blocks(path)
    script = tmp_path / "page.py"
    script.write_text("\n".join(blocks), encoding="utf-8")
    printed = run([sys.executable, str(script)], tmp_path).splitlines()
    promised = re.findall(r"^print\(.*\)  # (.*)$", "\n".join(blocks), re.MULTILINE)
    assert len(printed) == len(promised)
    for line, promise in zip(printed, promised, strict=True):
        if re.match(r"[\d\[(-]|True$|False$|None$|[A-Z]\w*\(", promise):
            assert line == promise
    for picture in tmp_path.glob("*.png"):
        with (
            Image.open(picture) as drawn,
            Image.open(REPOSITORY / "docs" / "images" / picture.name) as shown,
        ):
            pixels = [np.array(image.convert("RGB"), int) for image in (drawn, shown)]
        assert pixels[0].shape == pixels[1].shape
        assert abs(pixels[0] - pixels[1]).mean() < 0.5, f"{picture.name} is out of date"


def all_tests() -> str:
    """Return the text of all test files."""
    files = sorted(Path(__file__).parents[1].rglob("test_*.py"))
    return "\n".join(path.read_text(encoding="utf-8") for path in files)


def tables(path: Path) -> list[list[list[str]]]:
    """Return a document's tables: rows of cells, the header first, the ruler left out."""
    found = re.findall(r"(?:^\|.*\|\n)+", path.read_text(encoding="utf-8"), re.MULTILINE)
    return [
        [
            [cell.strip() for cell in line.strip("|").split("|")]
            for index, line in enumerate(block.splitlines())
            if index != 1
        ]
        for block in found
    ]


def test_promises_name_tests_that_exist() -> None:
    """Each promise of the page about reliability names tests of the suite, and all exist."""
    tests = all_tests()
    rows = [row for table in tables(DOCS / "reliability.md") for row in table[1:]]
    assert len(rows) >= 30
    for promise, names in rows:
        found = re.findall(r"`(test_\w+)`", names)
        assert found, promise
        for name in found:
            assert f"def {name}(" in tests, f"{promise}: {name}"


def test_tables_shown_twice_agree() -> None:
    """Rows of equal labels under equal headers are equal, wherever a table is repeated."""
    rows: dict[tuple[str, ...], list[str]] = {}
    twice = 0
    for path in DOCUMENTS:
        for header, *body in tables(path):
            if not any(cell[:1].isdigit() for row in body for cell in row[1:]):
                continue  # words
            labels = 2 if header[:2] == ["preset", "learner"] else 1
            keys = [(*header, *row[:labels]) for row in body]
            for key, row in zip(keys, body, strict=True):
                if keys.count(key) == 1:
                    twice += key in rows
                    assert rows.setdefault(key, row) == row, f"{path.name}: {row}"
    assert twice >= 10


def test_rules_of_thumb_stand_side_by_side() -> None:
    """Where a table of policies has one rule of thumb it has the other, with its own figures."""
    rules, found = ("nearest landmark", "earliest arrival"), 0
    for path in DOCUMENTS:
        for header, *body in tables(path):
            rows = [[row for row in body if rule in " ".join(row)] for rule in rules]
            assert len(rows[0]) == len(rows[1]), f"{path.name}: {header}"
            found += len(rows[0])
            for nearest, earliest in zip(*rows, strict=True):
                assert nearest != earliest
    assert found >= 7


def test_citations_agree() -> None:
    """CITATION.cff and README's BibTeX name this version, and the paper by the same DOI."""
    cited = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```bibtex\n(.*?)```", readme, re.DOTALL)
    software, paper = re.findall(r"^@\w+\{.*?^\}$", block, re.MULTILINE | re.DOTALL)
    fields = [
        dict(re.findall(r"^  (\w+) = \{(.*)\},?$", entry, re.MULTILINE))
        for entry in (software, paper)
    ]
    (reference,) = cited["references"]
    released = datetime.date.fromisoformat(cited["date-released"])
    version = importlib.import_module("mapp_env").__version__
    assert cited["version"] == fields[0]["version"] == version
    assert str(released.year) == fields[0]["year"]
    assert fields[0]["title"].replace("\\", "") == cited["title"]
    assert reference["doi"] == fields[1]["doi"] == "10.48550/arXiv." + fields[1]["eprint"]
    assert fields[1]["title"] == reference["title"]
    assert fields[1]["year"] == str(reference["year"])


def test_each_logged_metric_is_explained() -> None:
    """The page about the baselines has a row for every column and entry that a run writes."""
    training = importlib.import_module("baselines.learning.training")
    evaluation = importlib.import_module("baselines.policies.evaluation")
    setting = evaluation.Setting(importlib.import_module("mapp_env").make_grid())
    table = evaluation.evaluate(
        importlib.import_module("baselines.policies.rules_of_thumb").NearestLandmarkPolicy(
            setting.grid, 3, 5
        ),
        setting,
        np.array([[0, 6, 20, 42, 48]]),
    )
    (metrics, evaluated) = [
        [row[0].strip("`") for row in rows[1:]]
        for rows in tables(DOCS / "baselines.md")
        if rows[0] == ["column", "unit", "what"]
    ]
    assert metrics == list(training.METRICS)
    assert evaluated == list(table.summary())
    (timing,) = [
        rows for rows in tables(DOCS / "baselines.md") if rows[0] == ["entry", "unit", "what"]
    ]
    laps = set()
    for name in ("training", "train"):
        source = (REPOSITORY / "baselines" / "learning" / f"{name}.py").read_text(encoding="utf-8")
        laps |= set(re.findall(r"\.lap\(\"([^\"]+)\"\)", source))
    assert len(laps) >= 5
    (seconds,) = [row[2] for row in timing if row[0] == "`seconds`"]
    assert laps == set(re.findall(r"`([^`]+)`", seconds))


def test_code_blocks_say_what_they_are() -> None:
    """Every block is Python or a command, which are run, or else text that nobody could run."""
    known = {"python", "bash", "text", "markdown", "bibtex", "diff", "{eval-rst}"}
    for path in DOCUMENTS:
        fences = re.findall(r"^\s*```(.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert len(fences) % 2 == 0, path.name
        assert set(fences[::2]) <= known, path.name
        assert set(fences[1::2]) <= {""}, path.name


def test_rules_table_names_what_exists() -> None:
    """Each rule's row names functions of the package and tests of the suite."""
    text = (REPOSITORY / "docs" / "rules.md").read_text(encoding="utf-8")
    tests = all_tests()
    rows = re.findall(r"^\| (R\d+) \|.*\| (.*?) \| (.*?) \|$", text, re.MULTILINE)
    assert [rule for rule, _, _ in rows] == [f"R{number}" for number in range(1, 13)]
    for rule, functions, names in rows:
        found = re.findall(r"`(test_\w+)`", names)
        assert found, rule
        for name in found:
            assert f"def {name}(" in tests, f"{rule}: {name}"
        for name in re.findall(r"`([^`]+)`", functions):
            if "/" in name:
                assert (REPOSITORY / "mapp_env" / name).is_file(), name
                continue
            head, attribute = name.rsplit(".", 1)
            owner = importlib.import_module("mapp_env" if head[0].isupper() else f"mapp_env.{head}")
            owner = getattr(owner, head) if head[0].isupper() else owner
            assert hasattr(owner, attribute), f"{rule}: {name}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    """Every relative link and picture of a document exists."""
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{path.name}: {target}"


def test_documents_name_every_extra() -> None:
    """README and the quick start list the extras of pyproject.toml, all of them and no others."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = set(project["optional-dependencies"])
    readme = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    sentence = re.search(r"Extras: (.*?)\.\n\n", readme, re.DOTALL)
    assert sentence is not None
    assert set(re.findall(r"`(\w+)`", sentence[1])) == extras
    page = (REPOSITORY / "docs" / "quick_start.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == extras

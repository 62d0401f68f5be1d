"""What the README and the docs say is so: commands agree, examples run, names exist."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
DOCUMENTS = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
EXAMPLES = {
    "quickstart.py": [],
    "rollout.py": ["--out", "{folder}/rollout.gif"],
    "batched_rollout.py": ["--num-envs", "256", "--steps", "120"],
    "beside_optimum.py": ["--problems", "20"],
    "torchrl_vdn.py": ["--steps", "80", "--updates-per-batch", "1", "--problems", "5"],
}
# Run by hand: what they need does not install beside the rest. Their docstrings say how.
EXAMPLES_APART = {"benchmarl_task.py": ".venv-benchmarl/bin/pip install"}


def run(command: list[str], folder: Path) -> str:
    """Run a script away from the repository and return what it prints."""
    environ = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        command, cwd=folder, env=environ, capture_output=True, text=True, timeout=120, check=False
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


def test_rollout_writes_an_animation(tmp_path: Path) -> None:
    """The rollout's file is a GIF with a picture for the reset and one for each step."""
    from PIL import Image

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
        if promise[0].isdigit() or promise[0] in "[(":
            assert line == promise


def test_rules_table_names_what_exists() -> None:
    """Each rule's row names functions of the package and tests of the suite."""
    text = (REPOSITORY / "docs" / "env.md").read_text(encoding="utf-8")
    tests = "\n".join(
        path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("*.py")
    )
    rows = re.findall(r"^\| (R\d) \|.*\| (.*?) \| (.*?) \|$", text, re.MULTILINE)
    assert [rule for rule, _, _ in rows] == [f"R{number}" for number in range(1, 10)]
    for rule, functions, names in rows:
        found = re.findall(r"`(test_\w+)`", names)
        assert found, rule
        for name in found:
            assert f"def {name}(" in tests, f"{rule}: {name}"
        for name in re.findall(r"`([^`]+)`", functions):
            if "/" in name:
                assert (REPOSITORY / "mapp_env" / name).is_file(), name
                continue
            head, attribute = name.split(".")
            owner = importlib.import_module("mapp_env" if head[0].isupper() else f"mapp_env.{head}")
            owner = getattr(owner, head) if head[0].isupper() else owner
            assert hasattr(owner, attribute), f"{rule}: {name}"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_lead_somewhere(path: Path) -> None:
    """Every relative link and picture of a document exists."""
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{path.name}: {target}"

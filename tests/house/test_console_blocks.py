"""Every command that the documents show runs; one that takes minutes is at least understood."""

from __future__ import annotations

import argparse
import importlib
import os
import re
import runpy
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
import torch
import tyro
from PIL import Image, ImageSequence

REPOSITORY = Path(__file__).resolve().parents[2]
DOCUMENTS = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").glob("*.md"))]

# Commands that are not run here, by how they begin, and why. All others are.
NOT_RUN = {
    "python -m venv": "makes a virtual environment",
    "pip install": "installs",
    "python -m pytest": "is this suite",
    "ruff": "checks style; .ci/run runs it",
    "mypy": "checks types; .ci/run runs it",
    "python baselines/meta_dqn.py": "trains for minutes",
    "python baselines/independent_dqn.py": "trains for minutes",
    "python baselines/self_improve.py": "trains for an hour",
    "python baselines/export_playground.py": "plays the universe, or writes into the repository",
    "MAPP_PLAYGROUND_PROBLEMS=10000 python -m pytest": "is a longer part of this suite",
    "python examples/sb3_shared.py": "trains for a minute",
    "python examples/sb3_vec.py": "trains for a minute",
    "python examples/sb3_central.py": "trains for a minute",
    "python examples/epymarl_style.py": "trains for a minute",
    ".venv-rllib/bin/python": "trains for a minute, elsewhere",
    ".venv-tianshou/bin/python": "trains for a minute, elsewhere",
    ".venv-benchmarl/bin/pip": "installs",
    "OMP_NUM_THREADS=1 .venv-benchmarl/bin/python": "trains for a minute, elsewhere",
    "grep": "makes a list for pip",
    "python examples/ray_seeds.py": "trains dozens of times",
    "python examples/ray_tune.py": "trains for minutes",
    "chromium": "takes a picture with a browser, which not everybody has",
    "python baselines/distill.py": "trains for an hour",
    "python baselines/compare.py": "trains thirty times",
    "python baselines/ablate.py": "trains dozens of times",
    "python baselines/reward_ceiling.py": "iterates values for minutes",
    "python baselines/evaluate.py --policy pretrained --problems universe": "takes a minute",
    "python baselines/evaluate.py --policy RUN": "RUN stands for a folder",
    "python baselines/solve.py --policy RUN": "RUN stands for a folder",
    "python baselines/finetune.py --policy RUN": "RUN stands for a folder",
}


class Understood(BaseException):
    """A script's own parser has taken a command; no error, so that no script catches it."""


def in_blocks(path: Path) -> list[str]:
    """Return the commands of a document's ``bash`` blocks, in order, as one would type them."""
    found = []
    for block in re.findall(r"```bash\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            for part in line.split("&&"):
                words = shlex.split(part, comments=True)
                if words:
                    words[0] = re.sub(r"^(\.venv/bin/)?(python)3?$", r"\2", words[0])
                    found.append(shlex.join([words[0].removeprefix(".venv/bin/"), *words[1:]]))
    return found


def in_sentences() -> list[str]:
    """Return the commands with options that stand in the text."""
    found: dict[str, None] = {}
    for path in DOCUMENTS:
        prose = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
        for command in re.findall(r"`(python\s[^`]*\s-[^`]*)`", prose):
            words = shlex.split(command)
            if words[1].endswith(".py") and len(words) > 2:
                found[shlex.join(words)] = None
    return list(found)


def why_not_run(command: str) -> str | None:
    """Return why a command is not run, or None."""
    words = command.split()
    for start, reason in NOT_RUN.items():
        if words[: len(start.split())] == start.split():
            return reason
    return None


CHEAP = {
    path.name: [command for command in in_blocks(path) if why_not_run(command) is None]
    for path in DOCUMENTS
}
LONG = sorted({c for path in DOCUMENTS for c in in_blocks(path) if why_not_run(c)})
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]


# -- running -----------------------------------------------------------------------------------


def start(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Carry out ``python SCRIPT ...``, ``python -m MODULE ...`` or a console script's command."""
    words = shlex.split(command)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    if words[0] in PROJECT["scripts"]:
        module, function = PROJECT["scripts"][words[0]].split(":")
        monkeypatch.setattr(sys, "argv", words)
        sys.exit(getattr(importlib.import_module(module), function)())
    assert words[0] == "python", f"{command}: how is this run?"
    if words[1] == "-m":
        monkeypatch.setattr(sys, "argv", words[2:])
        runpy.run_module(words[2], run_name="__main__", alter_sys=True)
    else:
        script = REPOSITORY / words[1]
        assert script.is_file(), f"{command}: there is no {words[1]}"
        monkeypatch.setattr(sys, "argv", words[1:])
        monkeypatch.syspath_prepend(script.parent)  # as Python does
        runpy.run_path(str(script), run_name="__main__")


def frames(path: Path) -> np.ndarray:
    """Return a picture's frames, shape (frames, height, width, 3)."""
    with Image.open(path) as image:
        return np.array([np.array(f.convert("RGB")) for f in ImageSequence.Iterator(image)])


def finish(command: str) -> None:
    """Carry out a command to its end, and leave this process as it was.

    Raises
    ------
    AssertionError
        If it ends with an exit code.
    """
    threads, code = torch.get_num_threads(), None
    try:
        with pytest.MonkeyPatch.context() as patch:
            start(command, patch)
    except SystemExit as ended:
        code = ended.code
    finally:
        torch.set_num_threads(threads)
    assert not code, f"{command}: {code}"


@pytest.mark.parametrize("page", [page for page, commands in CHEAP.items() if commands])
def test_cheap_commands_run(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """One after the other each ends well, prints something, and draws what the page shows."""
    (tmp_path / "docs" / "images").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    for command in CHEAP[page]:
        finish(command)
        assert capsys.readouterr().out.strip(), command
    for picture in (tmp_path / "docs" / "images").iterdir():
        shown = frames(REPOSITORY / "docs" / "images" / picture.name)
        drawn = frames(picture)
        assert shown.shape == drawn.shape, f"{picture.name} is not what the command draws"
        # Letters may be drawn a shade differently by another version of a library.
        assert abs(shown.astype(int) - drawn).mean() < 0.5, f"{picture.name} is out of date"


# -- understanding -----------------------------------------------------------------------------


def read_by_script(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a script's own parser take a command, and stop it there."""
    own_cli, own_parse = tyro.cli, argparse.ArgumentParser.parse_args

    def cli(*arguments: Any, **options: Any) -> NoReturn:
        raise Understood(own_cli(*arguments, **options))

    def parse(*arguments: Any, **options: Any) -> NoReturn:
        raise Understood(own_parse(*arguments, **options))

    with monkeypatch.context() as patch:
        patch.setattr(tyro, "cli", cli)
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        with pytest.raises(Understood) as stopped:
            start(command, patch)
    taken = stopped.value.args[0]
    if isinstance(taken, tuple):  # a study, which hands what is not its own to every training
        args, words = taken
        args.plan(words)


def read_installation(words: list[str]) -> None:
    """Check that what is installed is there: constraints, extras, the project itself."""
    parser = argparse.ArgumentParser(exit_on_error=False)
    parser.add_argument("-c", dest="constraints")
    parser.add_argument("-e", dest="project")
    parser.add_argument("packages", nargs="*")
    taken = parser.parse_args(words)
    assert taken.constraints is None or (REPOSITORY / taken.constraints).is_file()
    for wanted in filter(None, [taken.project, *taken.packages]):
        name, extras = re.fullmatch(r"([\w.-]+)(?:\[([\w,]+)\])?", wanted).groups()
        assert name in (".", PROJECT["name"]), f"{wanted}: not this project"
        assert set(filter(None, (extras or "").split(","))) <= {*PROJECT["optional-dependencies"]}


def read_elsewhere(command: str) -> None:
    """Check that a script that runs in another virtual environment knows what it is told."""
    words = shlex.split(command)
    assert ".venv" in command
    scripts = [index for index, word in enumerate(words) if word.endswith(".py")]
    for index in scripts:
        text = (REPOSITORY / words[index]).read_text(encoding="utf-8")
        for option in words[index + 1 :]:
            known = option.removeprefix("--").replace("-", "_")
            assert option == "..." or option in text or known in text, f"{command}: {option}"


@pytest.mark.parametrize("command", LONG)
def test_long_commands_are_understood(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its script exists and takes all its options; what it installs, checks or makes is there."""
    words = command.split()
    if words[:2] == ["pip", "install"]:
        read_installation(shlex.split(command)[2:])
    elif words[:3] == ["python", "-m", "pytest"] or words[1:4] == ["python", "-m", "pytest"]:
        for word in words[words.index("pytest") + 1 :]:
            known = (
                word in ("-n", "2", "-k", "large", "rounded", "-m", "slow")
                or (REPOSITORY / word).exists()
            )
            assert known, f"{command}: {word}"
    elif words[0] == "grep" or any(word.startswith(".venv-") for word in words[:2]):
        read_elsewhere(command)
    elif words[0] == "chromium":
        for file in re.findall(r"docs/[\w./]+", command):
            assert (REPOSITORY / file).is_file(), f"{command}: {file}"
    elif words[:3] == ["python", "-m", "venv"]:
        assert re.fullmatch(r"\.venv(-[a-z]+)?", " ".join(words[3:]))
    elif words[0] in ("ruff", "mypy"):
        lines = (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8").splitlines()
        assert f".venv/bin/{command}" in lines
    else:
        read_by_script(command, monkeypatch)


@pytest.mark.parametrize("command", in_sentences())
def test_commands_in_sentences_are_understood(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside a figure stands the command that made it, and its script still takes it."""
    read_by_script(command, monkeypatch)


def test_nothing_is_left_out_without_need() -> None:
    """Commands are found, and each entry of the list above is there for one of them."""
    assert sum(map(len, CHEAP.values())) >= 8
    assert len(LONG) >= 20
    assert len(in_sentences()) >= 8
    for entry in NOT_RUN:
        begun = [c for c in LONG if c.split()[: len(entry.split())] == entry.split()]
        assert begun, f"no command begins with {entry!r}"


@pytest.mark.parametrize(
    "command",
    [
        "python baselines/meta_dqn.py --sed 0",
        "python baselines/compare.py --n-problem 5",
        "python benchmarks/solvers.py --secs 1",
    ],
)
def test_slips_are_noticed(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """An option that a script does not have is not understood."""
    with pytest.raises((SystemExit, pytest.fail.Exception, ValueError)):
        read_by_script(command, monkeypatch)
    capsys.readouterr()

"""Whole runs, as a user starts them: what they leave behind, also when they are stopped."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import pytest
import tyro

from baselines import evaluate, meta_dqn
from baselines.policy import load_policy
from baselines.runs import RunFolder, read_config, read_metrics, write_atomically

ROOT = Path(__file__).resolve().parents[1]
TINY = (
    "--n-problems=2",
    "--episodes-per-problem=3",
    "--hidden-units=16",
    "--learning-starts=20",
    "--evaluation-problems=20",
)
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def start(*arguments: str, cwd: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=cwd,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture(scope="module")
def two_runs(tmp_path_factory):
    """One tiny run as a script, the same again as a module, at the same time."""
    folder = tmp_path_factory.mktemp("runs")
    script = start(str(ROOT / "baselines" / "meta_dqn.py"), *TINY, "--out=a", cwd=folder)
    module = start("-m", "baselines.meta_dqn", *TINY, "--out=b", cwd=folder)
    outputs = []
    for process in (script, module):
        output, errors = process.communicate(timeout=120)
        assert process.returncode == 0, errors
        assert errors == ""  # no warnings, and no progress bar where there is no terminal
        outputs.append(output)
    return folder, outputs


def test_run_leaves_all_it_promises(two_runs):
    """Config, metrics, weights, table, figures and times are there and readable."""
    folder, (output, _) = two_runs
    run = folder / "a"
    assert sorted(path.name for path in run.iterdir()) == [
        "config.json",
        "evaluation.csv",
        "evaluation.md",
        "fig2_reward.png",
        "fig3_steps.png",
        "fig4_routes.png",
        "metrics.csv",
        "policy.safetensors",
        "timing.json",
    ]
    config = read_config(run)
    assert config["options"]["seed"] == 0
    assert config["options"]["n_problems"] == 2
    assert set(config["options"]) == {field.name for field in fields(meta_dqn.Args)}
    assert len(config["training_problems"]) == 2
    assert {"python", "numpy", "torch", "mapp_env"} <= set(config["environment"]["versions"])

    rows = list(csv.DictReader((run / "metrics.csv").read_text().splitlines()))
    assert tuple(rows[0]) == meta_dqn.METRICS
    assert [row["episode"] for row in rows] == list("123456")
    assert [row["problem"] for row in rows] == list("111222")
    for row in rows:
        assert 1 <= int(row["steps"]) <= 50
        assert int(row["solved"]) == 1 or int(row["steps"]) == 50
        assert float(row["reward"]) <= 0
    assert float(rows[0]["guidance"]) == 1.0
    assert float(rows[-1]["loss"]) > 0

    for name in ("fig2_reward.png", "fig3_steps.png", "fig4_routes.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    timing = json.loads((run / "timing.json").read_text())
    assert timing["episodes"] == 6
    assert timing["steps"] == sum(int(row["steps"]) for row in rows)
    assert (run / "evaluation.md").read_text() in output
    for label in ("network alone", "guidance", "random", "nearest landmark"):
        assert label in output


def test_same_seed_same_bytes(two_runs):
    """Metrics, weights and evaluation of two runs with one seed are the same, byte for byte."""
    folder, _ = two_runs
    for name in ("metrics.csv", "policy.safetensors", "evaluation.csv"):
        assert (folder / "a" / name).read_bytes() == (folder / "b" / name).read_bytes()


def test_saved_run_can_be_evaluated_again(two_runs, capsys):
    """The evaluation script, given the run folder, prints the figures the training printed."""
    folder, _ = two_runs
    evaluate.main(evaluate.Args(policy=str(folder / "a"), problems=20))
    again = capsys.readouterr().out.splitlines()[-1].split("|")[2:]
    lines = (folder / "a" / "evaluation.md").read_text().splitlines()
    alone = next(line for line in lines if "network alone" in line).split("|")[2:]
    assert [cell.strip() for cell in again] == [cell.strip() for cell in alone]


def test_another_seed_another_run(two_runs, tmp_path):
    """Seed 1 trains on other problems and ends with other weights."""
    folder, _ = two_runs
    options = read_config(folder / "a")["options"]
    args = meta_dqn.Args(**{**options, "out": tmp_path / "c", "seed": 1, "evaluation_problems": 0})
    assert meta_dqn.main(args) == 0
    problems = [read_config(run)["training_problems"] for run in (folder / "a", tmp_path / "c")]
    assert problems[0] != problems[1]
    weights = [(run / "policy.safetensors").read_bytes() for run in (folder / "a", tmp_path / "c")]
    assert weights[0] != weights[1]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stopped_run_is_readable(tmp_path, number, code):
    """Ctrl-C leaves whole rows, weights that load, a clear last line and its exit code."""
    process = start("-m", "baselines.meta_dqn", "--hidden-units=16", "--out=run", cwd=tmp_path)
    run = tmp_path / "run"
    metrics = run / "metrics.csv"
    deadline = time.monotonic() + 60
    while not metrics.exists() or metrics.read_text().count("\n") < 5:
        assert time.monotonic() < deadline
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)
    process.send_signal(number)
    output, errors = process.communicate(timeout=30)
    assert process.returncode == code, errors
    assert errors == ""
    assert output.splitlines()[-1] == "stopped early; what there is so far is in run"
    columns = read_metrics(run)
    assert columns["episode"] == list(range(1, len(columns["episode"]) + 1))
    assert metrics.read_text().endswith("\n")
    load_policy(run)
    timing = json.loads((run / "timing.json").read_text())
    assert timing["episodes"] == len(columns["episode"]) < 600


def test_occupied_folder_is_left_alone(tmp_path):
    """A folder that holds anything is refused by name, and nothing in it changes."""
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(ValueError, match="out must be a new or empty folder"):
        meta_dqn.main(meta_dqn.Args(out=tmp_path))
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="out must be"):
        RunFolder(tmp_path / "file", ["a"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "mine.txt"]


def test_impossible_options_leave_no_folder(tmp_path):
    """What the grid cannot give is refused before anything is written."""
    for options in ({"n_landmarks": 41}, {"grid": "nowhere"}, {"n_problems": 700_000}):
        with pytest.raises(ValueError, match=r"n_landmarks|nowhere|n_problems"):
            meta_dqn.main(meta_dqn.Args(out=tmp_path / "run", **options))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("args", [meta_dqn.Args, evaluate.Args])
def test_help_teaches_every_option(args, capsys):
    """--help names every field, and no field is without its line."""
    with pytest.raises(SystemExit) as end:
        tyro.cli(args, args=["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    helps = text.split("--")[1:]
    for field in fields(args):
        name = field.name.replace("_", "-")
        own = [part for part in helps if part.split()[:1] == [name]]
        assert own, name
        words = own[-1].replace("│", " ").split("(default")[0].split()
        assert len(words) > 4, f"{name} is not explained"


def test_bad_option_on_the_command_line_is_an_error(tmp_path):
    """A bad value ends with an error that names it, no traceback, and exit code not 0."""
    process = start("-m", "baselines.meta_dqn", "--discount=2", "--out=run", cwd=tmp_path)
    output, errors = process.communicate(timeout=60)
    assert process.returncode not in (0, None)
    assert "discount must be a number from 0 to 1, got 2.0" in " ".join((output + errors).split())
    assert "Traceback" not in output + errors
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no header"),
        ("episode,steps\n1\n", "line 2: 1 fields"),
        ("episode,steps\n1,2\n2,x\n", "line 3: steps: not a number"),
    ],
)
def test_damaged_metrics_are_refused_by_line(tmp_path, text, message):
    """A metrics file that is no table of numbers is refused with its path and line."""
    (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(ValueError, match=f"metrics.csv.*{message}"):
        read_metrics(tmp_path)


def test_torn_last_row_of_metrics_is_left_out(tmp_path):
    """A row that a killed run had half written does not spoil the others."""
    (tmp_path / "metrics.csv").write_text("episode,steps\n1,20\n2,3")
    assert read_metrics(tmp_path) == {"episode": [1.0], "steps": [20.0]}


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 100_000])
def test_damaged_config_is_refused(tmp_path, text):
    """A config that is no JSON object is refused with its path."""
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match=r"config\.json: not a readable config"):
        read_config(tmp_path)


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    """If the disk gives out while writing, the old content stays and no scrap is left."""
    path = tmp_path / "weights"
    write_atomically(path, b"old")

    def full_disk(handle: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="no space"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert [item.name for item in tmp_path.iterdir()] == ["weights"]

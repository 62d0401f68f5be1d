"""Whole runs, as a user starts them: what they leave behind, also when they are stopped."""

import csv
import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
import tyro
from matplotlib.figure import Figure

import mapp_env
from baselines import evaluate, meta_dqn
from baselines.learning import train
from baselines.learning.config import preset_options
from baselines.learning.training import METRICS
from baselines.policies import figures
from baselines.policies.figures import draw_learning_curves
from baselines.policies.guidance import GuidedPolicy
from baselines.policies.policy import load_policy
from baselines.runs import provenance
from baselines.runs.folder import RunFolder, read_config, read_metrics
from baselines.runs.stop import StopSignals
from mapp_env import Grid

ROOT = Path(__file__).resolve().parents[2]
TINY = (
    "--n-problems=2",
    "--episodes-per-problem=3",
    "--hidden-units=16",
    "--learning-starts=20",
    "--evaluation-problems=20",
)
PROMISED = (
    ".lock",
    "checkpoints",
    "config.json",
    "evaluation.csv",
    "evaluation.md",
    "fig2_reward.png",
    "fig3_steps.png",
    "fig4a_routes.png",
    "fig4b_routes.png",
    "metrics.csv",
    "policy.safetensors",
    "timing.json",
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
    """One tiny run of the paper's preset as a script, again as a module, at the same time."""
    folder = tmp_path_factory.mktemp("runs")
    paper = (*TINY, "--preset=paper")
    script = start(str(ROOT / "baselines" / "meta_dqn.py"), *paper, "--out=a", cwd=folder)
    module = start("-m", "baselines.meta_dqn", *paper, "--out=b", cwd=folder)
    outputs = []
    for process in (script, module):
        output, errors = process.communicate()
        assert process.returncode == 0, errors
        assert errors == ""  # no warnings, and no progress bar where there is no terminal
        outputs.append(output)
    return folder, outputs


def test_a_run_says_the_version_that_it_runs_with(monkeypatch):
    """The environment's version is that of what was imported, not of what is installed."""
    monkeypatch.setattr(mapp_env, "__version__", "9.8.7")
    assert provenance.describe_environment()["versions"]["mapp_env"] == "9.8.7"


def test_run_leaves_all_it_promises(two_runs):
    """Config, metrics, weights, table, figures and times are there and readable."""
    folder, (output, _) = two_runs
    run = folder / "a"
    assert sorted(path.name for path in run.iterdir()) == sorted(PROMISED)
    config = read_config(run)
    assert config["options"]["seed"] == 0
    assert config["options"]["n_problems"] == 2
    assert set(config["options"]) == {field.name for field in fields(meta_dqn.Args)}
    assert len(config["training_problems"]) == 2
    assert {"python", "numpy", "torch", "mapp_env"} <= set(config["environment"]["versions"])

    rows = list(csv.DictReader((run / "metrics.csv").read_text().splitlines()))
    assert tuple(rows[0]) == METRICS
    assert [row["episode"] for row in rows] == list("123456")
    assert [row["problem"] for row in rows] == list("111222")
    for row in rows:
        assert 1 <= int(row["steps"]) <= 50
        assert int(row["solved"]) == 1 or int(row["steps"]) == 50
        assert float(row["reward"]) <= 0
    assert float(rows[0]["guidance"]) == 1.0
    assert float(rows[-1]["loss"]) > 0
    assert int(rows[-1]["updates"]) > 0

    for name in ("fig2_reward.png", "fig3_steps.png", "fig4a_routes.png", "fig4b_routes.png"):
        assert (run / name).read_bytes().startswith(b"\x89PNG")
    timing = json.loads((run / "timing.json").read_text())
    assert timing["episodes"] == 6
    assert timing["steps"] == sum(int(row["steps"]) for row in rows)
    assert timing["updates"] == sum(int(row["updates"]) for row in rows)
    assert (run / "evaluation.md").read_text() in output
    for label in ("network alone", "guidance", "random", "nearest landmark", "earliest arrival"):
        assert label in output


def test_default_preset_leaves_all_it_promises(tmp_path, capsys):
    """The default preset's run folder holds the same files, and no rows of guidance.

    All of them have the mode that the user's mask leaves.
    """
    args = meta_dqn.Args(
        n_problems=2,
        episodes_per_problem=3,
        hidden_units=16,
        code_units=8,
        learning_starts=20,
        updates_per_episode=3,
        batch_size=16,
        evaluation_problems=20,
        out=tmp_path / "run",
    )
    before = os.umask(0o027)
    try:
        assert meta_dqn.main(args) == 0
    finally:
        os.umask(before)
    names = sorted(path.name for path in args.out.iterdir())
    assert names == sorted(PROMISED)
    for path in (args.out, *args.out.rglob("*")):
        assert path.stat().st_mode & 0o777 == (0o750 if path.is_dir() else 0o640), path
    columns = read_metrics(args.out)
    assert tuple(columns) == METRICS
    assert columns["guidance"] == [0.0] * 6
    assert columns["updates"][-1] == 3
    rows = list(csv.reader((args.out / "evaluation.csv").read_text().splitlines()))[1:]
    rules = ["nearest landmark", "earliest arrival"]
    labels = ["network alone", "random", *rules, "optimum of each cost"]
    assert [row[0] for row in rows] == labels
    assert (args.out / "evaluation.md").read_text() in capsys.readouterr().out
    assert load_policy(args.out).spec.kind == "pairs"


def test_same_seed_same_bytes(two_runs):
    """Metrics, weights and evaluation of two runs with one seed are the same, byte for byte."""
    folder, _ = two_runs
    for name in ("metrics.csv", "policy.safetensors", "evaluation.csv"):
        assert (folder / "a" / name).read_bytes() == (folder / "b" / name).read_bytes()


def test_saved_run_can_be_evaluated_again(two_runs, capsys):
    """The evaluation script, given the run folder, prints the figures the training printed."""
    folder, _ = two_runs
    evaluate.main(evaluate.Args(policy=str(folder / "a"), problems=20))
    again = capsys.readouterr().out.splitlines()[2].split("|")[2:]
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


@pytest.mark.parametrize(
    ("number", "code", "preset"), [(signal.SIGINT, 130, "default"), (signal.SIGTERM, 143, "paper")]
)
def test_stopped_run_is_readable(tmp_path, number, code, preset):
    """Ctrl-C leaves whole rows, weights that load, a clear last line and its exit code."""
    options = (f"--preset={preset}", "--hidden-units=16", "--out=run")
    process = start("-m", "baselines.meta_dqn", *options, cwd=tmp_path)
    run = tmp_path / "run"
    metrics = run / "metrics.csv"
    while not metrics.exists() or metrics.read_text().count("\n") < 5:
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)
    process.send_signal(number)
    output, errors = process.communicate()
    assert process.returncode == code, errors
    assert errors == ""
    assert output.splitlines()[-1] == "stopped early; go on with --resume run"
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
    (tmp_path / "large.txt").write_text(Grid(np.zeros((65, 65), dtype=bool)).to_text())
    with pytest.raises(ValueError, match=r"'pairs' would have .* weights on 4,225 cells"):
        meta_dqn.main(meta_dqn.Args(grid=str(tmp_path / "large.txt"), out=tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("args", [meta_dqn.Args, evaluate.Args])
def test_help_teaches_every_option(args, capsys):
    """--help names every field, and no field is without its line."""
    with pytest.raises(SystemExit) as end:
        tyro.cli(args, args=["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    # A new option begins where a line does; a flag has its opposite beside it.
    helps = re.split(r"\n\W*--(?=[a-z])", text)[1:]
    for field in fields(args):
        name = field.name.replace("_", "-")
        own = [part for part in helps if part.split()[0].rstrip(",") == name]
        assert len(own) == 1, name
        words = re.sub(r"[│|]", " ", own[0]).split("(default")[0].split()
        assert len(words) > 4, f"{name} is not explained"


def test_bad_option_on_the_command_line_is_an_error(tmp_path):
    """A bad value ends with an error that names it, no traceback, and exit code not 0."""
    process = start("-m", "baselines.meta_dqn", "--discount=2", "--out=run", cwd=tmp_path)
    output, errors = process.communicate()
    assert process.returncode not in (0, None)
    assert "discount must be a number in 0..1, got 2.0" in " ".join((output + errors).split())
    assert "Traceback" not in output + errors
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no header"),
        ("episode,steps\n1\n", "line 2: 1 fields"),
        ("episode,steps,steps\n1,2,3\n", "line 1: a column is there twice"),
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


@pytest.mark.parametrize(
    "text",
    ["", "[1]", "{", "[" * 100_000, '{"a": 1, "a": 1}', '{"options": {"seed": 1, "seed": 2}}'],
)
def test_damaged_config_is_refused(tmp_path, text):
    """A config that is no JSON object, or says something twice, is refused with its path."""
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(
        ValueError,
        match=r"config\.json: (is not strict JSON|is nested too deeply|must hold a JSON object)",
    ):
        read_config(tmp_path)


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_failed_drawing_keeps_the_old_figures(two_runs, tmp_path, monkeypatch, call):
    """If the disk gives out while figures are written, the old ones stay and no scrap is left."""
    folder, _ = two_runs
    (tmp_path / "metrics.csv").write_bytes((folder / "a" / "metrics.csv").read_bytes())
    paths = draw_learning_curves(tmp_path)
    before = [path.read_bytes() for path in paths]
    assert before == [(folder / "a" / path.name).read_bytes() for path in paths]

    def full_disk(*_: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, call, full_disk)
        with pytest.raises(ValueError, match=r"fig2_reward\.png.*no space"):
            draw_learning_curves(tmp_path, window=3)
    assert [path.read_bytes() for path in paths] == before
    assert len(list(tmp_path.iterdir())) == 3


def test_a_training_that_never_came_to_be_is_in_nobodys_way(tmp_path):
    """Killed before its config was written, its folder is as good as an empty one.

    But a metrics.csv with rows, or any other file, is somebody's.
    """
    run = tmp_path / "run"
    run.mkdir()
    left = {".lock": "", "metrics.csv": "a,b\n", ".0123456789abcdef.tmp": '{"algorithm'}
    for name, text in left.items():
        (run / name).write_text(text)
    RunFolder(run, ["a", "b"]).close()
    assert sorted(path.name for path in run.iterdir()) == [".lock", "metrics.csv"]
    assert (run / "metrics.csv").read_text() == "a,b\n"
    for name, text in {"metrics.csv": "a,b\n1,2\n", "policy.safetensors": "w", "x": ""}.items():
        (run / name).write_text(text)
        with pytest.raises(ValueError, match="out must be a new or empty folder"):
            RunFolder(run, ["a", "b"])
        assert (run / name).read_text() == text
        (run / name).unlink()


def test_a_row_that_has_no_room_is_said_once(tmp_path):
    """Where metrics.csv cannot grow that is an OSError; the folder can be closed, and is free."""
    run = RunFolder(tmp_path / "run", ["text"])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            run.log({"text": "x" * 2000})
        run.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    RunFolder.write_json(run, "config.json", {})
    RunFolder(tmp_path / "run", ["text"], resume=True).close()


SHORT = {
    "n_problems": 1,
    "episodes_per_problem": 2,
    "hidden_units": 8,
    "learning_starts": 8,
    "max_cycles": 10,
}


def test_large_grid_has_no_rows_of_rules(tmp_path, capsys):
    """Above 4,096 cells a run ends well, and says which rows of the table it leaves out."""
    (tmp_path / "large.txt").write_text(Grid(np.zeros((65, 65), dtype=bool)).to_text())
    grid = str(tmp_path / "large.txt")
    run = tmp_path / "run"
    args = preset_options(
        meta_dqn.Args, "paper", grid=grid, out=run, evaluation_problems=3, **SHORT
    )
    assert meta_dqn.main(args) == 0
    output = capsys.readouterr().out
    said = "no rows for nearest landmark and earliest arrival: the grid has more than 4,096 cells"
    assert output.count(said) == 1
    rows = list(csv.reader((run / "evaluation.csv").read_text().splitlines()))
    assert [row[0] for row in rows[-2:]] == ["random, guidance 1", "optimum of each cost"]
    assert (run / "fig4b_routes.png").exists()


@pytest.mark.parametrize(("n_problems", "left"), [(1, 35), (35, 1), (36, 0)])
def test_evaluation_takes_the_unseen_problems_there_are(tmp_path, capsys, n_problems, left):
    """A task with few problems is evaluated on those left, or on none, and says how many."""
    (tmp_path / "tiny.txt").write_text("D....\n.....")
    options = {**SHORT, "n_problems": n_problems, "episodes_per_problem": 1}
    run = tmp_path / "run"
    task = {"grid": str(tmp_path / "tiny.txt"), "n_agents": 1, "n_landmarks": 2}
    args = preset_options(meta_dqn.Args, "paper", out=run, **task, **options)
    assert meta_dqn.main(args) == 0
    line = f"{left} of 1,000 evaluation problems: there are no more unseen ones"
    assert capsys.readouterr().out.splitlines()[0] == line
    assert (run / "evaluation.csv").exists() == (left > 0)
    if left:
        assert f",{left}," in (run / "evaluation.csv").read_text().splitlines()[1]
        evaluate.main(evaluate.Args(policy=str(run)))
        assert f"only {left} of 1,000 problems" in capsys.readouterr().out
    else:
        with pytest.raises(ValueError, match=r"^problems: there is none"):
            evaluate.main(evaluate.Args(policy=str(run)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"max_cycles": 50', '"max_cycles": 1e999', "'1e999' is not a finite number"),
        ('"max_cycles": 50', '"max_cycles": 5.9', r"max_cycles must be .* got 5\.9"),
        ('"max_cycles": 50', '"cycles": 50', "no entry 'max_cycles'"),
        ('"n_agents": 3', '"n_agents": true', "n_agents must be .* got True"),
        ('"n_landmarks": 5', '"n_landmarks": 4', r"training_problems\[0\]: must have 4"),
        ('"training_problems": [', '"training_problems": [[0.5],', r"training_problems\[0\]: "),
        ('"training_problems": [', '"training_problems": [7,', r"training_problems\[0\]: "),
        ('"training_problems"', '"training_problems": 1.5, "rest"', "training_problems a list"),
        ('"options"', '"options": [], "rest"', "options must be an object"),
        ('"n_agents": 3', '"n_agents": 2', "n_agents is 2 by config.json, and 3 by the weights"),
    ],
)
def test_evaluating_a_damaged_run_is_an_error_with_a_name(two_runs, tmp_path, old, new, message):
    """What a config cannot say, or its weights contradict, is refused with folder and entry."""
    folder, _ = two_runs
    text = (folder / "a" / "config.json").read_text()
    assert text.count(old) == 1
    (tmp_path / "config.json").write_text(text.replace(old, new))
    weights = (folder / "a" / "policy.safetensors").read_bytes()
    (tmp_path / "policy.safetensors").write_bytes(weights)
    with pytest.raises(ValueError, match=f"^{tmp_path}.*{message}"):
        evaluate.main(evaluate.Args(policy=str(tmp_path), problems=5))


def test_weights_of_another_grid_are_refused_by_name(two_runs, tmp_path):
    """A run whose config tells of another grid than its weights is not evaluated."""
    folder, _ = two_runs
    config = read_config(folder / "a")
    config["grid"] = "D" + "\n".join(["." * 8] * 8)[1:]
    config["training_problems"] = []
    (tmp_path / "config.json").write_text(json.dumps(config))
    weights = (folder / "a" / "policy.safetensors").read_bytes()
    (tmp_path / "policy.safetensors").write_bytes(weights)
    refused = r"the grid is another one by config\.json than by the weights"
    with pytest.raises(ValueError, match=refused):
        evaluate.main(evaluate.Args(policy=str(tmp_path), problems=5))


@pytest.mark.parametrize("column", ["episode", "problem", "steps", "reward"])
def test_curves_without_a_column_are_refused_by_name(tmp_path, column):
    """A metrics file that lacks what is drawn is refused with its path and the column."""
    columns = [name for name in METRICS if name != column]
    rows = [",".join(columns), ",".join("1" for _ in columns), ""]
    (tmp_path / "metrics.csv").write_text("\n".join(rows))
    with pytest.raises(ValueError, match=rf"metrics\.csv: no column {column}$"):
        draw_learning_curves(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]


def test_bad_window_on_the_command_line_is_an_error(two_runs):
    """A running mean over no episodes ends with an error that names it, and no traceback."""
    folder, _ = two_runs
    process = start("-m", "baselines.figures", "--run=a", "--window=0", cwd=folder)
    output, errors = process.communicate()
    assert process.returncode == 1
    assert output == ""
    assert errors.startswith("error: window must be an integer in 1..")
    assert errors.count("\n") == 1


def test_commit_says_whether_the_code_was_changed(tmp_path, monkeypatch):
    """config.json names the commit, and whether anything was edited since."""

    def git(*words):
        identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        command = ["git", *identity, *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    git("init", "-q")
    (tmp_path / "code.py").write_text("1\n")
    git("add", "code.py")
    git("commit", "-q", "-m", "first")
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "code.py"))
    assert provenance.git_commit() == git("rev-parse", "HEAD")
    (tmp_path / "code.py").write_text("2\n")
    assert provenance.git_commit() == git("rev-parse", "HEAD") + "+changes"


def test_signals_are_as_before_afterwards():
    """Whoever trains as part of a larger program has its own handlers of signals back."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with StopSignals():
        assert all(signal.getsignal(number) != own for number, own in handlers.items())
    assert {number: signal.getsignal(number) for number in handlers} == handlers


def test_an_empty_field_is_no_number(tmp_path):
    """An episode without an update has no loss, which is not a loss of 0."""
    (tmp_path / "metrics.csv").write_text("episode,loss\n1,\n2,0.5\n")
    metrics = read_metrics(tmp_path)
    assert np.isnan(metrics["loss"][0])
    assert metrics["loss"][1] == 0.5


def test_a_folder_without_a_run_is_not_resumed(tmp_path):
    """Where there is no config nothing is made, and the folder is named."""
    (tmp_path / "metrics.csv").write_text("mine\n")
    with pytest.raises(ValueError, match=r"resume must be a run folder|config\.json"):
        RunFolder(tmp_path, ["a"], resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.csv"]
    assert (tmp_path / "metrics.csv").read_text() == "mine\n"


SQUARE = "D..\n...\n...\n"


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_rows_of_the_table(tmp_path, monkeypatch, preset):
    """Evaluated are problems that were not trained on, each rival as its row says."""
    (tmp_path / "square.txt").write_text(SQUARE)
    options = {"grid": str(tmp_path / "square.txt"), "n_agents": 2, "n_landmarks": 1}
    small = {"hidden_units": 8, "learning_starts": 5, "batch_size": 4, "max_cycles": 10}
    counts = {"n_problems": 4, "episodes_per_problem": 1, "evaluation_problems": 4}
    played = {}
    real = train.evaluate

    def evaluated(policy, setting, problems, *others, **more):
        played[more["progress"]] = policy, problems
        return real(policy, setting, problems, *others, **more)

    monkeypatch.setattr(train, "evaluate", evaluated)
    args = preset_options(
        meta_dqn.Args,
        preset,
        **options,
        **small,
        **counts,
        half_precision=True,
        out=tmp_path / "run",
    )
    assert meta_dqn.main(args) == 0
    trained = {row[0] for row in read_config(args.out)["training_problems"]}
    assert len(trained) == 4
    for _, problems in played.values():
        assert {row[0] for row in problems.tolist()} == set(range(1, 9)) - trained
    influences = {
        label: policy.influence
        for label, (policy, _) in played.items()
        if isinstance(policy, GuidedPolicy)
    }
    guided = {"network, guidance 0.1": 0.1, "network, guidance 1": 1.0, "random, guidance 1": 1.0}
    assert influences == (guided if preset == "paper" else {})
    kept = safetensors.torch.load_file(args.out / "policy.safetensors")
    assert {weights.dtype for weights in kept.values()} == {torch.float16}


def test_running_mean_ends_with_its_last_episode():
    """The mean of the last so many episodes is drawn at the last of them; lines part problems."""
    figure = Figure()
    axes = figure.add_subplot()
    values = np.arange(10.0) ** 2
    figures._draw_curve(axes, range(1, 11), values, [1] * 4 + [2] * 6, 3)
    lines = {line.get_label(): line for line in axes.lines}
    mean = lines["mean of the last 3"]
    assert list(mean.get_xdata()) == list(range(3, 11))
    expected = [values[i - 2 : i + 1].mean() for i in range(2, 10)]
    assert mean.get_ydata() == pytest.approx(expected)
    upright = [line for line in axes.lines if len(set(line.get_xdata())) == 1]
    assert [line.get_xdata()[0] for line in upright if len(line.get_xdata())] == [4.5]

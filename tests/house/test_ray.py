"""A study run as Ray tasks is the serial one, also if a worker is killed in the middle of it."""

import contextlib
import csv
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from filelock import FileLock

from baselines import compare
from baselines.learning.summary import MEASURES
from baselines.runs.folder import LOCK_FILE

pytest.importorskip("ray")
# Each starts a Ray of its own: `python -m pytest -m slow tests/house/test_ray.py`.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "examples" / "ray_seeds.py"
MAP = ROOT / "mapp_env" / "grids" / "paper-7x7.txt"
GRID = {"presets": ("default", "paper"), "learners": ("meta",), "seeds": 1, "default_updates": 4}
WORDS = [
    *("--n-problems", "2", "--episodes-per-problem", "8", "--max-cycles", "12"),
    *("--n-landmarks", "2", "--learning-starts", "10", "--update-interval", "5"),
    *("--batch-size", "8", "--hidden-units", "8", "--evaluation-problems", "40"),
    *("--checkpoint-seconds", "0.02"),
]
SAME = ("metrics.csv", "policy.safetensors", "evaluation.csv")


@contextlib.contextmanager
def start(out: Path, home: Path, *words: str) -> Iterator["subprocess.Popen[str]"]:
    """Start the study with Ray; if the test fails, end it."""
    command = [sys.executable, str(SCRIPT), "--out", str(out), "--jobs", "2", *words, *WORDS]
    for name, value in GRID.items():
        values = value if isinstance(value, tuple) else (str(value),)
        command += [f"--{name.replace('_', '-')}", *values]
    # Ray lets workers search the folder that it is started in.
    (home / "torch.py").write_text("raise SystemExit('not the library')\n")
    # Ray keeps a token in the home folder.
    environment = {**os.environ, "HOME": str(home), "RAY_USAGE_STATS_ENABLED": "0"}
    with subprocess.Popen(
        command,
        cwd=home,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as study:
        try:
            yield study
        finally:
            if study.poll() is None:
                study.terminate()


@pytest.fixture
def cluster(tmp_path):
    """Start a Ray cluster of three nodes on this machine; return its address and two of them.

    The head has no core, the two others have one each.
    """
    ray = Path(sys.executable).with_name("ray")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    head = ["--head", f"--port={address.split(':')[1]}", "--num-cpus=0", "--include-dashboard=0"]
    worker = [f"--address={address}", "--num-cpus=1"]
    common = ["--block", "--disable-usage-stats", "--node-ip-address=127.0.0.1"]
    common += ["--object-store-memory=100000000"]
    environment = {**os.environ, "HOME": str(tmp_path)}
    nodes = []
    try:
        for words in (head, worker, worker):
            nodes.append(
                subprocess.Popen(
                    [ray, "start", *words, *common],
                    env=environment,
                    stdout=subprocess.PIPE,
                    text=True,
                    start_new_session=True,
                )
            )
            wait_for_node(nodes[-1])
        yield address, nodes[1:]
    finally:
        for node in nodes:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(node.pid, signal.SIGKILL)
            node.wait()
            assert node.stdout is not None
            node.stdout.close()


def wait_for_node(node: "subprocess.Popen[str]") -> None:
    """Wait until a node says that it runs."""
    assert node.stdout is not None
    for line in node.stdout:
        if "Ray runtime started" in line:
            return
    raise AssertionError(f"a node of Ray has not started: exit code {node.poll()}")


def ancestors(process: int) -> list[int]:
    """Return the process that started `process`, the one that started that, and so on."""
    found = []
    while process > 1:
        # The name in parentheses may hold spaces.
        process = int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
        found.append(process)
    return found


def process_in_the_middle(study: "subprocess.Popen[str]", run: Path) -> int:
    """Wait until a training has saved twice and is not through; return the process it runs in."""
    while study.poll() is None:
        if len(list((run / "checkpoints").glob("*.json"))) == 2:
            assert not (run / "evaluation.csv").exists()
            log = run.with_name(run.name + ".log").read_text()
            return int(log.removeprefix("process ").split()[0])
        time.sleep(0.005)
    raise AssertionError(f"{run}: no second checkpoint; exit code {study.poll()}")


def untimed_csv(path: Path) -> list[dict[str, str]]:
    """Return the table of all digits without its minutes, exactly as written."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert any("minutes" in name for name in rows[0])
    return [{k: v for k, v in row.items() if not k.startswith("minutes ")} for row in rows]


def untimed_table(path: Path) -> list[str]:
    """Return the lines of the printed table without their last column, the minutes."""
    assert list(MEASURES)[-1] == "minutes"
    return [line.rsplit("|", 2)[0] for line in path.read_text().splitlines()]


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """Return the folder of the comparison that compare.py makes."""
    out = tmp_path_factory.mktemp("serial") / "study"
    assert compare.main(compare.Args(out=out, jobs=1, **GRID), WORDS) == 0
    return out


def test_killed_worker_changes_nothing(serial, tmp_path):
    """After kill -9 of a worker in mid-training, weights and tables are those of compare.py.

    Its lock on the run folder outlives it, as a lost machine's does.
    """
    out = tmp_path / "study"
    log = out / "default-meta-seed0.log"
    with start(out, tmp_path) as study:
        os.kill(process_in_the_middle(study, out / "default-meta-seed0"), signal.SIGKILL)
        with FileLock(out / "default-meta-seed0" / LOCK_FILE, timeout=60):
            while log.read_text().count("process ") < 2 and study.poll() is None:
                time.sleep(0.1)
            time.sleep(8)  # without waiting for the lock it would be tried by now
        printed, _ = study.communicate()
    assert study.returncode == 0, printed
    assert log.read_text().count("process ") == 2
    assert "going on from episode" in log.read_text()
    for run in ("default-meta-seed0", "paper-meta-seed0"):
        for name in SAME:
            assert (out / run / name).read_bytes() == (serial / run / name).read_bytes()
    assert untimed_csv(out / "comparison.csv") == untimed_csv(serial / "comparison.csv")
    assert untimed_table(out / "comparison.md") == untimed_table(serial / "comparison.md")
    assert (out / "comparison.png").stat().st_size > 10_000


def test_a_signal_stops_the_tasks_with_a_checkpoint(serial, tmp_path):
    """SIGTERM ends the study with 143; compare.py goes on with what it left, to the same table."""
    out = tmp_path / "study"
    with start(out, tmp_path) as study:
        process_in_the_middle(study, out / "default-meta-seed0")
        study.send_signal(signal.SIGTERM)
        printed, _ = study.communicate()
    assert study.returncode == 128 + signal.SIGTERM, printed
    assert "the same command goes on" in printed
    assert "stopped early" in (out / "default-meta-seed0.log").read_text()
    assert compare.main(compare.Args(out=out, jobs=1, **GRID), WORDS) == 0
    assert "going on from episode" in (out / "default-meta-seed0.log").read_text()
    assert untimed_csv(out / "comparison.csv") == untimed_csv(serial / "comparison.csv")


def test_what_is_lost_too_often_is_reported(tmp_path):
    """With no retry allowed, a killed worker ends the study with an error that names it."""
    out = tmp_path / "study"
    with start(out, tmp_path, "--max-retries", "0") as study:
        os.kill(process_in_the_middle(study, out / "default-meta-seed0"), signal.SIGKILL)
        printed, _ = study.communicate()
    assert study.returncode == 1
    assert "error: these trainings failed: default-meta-seed0: " in printed
    assert not (out / "comparison.md").exists()


def test_lost_node_changes_nothing(serial, cluster, tmp_path):
    """A node of a cluster is lost in mid-training; another goes on with it, to the same bytes.

    Workers find a map file that is named from where the study was started.
    """
    out, (address, nodes) = tmp_path / "study", cluster
    shutil.copy(MAP, tmp_path / "here.txt")
    with start(out, tmp_path, "--address", address, "--grid", "here.txt") as study:
        process = process_in_the_middle(study, out / "default-meta-seed0")
        lost = [node for node in nodes if node.pid in ancestors(process)]
        assert len(lost) == 1
        os.killpg(lost[0].pid, signal.SIGKILL)
        os.kill(process, signal.SIGKILL)
        printed, _ = study.communicate()
    assert study.returncode == 0, printed
    log = (out / "default-meta-seed0.log").read_text()
    assert log.count("process ") == 2
    for run in ("default-meta-seed0", "paper-meta-seed0"):
        for name in SAME:
            assert (out / run / name).read_bytes() == (serial / run / name).read_bytes()
    assert untimed_csv(out / "comparison.csv") == untimed_csv(serial / "comparison.csv")

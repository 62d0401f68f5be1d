"""Run compare.py's grid of presets, learners and seeds as Ray tasks on one or more machines.

    pip install -c constraints.txt -e ".[baselines,ray]"
    python examples/ray_seeds.py --out runs/compare --seeds 5
    python examples/ray_seeds.py --address auto --out /shared/compare --seeds 5

Every training run is a Ray task with one core and its own process. Ray restarts a lost worker
(killed, out of memory, its machine gone) up to ``--max-retries`` times, and the run continues from
the last checkpoint in its run folder, to the same bytes as an uninterrupted run. (On a cluster, the
limit for workers that ran out of memory is set where the cluster is started:
RAY_task_oom_retries, unlimited by default.) OUT must be a folder that all machines see under the
same path, and so must this checkout and, if an option names a file, the working directory.

Output: OUT/comparison.md, .csv and .png as written by ``python baselines/compare.py``, identical
except for the minutes, and the run folder and log of each run. The same command, or compare.py's,
resumes a stopped study. Ctrl-C (exit code 130) and SIGTERM (143) stop all runs, each with a
checkpoint.

Without ``--address`` Ray is started here, on ``--jobs`` cores, and stopped at the end.
"""

import contextlib
import importlib
import os
import socket
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import ray
import tyro
from filelock import FileLock, Timeout

from baselines import compare
from baselines.learning.config import parse_options
from baselines.learning.study import gather, last_line, make_folder
from baselines.learning.trials import Trial, check_folder
from baselines.runs.folder import LOCK_FILE, StopSignals
from mapp_env.validation import check_count

ROOT = Path(__file__).resolve().parents[1]
OBJECT_STORE_BYTES = 200_000_000  # a task returns one number
LEFT_SECONDS = 120.0
"""A process that Ray has lost may keep training for seconds, and a network file system holds a lost
machine's lock until its lease expires, by default after 90 s for NFS 4."""


@dataclass
class Args(compare.Args):
    """Options of a comparison, and where it runs; all others are passed to the training runs."""

    address: str | None = None
    """address of a Ray cluster ("auto": the one this machine belongs to), whose cores are all used,
    regardless of jobs; by default Ray is started here"""
    max_retries: int = 3
    """how often a run whose worker was lost is restarted"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("max_retries", self.max_retries, 0, 1000)


def train(trial: Trial, directory: Path) -> int:
    """Train in this process, or resume the run of a lost one; return the exit code.

    Paths in options are relative to `directory`.

    Raises
    ------
    ValueError
        If the run folder holds anything else, or another process is still training in it.
    """
    # Line buffered: all that remains of a killed process.
    with (
        trial.log.open("a", buffering=1, encoding="utf-8") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        print(f"process {os.getpid()} on {socket.gethostname()}")
        with contextlib.suppress(FileNotFoundError):  # not needed where no option names a file
            os.chdir(directory)
        wait_until_left(trial.folder)
        check_folder(trial)
        if trial.finished:
            return 0
        learner = importlib.import_module(f"baselines.{trial.algorithm}")
        code: int = learner.main(parse_options(type(trial.options), "", trial.arguments))
    return code


def wait_until_left(folder: Path) -> None:
    """Wait until no process has the run folder open, or for LEFT_SECONDS."""
    if folder.is_dir():
        with contextlib.suppress(Timeout), FileLock(folder / LOCK_FILE, timeout=LEFT_SECONDS):
            pass


def start_ray(address: str | None, jobs: int, max_retries: int) -> None:
    """Connect to a cluster, or start Ray here."""
    here = {
        "num_cpus": jobs,
        "object_store_memory": OBJECT_STORE_BYTES,
        "include_dashboard": False,
        "_system_config": {"task_oom_retries": max_retries},
    }
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    variables = {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    # Workers search the folder that Ray is started in before their libraries.
    with contextlib.chdir(ROOT):
        ray.init(
            address or "local",
            log_to_driver=False,
            runtime_env={"env_vars": variables},
            **(here if address is None else {}),
        )


def train_all(trials: Sequence[Trial], max_retries: int, signals: StopSignals) -> list[str]:
    """Train unfinished runs as Ray tasks; return one line for each failure."""
    waiting = [trial for trial in trials if not trial.finished]
    done = len(trials) - len(waiting)
    if done:
        print(f"{done} of {len(trials)} trainings were finished already")
    # One call per process: nothing is left over from the previous run.
    task = ray.remote(num_cpus=1, max_calls=1, max_retries=max_retries)(train)
    running = {task.remote(trial, Path.cwd()): trial for trial in waiting}
    failures: list[str] = []
    told = False
    while running:
        if signals.received is not None and not told:
            told = True
            for reference in running:
                ray.cancel(reference)  # like Ctrl-C: the run saves a checkpoint and returns
        for reference in ray.wait(list(running), timeout=0.5)[0]:
            trial = running.pop(reference)
            problem = describe_failure(reference, trial)
            if problem is None:
                done += 1
                print(f"{done}/{len(trials)} {trial.name}", flush=True)
            elif not told:
                failures.append(f"{trial.name}: {problem}")
                print(f"failed: {failures[-1]}", flush=True)
    return failures


def describe_failure(reference: "ray.ObjectRef[int]", trial: Trial) -> str | None:
    """Return why a finished task failed, or None if it succeeded."""
    try:
        code = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        return str(error.cause)
    except ray.exceptions.RayError as error:  # lost once too often, or cancelled
        return str(error).strip().splitlines()[0]
    return None if code == 0 and trial.finished else last_line(trial.log)


def main(args: Args, words: Sequence[str] = ()) -> int:
    """Train, compare and draw; return the exit code.

    Raises
    ------
    ValueError
        If an option is refused, or a run has failed.
    """
    args.out = args.out.resolve()
    trials = compare.plan_trials(args, words)
    make_folder(args.out)
    signals = StopSignals()
    start_ray(args.address, args.jobs, args.max_retries)
    try:
        with signals:
            failures = train_all(trials, args.max_retries, signals)
    finally:
        ray.shutdown()
    if signals.received is not None:
        print("stopped early; the same command goes on", flush=True)
        return 128 + signals.received
    if failures:
        raise ValueError("these trainings failed: " + "; ".join(failures))
    compare.draw(args.out, gather(trials, args.out / compare.TABLE, compare.COLUMNS))
    return 0


if __name__ == "__main__":
    try:
        own, others = tyro.cli(Args, description=__doc__, return_unknown_args=True)
        sys.exit(main(own, others))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

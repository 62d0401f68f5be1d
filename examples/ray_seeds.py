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
from functools import partial
from pathlib import Path

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

import ray
import tyro
from filelock import FileLock, Timeout

from baselines import compare
from baselines.learning.config import parse_options
from baselines.learning.study import Run
from baselines.runs.folder import LOCK_FILE
from baselines.runs.stop import StopSignals
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


def train(run: Run, directory: Path) -> int:
    """Train in this process, or resume the run of a lost one; return the exit code.

    Paths in options are relative to `directory`.

    Raises
    ------
    ValueError
        If the run folder holds anything else, or another process is still training in it.
    """
    # Line buffered: all that remains of a killed process.
    with (
        run.log.open("a", buffering=1, encoding="utf-8") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        print(f"process {os.getpid()} on {socket.gethostname()}")
        with contextlib.suppress(FileNotFoundError):  # not needed where no option names a file
            os.chdir(directory)
        wait_until_left(run.folder)
        run.check_folder()
        if run.finished:
            return 0
        learner = importlib.import_module(f"baselines.{run.algorithm}")
        code: int = learner.main(parse_options(type(run.options), "", run.arguments))
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


def train_all(runs: Sequence[Run], signals: StopSignals, max_retries: int) -> list[str]:
    """Train unfinished runs as Ray tasks; return one line for each failure."""
    # One call per process: nothing is left over from the previous run.
    task = ray.remote(num_cpus=1, max_calls=1, max_retries=max_retries)(train)
    running = {task.remote(run, Path.cwd()): run for run in runs}
    failures: list[str] = []
    told, done = False, 0
    while running:
        if signals.received is not None and not told:
            told = True
            for reference in running:
                ray.cancel(reference)  # like Ctrl-C: the run saves a checkpoint and returns
        for reference in ray.wait(list(running), timeout=0.5)[0]:
            run = running.pop(reference)
            problem = describe_failure(reference, run)
            if problem is None:
                done += 1
                print(f"{done}/{len(runs)} {run.name}", flush=True)
            elif not told:
                failures.append(f"{run.name}: {problem}")
                print(f"failed: {failures[-1]}", flush=True)
    return failures


def describe_failure(reference: "ray.ObjectRef[int]", run: Run) -> str | None:
    """Return why a finished task failed, or None if it succeeded."""
    try:
        code = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        return str(error.cause)
    except ray.exceptions.RayError as error:  # lost once too often, or cancelled
        return str(error).strip().splitlines()[0]
    return None if code == 0 and run.finished else run.last_words()


def main(args: Args, words: Sequence[str] = ()) -> int:
    """Train, compare and draw; return the exit code.

    Raises
    ------
    ValueError
        If an option is refused, or a run has failed.
    """
    args.out = args.out.resolve()
    args.plan(words)  # what is refused is refused before Ray is started
    start_ray(args.address, args.jobs, args.max_retries)
    try:
        return compare.main(args, words, partial(train_all, max_retries=args.max_retries))
    finally:
        ray.shutdown()


if __name__ == "__main__":
    try:
        own, others = tyro.cli(Args, description=__doc__, return_unknown_args=True)
        sys.exit(main(own, others))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

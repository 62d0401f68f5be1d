"""Studies: the same training with several seeds and options.

Trains what is missing, as many at a time as there are cores, each in a process with one thread, and
goes on where it was stopped; then adds up over the seeds. ``compare.py`` and ``ablate.py`` are
studies.
"""

import os
import subprocess
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.learning.planned_run import Run
from baselines.learning.ranges import Within, check_options
from baselines.learning.summary import Summary, format_study, read_outcome, save_study, summarise
from baselines.runs.stop import StopSignals

Train = Callable[[Sequence[Run], StopSignals], list[str]]


@dataclass
class StudyArgs:
    """Options of any study; all others are handed to the trainings."""

    out: Path = Path("runs/study")
    """folder of the runs and the tables"""
    seeds: Annotated[int, Within(1, 10_000)] = 5
    """trainings of each: seeds 0, 1, 2 ..."""
    jobs: Annotated[int, Within(1, 1024)] = field(default_factory=lambda: os.cpu_count() or 1)
    """trainings at a time"""

    def __post_init__(self) -> None:
        check_options(self)


def check_distinct(name: str, values: Sequence[str]) -> None:
    """Refuse a choice of nothing, or of one thing twice.

    Raises
    ------
    ValueError
        With the option's name.
    """
    if not values or len(set(values)) < len(values):
        raise ValueError(f"{name} must be one or more, none twice, got {values!r}")


def run_study(
    runs: Sequence[Run], path: Path, columns: Sequence[str], train: Train
) -> tuple[int, list[Summary]]:
    """Train what is not finished, add up, write and print the tables.

    Parameters
    ----------
    runs
        All of the study.
    path
        Of the tables, without their suffix.
    columns
        Titles of the cells that name a group.
    train
        Trains; returns what went wrong, a line for each: :func:`train_all`, with a number of jobs.

    Returns
    -------
    int, list of Summary
        The exit code, and what came out of each group if it is 0.

    Raises
    ------
    ValueError
        If the folder cannot be written into, or a training has failed or left no table.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"out: cannot write into {path.parent}: {error}") from error
    finished = sum(run.finished for run in runs)
    if finished:
        print(f"{finished} of {len(runs)} trainings were finished already")
    signals = StopSignals()
    with signals:
        failures = train([run for run in runs if not run.finished], signals)
    if signals.received is not None:
        print("stopped early; the same command goes on", flush=True)
        return 128 + signals.received, []
    if failures:
        raise ValueError("these trainings failed: " + "; ".join(failures))
    summaries = summarise([read_outcome(run) for run in runs])
    save_study(path, columns, summaries)
    print(f"\n{format_study(columns, summaries)}\n")
    return 0, summaries


def train_all(runs: Sequence[Run], signals: StopSignals, jobs: int) -> list[str]:
    """Train, `jobs` at a time; return what went wrong, a line for each."""
    waiting = deque(runs)
    running: dict[subprocess.Popen[bytes], Run] = {}
    failures: list[str] = []
    done = 0
    total = sum(run.options.n_episodes for run in runs)
    bar = tqdm(total=total, unit=" episodes", disable=None)  # None: if there is no terminal
    told = False
    try:
        while running or (waiting and signals.received is None):
            while waiting and len(running) < jobs and signals.received is None:
                run = waiting.popleft()
                running[run.start()] = run
            time.sleep(0.2)
            if signals.received is not None and not told:
                told = True
                for process in running:
                    process.terminate()
            for process in [p for p in running if p.poll() is not None]:
                run = running.pop(process)
                if process.returncode == 0 and run.finished:
                    done += 1
                    bar.write(f"{done}/{len(runs)} {run.name}")
                elif signals.received is None:
                    failures.append(f"{run.name}: {run.last_words()}")
                    bar.write(f"failed: {failures[-1]}")
            bar.n = sum(run.count_episodes() for run in runs)
            bar.set_postfix(finished=f"{done}/{len(runs)}")
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()
        bar.close()
    return failures

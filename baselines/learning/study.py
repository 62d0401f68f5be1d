"""Studies: the same training with several seeds and options, and what came out of all of them.

Trains what is missing, as many at a time as there are cores, each in a process with one thread;
goes on where it was stopped; adds up over the seeds. ``compare.py`` and ``ablate.py`` are studies.
"""

import csv
import io
import math
import os
import subprocess
import time
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.learning.trials import EVALUATION_FILE, Trial
from baselines.runs.folder import (
    METRICS_FILE,
    TIMING_FILE,
    StopSignals,
    parse_json,
    read_metrics,
)
from mapp_env.files import read_bytes, write_text

MAX_TABLE_BYTES = 1 << 20
ROW = "network alone"
RETURN_EPISODES = 100  # the last ones of a training, for its return
N_RESAMPLES = 10_000
CONFIDENCE = 0.95
CUT = 0.25  # from each side: the interquartile mean


# -- trainings ---------------------------------------------------------------------------------


def train_all(trials: Iterable[Trial], jobs: int, signals: StopSignals) -> list[str]:
    """Run what is not finished, `jobs` at a time; return what went wrong, a line for each."""
    trials = list(trials)
    waiting = deque(t for t in trials if not t.finished)
    running: dict[subprocess.Popen[bytes], Trial] = {}
    failures: list[str] = []
    done = len(trials) - len(waiting)
    if done:
        print(f"{done} of {len(trials)} trainings were finished already")
    total = sum(t.options.n_episodes for t in trials)
    progress = tqdm(total=total, unit=" episodes", disable=None)  # None: if there is no terminal
    told = False
    try:
        while running or (waiting and signals.received is None):
            while waiting and len(running) < jobs and signals.received is None:
                trial = waiting.popleft()
                running[start(trial)] = trial
            time.sleep(0.2)
            if signals.received is not None and not told:
                told = True
                for process in running:
                    process.terminate()
            for process in [p for p in running if p.poll() is not None]:
                trial = running.pop(process)
                if process.returncode == 0 and trial.finished:
                    done += 1
                    progress.write(f"{done}/{len(trials)} {trial.name}")
                elif signals.received is None:
                    failures.append(f"{trial.name}: {last_line(trial.log)}")
                    progress.write(f"failed: {failures[-1]}")
            progress.n = sum(count_episodes(t) for t in trials)
            progress.set_postfix(finished=f"{done}/{len(trials)}")
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()
        progress.close()
    return failures


def start(trial: Trial) -> subprocess.Popen[bytes]:
    """Start a training in a process of its own."""
    root = str(Path(__file__).resolve().parents[2])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    with trial.log.open("ab") as log:
        return subprocess.Popen(
            trial.command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            # Ctrl-C is for this process, which passes one signal on: a second would cut a
            # checkpoint short.
            start_new_session=True,
        )


def last_line(path: Path) -> str:
    """Return the last line of a log that says something."""
    lines = path.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "ended without a word"


def count_episodes(trial: Trial) -> int:
    """Return how many episodes are in a training's metrics.csv so far."""
    try:
        return max((trial.folder / METRICS_FILE).read_bytes().count(b"\n") - 1, 0)
    except OSError:
        return 0


# -- figures of one training -------------------------------------------------------------------


class Outcome(NamedTuple):
    """What came out of one trial."""

    trial: Trial
    measures: dict[str, float]  # a key of MEASURES each; NaN where there is none
    returns: np.ndarray  # (episodes,), while training
    solved: np.ndarray  # (episodes,) 0 or 1


MEASURES = {
    "solved %": "solved %",
    "gap %": "gap %",
    "optimal %": "optimal %",
    "cover time": "cover time, unsolved = limit",
    "return": f"return of the last {RETURN_EPISODES} episodes",
    "minutes": "minutes",
}


def read_outcome(trial: Trial) -> Outcome:
    """Read what came out of a trial.

    Raises
    ------
    ValueError
        If a file of it cannot be read.
    """
    path = trial.folder / EVALUATION_FILE
    content = read_bytes(path, MAX_TABLE_BYTES, "a table", ValueError)
    text = content.decode("utf-8", errors="replace")
    rows = {row.get("policy"): row for row in csv.DictReader(io.StringIO(text))}
    metrics = read_metrics(trial.folder)
    limit = trial.options.max_cycles
    try:
        row = rows[ROW]
        timing_file = trial.folder / TIMING_FILE
        timing = parse_json(read_bytes(timing_file, MAX_TABLE_BYTES, "a timing file", ValueError))
        returns, solved = np.array(metrics["reward"]), np.array(metrics["solved"])
        measures = {
            "solved %": float(row["solved %"]),
            "gap %": float(row["gap %"]),
            "optimal %": float(row["optimal %"]),
            "cover time": float(row[f"unsolved = {limit}"]),
            "return": float(returns[-RETURN_EPISODES:].mean()),
            "minutes": float(timing["seconds_total"]) / 60.0,
        }
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not the evaluation of a training: {error!r}") from error
    return Outcome(trial, measures, returns, solved)


# -- statistics --------------------------------------------------------------------------------


class Interval(NamedTuple):
    """An interquartile mean over seeds, and its bootstrap interval; NaN where there is none."""

    mean: np.ndarray  # of the shape of one value
    low: np.ndarray
    high: np.ndarray
    n: int  # values


def interval(values: np.ndarray) -> Interval:
    """Return the interquartile mean over the first axis and its 95 % bootstrap interval.

    The interval is that of the percentiles of 10,000 resamples (2,000 of curves) drawn by a
    generator of its own, so that the same runs give the same table.
    """
    n = len(values)
    if n == 0:
        nothing = np.full(values.shape[1:], np.nan)
        return Interval(nothing, nothing, nothing, 0)
    mean = np.asarray(stats.trim_mean(values, CUT, axis=0))
    if n == 1:
        nothing = np.full(mean.shape, np.nan)
        return Interval(mean, nothing, nothing, 1)
    curve = values.ndim > 1
    found = stats.bootstrap(
        (values,),
        lambda sample, axis: stats.trim_mean(sample, CUT, axis=axis),
        axis=0,
        n_resamples=2_000 if curve else N_RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        batch=200 if curve else None,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(mean, np.asarray(found.low), np.asarray(found.high), n)


class Summary(NamedTuple):
    """What came out of a group of trainings, over its seeds."""

    group: tuple[str, ...]
    outcomes: list[Outcome]
    measures: dict[str, Interval]


def summarise(outcomes: Iterable[Outcome]) -> list[Summary]:
    """Put the outcomes of all seeds of a group together, in their order."""
    groups: dict[tuple[str, ...], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.trial.group, []).append(outcome)
    summaries = []
    for group, members in groups.items():
        measures = {}
        for name in MEASURES:
            values = np.array([outcome.measures[name] for outcome in members])
            # Who solves no problem has no gap.
            measures[name] = interval(values[~np.isnan(values)])
        summaries.append(Summary(group, members, measures))
    return summaries


# -- what is written ---------------------------------------------------------------------------


def format_study(columns: Sequence[str], summaries: Sequence[Summary]) -> str:
    """Return the Markdown table; `columns` are the titles of the groups' cells."""
    lines = [
        "| " + " | ".join([*columns, "seeds", *MEASURES.values()]) + " |",
        "|---" * len(columns) + "|" + "---:|" * (1 + len(MEASURES)),
    ]
    for summary in summaries:
        n = len(summary.outcomes)
        cells = [format_interval(found, n) for found in summary.measures.values()]
        lines.append(f"| {' | '.join(summary.group)} | {n} | {' | '.join(cells)} |")
    return "\n".join(lines)


def format_interval(found: Interval, n_seeds: int) -> str:
    """Return a mean, its interval, and how many seeds have a value if not all have one."""
    if found.n == 0:
        return "-"
    text = f"{found.mean:.2f}"
    if not math.isnan(found.low):
        text += f" [{found.low:.2f}, {found.high:.2f}]"
    return text if found.n == n_seeds else f"{text} ({found.n} of {n_seeds})"


def save_study(path: Path, columns: Sequence[str], summaries: Sequence[Summary]) -> None:
    """Write PATH.csv (all digits) and PATH.md."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = [f"{name} {part}" for name in MEASURES for part in ("IQM", "low", "high", "n")]
    writer.writerow([*columns, "seeds", *parts])
    for summary in summaries:
        figures = [value for found in summary.measures.values() for value in found]
        writer.writerow([*summary.group, len(summary.outcomes), *figures])
    table = format_study(columns, summaries) + "\n"
    write_text(path.with_suffix(".csv"), text.getvalue(), MAX_TABLE_BYTES)
    write_text(path.with_suffix(".md"), table, MAX_TABLE_BYTES)


def run_study(
    trials: Sequence[Trial], path: Path, columns: Sequence[str], jobs: int
) -> tuple[int, list[Summary]]:
    """Train what is not finished, add up, write the tables; return exit code and summaries.

    Raises
    ------
    ValueError
        If the folder cannot be written into, or a training has failed.
    """
    make_folder(path.parent)
    signals = StopSignals()
    with signals:
        failures = train_all(trials, jobs, signals)
    if signals.received is not None:
        print("stopped early; the same command goes on", flush=True)
        return 128 + signals.received, []
    if failures:
        raise ValueError("these trainings failed: " + "; ".join(failures))
    return 0, gather(trials, path, columns)


def make_folder(folder: Path) -> None:
    """Make the folder of a study.

    Raises
    ------
    ValueError
        If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"out: cannot write into {folder}: {error}") from error


def gather(trials: Sequence[Trial], path: Path, columns: Sequence[str]) -> list[Summary]:
    """Add up what came out of finished trainings, write and print the tables.

    Raises
    ------
    ValueError
        If a file of a training cannot be read.
    """
    summaries = summarise([read_outcome(trial) for trial in trials])
    save_study(path, columns, summaries)
    print(f"\n{format_study(columns, summaries)}\n")
    return summaries

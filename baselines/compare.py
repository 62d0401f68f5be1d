"""Compare the meta-agent with independent learners: several seeds of each, with intervals.

Command::

    python baselines/compare.py --out runs/compare
    python baselines/compare.py --out runs/compare --presets paper --learners meta shared --seeds 10

Trains every learner under every preset with seeds 0, 1, 2 ..., as many at a time as there are
cores, each in a process with one thread. Options that are not its own are handed to every training
(``--n-problems 5``). The same command goes on where it was stopped: what is finished is not trained
again, what was interrupted is resumed.

Output: a run folder and a log for each training (OUT/PRESET-LEARNER-seedSEED), and over all of
them comparison.md, comparison.csv and comparison.png: interquartile means over the seeds, with
95 % bootstrap intervals, of the share of unseen problems solved, of the gap, of the cover time (an
unsolved problem counted with the step limit) and of the return of the last training episodes.
Ctrl-C (exit code 130) and SIGTERM (143) stop all trainings, each with a checkpoint.
"""

import csv
import dataclasses
import io
import math
import os
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro
from scipy import stats
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines import independent_dqn, meta_dqn
from baselines.checks import check_count
from baselines.options import Options, parse_options
from baselines.runs import (
    CONFIG_FILE,
    LOCK_FILE,
    METRICS_FILE,
    TIMING_FILE,
    StopSignals,
    parse_json,
    read_bytes,
    read_config,
    read_metrics,
    write_atomically,
)

LEARNERS: dict[str, tuple[str, type[Options], tuple[str, ...]]] = {
    "meta": (meta_dqn.ALGORITHM, meta_dqn.Args, ()),
    "independent": (independent_dqn.ALGORITHM, independent_dqn.Args, ()),
    "shared": (independent_dqn.ALGORITHM, independent_dqn.Args, ("--share-parameters",)),
}
EVALUATION_FILE = "evaluation.csv"  # a training writes it when it is through
MAX_EVALUATION_BYTES = 1024 * 1024
ROW = "network alone"
RETURN_EPISODES = 100  # the last ones of a training, for its return
OWN_ENTRIES = ("out", "resume", "seed", "preset", "share_parameters", "threads", "prefetch")
N_RESAMPLES = 10_000
CONFIDENCE = 0.95
CUT = 0.25  # from each side: the interquartile mean


@dataclass
class Args:
    """Options of a comparison; all others are handed to the trainings."""

    out: Path = Path("runs/compare")
    """folder of the runs, the tables and the figure"""
    presets: tuple[Literal["default", "paper"], ...] = ("default", "paper")
    """presets to compare under"""
    learners: tuple[Literal["meta", "independent", "shared"], ...] = (
        "meta",
        "independent",
        "shared",
    )
    """learners to compare: one network commands all agents, each agent has its own, or all use one
    by themselves"""
    seeds: int = 5
    """trainings of each: seeds 0, 1, 2 ..."""
    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
    """trainings at a time"""

    def __post_init__(self) -> None:
        for name in ("presets", "learners"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name} must be one or more, none twice, got {values!r}")
        check_count("seeds", self.seeds, 1, 10_000)
        check_count("jobs", self.jobs, 1, 1024)


# -- trainings ---------------------------------------------------------------------------------


class Training(NamedTuple):
    """One training of the comparison."""

    preset: str
    learner: str
    seed: int
    folder: Path
    options: Options

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return self.folder.name

    @property
    def finished(self) -> bool:
        """Whether it has been evaluated, the last thing that counts here."""
        return (self.folder / EVALUATION_FILE).is_file()

    def command(self, words: Sequence[str]) -> list[str]:
        """Return the command that starts it, or goes on with it."""
        algorithm = LEARNERS[self.learner][0]
        start = [sys.executable, "-m", f"baselines.{algorithm}"]
        if (self.folder / CONFIG_FILE).exists():
            return [*start, "--resume", str(self.folder)]
        return [*start, *self.words(words), "--out", str(self.folder)]

    def words(self, words: Sequence[str]) -> list[str]:
        """Return its options as words of a command line."""
        own = LEARNERS[self.learner][2]
        # With a process for each core a second thread gains nothing.
        about = ["--preset", self.preset, "--seed", str(self.seed), *own, "--no-prefetch"]
        return [*about, *words]


def plan_trainings(args: Args, words: Sequence[str]) -> list[Training]:
    """Return all trainings, those of one seed together.

    Raises
    ------
    ValueError
        If a learner does not take an option, or a folder holds a training with other options.
    """
    for word in words:
        name = word.partition("=")[0].removeprefix("--").replace("-", "_").removeprefix("no_")
        if word.startswith("--") and name in OWN_ENTRIES:
            raise ValueError(f"{word}: set for each training by the comparison itself")
    trainings = []
    for seed in range(args.seeds):
        for preset in args.presets:
            for learner in args.learners:
                folder = args.out / f"{preset}-{learner}-seed{seed}"
                planned = Training(preset, learner, seed, folder, Options())
                options = parse_options(LEARNERS[learner][1], "", planned.words(words))
                if not options.evaluation_problems:
                    raise ValueError("evaluation_problems must be at least 1 to compare, got 0")
                trainings.append(planned._replace(options=options))
    for training in trainings:
        check_folder(training)
    return trainings


def check_folder(training: Training) -> None:
    """Refuse what was trained with other options; clear away what did not come to begin.

    Raises
    ------
    ValueError
        If the folder holds anything else.
    """
    folder = training.folder
    if not folder.is_dir():
        return
    if (folder / CONFIG_FILE).exists():
        config = read_config(folder)
        options = config.get("options")
        # As JSON has it.
        wanted = {**dataclasses.asdict(training.options), "out": None, "resume": None}
        found = {**options, "out": None, "resume": None} if isinstance(options, dict) else {}
        differing = sorted(
            name for name in wanted | found if wanted.get(name) != found.get(name, wanted)
        )
        if config.get("algorithm") != LEARNERS[training.learner][0] or differing:
            raise ValueError(
                f"out: {folder} holds another training: {', '.join(differing) or 'algorithm'} "
                "differ; compare into another folder"
            )
        return
    for path in list(folder.iterdir()):
        # Killed before its config was written.
        own = path.name in (METRICS_FILE, LOCK_FILE) or path.name.startswith(f".{CONFIG_FILE}.")
        if not own:
            raise ValueError(f"out: {folder} holds something else: {path.name}")
        path.unlink()


def train_all(
    trainings: Iterable[Training], words: Sequence[str], jobs: int, signals: StopSignals
) -> list[str]:
    """Run what is not finished, `jobs` at a time; return what went wrong, a line for each."""
    trainings = list(trainings)
    waiting = deque(t for t in trainings if not t.finished)
    running: dict[subprocess.Popen[bytes], Training] = {}
    failures: list[str] = []
    done = len(trainings) - len(waiting)
    if done:
        print(f"{done} of {len(trainings)} trainings were finished already")
    total = sum(t.options.n_episodes for t in trainings)
    progress = tqdm(total=total, unit=" episodes", disable=None)  # None: if there is no terminal
    told = False
    try:
        while running or (waiting and signals.received is None):
            while waiting and len(running) < jobs and signals.received is None:
                training = waiting.popleft()
                running[start(training, words)] = training
            time.sleep(0.2)
            if signals.received is not None and not told:
                told = True
                for process in running:
                    process.terminate()
            for process in [p for p in running if p.poll() is not None]:
                training = running.pop(process)
                if process.returncode == 0 and training.finished:
                    done += 1
                    progress.write(f"{done}/{len(trainings)} {training.name}")
                elif signals.received is None:
                    failures.append(f"{training.name}: {last_line(log_of(training))}")
                    progress.write(f"failed: {failures[-1]}")
            progress.n = sum(count_episodes(t) for t in trainings)
            progress.set_postfix(finished=f"{done}/{len(trainings)}")
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()
        progress.close()
    return failures


def start(training: Training, words: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a training in a process of its own."""
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    with log_of(training).open("ab") as log:
        return subprocess.Popen(
            training.command(words),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            # Ctrl-C is for this process, which passes one signal on: a second would cut a
            # checkpoint short.
            start_new_session=True,
        )


def log_of(training: Training) -> Path:
    """Return where a training's output goes."""
    return training.folder.with_name(training.folder.name + ".log")


def last_line(path: Path) -> str:
    """Return the last line of a log that says something."""
    lines = path.read_text(errors="replace").strip().splitlines()
    return lines[-1] if lines else "ended without a word"


def count_episodes(training: Training) -> int:
    """Return how many episodes are in a training's metrics.csv so far."""
    try:
        return max((training.folder / METRICS_FILE).read_bytes().count(b"\n") - 1, 0)
    except OSError:
        return 0


# -- figures of one training -------------------------------------------------------------------


class Outcome(NamedTuple):
    """What came out of one training."""

    training: Training
    measures: dict[str, float]  # a key of MEASURES each; NaN where there is none
    returns: np.ndarray  # (episodes,), while training
    solved: np.ndarray  # (episodes,) 0 or 1


MEASURES = {
    "solved %": "solved %",
    "gap %": "gap %",
    "cover time": "cover time, unsolved = limit",
    "return": f"return of the last {RETURN_EPISODES} episodes",
    "minutes": "minutes",
}


def read_outcome(training: Training) -> Outcome:
    """Read what came out of a training.

    Raises
    ------
    ValueError
        If a file of it cannot be read.
    """
    path = training.folder / EVALUATION_FILE
    text = read_bytes(path, MAX_EVALUATION_BYTES).decode("utf-8", errors="replace")
    rows = {row.get("policy"): row for row in csv.DictReader(io.StringIO(text))}
    metrics = read_metrics(training.folder)
    limit = training.options.max_cycles
    try:
        row = rows[ROW]
        timing = parse_json(read_bytes(training.folder / TIMING_FILE, MAX_EVALUATION_BYTES))
        returns, solved = np.array(metrics["reward"]), np.array(metrics["solved"])
        measures = {
            "solved %": float(row["solved %"]),
            "gap %": float(row["gap %"]),
            "cover time": float(row[f"unsolved = {limit}"]),
            "return": float(returns[-RETURN_EPISODES:].mean()),
            "minutes": float(timing["seconds_total"]) / 60.0,
        }
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not the evaluation of a training: {error!r}") from error
    return Outcome(training, measures, returns, solved)


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
    """What came out of a learner under a preset, over its seeds."""

    preset: str
    learner: str
    outcomes: list[Outcome]
    measures: dict[str, Interval]


def summarise(outcomes: Sequence[Outcome]) -> list[Summary]:
    """Put the outcomes of all seeds of a learner under a preset together, in their order."""
    groups: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in outcomes:
        key = (outcome.training.preset, outcome.training.learner)
        groups.setdefault(key, []).append(outcome)
    summaries = []
    for (preset, learner), group in groups.items():
        measures = {}
        for name in MEASURES:
            values = np.array([outcome.measures[name] for outcome in group])
            # Who solves no problem has no gap.
            measures[name] = interval(values[~np.isnan(values)])
        summaries.append(Summary(preset, learner, group, measures))
    return summaries


# -- what is written ---------------------------------------------------------------------------


def format_comparison(summaries: Sequence[Summary]) -> str:
    """Return the Markdown table."""
    lines = [
        "| " + " | ".join(["preset", "learner", "seeds", *MEASURES.values()]) + " |",
        "|---|---|" + "---:|" * (1 + len(MEASURES)),
    ]
    for summary in summaries:
        n = len(summary.outcomes)
        cells = [format_interval(found, n) for found in summary.measures.values()]
        lines.append(f"| {summary.preset} | {summary.learner} | {n} | {' | '.join(cells)} |")
    return "\n".join(lines)


def format_interval(found: Interval, n_seeds: int) -> str:
    """Return a mean, its interval, and how many seeds have a value if not all have one."""
    if found.n == 0:
        return "-"
    text = f"{found.mean:.2f}"
    if not math.isnan(found.low):
        text += f" [{found.low:.2f}, {found.high:.2f}]"
    return text if found.n == n_seeds else f"{text} ({found.n} of {n_seeds})"


def save_comparison(folder: Path, summaries: Sequence[Summary]) -> None:
    """Write comparison.csv (all digits) and comparison.md."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = [f"{name} {part}" for name in MEASURES for part in ("IQM", "low", "high", "n")]
    writer.writerow(["preset", "learner", "seeds", *parts])
    for summary in summaries:
        figures = [value for found in summary.measures.values() for value in found]
        writer.writerow([summary.preset, summary.learner, len(summary.outcomes), *figures])
    write_atomically(folder / "comparison.csv", text.getvalue().encode())
    write_atomically(folder / "comparison.md", (format_comparison(summaries) + "\n").encode())


def main(args: Args, words: Sequence[str] = ()) -> int:
    """Train, compare, draw; return the exit code.

    Raises
    ------
    ValueError
        If an option is refused, or a training has failed.
    """
    trainings = plan_trainings(args, words)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"out: cannot write into {args.out}: {error}") from error
    signals = StopSignals()
    with signals:
        failures = train_all(trainings, words, args.jobs, signals)
    if signals.received is not None:
        print("stopped early; the same command goes on", flush=True)
        return 128 + signals.received
    if failures:
        raise ValueError("these trainings failed: " + "; ".join(failures))
    summaries = summarise([read_outcome(training) for training in trainings])
    save_comparison(args.out, summaries)
    print(f"\n{format_comparison(summaries)}\n")
    # Only here, because drawing takes longer to import than everything before.
    from baselines.figures import draw_comparison

    print(draw_comparison(args.out, summaries, interval))
    return 0


if __name__ == "__main__":
    try:
        own, others = tyro.cli(Args, description=__doc__, return_unknown_args=True)
        sys.exit(main(own, others))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

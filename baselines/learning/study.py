"""Studies: the same training with several seeds and options.

Trains what is missing, as many at a time as there are cores, each in a process with one thread, and
goes on where it was stopped; then adds up over the seeds. ``compare.py`` and ``ablate.py`` are
studies.
"""

import dataclasses
import os
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Annotated, NamedTuple

from filelock import FileLock, Timeout
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.learning.config import Options, option_name, parse_options
from baselines.learning.ranges import Within, check_options
from baselines.learning.summary import (
    Outcome,
    Summary,
    format_study,
    read_outcome,
    save_study,
    summarise,
)
from baselines.runs.folder import (
    CONFIG_FILE,
    EVALUATION_FILE,
    LOCK_FILE,
    METRICS_FILE,
    foreign_entry,
    read_config,
)
from baselines.runs.stop import StopSignals

# What a study sets for each run itself.
OWN_OPTIONS = ("out", "resume", "seed", "preset", "share_parameters", "threads", "prefetch")


# -- one run -----------------------------------------------------------------------------------


class Run(NamedTuple):
    """One training of a study."""

    group: tuple[str, ...]  # what is summed up over the seeds: its row's first cells in the table
    seed: int
    folder: Path
    algorithm: str
    options: Options
    words: tuple[str, ...]  # its options, as words of a command line

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return self.folder.name

    @property
    def finished(self) -> bool:
        """Whether it has been evaluated, the last thing that counts here."""
        return (self.folder / EVALUATION_FILE).is_file()

    @property
    def arguments(self) -> list[str]:
        """Arguments that start or resume it."""
        if (self.folder / CONFIG_FILE).exists():
            return ["--resume", str(self.folder)]
        return [*self.words, "--out", str(self.folder)]

    @property
    def log(self) -> Path:
        """Where its output goes."""
        return self.folder.with_name(self.folder.name + ".log")

    def last_words(self) -> str:
        """Return the last line of its log that says something."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "ended without a word"

    def count_episodes(self) -> int:
        """Return how many episodes are in its metrics.csv so far."""
        try:
            return max((self.folder / METRICS_FILE).read_bytes().count(b"\n") - 1, 0)
        except OSError:
            return 0

    def start(self) -> subprocess.Popen[bytes]:
        """Start it in a process of its own, or go on with it."""
        root = str(Path(__file__).resolve().parents[2])
        paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        with self.log.open("ab") as log:
            return subprocess.Popen(
                # -P: never import from the working directory.
                [sys.executable, "-P", "-m", f"baselines.{self.algorithm}", *self.arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                # Ctrl-C is for this process, which passes one signal on: a second would cut a
                # checkpoint short.
                start_new_session=True,
            )

    def outcome(self) -> Outcome:
        """Read what came out of it, once it is finished."""
        return read_outcome(self.group, self.folder, self.options.max_cycles)

    def check_folder(self) -> None:
        """Raise a ValueError if its folder holds a run with other options, or anything else."""
        folder = self.folder
        if not folder.is_dir():
            return
        if (folder / CONFIG_FILE).exists():
            config = read_config(folder)
            options = config.get("options")
            wanted = {**dataclasses.asdict(self.options), "out": None, "resume": None}
            found = {**options, "out": None, "resume": None} if isinstance(options, dict) else {}
            differing = sorted(
                name for name in wanted | found if wanted.get(name) != found.get(name, wanted)
            )
            if config.get("algorithm") != self.algorithm or differing:
                raise ValueError(
                    f"out: {folder} holds another training: "
                    f"{', '.join(differing) or 'algorithm'} differ; use another folder"
                )
            return
        try:
            with FileLock(folder / LOCK_FILE, timeout=0):
                name = foreign_entry(folder)
                if name is not None:
                    raise ValueError(f"out: {folder} holds something else: {name}")
        except Timeout:
            raise ValueError(f"out: another training is writing into {folder}") from None


def plan_run(
    group: tuple[str, ...],
    seed: int,
    out: Path,
    script: ModuleType,
    own: Sequence[str],
    words: Sequence[str],
) -> Run:
    """Return a run: a learner's script, its `own` words of a command line, those for all runs.

    Raises a ValueError if an option is refused, or its folder holds a training with other options.
    """
    set_here = {*OWN_OPTIONS, *map(option_name, own)}
    for word in words:
        if word.startswith("--") and option_name(word) in set_here:
            raise ValueError(f"{word}: set for each training by the study itself")
    # With a process for each core a second thread gains nothing.
    all_words = ("--seed", str(seed), "--no-prefetch", *own, *words)
    options = parse_options(script.Args, "", all_words)
    if not options.evaluation_problems:
        raise ValueError("evaluation_problems must be at least 1 to compare, got 0")
    name = "-".join("_".join(cell.split()) for cell in (*group, f"seed{seed}"))
    run = Run(group, seed, out / name, script.ALGORITHM, options, all_words)
    run.check_folder()
    return run


# -- all of them -------------------------------------------------------------------------------

# What is summed up over the seeds, and how it is trained: the learner's script, and words of its
# command line.
Groups = dict[tuple[str, ...], tuple[ModuleType, tuple[str, ...]]]
Train = Callable[[Sequence[Run], StopSignals], list[str]]


@dataclass
class StudyArgs(ABC):
    """Options of any study; all others are handed to the trainings."""

    out: Path = Path("runs/study")
    """folder of the runs and the tables"""
    seeds: Annotated[int, Within(1, 10_000)] = 5
    """trainings of each: seeds 0, 1, 2 ..."""
    jobs: Annotated[int, Within(1, 1024)] = field(default_factory=lambda: os.cpu_count() or 1)
    """trainings at a time"""

    def __post_init__(self) -> None:
        check_options(self)

    @abstractmethod
    def groups(self) -> Groups:
        """Return what is compared."""

    def plan(self, words: Sequence[str]) -> list[Run]:
        """Return all runs, those of one seed together; `words` are options for each of them.

        Raises a ValueError if a learner does not take an option, or a folder holds a training with
        other options.
        """
        return [
            plan_run(group, seed, self.out, script, own, words)
            for seed in range(self.seeds)
            for group, (script, own) in self.groups().items()
        ]


def check_distinct(name: str, values: Sequence[str]) -> None:
    """Raise a ValueError, with the option's name, for a choice of nothing or of one thing twice."""
    if not values or len(set(values)) < len(values):
        raise ValueError(f"{name} must be one or more, none twice, got {values!r}")


def run_study(
    args: StudyArgs,
    words: Sequence[str],  # options for each of its runs
    table: str,  # name of the tables
    columns: Sequence[str],  # titles of the cells that name a group
    train: Train | None = None,  # returns what went wrong, a line for each; default: train_all
) -> tuple[int, list[Summary]]:
    """Train what is not finished, add up, write and print the tables.

    Returns the exit code, and what came out of each group if it is 0. Raises a ValueError if an
    option is refused, the folder cannot be written into, or a training has failed.
    """
    runs, signals = args.plan(words), StopSignals()
    train = train or partial(train_all, jobs=args.jobs)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"out: cannot write into {args.out}: {error}") from error
    finished = sum(run.finished for run in runs)
    if finished:
        print(f"{finished} of {len(runs)} trainings were finished already")
    with signals:
        failures = train([run for run in runs if not run.finished], signals)
    if signals.received is not None:
        print("stopped early; the same command goes on", flush=True)
        return 128 + signals.received, []
    if failures:
        raise ValueError("these trainings failed: " + "; ".join(failures))
    summaries = summarise(run.outcome() for run in runs)
    save_study(args.out / table, columns, summaries)
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

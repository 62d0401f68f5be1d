"""One driver for all trainings: what a run does between its first and its last line.

A training advances by one step or one update at a time. Everything around that is here, once for
whatever is trained: the run folder, metrics, checkpoints, signals, the weights, and the table of
policies at the end.
"""

import signal
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.learning.config import TASK, RunOptions
from baselines.networks import Network
from baselines.policies.acting import Acting
from baselines.policies.evaluation import (
    N_ROUTES,
    Evaluation,
    count_unseen,
    evaluate,
    find_optima,
    format_table,
    out_of_reach,
    save_table,
    unseen_problems,
)
from baselines.policies.policy import NetworkPolicy, load_policy, save_policy
from baselines.policies.rules_of_thumb import rules_of_thumb
from baselines.policies.settings import Setting
from baselines.runs.checkpoints import Checkpoints, Resumable, go_on, save
from baselines.runs.folder import METRICS_FILE, TIMING_FILE, WEIGHTS_FILE, RunFolder
from baselines.runs.stop import StopSignals
from baselines.runs.stopwatch import Stopwatch
from mapp_env import Grid


class Trainable(Resumable, ABC):
    """A training that can be stopped between any two steps or updates, and carried on.

    It is of `total` episodes or updates; the weights are written after every `weights_interval`.
    """

    UNIT: ClassVar[str]  # what is counted: episodes or updates
    COLUMNS: ClassVar[tuple[str, ...]]  # of metrics.csv
    SHOWN: ClassVar[tuple[str, ...]]  # those that the progress bar shows

    def __init__(self, args: RunOptions, total: int, weights_interval: int) -> None:
        self.args, self.total, self.weights_interval = args, total, weights_interval
        self.watch = Stopwatch()

    @property
    @abstractmethod
    def network(self) -> Network:
        """What is trained, and kept as the policy."""

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Return what was done so far: episodes, steps, updates."""

    @property
    def done(self) -> int:
        """Episodes or updates so far."""
        return self.counts()[self.UNIT]

    @property
    def finished(self) -> bool:
        """Whether that is all of them."""
        return self.done >= self.total

    @property
    def number(self) -> int:
        """Steps and updates so far."""
        counts = self.counts()
        return counts.get("steps", 0) + counts["updates"]

    @abstractmethod
    def advance(self) -> dict[str, object] | None:
        """Carry out one step or update; return a row of metrics.csv if one is complete."""

    def rivals(self, policy: NetworkPolicy) -> dict[str, Acting]:
        """Return what the table at the end shows beside the policy and the rules of thumb."""
        return {}

    @abstractmethod
    def draw(self, folder: Path, evaluations: dict[str, Evaluation]) -> None:
        """Draw the figures of a run, if it has some, into its folder."""


def run_training(
    args: RunOptions,
    algorithm: str,
    setting: Setting,
    problems: Sequence[Sequence[int]],
    make_training: Callable[[], Trainable],
) -> int:
    """Train, evaluate, draw; return the exit code.

    The options are a resumed run's own; none of the problems trained on is evaluated.

    Raises a ValueError if an option or the folder cannot be used, or the folder cannot be written
    into.
    """
    torch.set_num_threads(args.threads)
    # Validate everything before anything is written.
    n_evaluated = min(args.evaluation_problems, count_unseen(setting, problems))
    unseen = unseen_problems(setting, n_evaluated, problems) if n_evaluated else None
    training = make_training()
    preset = getattr(args, "preset", "default")
    name = f"{algorithm}-{preset}-seed{args.seed}-{datetime.now():%Y%m%d-%H%M%S}"
    folder = args.resume or args.out or Path("runs") / name
    # The folder's name is not part of the config: a run may be moved.
    task = {name: getattr(setting, name) for name in TASK}
    config = {
        "algorithm": algorithm,
        "options": {**asdict(args), **task, "out": None, "resume": None},
        "grid": setting.grid.to_text(),
        "training_problems": problems,
    }
    run = RunFolder(folder, training.COLUMNS, resume=args.resume is not None)
    signals = StopSignals()
    try:
        with signals:
            checkpoints = begin(training, setting.grid, run, config)
            if n_evaluated < args.evaluation_problems:
                print(
                    f"{n_evaluated:,} of {args.evaluation_problems:,} evaluation problems: there "
                    "are no more unseen ones"
                )
            # No progress bar without a terminal: print where to look.
            where = run.path(METRICS_FILE)
            print(f"training, {training.total:,} {training.UNIT}: {where}", flush=True)
            train(training, setting.grid, run, checkpoints, signals)
        counts = ", ".join(f"{count:,} {name}" for name, count in training.counts().items())
        print(f"{counts} in {training.watch}")
        if signals.received is not None:
            raise KeyboardInterrupt
        finish(training, folder, setting, unseen)
    except KeyboardInterrupt:
        print(f"stopped early; go on with --resume {folder}", flush=True)
        return 128 + (signals.received or signal.SIGINT)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be written: {error}") from error
    finally:
        run.close()
    print(f"\nrun folder: {folder}")
    return 0


def begin(training: Trainable, grid: Grid, run: RunFolder, config: dict[str, Any]) -> Checkpoints:
    """Write what a new run is and what it starts from, or take up a resumed one."""
    checkpoints = Checkpoints(run.folder, config)
    if training.args.resume is None:
        run.write_config({**config, "options": {**config["options"], "out": str(run.folder)}})
    elif go_on(run, checkpoints, training):
        print(f"going on from {training.UNIT.removesuffix('s')} {training.done + 1:,}")
    if not checkpoints.numbers():
        # To the bit: it may have to start again.
        save_policy(run.path(WEIGHTS_FILE), training.network, grid)
    return checkpoints


def train(
    training: Trainable, grid: Grid, run: RunFolder, checkpoints: Checkpoints, signals: StopSignals
) -> None:
    """Train until all is done, or a signal comes; then leave a checkpoint."""
    weights, half = run.path(WEIGHTS_FILE), training.args.half_precision
    if not checkpoints.numbers():
        save(run, checkpoints, training)
    bar = tqdm(
        total=training.total,
        initial=training.done,
        unit=f" {training.UNIT}",
        disable=None,  # None: if there is no terminal
    )
    saved = time.monotonic()
    while not training.finished and signals.received is None:
        row = training.advance()
        bar.update(training.done - bar.n)
        if row is not None:
            run.log(row)
            bar.set_postfix({name: row[name] for name in training.SHOWN})
            if training.done % training.weights_interval == 0:
                save_policy(weights, training.network, grid, half)
            training.watch.lap("log and save")
        if time.monotonic() - saved >= training.args.checkpoint_seconds:
            save(run, checkpoints, training)
            training.watch.lap("log and save")
            saved = time.monotonic()
    bar.close()
    save(run, checkpoints, training)
    save_policy(weights, training.network, grid, half)
    training.watch.lap("log and save")
    seconds = {name: round(spent, 3) for name, spent in training.watch.seconds.items()}
    times = {"seconds": seconds, "seconds_total": round(training.watch.total, 3)}
    run.write_json(TIMING_FILE, {**training.counts(), **times})


def finish(training: Trainable, folder: Path, setting: Setting, unseen: np.ndarray | None) -> None:
    """Evaluate the policy and its rivals on unseen problems; write the table and the figures."""
    evaluations: dict[str, Evaluation] = {}
    if unseen is not None:
        policy = load_policy(folder)  # as it was kept, so perhaps rounded
        policies = {"network alone": policy, **training.rivals(policy), **rules_of_thumb(setting)}
        optima = find_optima(setting, unseen)
        for line in out_of_reach(setting, optima):
            print(line)
        evaluations = {
            label: evaluate(acting, setting, unseen, optima, n_kept=N_ROUTES, progress=label)
            for label, acting in policies.items()
        }
        save_table(folder, evaluations)
        print(f"\n{len(unseen):,} unseen problems:\n\n{format_table(evaluations)}")
    training.draw(folder, evaluations)

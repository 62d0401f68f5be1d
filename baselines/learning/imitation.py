"""Imitation: a network is taught, state by state, which joint actions to take.

What distillation (``distill.py``: the exact solver says it) and self-improvement
(``self_improve.py``: the best of several own episodes says it) have in common: the updates, the run
folder, checkpoints, and the table at the end. A pupil's network is trained as a classifier: its
outputs are read as logits, and the greedy policy takes the largest, as it does of values.
"""

import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import tyro
from torch import Tensor
from tqdm import tqdm  # type: ignore[import-untyped]

from baselines.learning.config import refuse_beside_resume
from baselines.learning.optimiser import optimiser_arrays, restore_optimiser
from baselines.networks import Network
from baselines.policies.evaluation import (
    count_unseen,
    evaluate,
    find_optima,
    format_table,
    save_table,
    unseen_problems,
)
from baselines.policies.policy import load_policy, save_policy
from baselines.policies.rules_of_thumb import rules_of_thumb
from baselines.policies.settings import PolicyOfRun, Setting, load_run
from baselines.runs.checkpoints import Checkpoints, go_on, part, save
from baselines.runs.folder import (
    TIMING_FILE,
    WEIGHTS_FILE,
    RunFolder,
    StopSignals,
    default_folder,
    read_config,
)
from mapp_env import Grid
from mapp_env.validation import check_count, check_flag, check_number

METRICS = ("updates", "loss")
LOGGED = 100  # updates in a row of metrics.csv
WARMUP = 200  # updates over which the step size rises to its value


@dataclass(frozen=True)
class ImitationOptions:
    """Options of an imitation."""

    seed: int = 0
    """seed of everything random"""
    out: Path | None = None
    """the run folder, new or empty; by default runs/ALGORITHM-default-seedSEED-TIME"""
    resume: Path | None = None
    """a run folder whose training goes on where it stopped, with its own options"""
    updates: int = 60_000
    """steps of Adam"""
    learning_rate: float = 0.003
    """step size of Adam; it falls in a straight line to 0"""
    weight_decay: float = 0.05
    """share of every weight, times the step size, that each update takes off it"""
    half_precision: bool = True
    """keep the finished policy's weights in 16 bits"""
    evaluation_problems: int = 1000
    """problems for the table at the end, 0 for none"""
    checkpoint_seconds: float = 30.0
    """seconds between two checkpoints; 0 for one after every update"""
    threads: int = 1
    """threads of PyTorch"""

    def __post_init__(self) -> None:
        check_count("seed", self.seed, 0, 2**63 - 1)
        check_count("updates", self.updates, 1, 1_000_000_000)
        check_number("learning_rate", self.learning_rate, 1e-12, 1.0)
        check_number("weight_decay", self.weight_decay, 0.0, 1.0)
        check_flag("half_precision", self.half_precision)
        check_count("evaluation_problems", self.evaluation_problems, 0, 1_000_000)
        check_number("checkpoint_seconds", self.checkpoint_seconds, 0.0, 1e9)
        check_count("threads", self.threads, 1, 1024)


class Pupil(ABC):
    """A network, its optimiser, and what it is taught.

    Parameters
    ----------
    args
        Options.
    network
        What is trained.
    rng
        Source of everything random.
    """

    def __init__(self, args: ImitationOptions, network: Network, rng: np.random.Generator) -> None:
        self.args, self.network, self.rng = args, network, rng
        self.spec = network.spec
        # Without decay the weights grow as the gradients vanish, and steps of Adam become noise.
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), weight_decay=args.weight_decay, fused=True
        )
        self.updates = 0
        self.losses: list[float] = []  # since the last row of metrics.csv
        self.seconds = 0.0

    @abstractmethod
    def lesson(self) -> Tensor:
        """Return the loss of the next batch."""

    @abstractmethod
    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the arrays that lessons change, by part and name."""

    @abstractmethod
    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""

    def update(self) -> None:
        """Learn from one batch."""
        start = time.perf_counter()
        loss = self.lesson()
        rate = self.args.learning_rate * (1 - self.updates / self.args.updates)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * min(1.0, (self.updates + 1) / WARMUP)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.updates += 1
        self.losses.append(loss.item())
        self.seconds += time.perf_counter() - start

    # -- checkpoints

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        parts = {
            "network": {name: t.numpy() for name, t in self.network.state_dict().items()},
            "optimiser": optimiser_arrays(self.optimiser),
            **self.own_arrays(),
        }
        return {
            f"{name}.{key}": value for name, named in parts.items() for key, value in named.items()
        }

    def state(self) -> dict[str, Any]:
        """Return all else that changes, ready for JSON."""
        return {
            "updates": self.updates,
            "rng": self.rng.bit_generator.state,
            "losses": self.losses,
            "seconds": self.seconds,
        }

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what was saved."""
        weights = part(arrays, "network")
        self.network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
        self.updates, self.seconds = state["updates"], state["seconds"]
        restore_optimiser(self.optimiser, part(arrays, "optimiser"), self.updates)
        self.restore_own(arrays)
        self.rng.bit_generator.state = state["rng"]
        self.losses = list(state["losses"])

    @property
    def number(self) -> int:
        """Updates so far."""
        return self.updates

    def check_metrics(self, table: dict[str, list[float]]) -> None:
        """Compare where it stands with the rows that are written.

        Raises
        ------
        ValueError
            If they differ.
        """
        rows, left = divmod(self.updates, LOGGED)
        if (len(table["updates"]), len(self.losses)) != (rows, left):
            raise ValueError(
                f"after {self.updates} updates there must be {rows} rows in metrics.csv and {left} "
                f"losses, got {len(table['updates'])} and {len(self.losses)}"
            )


# -- loss --------------------------------------------------------------------------------------


def good_actions_loss(scores: Tensor, good: Tensor) -> Tensor:
    """Return minus the log-probability of taking a good action, its mean over states.

    Parameters
    ----------
    scores
        (B, A ** N) the network's output, read as logits.
    good
        (B, A ** N) bool, which joint actions are good; at least one in each state.
    """
    of_good = scores.masked_fill(~good, -torch.inf).logsumexp(1)
    return (scores.logsumexp(1) - of_good).mean()


# -- the run -----------------------------------------------------------------------------------

Chosen = TypeVar("Chosen", bound=ImitationOptions)


def parse_arguments(kind: type[Chosen], description: str) -> Chosen:
    """Read the options from this process's command line.

    Raises
    ------
    ValueError
        If others are given beside ``resume``.
    """
    args = tyro.cli(kind, description=description)
    refuse_beside_resume(args.resume, sys.argv[1:])
    return args


def own_options(args: Chosen, algorithm: str) -> Chosen:
    """Return a run's options: if it is resumed, those it was started with.

    Raises
    ------
    ValueError
        If others are given beside ``resume``, or the folder is none of this algorithm's runs.
    """
    if args.resume is None:
        return args
    kind = type(args)
    if args != kind(resume=args.resume):
        raise ValueError("resume goes on with the run's own options: leave out all others")
    config = read_config(args.resume)
    options = config.get("options")
    if config.get("algorithm") != algorithm or not isinstance(options, dict):
        raise ValueError(f"{args.resume}: not a run of {algorithm}")
    names = {field.name for field in fields(kind)}
    if not names <= options.keys():
        raise ValueError(f"{args.resume}: its options are not those of this version")
    own = {name: options[name] for name in names}
    try:
        return kind(**{**own, "out": None, "resume": args.resume})
    except TypeError as error:
        raise ValueError(f"{args.resume}: {error}") from error


def start_of(resume: Path | None, policy: str | Path | None) -> str | Path | None:
    """Return where the policy is that a training starts from.

    Of a resumed run it is in its own folder, if the run was not killed before it was there.
    """
    own = resume is not None and (resume / WEIGHTS_FILE).is_file()
    return resume if own else policy


def starting_point(policy: str | Path | None) -> PolicyOfRun:
    """Return the meta-agent that a training starts from.

    Raises
    ------
    ValueError
        If none is named, or there is none of this name.
    """
    if policy is None:
        raise ValueError("policy must be the run folder of a trained meta-agent, got none")
    return load_run(policy)


def train(
    pupil: Pupil, run: RunFolder, checkpoints: Checkpoints, signals: StopSignals, grid: Grid
) -> None:
    """Teach until all updates are done, or a signal comes; then leave a checkpoint."""
    args = pupil.args
    if not checkpoints.numbers():
        save(run, checkpoints, pupil)
    bar = tqdm(total=args.updates, initial=pupil.updates, unit=" updates", disable=None)
    saved = time.monotonic()
    while pupil.updates < args.updates and signals.received is None:
        pupil.update()
        bar.update()
        if pupil.updates % LOGGED == 0:
            run.log({"updates": pupil.updates, "loss": sum(pupil.losses) / LOGGED})
            pupil.losses.clear()
        if time.monotonic() - saved >= args.checkpoint_seconds:
            save(run, checkpoints, pupil)
            saved = time.monotonic()
    bar.close()
    save(run, checkpoints, pupil)
    save_policy(run.path(WEIGHTS_FILE), pupil.network, grid, args.half_precision)
    run.write_json(
        TIMING_FILE, {"updates": pupil.updates, "seconds_total": round(pupil.seconds, 3)}
    )


def run_imitation(
    args: ImitationOptions,
    algorithm: str,
    setting: Setting,
    make_pupil: Callable[[], Pupil],
    seen: list[tuple[int, ...]],
) -> int:
    """Teach and evaluate; return the exit code.

    Parameters
    ----------
    args
        Options, of a resumed run its own.
    algorithm
        Name of the run's kind.
    setting
        What the agents have to do.
    make_pupil
        Builds what is taught.
    seen
        Problems that are none of those evaluated.
    """
    torch.set_num_threads(args.threads)
    # All that can be refused is refused before anything is written.
    n_evaluated = min(args.evaluation_problems, count_unseen(setting, seen))
    pupil = make_pupil()
    folder = args.resume or args.out or default_folder(algorithm, "default", args.seed)
    task = {name: getattr(setting, name) for name in ("n_agents", "n_landmarks", "max_cycles")}
    identity = {
        "algorithm": algorithm,
        "options": {**asdict(args), **task, "out": None, "resume": None},
        "grid": setting.grid.to_text(),
        "training_problems": seen,
    }
    run = RunFolder(folder, METRICS, resume=args.resume is not None)
    signals = StopSignals()
    try:
        checkpoints = Checkpoints(folder, identity)
        with signals:
            if args.resume is None:
                run.write_config(identity)
            elif go_on(run, checkpoints, pupil):
                print(f"going on from update {pupil.updates + 1:,}")
            if not checkpoints.numbers():
                # What it starts from, to the bit: it may have to start again.
                save_policy(run.path(WEIGHTS_FILE), pupil.network, setting.grid)
            train(pupil, run, checkpoints, signals, setting.grid)
        if signals.received is not None:
            raise KeyboardInterrupt
        if n_evaluated:
            problems = unseen_problems(setting, n_evaluated, seen)
            policy = load_policy(folder)  # as it was kept, so perhaps rounded
            optima = find_optima(setting, problems)
            table = {
                label: evaluate(acting, setting, problems, optima)
                for label, acting in {"network alone": policy, **rules_of_thumb(setting)}.items()
            }
            save_table(folder, table)
            print(format_table(table))
    except KeyboardInterrupt:
        print(f"stopped early; go on with --resume {folder}", flush=True)
        return 128 + (signals.received or signal.SIGINT)
    except OSError as error:
        raise ValueError(f"{folder}: cannot be written: {error}") from error
    finally:
        run.close()
    print(f"\nrun folder: {folder}")
    return 0

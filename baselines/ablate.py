"""Change one component of the default preset at a time, to see what each is worth.

Command::

    python baselines/ablate.py --out runs/ablation
    python baselines/ablate.py --out runs/ablation --variants "double DQN" --seeds 10

Trains the default preset and every variant of it, one component changed in each, with seeds 0, 1, 2
..., as many at a time as there are cores, each in a process with one thread. Options that are not
its own are handed to every training (``--updates-per-episode 10``). The same command goes on where
it was stopped.

Output: a run folder and a log for each training (OUT/VARIANT-seedSEED), and over all of them
ablation.md and ablation.csv: interquartile means over the seeds with 95 % bootstrap intervals.
Ctrl-C (exit code 130) and SIGTERM (143) stop all trainings, each with a checkpoint.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from baselines import meta_dqn
from baselines.learning.study import run_study
from baselines.learning.trials import Trial, plan_trial
from mapp_env.validation import check_choice, check_count

VARIANTS: dict[str, tuple[str, ...]] = {
    "default": (),
    "plain numbers": ("--network", "paper", "--hidden-units", "512"),
    "12 outputs": ("--outputs", "agents"),
    "replay as played": ("--replay", "stored"),
    "one action a state": ("--tried-actions", "1"),
    "paper's reward alone": ("--final-reward", "same"),
    "-1 a step alone": ("--final-from", "0"),
    "no wider action gap": ("--action-gap", "0"),
    "no retries": ("--imagined-retries", "0"),
    "double DQN": ("--double",),
    "no dueling": ("--no-dueling",),
    "constant step size": ("--no-learning-rate-falls",),
    "guidance": ("--guidance-start", "1", "--guidance-end", "0.1"),
}


@dataclass
class Args:
    """Options of an ablation; all others are handed to the trainings."""

    out: Path = Path("runs/ablation")
    """folder of the runs and the tables"""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """what to train"""
    seeds: int = 5
    """trainings of each: seeds 0, 1, 2 ..."""
    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
    """trainings at a time"""

    def __post_init__(self) -> None:
        for variant in self.variants:
            check_choice("variants", variant, tuple(VARIANTS))
        if not self.variants or len(set(self.variants)) < len(self.variants):
            raise ValueError(f"variants must be one or more, none twice, got {self.variants!r}")
        check_count("seeds", self.seeds, 1, 10_000)
        check_count("jobs", self.jobs, 1, 1024)


def plan_trials(args: Args, words: Sequence[str]) -> list[Trial]:
    """Return all trainings, those of one seed together.

    Raises
    ------
    ValueError
        If an option is refused, or a folder holds a training with other options.
    """
    kind = (meta_dqn.ALGORITHM, meta_dqn.Args)
    return [
        plan_trial((variant,), seed, args.out, kind, VARIANTS[variant], words)
        for seed in range(args.seeds)
        for variant in args.variants
    ]


def main(args: Args, words: Sequence[str] = ()) -> int:
    """Train and add up; return the exit code.

    Raises
    ------
    ValueError
        If an option is refused, or a training has failed.
    """
    trials = plan_trials(args, words)
    return run_study(trials, args.out / "ablation", ("variant",), args.jobs)[0]


if __name__ == "__main__":
    try:
        own, others = tyro.cli(Args, description=__doc__, return_unknown_args=True)
        sys.exit(main(own, others))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

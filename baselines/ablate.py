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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from baselines import meta_dqn
from baselines.learning.config import run_script
from baselines.learning.study import Groups, StudyArgs, check_distinct, run_study
from mapp_env.validation import check_choice

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
class Args(StudyArgs):
    """Options of an ablation; all others are handed to the trainings."""

    out: Path = Path("runs/ablation")
    """folder of the runs and the tables"""
    variants: tuple[str, ...] = tuple(VARIANTS)
    """what to train"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_distinct("variants", self.variants)
        for variant in self.variants:
            check_choice("variants", variant, tuple(VARIANTS))

    def groups(self) -> Groups:
        """Return the variants."""
        return {(variant,): (meta_dqn, VARIANTS[variant]) for variant in self.variants}


def main(args: Args, words: Sequence[str] = ()) -> int:
    """Train and add up; return the exit code.

    Raises a ValueError if an option is refused, or a training has failed.
    """
    return run_study(args, words, "ablation", ("variant",))[0]


if __name__ == "__main__":
    run_script(main, Args, __doc__, others=True)

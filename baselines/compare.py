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

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal

from baselines import independent_dqn, meta_dqn
from baselines.learning.config import run_script
from baselines.learning.study import Groups, StudyArgs, Train, check_distinct, run_study
from baselines.learning.summary import Summary, interval
from mapp_env.validation import check_count

LEARNERS: dict[str, tuple[ModuleType, tuple[str, ...]]] = {
    "meta": (meta_dqn, ()),
    "independent": (independent_dqn, ()),
    "shared": (independent_dqn, ("--share-parameters",)),
}
COLUMNS = ("preset", "learner")


@dataclass
class Args(StudyArgs):
    """Options of a comparison; all others are handed to the trainings."""

    out: Path = Path("runs/compare")
    """folder of the runs, the tables and the figure"""
    presets: tuple[Literal["default", "paper"], ...] = ("default", "paper")
    """presets to compare under"""
    learners: tuple[Literal[tuple(LEARNERS)], ...] = tuple(LEARNERS)  # type: ignore[valid-type]
    """learners to compare: one network commands all agents, each agent has its own, or all use one
    by themselves"""
    default_updates: int | None = None
    """updates after each episode under the preset default (32, its own)"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_distinct("presets", self.presets)
        check_distinct("learners", self.learners)
        if self.default_updates is not None:
            check_count("default_updates", self.default_updates, 1, 1_000_000)
            if "default" not in self.presets:
                raise ValueError(
                    f"default_updates has no effect with presets {self.presets!r}: leave it out"
                )

    def groups(self) -> Groups:
        """Return each learner under each preset."""
        found: Groups = {}
        for preset, learner in itertools.product(self.presets, self.learners):
            script, own = LEARNERS[learner]
            updates = ("--updates-per-episode", str(self.default_updates or 32))
            own = ("--preset", preset, *own, *(updates if preset == "default" else ()))
            found[preset, learner] = script, own
        return found


def main(args: Args, words: Sequence[str] = (), train: Train | None = None) -> int:
    """Train, compare, draw; return the exit code.

    Raises a ValueError if an option is refused, or a training has failed.
    """
    code, summaries = run_study(args, words, "comparison", COLUMNS, train)
    if code == 0:
        draw(args.out, summaries)
    return code


def draw(out: Path, summaries: Sequence[Summary]) -> None:
    """Draw the figure."""
    # Only here, because drawing takes longer to import than everything before.
    from baselines.policies.figures import draw_comparison

    print(draw_comparison(out, summaries, interval))


if __name__ == "__main__":
    run_script(main, Args, __doc__, others=True)

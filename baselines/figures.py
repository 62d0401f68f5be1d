"""The paper's figures, drawn from a run folder.

Command::

    python baselines/figures.py --run runs/meta_dqn-paper-seed0-...

Figures 2 and 3 (reward and steps per episode) are read from metrics.csv, so they can be drawn
again from any run, a stopped one too. Figure 4 (routes) is drawn when a training ends.
"""

from dataclasses import dataclass
from pathlib import Path

from baselines.learning.config import run_script
from baselines.policies.figures import draw_learning_curves


@dataclass
class Args:
    """Options of drawing a run again."""

    run: Path
    """the run folder; the figures are written into it"""
    window: int = 30
    """episodes in the running mean"""


def main(args: Args) -> None:
    """Draw the figures, and print where they are."""
    print(*draw_learning_curves(args.run, args.window), sep="\n")


if __name__ == "__main__":
    run_script(main, Args, __doc__)

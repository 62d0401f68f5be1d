"""Evaluate a policy against the proven optimum.

Command::

    python baselines/evaluate.py --policy runs/meta_dqn-paper-seed0-... --problems 1000
    python baselines/evaluate.py --policy nearest --problems universe

Output: a table of the policy, two rules of thumb and the optimum, with the share of problems
solved; of the cover time the mean gap to the proven optimum, the share of optimal problems and the
largest gap; and the means of all three costs. A problem is solved when every landmark was visited
within the step limit; gaps and costs are those of the solved problems, and the cover time is shown
a second time over all problems, an unsolved one counted with the step limit. Optima are proven up
to 20 landmarks; beyond, there are no gaps. Below the table: for each policy the regret, the mean
number of steps by which a decision makes the optimum of what is left longer than it was, and which
shares of it were lost at the first decision, later, and with one landmark left.

The rules of thumb: "nearest landmark", in which each agent walks to the unvisited landmark nearest
to itself, whatever the others do; and "earliest arrival", which gives each landmark to the agent
that can be there first, one landmark after another, on its way from those it already has.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch

from baselines.learning.config import run_script
from baselines.learning.ranges import Share, Within, check_options
from baselines.policies.acting import Acting
from baselines.policies.evaluation import (
    EVALUATION_SEED,
    MAX_EXACT_LANDMARKS,
    Evaluation,
    count_problems,
    count_unseen,
    evaluate,
    every_problem,
    find_optima,
    format_table,
    out_of_reach,
    regret_lines,
    save_table,
    unseen_problems,
)
from baselines.policies.guidance import Guidance, GuidedPolicy
from baselines.policies.rules_of_thumb import RULES, RandomPolicy, rules_of_thumb
from baselines.policies.settings import N_ACTIONS, Setting, load_run
from mapp_env.grids import find_grid
from mapp_env.validation import check_count

RIVALS = ("random", *RULES)
SETTING = ("grid", "n_agents", "n_landmarks", "max_cycles")


@dataclass
class Args:
    """Options of an evaluation."""

    policy: str
    """a pretrained policy's name, a run folder or a weights file; or "random", "nearest" (landmark)
    or "earliest" (arrival)"""
    problems: int | Literal["universe"] = 1000
    """number of distinct problems, none of them a training problem of the run; or "universe": all
    problems of the grid, training problems too"""
    seed: Annotated[int, Within(0, 2**63 - 1)] = EVALUATION_SEED
    """seed of the problems and of everything random in the policy"""
    guidance: Share = 0.0
    """probability that an agent with a close unvisited landmark in sight is sent there instead"""
    guidance_reach: int | None = None
    """with guidance: how many moves away a landmark is still close (3)"""
    grid: str | None = None
    """bundled grid or map file, for "random", "nearest" and "earliest" (paper-7x7); a run brings
    its own"""
    n_agents: int | None = None
    """number of agents, for "random", "nearest" and "earliest" (3); a run brings its own"""
    n_landmarks: int | None = None
    """number of landmarks, for "random", "nearest" and "earliest" (5); a run brings its own"""
    max_cycles: int | None = None
    """step limit of an episode, for "random", "nearest" and "earliest" (50); a run brings its
    own"""
    out: Path | None = None
    """folder for evaluation.csv and evaluation.md; nothing is written without it"""
    threads: Annotated[int, Within(1, 1024)] = 1
    """threads of PyTorch"""
    device: str = "cpu"
    """where the policy's network computes, as PyTorch names it"""

    def __post_init__(self) -> None:
        if self.problems != "universe":
            check_count("problems", self.problems, 1, 1_000_000)
        check_options(self)
        if self.guidance == 0 and self.guidance_reach is not None:
            raise ValueError("guidance_reach has no effect with guidance 0: leave it out")
        brought = [name for name in SETTING if getattr(self, name) is not None]
        if brought and self.policy not in RIVALS:
            raise ValueError(
                f"{brought[0]} has no effect with policy {self.policy!r}, which brings its own: "
                "leave it out"
            )


def main(args: Args) -> None:
    """Evaluate one policy and print the table."""
    torch.set_num_threads(args.threads)
    if args.out is not None:
        # Refused before the work, not after it.
        try:
            args.out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"out: cannot write into {args.out}: {error}") from error
    label, policy, setting, training_problems = choose_policy(args)
    problems = choose_problems(args, setting, training_problems)
    optima = find_optima(setting, problems)
    table = {
        name: evaluate(acting, setting, problems, optima, progress=name)
        for name, acting in {label: policy, **rules_of_thumb(setting)}.items()
    }
    print(format_table(table))
    for line in (*worst_cases(table[label]), *regret_lines(table)):
        print(line)
    if args.out is not None:
        save_table(args.out, table)


def choose_policy(args: Args) -> tuple[str, Acting, Setting, list[tuple[int, ...]]]:
    """Return what the table calls the policy, the policy, its task and its training problems."""
    rng_policy, rng_guidance = np.random.default_rng(args.seed).spawn(2)
    label, training_problems = args.policy, []
    policy: Acting
    if args.policy in RIVALS:
        values = {name: getattr(args, name) for name in SETTING[1:]}
        given = {name: value for name, value in values.items() if value is not None}
        setting = Setting(find_grid("paper-7x7" if args.grid is None else args.grid), **given)
        if args.policy == "random":
            policy = RandomPolicy(setting.n_agents, N_ACTIONS, rng_policy)
        else:
            label, rule = RULES[args.policy]
            policy = rule(setting.grid, setting.n_agents, setting.n_landmarks)
    else:
        policy, setting, training_problems = load_run(args.policy, args.device)
    if args.guidance > 0:
        reach = 3 if args.guidance_reach is None else args.guidance_reach
        guidance = Guidance(setting.grid, setting.n_agents, setting.n_landmarks, reach)
        policy = GuidedPolicy(policy, guidance, args.guidance, rng_guidance)
        label += f" + guidance {args.guidance:g}"
    return label, policy, setting, training_problems


def choose_problems(
    args: Args, setting: Setting, training_problems: list[tuple[int, ...]]
) -> np.ndarray:
    """Return the problems to play, (P, K), and say where they are not what was asked for."""
    total = count_problems(setting)
    if args.problems == "universe":
        if training_problems:
            print(
                f"all {total:,} problems of the grid, the {len(training_problems)} that the run "
                "was trained on among them\n"
            )
        return every_problem(setting)
    if total == 0:
        raise ValueError(
            f"n_landmarks must be at most {setting.grid.reachable.size}, the cells of this grid "
            f"that may hold one; got {setting.n_landmarks}"
        )
    n_problems = count_unseen(setting, training_problems)
    if n_problems < 1:
        raise ValueError("problems: there is none that the run was not trained on")
    if n_problems < args.problems:
        print(f"only {n_problems:,} of {args.problems:,} problems: there are no more unseen ones\n")
    return unseen_problems(setting, min(args.problems, n_problems), training_problems, args.seed)


def worst_cases(evaluation: Evaluation) -> list[str]:
    """Return lines on unsolvable and unsolved problems and on the largest gap."""
    optima, unsolved = evaluation.optima, ~evaluation.success
    lines = out_of_reach(evaluation.setting, optima)
    if optima is None:
        lines.append(f"no gaps: optima are proven up to {MAX_EXACT_LANDMARKS} landmarks")
    if unsolved.any():
        cells = " ".join(map(str, evaluation.landmarks[unsolved.argmax()]))
        lines.append(f"unsolved: {unsolved.sum():,}, the first with landmarks {cells}")
    if optima is not None and not unsolved.all():
        index = int(np.where(unsolved, -1.0, evaluation.gaps).argmax())
        lines.append(
            f"largest gap: landmarks {' '.join(map(str, evaluation.landmarks[index]))}, cover time "
            f"{evaluation.cover_time[index]:.0f}, optimum {optima.cover_time[index]}"
        )
    return lines


if __name__ == "__main__":
    run_script(main, Args, __doc__)

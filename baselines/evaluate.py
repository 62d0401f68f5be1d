"""Evaluate a policy on problems it was not trained on.

Command::

    python baselines/evaluate.py --policy runs/meta_dqn-paper-seed0-... --problems 1000
    python baselines/evaluate.py --policy nearest --problems 1000

Output: a table with the share of problems solved, the steps, the total distance and the makespan.
A problem is solved when every landmark was visited within the step limit; costs are means over
the solved problems, and the steps are shown a second time over all problems, an unsolved one
counted with the step limit.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import torch
import tyro

from baselines.checks import check_count, check_number
from baselines.guidance import Acting, Guidance, GuidedPolicy
from baselines.policy import NearestLandmarkPolicy, RandomPolicy, load_policy
from baselines.runs import read_config, write_atomically
from mapp_env import Grid, grid_names, make_grid, make_vec, sample_problems

# Every policy meets the same problems unless another seed is asked for. Trainings draw theirs
# from streams spawned from their own seeds; those that coincide are left out one by one.
EVALUATION_SEED = 0
BATCH = 4096  # problems played at a time
N_ACTIONS = 4


@dataclass(frozen=True)
class Setting:
    """What the agents have to do, but for the landmarks' places."""

    grid: Grid
    n_agents: int = 3
    n_landmarks: int = 5
    max_cycles: int = 50


@dataclass(frozen=True)
class Evaluation:
    """What came out on P problems; costs are infinite where not every landmark was visited."""

    setting: Setting
    landmarks: np.ndarray  # (P, K) int32
    success: np.ndarray  # (P,) bool
    steps: np.ndarray  # (P,) int64, until the last landmark or the step limit
    cover_time: np.ndarray  # (P,) float64
    makespan: np.ndarray  # (P,) float64, the way home included (R8)
    total_distance: np.ndarray  # (P,) float64, the way home included (R8)
    actions: np.ndarray | None  # (T, P, N) int64 when asked for; problem p took steps[p] of them

    def summary(self) -> dict[str, float]:
        """Means over the problems, in the order of the table's columns; NaN if none is solved."""

        def mean_over_solved(cost: np.ndarray) -> float:
            return float(cost[self.success].mean()) if self.success.any() else float("nan")

        return {
            "problems": len(self.success),
            "solved %": 100.0 * float(self.success.mean()),
            "steps (solved)": mean_over_solved(self.cover_time),
            f"steps (unsolved = {self.setting.max_cycles})": float(self.steps.mean()),
            "distance (solved)": mean_over_solved(self.total_distance),
            "makespan (solved)": mean_over_solved(self.makespan),
        }


def evaluate(
    policy: Acting, setting: Setting, landmarks: np.ndarray, keep_actions: bool = False
) -> Evaluation:
    """Let a policy play each problem once.

    Parameters
    ----------
    policy
        Who commands the agents.
    setting
        Grid, number of agents and landmarks, step limit.
    landmarks
        (P, K) landmark cells, a problem per row.
    keep_actions
        Whether the joint actions are kept, to be replayed or drawn.

    Raises
    ------
    ValueError
        If there is no problem, or one is not a problem of the grid.
    """
    landmarks = np.asarray(landmarks)
    if landmarks.ndim != 2 or landmarks.shape[0] == 0 or landmarks.shape[1] != setting.n_landmarks:
        raise ValueError(
            f"landmarks must be cells of shape (P, {setting.n_landmarks}) with P at least 1, got "
            f"shape {landmarks.shape}"
        )
    n_problems = len(landmarks)
    batch = min(BATCH, n_problems)
    envs = make_vec(
        batch,
        autoreset_mode=gymnasium.vector.AutoresetMode.NEXT_STEP,
        grid=setting.grid,
        n_agents=setting.n_agents,
        n_landmarks=setting.n_landmarks,
        max_cycles=setting.max_cycles,
    )
    costs = {
        name: np.full(n_problems, np.inf) for name in ("cover_time", "makespan", "total_distance")
    }
    success = np.zeros(n_problems, np.bool_)
    steps = np.zeros(n_problems, np.int64)
    kept = np.zeros(
        (setting.max_cycles if keep_actions else 0, n_problems, setting.n_agents), np.int64
    )
    for start in range(0, n_problems, batch):
        # The last batch is filled up with problems played before; they are not read again.
        rows = np.minimum(np.arange(start, start + batch), n_problems - 1)
        playing = np.arange(batch) < n_problems - start
        observations, _ = envs.reset(seed=0, options={"landmarks": landmarks[rows]})
        step = 0
        while playing.any():
            actions = policy.act(observations)
            if keep_actions:
                kept[step, rows[playing]] = actions[playing]
            observations, _, terminated, truncated, infos = envs.step(actions)
            step += 1
            ended = playing & (terminated | truncated)
            if ended.any():
                steps[rows[ended]] = step
                success[rows[ended]] = infos["metrics"]["success"][ended]
                for name, cost in costs.items():
                    cost[rows[ended]] = infos["metrics"][name][ended]
            playing &= ~ended  # what the row plays after its reset is nobody's problem
    envs.close()
    return Evaluation(
        setting=setting,
        landmarks=landmarks,
        success=success,
        steps=steps,
        **costs,
        actions=kept if keep_actions else None,
    )


def unseen_problems(
    setting: Setting,
    n_problems: int,
    seen: Sequence[Sequence[int]] = (),
    seed: int = EVALUATION_SEED,
) -> np.ndarray:
    """Draw distinct problems, none of them in `seen` (in whatever order): (n_problems, K)."""
    return sample_problems(
        setting.grid, n_problems, n_landmarks=setting.n_landmarks, seed=seed, exclude=seen
    )


def format_table(evaluations: dict[str, Evaluation]) -> str:
    """Return a Markdown table, a row per policy."""
    names = list(next(iter(evaluations.values())).summary())
    lines = [["policy", *names]]
    for label, evaluation in evaluations.items():
        cells = [_format_cell(name, value) for name, value in evaluation.summary().items()]
        lines.append([label, *cells])
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    rows = [
        "| "
        + " | ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        + " |"
        for line in lines
    ]
    ruler = "|" + "|".join("-" * (w + 1) + (":" if c else "-") for c, w in enumerate(widths)) + "|"
    return "\n".join([rows[0], ruler, *rows[1:]])


def _format_cell(name: str, value: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.0f}" if name == "problems" else f"{value:.1f}"


def save_table(folder: Path, evaluations: dict[str, Evaluation]) -> None:
    """Write evaluation.csv (all digits) and evaluation.md (the printed table)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["policy", *next(iter(evaluations.values())).summary()])
    for label, evaluation in evaluations.items():
        writer.writerow([label, *evaluation.summary().values()])
    write_atomically(folder / "evaluation.csv", text.getvalue().encode())
    write_atomically(folder / "evaluation.md", (format_table(evaluations) + "\n").encode())


# -- from the command line ---------------------------------------------------------------------


@dataclass
class Args:
    """Options of an evaluation."""

    policy: str
    """a run folder or a weights file; or "random", or "nearest" (each agent walks a shortest path
    to its nearest unvisited landmark)"""
    problems: int = 1000
    """number of distinct problems, none of them a training problem of the run"""
    seed: int = EVALUATION_SEED
    """seed of the problems and of everything random in the policy"""
    guidance: float = 0.0
    """probability that an agent with a close unvisited landmark in sight is sent there instead"""
    guidance_reach: int = 3
    """how many moves away a landmark is still close"""
    grid: str = "paper-7x7"
    """bundled grid or map file, for "random" and "nearest"; a run brings its own"""
    n_agents: int = 3
    """number of agents, for "random" and "nearest"; a run brings its own"""
    n_landmarks: int = 5
    """number of landmarks, for "random" and "nearest"; a run brings its own"""
    max_cycles: int = 50
    """step limit of an episode, for "random" and "nearest"; a run brings its own"""
    threads: int = 1
    """threads of PyTorch"""

    def __post_init__(self) -> None:
        check_count("problems", self.problems, 1, 1_000_000)
        check_count("seed", self.seed, 0, 2**63 - 1)
        check_number("guidance", self.guidance, 0.0, 1.0)
        check_count("threads", self.threads, 1, 1024)


def find_grid(name: str) -> Grid:
    """Return a bundled grid, or the one in a map file."""
    return make_grid(name) if name in grid_names() else Grid.load(name)


def read_setting(folder: Path) -> tuple[Setting, list[list[int]]]:
    """Read from a run folder what was trained: the setting, and the training problems.

    Raises
    ------
    ValueError
        If the run's config does not say it.
    """
    config = read_config(folder)
    try:
        options = config["options"]
        setting = Setting(
            Grid.from_text(config["grid"]),
            int(options["n_agents"]),
            int(options["n_landmarks"]),
            int(options["max_cycles"]),
        )
        return setting, [[int(cell) for cell in row] for row in config["training_problems"]]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{folder}: its config does not tell the setting: {error!r}") from error


def main(args: Args) -> None:
    """Evaluate one policy and print the table."""
    torch.set_num_threads(args.threads)
    rng_policy, rng_guidance = np.random.default_rng(args.seed).spawn(2)
    seen: list[list[int]] = []
    policy: Acting
    if args.policy in ("random", "nearest"):
        setting = Setting(find_grid(args.grid), args.n_agents, args.n_landmarks, args.max_cycles)
        if args.policy == "random":
            policy = RandomPolicy(setting.n_agents, N_ACTIONS, rng_policy)
        else:
            policy = NearestLandmarkPolicy(setting.grid, setting.n_agents, setting.n_landmarks)
    else:
        policy = load_policy(args.policy)
        folder = Path(args.policy)
        setting, seen = read_setting(folder if folder.is_dir() else folder.parent)
    label = args.policy
    if args.guidance > 0:
        guidance = Guidance(
            setting.grid, setting.n_agents, setting.n_landmarks, args.guidance_reach
        )
        policy = GuidedPolicy(policy, guidance, args.guidance, rng_guidance)
        label += f" + guidance {args.guidance:g}"
    problems = unseen_problems(setting, args.problems, seen, args.seed)
    print(format_table({label: evaluate(policy, setting, problems)}))


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

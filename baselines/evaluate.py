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
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import torch
import tyro

from baselines.checks import check_count, check_number
from baselines.guidance import Acting, Guidance, GuidedPolicy
from baselines.networks import NetworkSpec
from baselines.policy import NearestLandmarkPolicy, RandomPolicy, load_policy
from baselines.runs import CONFIG_FILE, read_config, write_atomically
from mapp_env import Grid, Problem, grid_names, make_grid, make_vec, sample_problems

# Every policy meets the same problems unless another seed is asked for. Trainings draw theirs
# from streams spawned from their own seeds; those that coincide are left out one by one.
EVALUATION_SEED = 0
BATCH = 4096  # problems played at a time
N_ACTIONS = 4
N_ROUTES = 2  # problems of an evaluation whose routes are drawn: the first ones


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
    actions: np.ndarray  # (T, kept, N) int8, of the first problems; p took steps[p] of them

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
    policy: Acting, setting: Setting, landmarks: np.ndarray, n_kept: int = 0
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
    n_kept
        Of how many problems, the first ones, the joint actions are kept, to be replayed or drawn.

    Raises
    ------
    ValueError
        If there is no problem, or one is not a problem of the grid.
    """
    check_count("n_kept", n_kept, 0, 1_000_000)
    landmarks = np.asarray(landmarks)
    if landmarks.ndim != 2 or landmarks.shape[0] == 0 or landmarks.shape[1] != setting.n_landmarks:
        raise ValueError(
            f"landmarks must be cells of shape (P, {setting.n_landmarks}) with P at least 1, got "
            f"shape {landmarks.shape}"
        )
    n_problems = len(landmarks)
    n_kept = min(n_kept, n_problems)
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
    kept = np.zeros((setting.max_cycles, n_kept, setting.n_agents), np.int8)
    for start in range(0, n_problems, batch):
        # The last batch is filled up with problems played before; they are not read again.
        rows = np.minimum(np.arange(start, start + batch), n_problems - 1)
        playing = np.arange(batch) < n_problems - start
        observations, _ = envs.reset(seed=0, options={"landmarks": landmarks[rows]})
        step = 0
        while playing.any():
            actions = policy.act(observations)
            if start < n_kept:
                drawn = playing & (rows < n_kept)
                kept[step, rows[drawn]] = actions[drawn]
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
        actions=kept,
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


def count_unseen(setting: Setting, seen: Sequence[Sequence[int]]) -> int:
    """Return how many problems of the setting there are besides those in `seen`."""
    every = math.comb(setting.grid.reachable.size, setting.n_landmarks)
    return every - len({tuple(sorted(landmarks)) for landmarks in seen})


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


def read_setting(folder: Path) -> tuple[Setting, list[tuple[int, ...]]]:
    """Read from a run folder what was trained: the setting, and the training problems.

    Raises
    ------
    ValueError
        If the run's config does not say it, or says what cannot be.
    """
    config = read_config(folder)
    where = f"{folder / CONFIG_FILE}"
    try:
        options, rows = config["options"], config["training_problems"]
        if not isinstance(options, dict) or not isinstance(rows, list):
            raise ValueError("options must be an object, training_problems a list")
        setting = Setting(
            Grid.from_text(config["grid"]),
            options["n_agents"],
            options["n_landmarks"],
            options["max_cycles"],
        )
        check_count("n_agents", setting.n_agents, 1, 16)
        check_count("n_landmarks", setting.n_landmarks, 1, 256)
        check_count("max_cycles", setting.max_cycles, 1, 1_000_000)
    except KeyError as error:
        raise ValueError(f"{where}: no entry {error}") from error
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error
    problems = []
    for index, landmarks in enumerate(rows):
        try:
            cells = Problem(setting.grid, landmarks).landmarks
        except ValueError as error:
            raise ValueError(f"{where}: training_problems[{index}]: {error}") from error
        if len(cells) != setting.n_landmarks:
            raise ValueError(
                f"{where}: training_problems[{index}]: must have {setting.n_landmarks} landmarks, "
                f"got {len(cells)}"
            )
        problems.append(cells)
    return setting, problems


def check_fits(spec: NetworkSpec, setting: Setting, folder: Path) -> None:
    """Refuse a run whose config and weights tell of different tasks.

    Raises
    ------
    ValueError
        If grid size, number of agents, landmarks or actions differ.
    """
    told = {
        "n_cells": setting.grid.n_cells,
        "n_agents": setting.n_agents,
        "n_landmarks": setting.n_landmarks,
        "n_actions": N_ACTIONS,
    }
    for name, value in told.items():
        if getattr(spec, name) != value:
            raise ValueError(
                f"{folder}: {name} is {value} by {CONFIG_FILE}, and {getattr(spec, name)} by the "
                "weights"
            )


def main(args: Args) -> None:
    """Evaluate one policy and print the table."""
    torch.set_num_threads(args.threads)
    rng_policy, rng_guidance = np.random.default_rng(args.seed).spawn(2)
    seen: list[tuple[int, ...]] = []
    policy: Acting
    if args.policy in ("random", "nearest"):
        setting = Setting(find_grid(args.grid), args.n_agents, args.n_landmarks, args.max_cycles)
        if args.policy == "random":
            policy = RandomPolicy(setting.n_agents, N_ACTIONS, rng_policy)
        else:
            policy = NearestLandmarkPolicy(setting.grid, setting.n_agents, setting.n_landmarks)
    else:
        policy = trained = load_policy(args.policy)
        folder = Path(args.policy)
        folder = folder if folder.is_dir() else folder.parent
        setting, seen = read_setting(folder)
        check_fits(trained.spec, setting, folder)
    label = args.policy
    if args.guidance > 0:
        guidance = Guidance(
            setting.grid, setting.n_agents, setting.n_landmarks, args.guidance_reach
        )
        policy = GuidedPolicy(policy, guidance, args.guidance, rng_guidance)
        label += f" + guidance {args.guidance:g}"
    n_problems = count_unseen(setting, seen)
    if n_problems < 1:
        raise ValueError("problems: there is none that the run was not trained on")
    if n_problems < args.problems:
        print(f"only {n_problems:,} of {args.problems:,} problems: there are no more unseen ones\n")
    problems = unseen_problems(setting, min(args.problems, n_problems), seen, args.seed)
    print(format_table({label: evaluate(policy, setting, problems)}))


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

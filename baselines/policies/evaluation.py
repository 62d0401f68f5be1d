"""Evaluate a policy on many problems against the proven optimum of each.

A problem is solved when every landmark was visited within the step limit. The gap of a solved
problem is (cover time - optimum) / optimum; optima are proven up to 20 landmarks.
"""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from baselines.policies.acting import Acting
from baselines.policies.settings import Setting
from mapp_env import Plan, Problem, replay, sample_problems
from mapp_env.evaluation.episodes import BATCH, Moments, play_episodes
from mapp_env.evaluation.optima import find_losses, proven_costs
from mapp_env.evaluation.problems import enough_steps, group_problems
from mapp_env.evaluation.progress import Progress
from mapp_env.evaluation.summary import losses_line, lost_figures
from mapp_env.files import write_text
from mapp_env.plans.plan import OBJECTIVES
from mapp_env.problem import MAX_CYCLES
from mapp_env.solvers import solve_universe
from mapp_env.solvers.exact import MAX_EXACT_LANDMARKS
from mapp_env.validation import check_count

# Every policy meets the same problems unless another seed is asked for. Trainings draw theirs
# from streams spawned from their own seeds; those that coincide are left out one by one.
EVALUATION_SEED = 0
MAX_JUDGED = 10_000  # problems of an evaluation whose decisions are judged
N_ROUTES = 2  # problems of an evaluation whose routes are drawn: the first ones
MAX_TABLE_BYTES = 1 << 20


# -- problems ----------------------------------------------------------------------------------


def unseen_problems(
    setting: Setting,
    n_problems: int,
    exclude: Sequence[Sequence[int]] = (),
    seed: int = EVALUATION_SEED,
) -> np.ndarray:
    """Draw distinct problems, none of the excluded (in whatever order): (n_problems, K)."""
    return sample_problems(
        setting.grid, n_problems, n_landmarks=setting.n_landmarks, seed=seed, exclude=exclude
    )


def count_problems(setting: Setting) -> int:
    """Return how many problems of the setting there are."""
    return math.comb(setting.grid.reachable.size, setting.n_landmarks)


def count_unseen(setting: Setting, exclude: Sequence[Sequence[int]]) -> int:
    """Return how many problems of the setting there are besides the excluded."""
    return count_problems(setting) - len({tuple(sorted(landmarks)) for landmarks in exclude})


def every_problem(setting: Setting) -> np.ndarray:
    """Return the universe of a setting, in lexicographic order: (P, K).

    Raises a ValueError if it is too large to be listed.
    """
    return solve_universe(setting.grid, setting.n_landmarks, setting.n_agents)[0]


# -- optima ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Optima:
    """The proven optimum of P problems in each objective, every objective by itself."""

    cover_time: np.ndarray  # (P,) int32
    makespan: np.ndarray  # (P,) int32
    total_distance: np.ndarray  # (P,) int32


def find_optima(setting: Setting, landmarks: np.ndarray) -> Optima | None:
    """Return the optima of problems (P, K); None if K is more than the exact solver takes."""
    if setting.n_landmarks > MAX_EXACT_LANDMARKS:
        return None
    group, costs = setting.group(landmarks), []
    for objective in OBJECTIVES:
        bar = Progress(f"optima: {objective}", len(landmarks))
        costs.append(proven_costs(group, objective, progress=bar).optimum.astype(np.int32))
        bar.close()
    return Optima(*costs)


def out_of_reach(setting: Setting, optima: Optima | None) -> list[str]:
    """Return a line on problems whose optimum already takes more than the step limit, if any."""
    least = np.zeros(1) if optima is None else optima.cover_time
    line = (
        f"out of reach: {(least > setting.max_cycles).sum():,} of {len(least):,} problems take "
        f"more than {setting.max_cycles} steps at their optimum (the limit is --max-cycles)"
    )
    return [line] if (least > setting.max_cycles).any() else []


# -- episodes -----------------------------------------------------------------------------------


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
    moments: Moments
    optima: Optima | None = None  # None: too many landmarks for a proven optimum

    def __post_init__(self) -> None:
        for objective in OBJECTIVES if self.optima is not None else ():
            short = getattr(self, objective) < getattr(self.optima, objective)
            if short.any():
                landmarks = self.landmarks[short.argmax()].tolist()
                raise RuntimeError(f"a {objective} below the proven optimum, landmarks {landmarks}")

    @property
    def gaps(self) -> np.ndarray:
        """Gaps of the cover time, (P,) float64: infinite where unsolved, NaN without optima."""
        if self.optima is None:
            return np.full(len(self.success), np.nan)
        return self.cover_time / self.optima.cover_time - 1.0

    def summary(self) -> dict[str, float]:
        """Figures in the order of the table's columns; NaN where there is none.

        Gaps and costs are those of the solved problems; "optimal %" counts among all problems.
        """

        def over_solved(values: np.ndarray, reduce: str = "mean") -> float:
            solved = values[self.success]
            return float(getattr(solved, reduce)()) if len(solved) else math.nan

        # Infinite gaps are above 0, NaN stays NaN.
        optimal = np.where(np.isnan(self.gaps), np.nan, self.gaps <= 0.0)
        return {
            "problems": len(self.success),
            "solved %": 100.0 * float(self.success.mean()),
            "gap %": 100.0 * over_solved(self.gaps),
            "optimal %": 100.0 * float(optimal.mean()),
            "worst gap %": 100.0 * over_solved(self.gaps, "max"),
            "cover time": over_solved(self.cover_time),
            f"unsolved = {self.setting.max_cycles}": float(self.steps.mean()),
            "makespan": over_solved(self.makespan),
            "total distance": over_solved(self.total_distance),
        }


def evaluate(
    policy: Acting,
    setting: Setting,
    landmarks: np.ndarray,  # (P, K) cells, a problem per row
    optima: Optima | None = None,
    n_kept: int = 0,  # of how many problems, the first ones, the joint actions are kept
    progress: str | None = None,  # label of a progress bar, shown in a terminal
) -> Evaluation:
    """Evaluate a policy for one episode on each problem; without optima there are no gaps.

    Raises a ValueError if there is no problem, one is not a problem of the grid, or the policy is
    of another grid.
    """
    check_count("n_kept", n_kept, 0, 1_000_000)
    landmarks = np.asarray(landmarks)
    whole = landmarks.ndim == 2 and landmarks.dtype.kind in "iu"
    if not whole or len(landmarks) == 0 or landmarks.shape[1] != setting.n_landmarks:
        raise ValueError(
            f"landmarks must be cells of shape (P, {setting.n_landmarks}) with P at least 1, got "
            f"{landmarks.dtype} of shape {landmarks.shape}"
        )
    bar = Progress(progress, len(landmarks))
    episodes = play_episodes(policy, setting.group(landmarks), {}, n_kept, BATCH, bar)
    bar.close()
    return Evaluation(
        setting,
        landmarks,
        episodes.solved,
        episodes.steps,
        **episodes.costs,
        actions=episodes.actions,
        moments=episodes.moments,
        optima=optima,
    )


def play(policy: Acting, problems: Sequence[Problem], max_cycles: int | None = None) -> list[Plan]:
    """Return what the rules make of a policy's episodes: closed loop, no search.

    Parameters
    ----------
    policy
        Who commands the agents.
    problems
        On grids, with numbers of agents and landmarks, that the policy takes.
    max_cycles
        Step limit of all of them. By default each problem's own or, if it has none, as many steps
        as one agent alone needs that walks from each landmark to the next.

    Raises
    ------
    ValueError
        If the policy is of another grid than a problem, or cannot play it.
    """
    limits = [
        check_count("max_cycles", max_cycles, 1, MAX_CYCLES)
        if max_cycles is not None
        else problem.max_cycles or enough_steps(problem.grid, len(problem.landmarks))
        for problem in problems
    ]
    plans = {}
    for group in group_problems(problems, limits):
        episodes = play_episodes(policy, group, {}, n_kept=len(group.places))
        for row, place in enumerate(group.places.tolist()):
            problem = replace(problems[place], max_cycles=limits[place])
            plans[place] = replay(problem, episodes.actions[: episodes.steps[row], row])
    return [plans[place] for place in range(len(problems))]


# -- regrets -----------------------------------------------------------------------------------


def regret_lines(evaluations: dict[str, Evaluation]) -> list[str]:
    """Return lines on what each policy's decisions lost; none without optima.

    Of more than 10,000 problems a sample is judged, spread evenly, and a line says so.
    """
    first = next(iter(evaluations.values()))
    if first.optima is None:
        return []
    n_problems = len(first.landmarks)
    rows = np.arange(0, n_problems, -(-n_problems // MAX_JUDGED))
    lines = []
    if len(rows) < n_problems:
        lines = [f"regrets are those of {len(rows):,} problems, spread evenly among all"]
    for label, evaluation in evaluations.items():
        group = evaluation.setting.group(evaluation.landmarks[rows])
        moments = Moments(*(part[:, rows] for part in evaluation.moments))
        losses = find_losses(group, moments, first.optima.cover_time[rows])
        lines.append(f"{label}: {losses_line(lost_figures(losses, evaluation.steps[rows]))}")
    return lines


# -- tables ------------------------------------------------------------------------------------


def table_rows(evaluations: dict[str, Evaluation]) -> dict[str, dict[str, float]]:
    """Return the figures of each policy, and a last row of the optima, if they are known."""
    rows = {label: evaluation.summary() for label, evaluation in evaluations.items()}
    first = next(iter(evaluations.values()))
    if first.optima is not None:
        cover_time, *others = (float(getattr(first.optima, name).mean()) for name in OBJECTIVES)
        figures = (len(first.success), 100.0, 0.0, 100.0, 0.0, cover_time, cover_time, *others)
        rows["optimum of each cost"] = dict(zip(first.summary(), figures, strict=True))
    return rows


def format_table(evaluations: dict[str, Evaluation]) -> str:
    """Return a Markdown table, a row per policy, and the optimum."""
    rows = table_rows(evaluations)
    lines = [["policy", *next(iter(rows.values()))]]
    for label, figures in rows.items():
        lines.append([label, *(_format_cell(name, value) for name, value in figures.items())])
    first, *others = (max(map(len, column)) for column in zip(*lines, strict=True))
    texts = []
    for label, *cells in lines:
        figures_of = (cell.rjust(width) for cell, width in zip(cells, others, strict=True))
        texts.append(f"| {' | '.join([label.ljust(first), *figures_of])} |")
    ruler = "|".join(["-" * (first + 2), *("-" * (width + 1) + ":" for width in others)])
    return "\n".join([texts[0], f"|{ruler}|", *texts[1:]])


def _format_cell(name: str, value: float) -> str:
    if math.isnan(value):
        return "-"
    if name == "problems":
        return f"{value:.0f}"
    if not name.endswith("%"):
        return f"{value:.2f}"
    # 99.9998 % is not 100 %: rounded away from what would say too much.
    # (5.1 * 100 is 509.999...)
    whole = math.floor(value * 100 + 1e-6) / 100 if name in ("solved %", "optimal %") else value
    return f"{whole:.2f}"


def save_table(folder: Path, evaluations: dict[str, Evaluation]) -> None:
    """Write evaluation.csv (all digits) and evaluation.md (the printed table)."""
    rows = table_rows(evaluations)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["policy", *next(iter(rows.values()))])
    writer.writerows([label, *figures.values()] for label, figures in rows.items())
    write_text(folder / "evaluation.csv", text.getvalue(), MAX_TABLE_BYTES)
    write_text(folder / "evaluation.md", format_table(evaluations) + "\n", MAX_TABLE_BYTES)

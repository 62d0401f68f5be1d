"""The paper's figures, drawn from a run folder.

Command::

    python baselines/figures.py --run runs/meta_dqn-paper-seed0-...

Figures 2 and 3 (reward and steps per episode) are read from metrics.csv, so they can be drawn
again from any run, a stopped one too. Figure 4 (routes) is drawn when a training ends.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # files only, so that no screen is needed
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.checks import check_count
from baselines.evaluation import Evaluation
from baselines.runs import METRICS_FILE, read_metrics
from mapp_env import Problem, replay, solve
from mapp_env.rendering import compare_plans

DPI = 120
ROUTES_FILES = ("fig4a_routes.png", "fig4b_routes.png")
DRAWN_COLUMNS = ("episode", "problem", "steps", "reward")
EPISODE_COLOUR = "#9db8d2"
MEAN_COLOUR = "#123a63"


def draw_learning_curves(folder: Path, window: int = 30) -> list[Path]:
    """Draw Fig. 2 and Fig. 3 of a run; `window` episodes go into the running mean.

    Raises
    ------
    ValueError
        If the window is none, or metrics.csv cannot be read, lacks a column that is drawn, or has
        no finished episode.
    """
    check_count("window", window, 1, 1_000_000_000)
    metrics = read_metrics(folder)
    missing = [name for name in DRAWN_COLUMNS if name not in metrics]
    if missing:
        raise ValueError(f"{folder / METRICS_FILE}: no column {', '.join(missing)}")
    if not metrics["episode"]:
        raise ValueError(f"{folder}: no finished episode to draw")
    panels = (
        ("fig2_reward.png", "reward", "Reward of the episode", "Fig. 2: reward per episode"),
        ("fig3_steps.png", "steps", "Steps of the episode", "Fig. 3: steps per episode"),
    )
    paths = []
    for name, column, label, title in panels:
        figure, axes = plt.subplots(figsize=(7.0, 3.6), layout="constrained")
        _draw_curve(axes, metrics["episode"], metrics[column], metrics["problem"], window)
        axes.set(xlabel="Episode", ylabel=label)
        axes.set_title(title, loc="left", fontsize="medium")
        paths.append(_save(figure, folder / name))
    return paths


def _draw_curve(
    axes: Axes,
    episodes: Sequence[float],
    values: Sequence[float],
    problems: Sequence[float],
    window: int,
) -> None:
    new_problem = (np.flatnonzero(np.diff(problems)) + 1).tolist()
    for index in new_problem:
        axes.axvline(episodes[index] - 0.5, color="0.9", linewidth=0.8, zorder=0)
    axes.plot(episodes, values, color=EPISODE_COLOUR, linewidth=0.8, label="episode")
    if len(values) >= window:
        mean = np.convolve(values, np.ones(window) / window, mode="valid")
        label = f"mean of the last {window}"
        axes.plot(episodes[window - 1 :], mean, color=MEAN_COLOUR, linewidth=1.8, label=label)
    if new_problem:
        axes.plot([], [], color="0.85", linewidth=0.8, label="new problem")
    axes.margins(x=0.01)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, fontsize="small"
    )


def draw_routes(folder: Path, evaluations: dict[str, Evaluation]) -> list[Path]:
    """Draw Fig. 4: the routes of the first two problems, a file each, beside the optimum.

    The evaluations must have kept the actions of these. Nothing is chosen by how it came out: the
    problems are the first two of the evaluation, solved or not.
    """
    first = next(iter(evaluations.values()))
    names = ROUTES_FILES[: len(first.landmarks)]
    for label, evaluation in evaluations.items():
        if evaluation.actions.shape[1] < len(names):
            raise ValueError(
                f"evaluations must have kept the actions of {len(names)} problems, {label!r} has "
                f"those of {evaluation.actions.shape[1]}"
            )
    for index, name in enumerate(names):
        setting = first.setting
        landmarks = tuple(first.landmarks[index].tolist())
        problem = Problem(setting.grid, landmarks, setting.n_agents, setting.max_cycles)
        plans = {
            label: replay(problem, evaluation.actions[: evaluation.steps[index], index])
            for label, evaluation in evaluations.items()
        }
        best = solve(problem)
        plans["optimum" if best.status == "optimal" else "best known"] = best
        compare_plans(problem, plans, folder / name)
    return [folder / name for name in names]


def _save(figure: Figure, path: Path) -> Path:
    figure.savefig(path, dpi=DPI)
    plt.close(figure)
    return path


@dataclass
class Args:
    """Options of drawing a run again."""

    run: Path
    """the run folder; the figures are written into it"""
    window: int = 30
    """episodes in the running mean"""


if __name__ == "__main__":
    arguments = tyro.cli(Args, description=__doc__)
    try:
        for drawn in draw_learning_curves(arguments.run, arguments.window):
            print(drawn)
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

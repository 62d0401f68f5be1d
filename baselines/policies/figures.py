"""The paper's figures 2, 3 and 4, and those of a comparison."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # files only, so that no screen is needed
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from baselines.policies.evaluation import Evaluation
from baselines.runs.folder import METRICS_FILE, read_metrics
from mapp_env import Problem, replay, solve
from mapp_env.rendering import compare_plans, save_figure
from mapp_env.validation import check_count

DPI = 120
ROUTES_FILES = ("fig4a_routes.png", "fig4b_routes.png")
DRAWN_COLUMNS = ("episode", "problem", "steps", "reward")
EPISODE_COLOUR = "#9db8d2"
MEAN_COLOUR = "#123a63"
LEARNER_COLOURS = ("#123a63", "#d1682c", "#3b8f5a")


def draw_learning_curves(folder: Path, window: int = 30) -> list[Path]:
    """Draw Fig. 2 and Fig. 3 of a run; `window` episodes go into the running mean.

    Raises a ValueError if the window is none, or metrics.csv cannot be read, lacks a column that is
    drawn, or has no finished episode.
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
        figure, axes = plt.subplots(figsize=(7.0, 3.6), dpi=DPI, layout="constrained")
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


def draw_comparison(
    folder: Path,
    summaries: Sequence[Any],  # a summary.Summary for each learner under each preset
    interval: Callable[[np.ndarray], Any],  # summary.interval: mean over the first axis, and bounds
    window: int = 30,  # episodes in the running mean of each seed
) -> Path:
    """Draw comparison.png: learning curves and final figures over the seeds, a row per preset."""
    presets = list(dict.fromkeys(summary.group[0] for summary in summaries))
    learners = list(dict.fromkeys(summary.group[1] for summary in summaries))
    figure, grid = plt.subplots(
        len(presets),
        4,
        figsize=(14.0, 3.2 * len(presets)),
        dpi=DPI,
        layout="constrained",
        squeeze=False,
        width_ratios=(3, 3, 2, 2),
    )
    for preset, row in zip(presets, grid, strict=True):
        shown = [summary for summary in summaries if summary.group[0] == preset]
        for height, summary in enumerate(shown):
            colour = LEARNER_COLOURS[learners.index(summary.group[1]) % len(LEARNER_COLOURS)]
            for axes, name, factor in ((row[0], "returns", 1.0), (row[1], "solved", 100.0)):
                curves = [factor * getattr(outcome, name) for outcome in summary.outcomes]
                _draw_mean_curve(axes, curves, interval, window, colour, summary.group[1])
            for axes, name in ((row[2], "solved %"), (row[3], "gap %")):
                values = [outcome.measures[name] for outcome in summary.outcomes]
                _draw_interval(axes, values, summary.measures[name], -height, colour)
        row[0].set(ylabel=f"preset {preset}\nreturn, training", xlabel="Episode")
        row[1].set(ylabel="solved %, training", xlabel="Episode", ylim=(-3, 103))
        row[2].set(xlabel="solved %, unseen problems", xlim=(-3, 103))
        row[3].set(xlabel="gap %, those solved")
        row[3].set_xlim(left=min(0.0, row[3].get_xlim()[0]))
        for axes in row[2:]:
            axes.set_yticks([-i for i in range(len(shown))], [s.group[1] for s in shown])
            axes.set_ylim(-len(shown) + 0.5, 0.5)
        for axes in row:
            axes.spines[["top", "right"]].set_visible(False)
    grid[0, 0].legend(frameon=False, fontsize="small")
    figure.suptitle(
        f"Interquartile means over seeds, 95 % bootstrap intervals; curves: mean of {window} "
        "episodes",
        fontsize="medium",
    )
    return _save(figure, folder / "comparison.png")


def _draw_mean_curve(
    axes: Axes,
    curves: Sequence[np.ndarray],
    interval: Callable[[np.ndarray], Any],
    window: int,
    colour: str,
    label: str,
) -> None:
    width = min(window, min(map(len, curves)))
    found = interval(np.array([np.convolve(c, np.ones(width) / width, "valid") for c in curves]))
    episodes = np.arange(width, width + len(found.mean))
    axes.plot(episodes, found.mean, color=colour, label=label)
    if found.n > 1:
        axes.fill_between(episodes, found.low, found.high, color=colour, alpha=0.2, linewidth=0)


def _draw_interval(
    axes: Axes, values: Sequence[float], found: Any, height: int, colour: str
) -> None:
    axes.plot(values, [height] * len(values), "|", color=colour, alpha=0.6)
    if found.n:
        axes.plot(found.mean, height, "o", color=colour)
    if found.n > 1:
        axes.plot([found.low, found.high], [height] * 2, color=colour, linewidth=3)


def _save(figure: Figure, path: Path) -> Path:
    save_figure(figure, path)
    plt.close(figure)
    return path

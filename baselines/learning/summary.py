"""What came out of the runs of a study: their figures, means and intervals over seeds, tables."""

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats

from baselines.runs.folder import EVALUATION_FILE, TIMING_FILE, read_metrics
from mapp_env.files import read_bytes, read_json, write_text

MAX_TABLE_BYTES = 1 << 20
ROW = "network alone"
RETURN_EPISODES = 100  # the last ones of a training, for its return
N_RESAMPLES = 10_000
CONFIDENCE = 0.95
CUT = 0.25  # from each side: the interquartile mean


# -- figures of one training -------------------------------------------------------------------


class Outcome(NamedTuple):
    """What came out of one run."""

    group: tuple[str, ...]
    measures: dict[str, float]  # a key of MEASURES each; NaN where there is none
    returns: np.ndarray  # (episodes,), while training
    solved: np.ndarray  # (episodes,) 0 or 1


MEASURES = {
    "solved %": "solved %",
    "gap %": "gap %",
    "optimal %": "optimal %",
    "cover time": "cover time, unsolved = limit",
    "return": f"return of the last {RETURN_EPISODES} episodes",
    "minutes": "minutes",
}


def read_outcome(group: tuple[str, ...], folder: Path, max_cycles: int) -> Outcome:
    """Read what came out of a run of a group, with a step limit.

    Raises a ValueError if a file of it cannot be read.
    """
    path = folder / EVALUATION_FILE
    text = read_bytes(path, MAX_TABLE_BYTES, "a table", ValueError).decode(errors="replace")
    rows = {row.get("policy"): row for row in csv.DictReader(io.StringIO(text))}
    metrics = read_metrics(folder)
    timing = read_json(folder / TIMING_FILE, MAX_TABLE_BYTES, "a timing file", ValueError)
    try:
        row = rows[ROW]
        returns, solved = np.array(metrics["reward"]), np.array(metrics["solved"])
        measures = {
            "solved %": float(row["solved %"]),
            "gap %": float(row["gap %"]),
            "optimal %": float(row["optimal %"]),
            "cover time": float(row[f"unsolved = {max_cycles}"]),
            "return": float(returns[-RETURN_EPISODES:].mean()),
            "minutes": float(timing["seconds_total"]) / 60.0,
        }
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not the evaluation of a training: {error!r}") from error
    return Outcome(group, measures, returns, solved)


# -- statistics --------------------------------------------------------------------------------


class Interval(NamedTuple):
    """An interquartile mean over seeds, and its bootstrap interval; NaN where there is none."""

    mean: np.ndarray  # of the shape of one value
    low: np.ndarray
    high: np.ndarray
    n: int  # values


def interval(values: np.ndarray) -> Interval:
    """Return the interquartile mean over the first axis and its 95 % bootstrap interval.

    The interval is that of the percentiles of 10,000 resamples (2,000 of curves) drawn by a
    generator of its own, so that the same runs give the same table.
    """
    n = len(values)
    nothing = np.full(values.shape[1:], np.nan)
    mean = np.asarray(stats.trim_mean(values, CUT, axis=0)) if n else nothing
    if n < 2:
        return Interval(mean, nothing, nothing, n)
    curve = values.ndim > 1
    found = stats.bootstrap(
        (values,),
        lambda sample, axis: stats.trim_mean(sample, CUT, axis=axis),
        axis=0,
        n_resamples=2_000 if curve else N_RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        batch=200 if curve else None,
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(mean, np.asarray(found.low), np.asarray(found.high), n)


class Summary(NamedTuple):
    """The results of a group of trials over its seeds."""

    group: tuple[str, ...]
    outcomes: list[Outcome]
    measures: dict[str, Interval]


def summarise(outcomes: Iterable[Outcome]) -> list[Summary]:
    """Put the outcomes of all seeds of a group together, in their order."""
    groups: dict[tuple[str, ...], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.group, []).append(outcome)
    summaries = []
    for group, members in groups.items():
        measures = {}
        for name in MEASURES:
            values = np.array([outcome.measures[name] for outcome in members])
            # Without solved problems there is no gap.
            measures[name] = interval(values[~np.isnan(values)])
        summaries.append(Summary(group, members, measures))
    return summaries


# -- what is written ---------------------------------------------------------------------------


def format_study(columns: Sequence[str], summaries: Sequence[Summary]) -> str:
    """Return the Markdown table; `columns` are the titles of the groups' cells."""
    lines = [
        "| " + " | ".join([*columns, "seeds", *MEASURES.values()]) + " |",
        "|---" * len(columns) + "|" + "---:|" * (1 + len(MEASURES)),
    ]
    for summary in summaries:
        n = len(summary.outcomes)
        cells = [format_interval(found, n) for found in summary.measures.values()]
        lines.append(f"| {' | '.join(summary.group)} | {n} | {' | '.join(cells)} |")
    return "\n".join(lines)


def format_interval(found: Interval, n_seeds: int) -> str:
    """Return a mean, its interval, and how many seeds have a value if not all have one."""
    if found.n == 0:
        return "-"
    text = f"{found.mean:.2f}"
    if not math.isnan(found.low):
        text += f" [{found.low:.2f}, {found.high:.2f}]"
    return text if found.n == n_seeds else f"{text} ({found.n} of {n_seeds})"


def save_study(path: Path, columns: Sequence[str], summaries: Sequence[Summary]) -> None:
    """Write PATH.csv (all digits) and PATH.md."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = [f"{name} {part}" for name in MEASURES for part in ("IQM", "low", "high", "n")]
    writer.writerow([*columns, "seeds", *parts])
    for summary in summaries:
        figures = [value for found in summary.measures.values() for value in found]
        writer.writerow([*summary.group, len(summary.outcomes), *figures])
    table = format_study(columns, summaries) + "\n"
    write_text(path.with_suffix(".csv"), text.getvalue(), MAX_TABLE_BYTES)
    write_text(path.with_suffix(".md"), table, MAX_TABLE_BYTES)

"""What many results come to: shares, means, and where steps were lost."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOSSES = ("lost_first", "lost_middle", "lost_last")
PLACES = ("at the first decision", "with several landmarks left", "with the last one left")


def summarise(results: dict[str, NDArray[Any]]) -> dict[str, float]:
    """Return the figures of :func:`mapp_env.evaluate`'s results; NaN where there is none.

    Costs, optima and gaps are means over the problems that were solved; ``optimal`` counts among
    all whose optimum is proven; ``regret`` is the mean over all decisions.
    """
    solved, optimum = results["solved"], results["optimum"]
    proven = ~np.isnan(optimum)
    losses = np.array([results[name] for name in LOSSES])
    known = ~np.isnan(results["regret"])
    lost, steps = losses[:, known].sum(axis=1), results["steps"][known].sum()
    figures = {
        "n_problems": len(solved),
        "solved": _mean(solved),
        "visited": _mean(results["visited"]),
        "optimal": _mean((results["cost"] == optimum)[proven]),
        "cost": _mean(results["cost"][solved]),
        "optimum": _mean(optimum[solved & proven]),
        "bound": _mean(results["bound"][solved]),
        "gap": _mean(results["gap"][solved & proven]),
        "worst_gap": max(results["gap"][solved & proven], default=math.nan),
        "regret": lost.sum() / steps if steps else math.nan,
    }
    for name, share in zip(LOSSES, lost, strict=True):
        figures[name] = share / lost.sum() if lost.sum() > 0 else math.nan
    return {name: float(value) for name, value in figures.items()}


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan


def losses_line(losses: NDArray[np.float64], steps: NDArray[np.int64]) -> str:
    """Return in words the mean regret of decisions, and where steps were lost, (3, P)."""
    lost, total = losses.sum(axis=1), losses.sum()
    line = f"regret {total / steps.sum():.4f} steps a decision"
    if total <= 0:
        return f"{line}: nothing is lost"
    parts = (
        f"{100 * share:.1f} % {place}" for share, place in zip(lost / total, PLACES, strict=True)
    )
    return f"{line}, lost {', '.join(parts)}"

"""What many results come to: shares, means, and where steps were lost."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

LOSSES = ("lost_first", "lost_middle", "lost_last")
PLACES = ("first decision", "several landmarks left", "one left")


def summarise(results: dict[str, NDArray[Any]]) -> dict[str, float]:
    """Return the figures of :func:`mapp_env.evaluate`'s results; NaN where there is none.

    Costs, optima and gaps are means over the problems that were solved; ``optimal`` counts among
    all whose optimum is proven; ``regret`` is the mean over all decisions.
    """
    solved, optimum = results["solved"], results["optimum"]
    proven = ~np.isnan(optimum)
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
    }
    losses = np.array([results["regret"] * results["steps"], *(results[name] for name in LOSSES)])
    figures |= lost_figures(losses, results["steps"])
    return {name: float(value) for name, value in figures.items()}


def lost_figures(losses: NDArray[np.float64], steps: NDArray[np.int64]) -> dict[str, float]:
    """Return the mean regret of all decisions, and the shares of what was lost where.

    ``losses``, (4, P), are as :func:`mapp_env.evaluation.optima.find_losses` returns them, of
    episodes of so many ``steps``, (P,); those that are NaN do not count.
    """
    known = ~np.isnan(losses)
    whole = known.all(axis=0)
    lost, total = losses[1:, whole].sum(axis=1), losses[0, whole].sum()
    shares = lost / total if total > 0 else np.full(len(LOSSES), np.nan)
    decisions = steps[known[0]].sum()
    regret = losses[0, known[0]].sum() / decisions if decisions else math.nan
    return {"regret": float(regret), **dict(zip(LOSSES, shares.tolist(), strict=True))}


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan


def losses_line(figures: dict[str, float]) -> str:
    """Return in words what :func:`lost_figures` are."""
    line = f"regret {figures['regret']:.4f} steps a decision"
    shares = [figures[name] for name in LOSSES]
    if any(map(math.isnan, shares)):
        return line
    parts = (f"{place} {100 * share:.1f} %" for share, place in zip(shares, PLACES, strict=True))
    return f"{line}: {', '.join(parts)}"

"""Policies that other libraries have trained: what they return while training, how they act after.

The scripts of examples/ that train end with :func:`report`, so that docs/trainers.md can put them
side by side with the baselines, and the optimum beside all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from baselines.evaluation import evaluate, find_optima, unseen_problems
from baselines.settings import Setting
from mapp_env import make_grid

FIRST = 200  # episodes at each end of a training whose returns are averaged
# An evaluation draws its problems with a seed of its own; a training may meet some of them.


@dataclass
class ActingPolicy:
    """A function of observations as a policy."""

    function: Callable[[np.ndarray], np.ndarray]
    """what :func:`baselines.evaluation.evaluate` hands over -> actions (B, N)"""

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return joint actions (B, N)."""
        return np.asarray(self.function(observations), np.int64)


def report(
    script: str,
    seconds: float,
    returns: Sequence[float],
    act: Callable[[np.ndarray], np.ndarray],
    observation: str = "global",
    problems: int = 1000,
) -> dict[str, float]:
    """Print and return what a training on the default setting has come to.

    Parameters
    ----------
    script
        Its name.
    seconds
        How long it took.
    returns
        Of the training's episodes, undiscounted, in order, one a team's episode.
    act
        Greedy joint actions (B, N) for observations (B, N + 2K), or (B, N, ...) of the kinds that
        agents see by themselves.
    observation
        The kind of observation that `act` takes.
    problems
        Number of problems to evaluate on.

    Raises
    ------
    ValueError
        If no episode has ended.
    """
    if len(returns) == 0:
        raise ValueError("returns must hold at least one episode's, got none: train longer")
    count = max(1, min(FIRST, len(returns) // 2))
    setting = Setting(make_grid(), n_agents=3, n_landmarks=5, max_cycles=50)
    landmarks = unseen_problems(setting, problems)
    optima = find_optima(setting, landmarks)
    policy = ActingPolicy(act)
    summary = evaluate(policy, setting, landmarks, optima, observation=observation).summary()
    result = {
        "seconds": seconds,
        "episodes": len(returns),
        "first": float(np.mean(returns[:count])),
        "last": float(np.mean(returns[-count:])),
        **summary,
    }
    print(
        f"{script}: {len(returns)} episodes in {seconds:.0f} s; "
        f"return {result['first']:.0f} -> {result['last']:.0f} "
        f"(means of the first and the last {count} episodes)"
    )
    print(
        f"greedy on {problems} problems: {summary['solved %']:.1f} % solved, "
        f"gap {summary['gap %']:.1f} %, {summary['optimal %']:.1f} % optimal"
    )
    return result

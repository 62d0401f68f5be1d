"""Evaluate any trainer's policy on unseen problems and compare it with the proven optima.

Usage, here with random moves that never bump::

    python examples/beside_optimum.py --problems 200

The other scripts in this folder import :func:`judge`, or :func:`report`, which prints its result.
All problems are played in parallel, so a network needs one forward pass per step for all of them.
Needs only ``mapp_env``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mapp_env import mapp_v0, sample_problems
from mapp_env.solvers import optimal_costs

# Takes observations (P, N, ...) and action masks (P, N, A); returns actions (P, N).
Acting = Callable[[np.ndarray, np.ndarray], np.ndarray]


class Judgement(NamedTuple):
    """A policy's results on P problems."""

    solved: float  # percent
    gap: float  # percent: cover time above the optimum, mean over solved problems; NaN if none
    mean_return: float  # undiscounted, over all problems

    def __str__(self) -> str:
        gap = "-" if math.isnan(self.gap) else f"{self.gap:.1f} %"
        return f"return {self.mean_return:.1f}, solved {self.solved:.1f} %, mean gap {gap}"


def unseen_landmarks(
    n_problems: int, seen: Iterable[Sequence[int]] = (), seed: int = 0, **arguments: Any
) -> np.ndarray:
    """Draw distinct problems that are not in `seen`: landmark cells, shape (n_problems, K).

    `arguments` are passed to ``parallel_env``.
    """
    task = mapp_v0.parallel_env(**arguments).task
    return sample_problems(
        task.grid, n_problems, n_landmarks=task.n_landmarks, seed=seed, exclude=list(seen)
    )


def judge(act: Acting, landmarks: np.ndarray, **arguments: Any) -> Judgement:
    """Let a policy play each problem once.

    Parameters
    ----------
    act
        The policy.
    landmarks
        (P, K) landmark cells, one problem per row.
    arguments
        Passed to ``parallel_env``: what the policy sees, and the reward that is counted.
    """
    envs = [mapp_v0.parallel_env(**arguments) for _ in landmarks]
    seen = [
        env.reset(seed=0, options={"landmarks": cells})
        for env, cells in zip(envs, landmarks, strict=True)
    ]
    agents = envs[0].possible_agents
    returns = np.zeros(len(envs))
    cover_times = np.full(len(envs), np.inf)
    playing = list(range(len(envs)))
    while playing:
        observations = np.stack([[seen[p][0][a] for a in agents] for p in playing])
        masks = np.stack([[seen[p][1][a]["action_mask"] for a in agents] for p in playing])
        for p, actions in zip(playing, act(observations, masks), strict=True):
            moves = dict(zip(agents, actions.tolist(), strict=True))
            observation, rewards, _, _, infos = envs[p].step(moves)
            returns[p] += rewards[agents[0]]  # the team reward, the same for all agents
            seen[p] = observation, infos
            if not envs[p].agents:
                cover_times[p] = infos[agents[0]]["metrics"]["cover_time"]
        playing = [p for p in playing if envs[p].agents]
    task = envs[0].task
    optima = optimal_costs(task.grid, np.asarray(landmarks), task.n_agents, "cover_time")
    solved = np.isfinite(cover_times)
    gaps = cover_times[solved] / optima[solved] - 1
    gap = 100 * float(gaps.mean()) if solved.any() else float("nan")
    return Judgement(100 * float(solved.mean()), gap, float(returns.mean()))


def check_options(seconds: float, n_problems: int) -> None:
    """Exit before training if the options would leave nothing to report."""
    if not seconds > 0:
        raise SystemExit(f"error: --seconds must be above 0, got {seconds}")
    if n_problems < 1:
        raise SystemExit(f"error: --problems must be 1 or more, got {n_problems}")


def report(
    seconds: float, returns: Sequence[float], act: Acting, n_problems: int, **arguments: Any
) -> None:
    """Print a training run's results: first and last returns, and an evaluation of the policy.

    Parameters
    ----------
    seconds
        Duration of the run.
    returns
        Undiscounted returns of the training episodes, in order, at least one. Their problems are
        assumed to be random, so some of the evaluation problems will have been met: at most the
        share of all problems that were played.
    act
        The greedy policy.
    n_problems
        Number of problems to evaluate on.
    arguments
        Passed to ``parallel_env``: what the policy sees, and the reward that is counted.

    Raises
    ------
    ValueError
        If no episode has ended.
    """
    if len(returns) == 0:
        raise ValueError("returns must have at least one episode, got none: train longer")
    count = max(1, min(200, len(returns) // 2))
    first, last = np.mean(returns[:count]), np.mean(returns[-count:])
    print(f"{len(returns)} episodes in {seconds:.0f} CPU seconds")
    print(f"return of the first and the last {count}: {first:.1f} -> {last:.1f}")
    task = mapp_v0.parallel_env(**arguments).task
    met = min(1.0, len(returns) / math.comb(task.grid.reachable.size, task.n_landmarks))
    print(f"greedy on {n_problems} problems, about {met:.1%} of them met in training:")
    print(judge(act, unseen_landmarks(n_problems, **arguments), **arguments))


def main() -> None:
    """Evaluate random moves."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--problems", type=int, default=200, help="problems to play (default 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the moves (default 0)")
    arguments = parser.parse_args()
    generator = np.random.default_rng(arguments.seed)

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        return np.argmax(generator.random(masks.shape) * masks, axis=-1)

    print("random moves:", judge(act, unseen_landmarks(arguments.problems)))


if __name__ == "__main__":
    main()

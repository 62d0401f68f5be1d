"""Measure the overhead of the Stable-Baselines3 VecEnv over the engine that it steps.

Timed alternately, in CPU seconds of this process, with random actions, including resets, one
thread. Each figure is printed with the ratio to the plain engine with the same number of rows in
same-step mode, the median over rounds.

    python benchmarks/sb3_vec.py              # half a minute; --seconds 0.2 for a quick look
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import time
import warnings
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

import mapp_env
from mapp_env.adapters.sb3_vec import make_sb3_vec
from mapp_env.envs.central_env import CentralEnv

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # SuperSuit's own imports warn
    from mapp_env.adapters.sb3_shared import make_sb3_shared

TURNS = 15
OBSERVATIONS = ("global", "geodesic")


def stepper(envs: Any, actions: np.ndarray, rows: int) -> Callable[[float], float]:
    """Return a function that steps for some CPU seconds and returns env-steps per second."""
    for joint_actions in actions:  # spread the rows over their episodes
        envs.step(joint_actions)

    def run(seconds: float) -> float:
        started, count = time.process_time(), 0
        while True:
            for joint_actions in actions[:8]:
                envs.step(joint_actions)
                count += rows
            elapsed = time.process_time() - started
            if elapsed >= seconds:
                return count / elapsed

    return run


def make_steppers(rows: int, observation: str) -> dict[str, Callable[[float], float]]:
    """Return the engine, its VecEnv and, for few rows, the alternatives to it."""
    rng = np.random.default_rng(0)
    actions = rng.integers(0, 4, (64, rows, 3))
    engine = mapp_env.make_vec(rows, autoreset_mode="SameStep", observation=observation)
    engine.reset(seed=0)
    adapted = make_sb3_vec(rows, observation=observation)
    adapted.seed(0)
    adapted.reset()
    found = {
        "make_vec": stepper(engine, actions, rows),
        "make_sb3_vec": stepper(adapted, actions, rows),
    }
    if rows <= 64:
        arguments: dict[str, Any] = {"observation": observation}
        dummy = DummyVecEnv([lambda: CentralEnv(central_action="multi", **arguments)] * rows)
        dummy.reset()
        found["DummyVecEnv of CentralEnv"] = stepper(dummy, actions, rows)
        shared = make_sb3_shared(rows, **arguments)
        shared.reset()
        found["make_sb3_shared"] = stepper(shared, actions.reshape(64, -1), rows)
    return found


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--seconds", type=float, default=1.5, help="CPU seconds per line (default 1.5)"
    )
    arguments = parser.parse_args()
    print(f"{'rows':>5} {'observation':<10} {'':<28}{'env-steps/CPU s':>16}{'of make_vec':>13}")
    for observation in OBSERVATIONS:
        for rows in (64, 4096):
            steppers = make_steppers(rows, observation)
            rates: dict[str, list[float]] = {name: [] for name in steppers}
            for _ in range(TURNS):
                for name, run in steppers.items():
                    rates[name].append(run(arguments.seconds / TURNS))
            for name, own in rates.items():
                pairs = zip(own, rates["make_vec"], strict=True)
                ratio = median(rate / base for rate, base in pairs)
                print(f"{rows:>5} {observation:<10} {name:<28}{median(own):>16,.0f}{ratio:>13.2f}")


if __name__ == "__main__":
    main()

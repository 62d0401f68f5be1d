"""Play thousands of episodes at once and count how often random agents solve the problem.

python examples/batched_rollout.py --num-envs 4096 --steps 500
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import mapp_env


def main() -> None:
    """Print success, mean cover time and speed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--num-envs", type=int, default=4096, help="rows (default 4096)")
    parser.add_argument("--steps", type=int, default=500, help="steps per row (default 500)")
    arguments = parser.parse_args()

    envs = mapp_env.make_vec(arguments.num_envs, autoreset_mode="SameStep")
    envs.reset(seed=0)
    rng = np.random.default_rng(0)
    episodes, cover_times = 0, []
    started = time.perf_counter()
    for _ in range(arguments.steps):
        actions = rng.integers(0, 4, (arguments.num_envs, 3))
        _, _, _, _, infos = envs.step(actions)
        if "final_info" in infos:
            metrics = infos["final_info"]["metrics"]
            episodes += metrics["_success"].sum()
            cover_times.extend(metrics["cover_time"][metrics["success"]])
    seconds = time.perf_counter() - started

    solved = len(cover_times) / max(episodes, 1)
    print(f"{episodes} episodes in {seconds:.1f} s: {solved:.1%} solved")
    if cover_times:
        print(f"mean cover time of those: {np.mean(cover_times):.1f} steps")


if __name__ == "__main__":
    main()

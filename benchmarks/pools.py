"""Measure how fast a batch steps on a pool of maps, next to one of its maps in the same run.

1,000 maps of 16 x 16 from all four generators. Each row of the table times a batch of 4,096 rows on
the pool and on a single map, alternately, in CPU seconds of this process; the ratio is the median
over rounds. Random actions, same-step mode, resets included, one thread.

    python benchmarks/pools.py            # a minute; --rounds 3 for a quick look
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse
import time
from statistics import median
from typing import Any

import numpy as np

import mapp_env

N_MAPS, SIDE, N_ROWS, N_STEPS = 1_000, 16, 4_096, 64
KINDS: tuple[dict[str, Any], ...] = (
    {},
    {"reward": "geodesic"},
    {"observation": "geodesic"},
    {"observation": "distances"},
    {"observation": "distances", "actions": "landmarks"},
)


class Batch:
    """A batch in the middle of its episodes, and random actions for it."""

    def __init__(self, **arguments: Any) -> None:
        self.envs = mapp_env.make_vec(N_ROWS, autoreset_mode="SameStep", **arguments)
        self.envs.reset(seed=0)
        n_actions = int(self.envs.single_action_space.nvec[0])
        shape = (N_STEPS, N_ROWS, self.envs.task.n_agents)
        self.actions = np.random.default_rng(0).integers(0, n_actions, shape)
        self.rate()

    def rate(self) -> float:
        """Return steps of single rows per CPU second."""
        started = time.process_time()
        for joint_actions in self.actions:
            self.envs.step(joint_actions)
        return N_STEPS * N_ROWS / (time.process_time() - started)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=15, help="how often each is timed")
    arguments = parser.parse_args()
    grids = mapp_env.make_grids(("random", "rooms", "maze", "warehouse"), N_MAPS, SIDE, SIDE)
    mapp_env.make_vec(1, grid=grids[:2])
    started = time.perf_counter()
    mapp_env.make_vec(N_ROWS, grid=grids)
    seconds = time.perf_counter() - started
    print(f"an environment of {N_MAPS:,} maps is made in {seconds:.2f} s\n")
    print(f"{'env-steps a CPU second, one core':<46}{'one map':>12}{'pool':>12}{'ratio':>8}")
    for kind in KINDS:
        one, pool = Batch(grid=grids[0], **kind), Batch(grid=grids, **kind)
        rates = [(one.rate(), pool.rate()) for _ in range(arguments.rounds)]
        ratio = median(each / base for base, each in rates)
        label = ", ".join(f"{name}={value!r}" for name, value in kind.items()) or "default"
        first, second = (median(column) for column in zip(*rates, strict=True))
        print(f"{label:<46}{first:>12,.0f}{second:>12,.0f}{ratio:>8.3f}")


if __name__ == "__main__":
    main()

"""Stable-Baselines3 on `mapp_env/Central-v0`: DQN over the 64 joint actions of three agents.

One network sees each agent's shortest paths to the landmarks (`observation="geodesic"`) and gives
a Q-value for every joint action. Results are in docs/trainers.md.

    python examples/sb3_central.py            # a minute of CPU time; --help for more

Needs `pip install -c constraints.txt -e ".[baselines,sb3]"`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import tyro
from beside_optimum import check_options, report
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env

from mapp_env.adapters.sb3_returns import EpisodeReturns


@dataclass
class Args:
    """Options of the training."""

    seconds: float = 60.0
    """CPU seconds to train for"""
    steps: int = 120_000
    """maximum steps to train for; exploration decreases over them"""
    problems: int = 1000
    """number of problems to evaluate on, greedily"""
    seed: int = 0
    """seed of network, exploration and problems"""
    num_envs: int = 16
    """number of parallel environments"""
    learning_rate: float = 1e-3
    """learning rate of Adam"""
    discount: float = 0.9
    """discount per step"""


def main(args: Args) -> None:
    """Train and print the results."""
    check_options(args.seconds, args.problems)
    torch.set_num_threads(1)
    envs = make_vec_env(
        "mapp_env:mapp_env/Central-v0",
        n_envs=args.num_envs,
        seed=args.seed,
        env_kwargs={"observation": "geodesic"},
    )
    model = DQN(
        "MlpPolicy",
        envs,
        buffer_size=200_000,
        learning_starts=2_000,
        batch_size=256,
        train_freq=4,
        gradient_steps=8,
        target_update_interval=2_000,
        exploration_fraction=1.0,
        exploration_initial_eps=0.5,
        exploration_final_eps=0.05,
        gamma=args.discount,
        learning_rate=args.learning_rate,
        policy_kwargs={"net_arch": [256, 256]},
        seed=args.seed,
        device="cpu",
    )
    watch = EpisodeReturns(args.seconds)
    model.learn(args.steps, callback=watch)

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        numbers = model.predict(observations, deterministic=True)[0]
        return np.stack(np.unravel_index(numbers, (4, 4, 4)), axis=1)  # first agent first

    report(watch.elapsed, watch.returns, act, args.problems, observation="geodesic")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

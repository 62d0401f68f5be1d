"""Stable-Baselines3 on the batched engine: PPO with one network that commands all agents.

`make_sb3_vec` is `mapp_env.make_vec` as a VecEnv, without a separate environment per row. The
network sees each agent's shortest paths to the landmarks (`observation="geodesic"`) and outputs an
action for each agent. Results are in docs/trainers.md.

    python examples/sb3_vec.py                # a minute of CPU time; --help for more

Needs `pip install -c constraints.txt -e ".[baselines,sb3]"`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import tyro
from beside_optimum import check_options, report
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from mapp_env.adapters.sb3_returns import EpisodeReturns
from mapp_env.adapters.sb3_vec import make_sb3_vec


@dataclass
class Args:
    """Options of the training."""

    seconds: float = 60.0
    """CPU seconds to train for"""
    problems: int = 1000
    """number of problems to evaluate on, greedily"""
    seed: int = 0
    """seed of network, exploration and problems"""
    num_envs: int = 128
    """rows of the engine"""
    learning_rate: float = 1e-3
    """learning rate of Adam"""
    discount: float = 0.95
    """discount per step"""


def main(args: Args) -> None:
    """Train and print the results."""
    check_options(args.seconds, args.problems)
    torch.set_num_threads(1)
    envs = make_sb3_vec(args.num_envs, observation="geodesic")
    model = PPO(
        "MlpPolicy",
        # Returns run into the hundreds: unscaled, the critic's loss would drown the actor's.
        VecNormalize(envs, norm_obs=False, gamma=args.discount),
        n_steps=16,
        batch_size=512,
        n_epochs=3,
        gamma=args.discount,
        gae_lambda=0.9,
        ent_coef=0.003,
        learning_rate=args.learning_rate,
        policy_kwargs={"net_arch": [128, 128]},
        seed=args.seed,
        device="cpu",
    )
    watch = EpisodeReturns(args.seconds)
    model.learn(10**9, callback=watch)

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        return model.predict(observations, deterministic=True)[0]

    report(watch.elapsed, watch.returns, act, args.problems, observation="geodesic")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

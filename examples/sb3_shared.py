"""SuperSuit and Stable-Baselines3: PPO with one network that all agents use separately.

`make_sb3_shared` puts the wrapper in `mapp_env.adapters.sb3_shared` around SuperSuit's batch of
agents, so that seeds and truncations get through. Agents start on the same cell;
`observation="geodesic"` tells each which landmarks it is the nearest to. Results are in
docs/trainers.md.

    python examples/sb3_shared.py             # a minute of CPU time; --help for more

Needs `pip install -c constraints.txt -e ".[baselines,sb3]"`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import tyro
from beside_optimum import check_options, report
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from mapp_env.adapters.sb3_returns import EpisodeReturns
from mapp_env.adapters.sb3_shared import make_sb3_shared


@dataclass
class Args:
    """Options of the training."""

    seconds: float = 60.0
    """CPU seconds to train for"""
    problems: int = 1000
    """number of problems to evaluate on, greedily"""
    seed: int = 0
    """seed of network, exploration and problems"""
    num_envs: int = 16
    """number of environments; each has three rows, one per agent"""
    learning_rate: float = 1e-3
    """learning rate of Adam"""
    discount: float = 0.95
    """discount per step"""


def main(args: Args) -> None:
    """Train and print the results."""
    check_options(args.seconds, args.problems)
    torch.set_num_threads(1)
    envs = make_sb3_shared(args.num_envs, observation="geodesic")
    model = PPO(
        "MlpPolicy",
        # Returns run into the hundreds: unscaled, the critic's loss would drown the actor's.
        VecNormalize(VecMonitor(envs), norm_obs=False, gamma=args.discount),
        n_steps=64,
        batch_size=768,
        n_epochs=4,
        gamma=args.discount,
        gae_lambda=0.9,
        ent_coef=0.003,
        learning_rate=args.learning_rate,
        policy_kwargs={"net_arch": [64, 64]},
        seed=args.seed,
        device="cpu",
    )
    watch = EpisodeReturns(args.seconds)
    model.learn(10**9, callback=watch)

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        rows = observations.reshape(-1, observations.shape[-1])
        return model.predict(rows, deterministic=True)[0].reshape(observations.shape[:2])

    # All agents of a team finish together, with the same return.
    returns = watch.returns[:: envs.n_agents]
    report(watch.elapsed, returns, act, args.problems, observation="geodesic")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

"""Train PPO with RLlib's new API stack, one policy for all agents or one for each, for a minute.

RLlib pins a Gymnasium of its own and is large (1.9 GB): give it a virtual environment of its own.

    python3 -m venv .venv-rllib
    grep -v '^gymnasium==' constraints.txt > /tmp/rllib-constraints.txt
    .venv-rllib/bin/pip install -c /tmp/rllib-constraints.txt -e . "ray[rllib]==2.60.0" torch
    .venv-rllib/bin/python examples/rllib_ppo.py --policies shared
    .venv-rllib/bin/python examples/rllib_ppo.py --policies independent

Prints the mean return of an episode while training, then plays problems greedily: share solved, and
how far above the proven optimum the cover time is. One core: sampling and learning take turns in
this process.
"""

from __future__ import annotations

import argparse
import os
import time

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import ray
import torch
from pettingzoo.utils import BaseParallelWrapper
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

import mapp_env
from mapp_env import mapp_v0
from mapp_env.solvers import optimal_costs

N_AGENTS = 3
REWARD_SCALE = 0.1
TASK = {"n_agents": N_AGENTS, "observation": "geodesic", "reward": "geodesic"}


class ScaledReward(BaseParallelWrapper[str, np.ndarray, int]):
    """Rewards of the order of one, as PPO's value network likes them."""

    def step(self, actions):  # noqa: D102
        seen, rewards, *others = self.env.step(actions)
        return seen, {agent: REWARD_SCALE * reward for agent, reward in rewards.items()}, *others


def name_policy(policies: str, agent: str) -> str:
    """Return which policy commands an agent."""
    return "shared" if policies == "shared" else agent


def configure(policies: str, seed: int) -> PPOConfig:
    """Return the settings of a training: which agent is commanded by which policy, and PPO's."""
    register_env(
        "mapp", lambda _: ParallelPettingZooEnv(ScaledReward(mapp_v0.parallel_env(**TASK)))
    )
    names = {name_policy(policies, f"agent_{index}") for index in range(N_AGENTS)}
    network = DefaultModelConfig(fcnet_hiddens=[128, 128], fcnet_activation="relu")
    return (
        PPOConfig()
        .environment("mapp")
        .env_runners(num_env_runners=0, num_envs_per_env_runner=16)
        .learners(num_learners=0)
        .multi_agent(
            policies=names,
            policy_mapping_fn=lambda agent, *args, **kwargs: name_policy(policies, agent),
        )
        .rl_module(
            rl_module_spec=MultiRLModuleSpec(
                rl_module_specs={name: RLModuleSpec(model_config=network) for name in names}
            )
        )
        .training(
            train_batch_size_per_learner=2048,
            minibatch_size=512,
            num_epochs=6,
            lr=1e-3,
            gamma=0.97,
            lambda_=0.9,
            use_kl_loss=False,
            vf_clip_param=float("inf"),
            entropy_coeff=0.01,
            vf_loss_coeff=0.5,
            grad_clip=0.5,
        )
        .reporting(min_sample_timesteps_per_iteration=100)
        .debugging(seed=seed, log_level="ERROR")
    )


def train(algorithm: Algorithm, seconds: float) -> tuple[float, float]:
    """Train for some seconds; return the mean return at the beginning and at the end."""
    returns, steps, started = [], 0, time.process_time()
    while (spent := time.process_time() - started) < seconds:
        found = algorithm.train()["env_runners"]
        # Every agent gets the team's reward: the sum over agents counts it three times.
        returns.append(found["episode_return_mean"] / N_AGENTS)
        steps = found["num_env_steps_sampled_lifetime"]
        print(f"{spent:5.0f} s {steps:8,.0f} steps: return {returns[-1]:7.2f}", flush=True)
    return returns[0], returns[-1]


def evaluate(
    algorithm: Algorithm, policies: str, n_problems: int, seed: int
) -> tuple[float, float]:
    """Play problems greedily; return the share solved, and the mean gap of the solved ones."""
    grid = mapp_env.make_grid()
    landmarks = mapp_env.sample_problems(grid, n_problems, seed=seed)
    modules = [algorithm.get_module(name_policy(policies, f"agent_{i}")) for i in range(N_AGENTS)]
    envs = mapp_env.make_vec(n_problems, **TASK)
    seen, _ = envs.reset(options={"landmarks": landmarks})  # (P, N, 8 K)
    playing = np.ones(n_problems, np.bool_)
    cover_time = np.full(n_problems, np.inf)  # infinite where not every landmark was visited
    while playing.any():
        actions = np.zeros((n_problems, N_AGENTS), np.int64)
        with torch.inference_mode():
            for agent, module in enumerate(modules):
                batch = {"obs": torch.from_numpy(seen[:, agent])}
                actions[:, agent] = module.forward_inference(batch)["action_dist_inputs"].argmax(-1)
        seen, _, terminated, truncated, infos = envs.step(actions)
        ended = playing & (terminated | truncated)
        if ended.any():
            cover_time[ended] = infos["metrics"]["cover_time"][ended]
        playing &= ~ended  # what is played after the first end does not count
    solved = np.isfinite(cover_time)
    gaps = cover_time / optimal_costs(grid, landmarks, N_AGENTS, "cover_time") - 1.0
    return float(solved.mean()), float(gaps[solved].mean()) if solved.any() else float("nan")


def main() -> None:
    """Train, evaluate, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", choices=("shared", "independent"), default="shared")
    parser.add_argument("--seconds", type=float, default=60.0, help="of training (default 60)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--problems", type=int, default=1000, help="to evaluate on (default 1000)")
    arguments = parser.parse_args()

    torch.set_num_threads(1)
    ray.init(
        "local",
        num_cpus=2,
        object_store_memory=200_000_000,
        include_dashboard=False,
        log_to_driver=False,
    )
    algorithm = configure(arguments.policies, arguments.seed).build_algo()
    try:
        before = evaluate(algorithm, arguments.policies, arguments.problems, seed=1)
        first, last = train(algorithm, arguments.seconds)
        after = evaluate(algorithm, arguments.policies, arguments.problems, seed=1)
    finally:
        algorithm.stop()
        ray.shutdown()
    print(f"return: {first:.2f} -> {last:.2f}")
    for name, (solved, gap) in (("before", before), ("after", after)):
        print(f"{name}: {arguments.problems:,} problems, {solved:.1%} solved, gap {gap:.1%}")


if __name__ == "__main__":
    main()

"""Train PPO with RLlib's new API stack for a minute, with one policy for all agents or one each.

RLlib pins its own Gymnasium version and is large (1.9 GB): use a separate virtual environment.

    python3 -m venv .venv-rllib
    grep -v '^gymnasium==' constraints.txt > /tmp/rllib-constraints.txt
    .venv-rllib/bin/pip install -c /tmp/rllib-constraints.txt -e . "ray[rllib]==2.60.0" torch
    .venv-rllib/bin/python examples/rllib_ppo.py --policies shared
    .venv-rllib/bin/python examples/rllib_ppo.py --policies independent

The observation "geodesic" is treated as a set: a network applied to each landmark, summed over the
unvisited ones, then a second network for the sum (RLlib's own layers learn much more slowly here).
Prints the mean episode return during training, then plays unseen problems greedily: share solved,
and how far the cover time is above the proven optimum. One core: sampling and learning alternate
in this process.
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any, ClassVar

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import ray
import torch
from beside_optimum import Acting, judge, unseen_landmarks
from pettingzoo.utils import BaseParallelWrapper
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env
from torch import nn

from mapp_env import mapp_v0

N_AGENTS = 3
N_UNITS = 64
REWARD_SCALE = 0.05
TASK = {"n_agents": N_AGENTS, "observation": "geodesic", "reward": "geodesic"}


class Training(BaseParallelWrapper[str, np.ndarray, int]):
    """Scales rewards to the order of one, for the value network; records the problems met."""

    met: ClassVar[set[tuple[int, ...]]] = set()

    def reset(self, seed=None, options=None):  # noqa: D102
        returned = self.env.reset(seed=seed, options=options)
        cells = self.env.state()[N_AGENTS:].astype(int)  # landmark cells, then visited flags
        self.met.add(tuple(cells[: len(cells) // 2].tolist()))
        return returned

    def step(self, actions):  # noqa: D102
        seen, rewards, *others = self.env.step(actions)
        return seen, {agent: REWARD_SCALE * reward for agent, reward in rewards.items()}, *others


class LandmarkSet(TorchRLModule, ValueFunctionAPI):
    """Logits of an agent's actions, and its value, from its features of each landmark."""

    def setup(self) -> None:  # noqa: D102
        n_features = self.observation_space.shape[0] // self.model_config["n_landmarks"]
        self.policy = self.network(n_features, int(self.action_space.n))
        self.value = self.network(n_features, 1)

    def network(self, n_features: int, n_outputs: int) -> nn.ModuleDict:
        """Return a network for each landmark, and one for the sum over the unvisited ones."""
        n = self.model_config["n_units"]
        one = nn.Sequential(nn.Linear(n_features, n), nn.ReLU(), nn.Linear(n, n), nn.ReLU())
        return nn.ModuleDict(
            {"one": one, "all": nn.Sequential(nn.Linear(n, n), nn.ReLU(), nn.Linear(n, n_outputs))}
        )

    def apply_to(self, network: nn.ModuleDict, observations: torch.Tensor) -> torch.Tensor:
        """Return outputs (..., O) for observations (..., K * features)."""
        landmarks = observations.unflatten(-1, (self.model_config["n_landmarks"], -1))
        unvisited = landmarks[..., :1]
        return network["all"]((unvisited * network["one"](landmarks)).sum(-2))

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        return {Columns.ACTION_DIST_INPUTS: self.apply_to(self.policy, batch[Columns.OBS])}

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> torch.Tensor:
        """Return values (...) of a batch's observations."""
        return self.apply_to(self.value, batch[Columns.OBS]).squeeze(-1)


def name_policy(policies: str, agent: str) -> str:
    """Return the name of the policy that commands an agent."""
    return "shared" if policies == "shared" else agent


def configure(policies: str, seed: int) -> PPOConfig:
    """Return the training config: the mapping of agents to policies, and PPO's settings."""
    register_env("mapp", lambda _: ParallelPettingZooEnv(Training(mapp_v0.parallel_env(**TASK))))
    names = {name_policy(policies, f"agent_{index}") for index in range(N_AGENTS)}
    network = {"n_landmarks": mapp_v0.parallel_env(**TASK).task.n_landmarks, "n_units": N_UNITS}
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
                rl_module_specs={
                    name: RLModuleSpec(module_class=LandmarkSet, model_config=network)
                    for name in names
                }
            )
        )
        .training(
            train_batch_size_per_learner=1024,
            minibatch_size=512,
            num_epochs=6,
            lr=2e-3,
            gamma=0.9,
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
    """Train for some seconds; return the mean return at the start and at the end."""
    returns, steps, started = [], 0, time.process_time()
    while (spent := time.process_time() - started) < seconds:
        found = algorithm.train()["env_runners"]
        # Every agent receives the team's reward, so the sum over agents counts it three times.
        returns.append(found["episode_return_mean"] / N_AGENTS / REWARD_SCALE)
        steps = found["num_env_steps_sampled_lifetime"]
        print(f"{spent:5.0f} s {steps:8,.0f} steps: return {returns[-1]:7.2f}", flush=True)
    return returns[0], returns[-1]


def greedy(algorithm: Algorithm, policies: str) -> Acting:
    """Return a function that takes the policies' most probable actions."""
    modules = [algorithm.get_module(name_policy(policies, f"agent_{i}")) for i in range(N_AGENTS)]

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        actions = np.zeros(observations.shape[:2], np.int64)
        with torch.inference_mode():
            for agent, module in enumerate(modules):
                batch = {Columns.OBS: torch.from_numpy(observations[:, agent])}
                logits = module.forward_inference(batch)[Columns.ACTION_DIST_INPUTS]
                actions[:, agent] = logits.argmax(-1)
        return actions

    return act


def main() -> None:
    """Train, evaluate, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
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
        first, last = train(algorithm, arguments.seconds)
        landmarks = unseen_landmarks(arguments.problems, Training.met)
        judgement = judge(greedy(algorithm, arguments.policies), landmarks, **TASK)
    finally:
        algorithm.stop()
        ray.shutdown()
    print(f"return in training: {first:.1f} -> {last:.1f}; {len(Training.met):,} problems met")
    print(f"{len(landmarks):,} unseen problems, greedy: {judgement}")


if __name__ == "__main__":
    main()

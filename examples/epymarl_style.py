"""EPyMARL-style VDN in plain PyTorch, on `mapp_env/Tuple-v0`.

EPyMARL is not on PyPI, so this is a small version of its loop, on the environment that it accepts
(`env_args.key="mapp_env:mapp_env/Tuple-v0"`): whole episodes in a replay memory, one network with
the agent's index as an input, the team's value as the sum of the agents' values, an update after
each episode. Rewards of the last step are kept, and a truncation is not treated as a termination.
Results are in docs/trainers.md.

    python examples/epymarl_style.py              # a minute of CPU time
    python examples/epymarl_style.py --no-mix     # independent learners (IQL); --help for more

Needs `pip install -c constraints.txt -e ".[baselines]"`.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass

import gymnasium
import numpy as np
import torch
import tyro
from beside_optimum import check_options, report
from torch import nn


@dataclass
class Args:
    """Options of the training."""

    seconds: float = 60.0
    """CPU seconds to train for"""
    problems: int = 1000
    """number of problems to evaluate on, greedily"""
    seed: int = 0
    """seed of network, exploration and problems"""
    mix: bool = True
    """learn the sum of the agents' values (VDN); otherwise each agent's separately (IQL)"""
    learning_rate: float = 1e-3
    """learning rate of Adam"""
    reward_scale: float = 0.05
    """factor for rewards, which may be -30 in one step"""
    discount: float = 0.9
    """discount per step"""
    batch_episodes: int = 16
    """episodes per update"""
    memory_episodes: int = 2000
    """episodes kept"""
    target_updates: int = 50
    """updates between copies to the target network"""


class Episodes:
    """Replay memory of whole episodes: observations (T + 1), actions, rewards, terminations."""

    def __init__(self, size: int, limit: int, n_agents: int, n_features: int) -> None:
        self.seen = np.zeros((size, limit + 1, n_agents, n_features), np.float32)
        self.actions = np.zeros((size, limit, n_agents), np.int64)
        self.rewards = np.zeros((size, limit, n_agents), np.float32)
        self.ended = np.zeros((size, limit), np.float32)  # terminated, not truncated
        self.filled = np.zeros((size, limit), np.float32)
        self.count = 0

    def place(self) -> int:
        """Return the cleared slot for the next episode."""
        index = self.count % len(self.seen)
        self.count += 1
        self.filled[index] = self.ended[index] = 0.0
        return index

    def sample(self, n: int, rng: np.random.Generator) -> list[torch.Tensor]:
        """Return n random episodes, padded to the longest of them."""
        rows = rng.integers(0, min(self.count, len(self.seen)), n)
        steps = int(self.filled[rows].sum(1).max())
        parts = (self.actions, self.rewards, self.ended, self.filled)
        return [
            torch.from_numpy(part)
            for part in (self.seen[rows, : steps + 1], *(part[rows, :steps] for part in parts))
        ]


def make_network(n_features: int, n_actions: int) -> nn.Module:
    """Return the shared network: features and the agent's index -> action values."""
    return nn.Sequential(
        nn.Linear(n_features, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, n_actions)
    )


def with_numbers(observations: np.ndarray) -> np.ndarray:
    """Append each agent's one-hot index: (..., N, F) -> (..., N, F + N)."""
    n_agents = observations.shape[-2]
    numbers = np.broadcast_to(
        np.eye(n_agents, dtype=np.float32), (*observations.shape[:-1], n_agents)
    )
    return np.concatenate([observations, numbers], axis=-1)


def find_loss(
    batch: list[torch.Tensor], network: nn.Module, target: nn.Module, args: Args
) -> torch.Tensor:
    """Return the mean double Q-learning Huber loss over the steps played."""
    seen, actions, rewards, ended, filled = batch
    values = network(seen)  # (E, T + 1, N, A)
    chosen = values[:, :-1].gather(3, actions[..., None])[..., 0]
    with torch.no_grad():
        best = values[:, 1:].argmax(3, keepdim=True)
        later = target(seen[:, 1:]).gather(3, best)[..., 0]
    reward = args.reward_scale * rewards
    if args.mix:
        chosen, later = chosen.sum(2, keepdim=True), later.sum(2, keepdim=True)
        reward = reward[:, :, :1]  # the team's, the same for each agent
    wanted = reward + args.discount * (1.0 - ended[..., None]) * later
    losses = nn.functional.huber_loss(chosen, wanted, reduction="none").mean(2)
    return (losses * filled).sum() / filled.sum()


def play(
    env: gymnasium.Env,
    network: nn.Module,
    memory: Episodes,
    epsilon: float,
    rng: np.random.Generator,
) -> float:
    """Play one episode into the memory and give its undiscounted return."""
    row, step, total = memory.place(), 0, 0.0
    observations, _ = env.reset()
    terminated = truncated = False
    while not (terminated or truncated):
        memory.seen[row, step] = with_numbers(np.stack(observations))
        with torch.no_grad():
            actions = network(torch.from_numpy(memory.seen[row, step])).argmax(1).numpy()
        random = rng.integers(0, env.action_space[0].n, len(actions))
        actions = np.where(rng.random(len(actions)) < epsilon, random, actions)
        observations, rewards, terminated, truncated, _ = env.step(actions.tolist())
        memory.actions[row, step], memory.rewards[row, step] = actions, rewards
        memory.ended[row, step], memory.filled[row, step] = terminated, 1.0
        total += rewards[0]
        step += 1
    memory.seen[row, step] = with_numbers(np.stack(observations))
    return total


def main(args: Args) -> None:
    """Train and print the results."""
    check_options(args.seconds, args.problems)
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    env = gymnasium.make("mapp_env:mapp_env/Tuple-v0", observation="geodesic")
    env.reset(seed=args.seed)
    n_agents, limit = env.unwrapped.n_agents, env.unwrapped.max_cycles
    n_features = env.observation_space[0].shape[0] + n_agents
    network = make_network(n_features, int(env.action_space[0].n))
    target = copy.deepcopy(network)
    optimiser = torch.optim.Adam(network.parameters(), lr=args.learning_rate)
    memory = Episodes(args.memory_episodes, limit, n_agents, n_features)

    returns: list[float] = []
    started = time.process_time()
    while (elapsed := time.process_time() - started) < args.seconds:
        epsilon = max(0.05, 1.0 - 2.0 * elapsed / args.seconds)
        returns.append(play(env, network, memory, epsilon, rng))
        if len(returns) < args.batch_episodes:
            continue
        loss = find_loss(memory.sample(args.batch_episodes, rng), network, target, args)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        if len(returns) % args.target_updates == 0:
            target.load_state_dict(network.state_dict())
    env.close()

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return network(torch.from_numpy(with_numbers(observations))).argmax(2).numpy()

    report(elapsed, returns, act, args.problems, observation="geodesic")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

"""One network for many maps: trained on a pool of generated ones, judged on maps it has never seen.

VDN in plain PyTorch on the batched engine. Each episode draws its map. An action is the landmark
that an agent walks towards (`actions="landmarks"`), and agents see nothing but distances
(`observation="distances"`), so that one network plays maps of any size. It is judged on held-out
maps, of the training maps' sizes and larger, beside the proven optima. Results are in
docs/generalise.md.

    python examples/many_maps.py                 # a minute of CPU time; --help for more

Needs `pip install -c constraints.txt -e ".[baselines]"`.
"""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from beside_optimum import check_options
from torch import nn

import mapp_env

N_AGENTS, N_LANDMARKS = 3, 5
KINDS = ("random", "rooms", "maze", "warehouse")
SMALL, LARGE = (7, 12), (16, 24)  # rows and columns, from and to
SEEING: dict[str, Any] = {"observation": "distances", "actions": "landmarks"}


@dataclass
class Args:
    """Options of the training."""

    seconds: float = 60.0
    """CPU seconds to train for"""
    problems: int = 1000
    """number of problems to evaluate on, of either size, each on a map of its own"""
    seed: int = 0
    """seed of network, exploration and problems"""
    maps: int = 500
    """number of maps to train on"""
    num_envs: int = 64
    """rows of the engine: each step of all is followed by an update"""
    learning_rate: float = 1e-3
    """learning rate of Adam"""
    discount: float = 0.97
    """discount per step"""
    batch_size: int = 256
    """transitions per update"""
    memory: int = 50_000
    """transitions kept"""
    target_updates: int = 200
    """updates between copies to the target network"""


class Memory:
    """The latest transitions of the rows."""

    def __init__(self, size: int, n_features: int) -> None:
        self.seen = np.zeros((size, N_AGENTS, n_features), np.float32)
        self.later = np.zeros_like(self.seen)
        self.actions = np.zeros((size, N_AGENTS), np.int64)
        self.rewards = np.zeros(size, np.float32)
        self.terminated = np.zeros(size, np.float32)  # not truncated: then the problem goes on
        self.count = 0

    def add(self, kept: np.ndarray, *transition: np.ndarray) -> None:
        """Store the transitions of the rows that are kept."""
        places = (self.count + np.arange(kept.sum())) % len(self.rewards)
        parts = (self.seen, self.actions, self.rewards, self.later, self.terminated)
        for part, values in zip(parts, transition, strict=True):
            part[places] = values[kept]
        self.count += len(places)

    def sample(self, n: int, rng: np.random.Generator) -> list[torch.Tensor]:
        """Return n random transitions."""
        rows = rng.integers(min(self.count, len(self.rewards)), size=n)
        parts = (self.seen, self.actions, self.rewards, self.later, self.terminated)
        return [torch.from_numpy(part[rows]) for part in parts]


def make_network(n_features: int) -> nn.Module:
    """Return the shared network: distances and the agent's index -> a value for each landmark."""
    return nn.Sequential(
        nn.Linear(n_features + N_AGENTS, 128),
        nn.ReLU(),
        nn.Linear(128, 128),
        nn.ReLU(),
        nn.Linear(128, N_LANDMARKS + 1),
    )


def find_values(network: nn.Module, seen: torch.Tensor) -> torch.Tensor:
    """Return each agent's values (..., N, K + 1), minus infinity for visited landmarks."""
    index = torch.eye(N_AGENTS).expand(*seen.shape[:-1], N_AGENTS)  # on the depot all see the same
    visited = nn.functional.pad(seen[..., -N_LANDMARKS:] == 0, (0, 1))  # the last part of the view
    return network(torch.cat([seen, index], -1)).masked_fill(visited, -torch.inf)


def find_loss(
    batch: list[torch.Tensor], network: nn.Module, target: nn.Module, discount: float
) -> torch.Tensor:
    """Return the double Q-learning loss of the team's value, the sum of the agents' (VDN)."""
    seen, actions, rewards, later, terminated = batch
    chosen = find_values(network, seen).gather(-1, actions[..., None]).sum((1, 2))
    with torch.no_grad():
        best = find_values(network, later).argmax(-1, keepdim=True)
        after = find_values(target, later).gather(-1, best).sum((1, 2))
        wanted = rewards / 10 + discount * (1 - terminated) * after
    return nn.functional.smooth_l1_loss(chosen, wanted)


def draw_problems(
    sides: tuple[int, int], seed: int, n: int, known: set[mapp_env.Grid]
) -> list[mapp_env.Problem]:
    """Return a problem on each of n maps, but for those that are known: small ones may recur."""
    grids = mapp_env.make_grids(KINDS, n, rows=sides, cols=sides, seed=seed)
    return [
        mapp_env.Problem(grid, mapp_env.sample_problems(grid, 1, N_LANDMARKS, seed)[0], N_AGENTS)
        for grid in grids
        if grid not in known
    ]


def report(name: str, act: Any, problems: list[mapp_env.Problem]) -> None:
    """Print how a policy does on some problems, beside the optimum of each."""
    found = mapp_env.evaluate(act, problems, progress=False, **SEEING)
    solved, gap = found["solved"], 100 * np.nanmean(found["gap"])
    optimal = 100 * (found["cost"] == found["optimum"]).mean()
    print(
        f"{name} ({len(problems)}): solved {100 * solved.mean():.1f} %, mean gap {gap:.1f} %, "
        f"optimal {optimal:.1f} %, {np.nanmean(found['regret']):.2f} steps lost a decision"
    )


def main(args: Args) -> None:
    """Train and print the results."""
    check_options(args.seconds, args.problems)
    torch.set_num_threads(1)
    torch.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    pool = mapp_env.make_grids(KINDS, args.maps, rows=SMALL, cols=SMALL, seed=0)
    sizes = {"n_agents": N_AGENTS, "n_landmarks": N_LANDMARKS, "max_cycles": 60}
    envs = mapp_env.make_vec(args.num_envs, grid=pool, reward="step", **sizes, **SEEING)
    n_features = envs.single_observation_space.shape[-1]
    network = make_network(n_features)
    target = copy.deepcopy(network)
    optimiser = torch.optim.Adam(network.parameters(), lr=args.learning_rate)
    memory = Memory(args.memory, n_features)

    def act(observations: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return find_values(network, torch.from_numpy(observations)).argmax(-1).numpy()

    observations, infos = envs.reset(seed=args.seed)
    begins = np.zeros(args.num_envs, bool)  # whether the next step only begins a row's episode
    totals, returns, updates = np.zeros(args.num_envs), [], 0
    started = time.process_time()
    while (elapsed := time.process_time() - started) < args.seconds:
        epsilon = max(0.05, 1.0 - 2.0 * elapsed / args.seconds)
        masks = infos["action_mask"]
        random = (rng.random(masks.shape) * masks).argmax(-1)
        explores = rng.random(random.shape) < epsilon
        actions = np.where(explores, random, act(observations))
        later, rewards, terminated, truncated, infos = envs.step(actions)
        memory.add(~begins, observations, actions, rewards, later, terminated)
        observations, begins = later, terminated | truncated
        totals += rewards
        returns.extend(totals[begins].tolist())
        totals[begins] = 0.0
        if memory.count < 4 * args.batch_size:
            continue
        loss = find_loss(memory.sample(args.batch_size, rng), network, target, args.discount)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        updates += 1
        if updates % args.target_updates == 0:
            target.load_state_dict(network.state_dict())

    count = max(1, min(200, len(returns) // 2))
    first, last = np.mean(returns[:count]), np.mean(returns[-count:])
    print(f"{len(returns)} episodes on {len(pool)} maps in {elapsed:.0f} CPU seconds")
    print(f"return of the first and the last {count}: {first:.1f} -> {last:.1f}")
    known = set(pool)
    held_out = draw_problems(SMALL, 1, args.problems, known)

    def nearest(observations: np.ndarray) -> np.ndarray:
        own, unvisited = observations[..., :N_LANDMARKS], observations[..., -N_LANDMARKS:]
        return np.where(unvisited > 0, own, np.inf).argmin(-1)

    report("held-out maps", act, held_out)
    report("larger held-out maps", act, draw_problems(LARGE, 2, args.problems, known))
    report("nearest landmark, held-out maps", nearest, held_out)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

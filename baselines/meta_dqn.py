"""One network commands all agents: a meta-agent, trained by deep Q-learning.

Method: DQN (Mnih et al. 2015) on the global observation. Two presets:

- ``default``: a network that sees cells as categories and landmarks as a set, a value for each of
  the 64 joint actions, and replay that recombines and relabels what was experienced;
- ``paper``: a network on the plain numbers with one score per action for each agent; each agent
  takes the action with its own highest score, and each agent's chosen score is trained on the team
  reward. A decaying guidance points agents to close landmarks while training.

Paper: M. Cetinkaya, Multi-Agent Path Planning Using Deep Reinforcement Learning, section 5
(arXiv 2110.01460). docs/paper.md goes through it item by item, with what the paper leaves open.

Command::

    python baselines/meta_dqn.py --seed 0
    python baselines/meta_dqn.py --preset paper
    python baselines/meta_dqn.py --resume runs/meta_dqn-default-seed0-...

Output: a new run folder (runs/meta_dqn-PRESET-seedSEED-TIME) with config.json, metrics.csv (a row
per episode), policy.safetensors, evaluation.csv and .md (1,000 unseen problems beside their proven
optima), the paper's figures 2, 3 and 4, timing.json and checkpoints. Ctrl-C (exit code 130) and
SIGTERM (143) end a run early and leave a checkpoint.
"""

import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.learning.config import Options, parse_options
from baselines.learning.experiment import run_experiment
from baselines.learning.q_learning import QLearner, next_values, td_targets
from baselines.learning.training import Streams
from baselines.networks import (
    Network,
    NetworkSpec,
    build_network,
    greedy_actions,
    spec_from_options,
    torch_generator,
)
from baselines.policies.policy import NetworkPolicy
from baselines.replay.imagined import ImaginedReplay
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import take
from mapp_env import Grid
from mapp_env.validation import check_count

ALGORITHM = "meta_dqn"
MAX_IMAGINED_AGENTS = 6  # 4,096 joint actions, with values for each in imagined replay


# -- configuration -----------------------------------------------------------------------------


class Args(Options):
    """Options of the meta-agent."""


# -- network -----------------------------------------------------------------------------------


def make_network(args: Args, grid: Grid, generator: torch.Generator) -> Network:
    """Build the network that commands all agents."""
    return build_network(spec_from_options(args, args.network, grid), generator)


# -- loss --------------------------------------------------------------------------------------


def chosen_values(values: Tensor, actions: Tensor, spec: NetworkSpec) -> Tensor:
    """Return the values of the actions taken: (B, T) of joint ones, (B, T, N) of agents'.

    Parameters
    ----------
    values
        (B, A ** N) or (B, N, A).
    actions
        (B, T, N), one action per agent.
    spec
        Of the network.
    """
    if spec.outputs == "joint":
        weights = spec.n_actions ** torch.arange(spec.n_agents - 1, -1, -1)
        return values.gather(1, (actions * weights).sum(-1))
    return values.gather(2, actions.transpose(1, 2)).transpose(1, 2)


# -- learner -----------------------------------------------------------------------------------


class MetaLearner(QLearner):
    """The network, its target network, optimiser and replay."""

    def __init__(self, args: Args, grid: Grid, streams: Streams) -> None:
        network = make_network(args, grid, torch_generator(streams.network))
        target = make_network(args, grid, torch.Generator())
        super().__init__(args, grid, network, target, np.random.default_rng(streams.replay))
        self.memory: ReplayMemory | None = None
        self.imagined: ImaginedReplay | None = None
        # The target network's values in the imagined states.
        self.here = torch.zeros(args.batch_size, *self.spec.values_shape)
        if args.replay == "stored":
            self.memory = ReplayMemory(args.memory_size, self.spec.observation_size, args.n_agents)
        else:
            # Joint actions are compared, whatever the network's outputs are.
            check_count("n_agents", args.n_agents, 1, MAX_IMAGINED_AGENTS)
            self.imagined = ImaginedReplay(
                self.spec,
                grid.depot,
                args.batch_size,
                args.tried_actions,
                args.temperature,
                args.imagined_exploration,
                args.imagined_from_depot,
                args.imagined_length,
                args.imagined_retries,
            )

    # -- acting

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the greedy joint action (N,)."""
        with torch.inference_mode():
            return greedy_actions(self.network(torch.from_numpy(observation[None])), self.spec)[0]

    def policy(self) -> NetworkPolicy:
        """Return what was learned."""
        return NetworkPolicy(self.network)

    # -- learning

    def remember(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Take note of a transition."""
        if self.memory is not None:
            self.memory.add(observation, actions, reward, next_observation, terminated)
        if self.imagined is not None:
            self.imagined.remember(observation, actions, next_observation)

    @property
    def ready(self) -> bool:
        """Whether there is something to learn from."""
        return self.imagined.ready if self.imagined is not None else True

    @property
    def replay(self) -> ReplayMemory | ImaginedReplay:
        """What is learned from."""
        if self.memory is not None:
            return self.memory
        assert self.imagined is not None
        return self.imagined

    def prepare(self, progress: float) -> tuple[Batch, Tensor]:
        """Return a batch and the targets of its values."""
        return self.prepare_stored() if self.imagined is None else self.prepare_imagined(progress)

    def prepare_stored(self) -> tuple[Batch, Tensor]:
        """Return transitions as they were played, and the targets of their values."""
        assert self.memory is not None
        args, batch = self.args, self.memory.sample(self.args.batch_size, self.rng)
        rewards = args.reward_scale * torch.from_numpy(batch.rewards[:, 0])
        with torch.no_grad():
            seen = torch.from_numpy(batch.next_observations[:, 0])
            values = self.target(seen)
            chooser = self.network(seen) if args.double else values
            following = next_values(values, chooser, None)
        terminated = torch.from_numpy(batch.terminated[:, 0])
        return batch, td_targets(rewards, terminated, following, args.discount)[:, None]

    def prepare_imagined(self, progress: float) -> tuple[Batch, Tensor]:
        """Return imagined transitions, and the targets of their values."""
        imagined, goal, spec = self.imagined, self.goal(progress), self.spec
        assert imagined is not None
        with torch.no_grad():
            fresh = imagined.start_over(self.rng)
            seen = torch.from_numpy(imagined.observations()[fresh])
            self.here[fresh] = self.target(seen)
            batch, followed = imagined.draw(
                joint_values(self.here, spec).numpy(), goal.reward, self.rng
            )
            flat = batch.next_observations.reshape(-1, spec.observation_size)
            seen = torch.from_numpy(flat)
            values = self.target(seen)
            chooser = self.network(seen) if self.args.double else values
            targets = td_targets(
                torch.from_numpy(batch.rewards.reshape(-1)),
                torch.from_numpy(batch.terminated.reshape(-1)),
                next_values(values, chooser, imagined.known_actions(flat)),
                goal.discount,
            ).view(*batch.rewards.shape, *self.here.shape[1:-1])
            if self.args.action_gap:
                known = imagined.known_actions(batch.observations)
                best = next_values(self.here, self.here, known)[:, None]
                taken = chosen_values(self.here, torch.from_numpy(batch.actions), spec)
                targets -= self.args.action_gap * (best - taken)
            # The episodes go on by these values, one update old by then.
            n_rows, n_tried = batch.rewards.shape
            goes_on = torch.from_numpy(np.arange(n_rows) * n_tried + followed)
            self.here = values[goes_on]
        return batch, targets

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        return {**super().arrays(), "here": self.here.numpy()}

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what was saved."""
        super().restore(arrays, state)
        self.here = torch.from_numpy(take(arrays, "here", self.here.numpy()))

    def chosen(self, values: Tensor, actions: Tensor) -> Tensor:
        """Return the values of the joint actions taken."""
        return chosen_values(values, actions, self.spec)


def joint_values(values: Tensor, spec: NetworkSpec) -> Tensor:
    """Return a value for each joint action, (B, A ** N): agents' values are summed."""
    if spec.outputs == "joint":
        return values
    whole = values[:, 0]
    for agent in range(1, spec.n_agents):
        whole = (whole[:, :, None] + values[:, agent, None, :]).flatten(1)
    return whole


def main(args: Args) -> int:
    """Train, evaluate, draw; return the exit code."""
    return run_experiment(args, ALGORITHM, MetaLearner)


if __name__ == "__main__":
    try:
        sys.exit(main(parse_options(Args, __doc__ or "")))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

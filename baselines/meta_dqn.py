"""One network commands all agents: a meta-agent, trained by deep Q-learning.

Method: DQN (Mnih et al. 2015) on the global observation. Two presets:

- ``default``: a network that sees cells as categories and landmarks as a set, a value for each of
  the 64 joint actions, and replay that recombines and relabels what was experienced;
- ``paper``: a network on the plain numbers with one score per action for each agent; each agent
  takes the action with its own highest score, and each agent's chosen score is trained on the team
  reward. A decaying guidance points agents to close landmarks while training.

Paper: M. Cetinkaya, Multi-Agent Path Planning Using Deep Reinforcement Learning, section 5
(arXiv 2110.01460). docs/paper.md goes through it item by item, with what the paper leaves open.

The algorithm stands in :class:`MetaLearner`, in the order in which it happens: ``act``,
``remember``, ``sample`` (a batch, and the targets of its values), ``update`` (the loss, a step down
it, the target network). The step of the environment between the first two is the same for all
learners, with exploration, guidance and the loop over episodes: ``Training`` in
``baselines/learning/training.py``.

Command::

    python baselines/meta_dqn.py --seed 0
    python baselines/meta_dqn.py --preset paper
    python baselines/meta_dqn.py --resume runs/meta_dqn-default-seed0-...

Output: a new run folder (runs/meta_dqn-PRESET-seedSEED-TIME) with config.json, metrics.csv (a row
per episode), policy.safetensors, evaluation.csv and .md (1,000 unseen problems beside their proven
optima), the paper's figures 2, 3 and 4, timing.json and checkpoints. Ctrl-C (exit code 130) and
SIGTERM (143) end a run early and leave a checkpoint.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from baselines.learning.config import Options, run_script
from baselines.learning.q_learning import (
    QLearner,
    action_values,
    chosen_values,
    imagination,
    joint_values,
    learning_rate,
    move_target,
    next_values,
    td_targets,
)
from baselines.learning.training import Streams, train_learner
from baselines.networks import (
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


class Args(Options):
    """Options of the meta-agent."""


def make_replay(args: Args, grid: Grid, spec: NetworkSpec) -> ReplayMemory | ImaginedReplay:
    """Build the memory of what all agents did."""
    if args.replay == "stored":
        size = spec.observation_size
        return ReplayMemory(args.memory_size, size, args.n_agents, args.reward_scale)
    # Joint actions are compared, whatever the network's outputs are.
    check_count("n_agents", args.n_agents, 1, MAX_IMAGINED_AGENTS)
    return ImaginedReplay(spec, grid, **imagination(args))


class MetaLearner(QLearner):
    """The network of all agents, and what it learns with."""

    def __init__(self, args: Args, grid: Grid, streams: Streams) -> None:
        spec = spec_from_options(args, args.network, grid)
        network = build_network(spec, torch_generator(streams.network))
        replay, rng = make_replay(args, grid, spec), np.random.default_rng(streams.replay)
        super().__init__(args, grid, network, build_network(spec), replay, rng)
        # The target network's values in the imagined states.
        self.here = torch.zeros(args.batch_size, *self.spec.values_shape)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the greedy joint action (N,)."""
        with torch.inference_mode():
            return greedy_actions(self.network(torch.from_numpy(observation[None])), self.spec)[0]

    def remember(
        self,
        observation: np.ndarray,
        actions: np.ndarray,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Store a transition (imagined replay keeps only where each agent's move led)."""
        self.replay.add(observation, actions, reward, next_observation, terminated)

    @property
    def ready(self) -> bool:
        """Whether enough has been stored to learn."""
        return self.replay.ready

    @torch.no_grad()
    def sample(self, progress: float) -> tuple[Batch, Tensor]:
        """Draw a batch, and compute the targets of its values."""
        args, goal, replay = self.args, self.goal(progress), self.replay
        # The states: imagined along the policy, or stored.
        if isinstance(replay, ImaginedReplay):
            begun = replay.start_over(self.rng)
            self.here[begun] = self.target(torch.from_numpy(replay.observations()[begun]))
            here = joint_values(self.here, self.spec).cpu().numpy()
            batch, followed = replay.draw(here, goal.reward, self.rng)
        else:
            batch = replay.sample(args.batch_size, self.rng)

        # The targets: the reward, and the best that can follow.
        next_obs = torch.from_numpy(batch.next_observations)
        values = action_values(self.target, next_obs)
        chooser = action_values(self.network, next_obs) if args.double else values
        best = next_values(values, chooser, replay.known_actions(batch.next_observations))
        rewards, terminated = map(torch.from_numpy, (batch.rewards, batch.terminated))
        targets = td_targets(rewards, terminated, best, goal.discount)

        if isinstance(replay, ImaginedReplay):
            if args.action_gap:
                known = replay.known_actions(batch.observations)
                best = next_values(self.here, self.here, known)[:, None]
                taken = chosen_values(self.here, torch.from_numpy(batch.actions), self.spec)
                targets -= args.action_gap * (best - taken)
            # The episodes go on by these values, one update old by then.
            self.here = values[torch.arange(len(followed)), torch.from_numpy(followed)]
        return batch, targets

    def update(self, progress: float) -> float:
        """One step of Adam down the Huber loss of a batch, at a part of the training (0 to 1)."""
        args = self.args
        # Imagined batches are drawn one update early, beside the step below.
        batch, targets = self.prepared or self.sample(progress)
        coming = self.draw_ahead(progress)

        obs, actions = map(torch.from_numpy, (batch.observations, batch.actions))
        loss = smooth_l1_loss(
            chosen_values(self.network(obs), actions, self.spec), targets, beta=args.huber_delta
        )
        self.optimiser.param_groups[0]["lr"] = learning_rate(args, progress, self.updates)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()

        self.prepared = coming()  # before the target network moves, which it reads
        self.updates += 1
        move_target(self.target, self.network, args, self.updates)
        return loss.item()

    def policy(self) -> NetworkPolicy:
        """Return the trained policy."""
        return NetworkPolicy(self.network)

    # -- checkpoints

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        return {**super().arrays(), "here": self.here.cpu().numpy()}

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Restore a checkpoint."""
        super().restore(arrays, state)
        self.here = torch.from_numpy(take(arrays, "here", self.here.cpu().numpy()))


def main(args: Args) -> int:
    """Train, evaluate, draw; return the exit code."""
    return train_learner(args, ALGORITHM, MetaLearner)


if __name__ == "__main__":
    run_script(main, Args, __doc__)

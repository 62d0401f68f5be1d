"""TorchRL: value decomposition (VDN) on ``mapp_env``, trained in about a minute on one core.

Usage::

    pip install -c constraints.txt -e ".[baselines]" torchrl
    OMP_NUM_THREADS=1 python examples/torchrl_vdn.py
    python examples/torchrl_vdn.py --help

One network, shared by the agents, computes each agent's action values from its own observation;
their sum is trained to be the value of the team (centralised training, decentralised execution).
All parts are TorchRL's: wrapper, collector, replay buffer, loss, mixer, target network.

Output: the mean return of the training episodes every thousand steps; then the greedy policy on
unseen problems before and after training, compared with the proven optima.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import tyro
from beside_optimum import Judgement, judge, unseen_landmarks
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import PettingZooWrapper
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type
from torchrl.modules import MLP, EGreedyModule, QValueActor, VDNMixer
from torchrl.objectives import SoftUpdate
from torchrl.objectives.multiagent import QMixerLoss

from mapp_env import mapp_v0

OBSERVATION, ACTION, MASK = (("agent", key) for key in ("observation", "action", "action_mask"))
ACTION_VALUE, CHOSEN_VALUE = ("agent", "action_value"), ("agent", "chosen_action_value")


@dataclass(frozen=True)
class Args:
    """Options of the training."""

    seed: int = 0
    """seed of problems, exploration and weights"""
    steps: int = 6000
    """steps played in the environment"""
    steps_per_batch: int = 40
    """steps played before the network is updated"""
    updates_per_batch: int = 30
    """updates after that"""
    batch_size: int = 128
    """transitions per update"""
    reward: Literal["manhattan", "geodesic", "step"] = "geodesic"
    """the team reward"""
    reward_scale: float = 0.05
    """factor for rewards, to keep values of the order of one"""
    discount: float = 0.9
    """discount factor of future rewards"""
    learning_rate: float = 0.001
    """learning rate of Adam"""
    tau: float = 0.01
    """fraction by which the target network moves towards the network at each update"""
    hidden_units: int = 64
    """rectifier units in a hidden layer"""
    explore: float = 0.1
    """final share of random actions; decreases from 1 during the first half of the steps"""
    problems: int = 500
    """unseen problems to evaluate on"""


def make_env(args: Args) -> PettingZooWrapper:
    """Return the environment in TorchRL's wrapper: one group, "agent", of all agents."""
    env = mapp_v0.parallel_env(observation="geodesic", reward=args.reward)
    with warnings.catch_warnings():
        # TorchRL warns that it tests with one PettingZoo version, from 2024.
        warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested", UserWarning)
        return PettingZooWrapper(env, categorical_actions=True, return_state=True)


class LandmarkSet(nn.Module):
    """An agent's action values, from its features of each landmark, in any order."""

    def __init__(self, n_features: int, n_actions: int, n_units: int) -> None:
        super().__init__()
        self.n_features = n_features
        self.one = MLP(n_features, n_units, depth=1, num_cells=n_units, activation_class=nn.ReLU)
        self.all = MLP(n_units, n_actions, depth=1, num_cells=n_units, activation_class=nn.ReLU)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return values (..., A) of observations (..., K * features)."""
        landmarks = observations.unflatten(-1, (-1, self.n_features))
        unvisited = landmarks[..., :1]
        return self.all((unvisited * torch.relu(self.one(landmarks))).sum(-2))


def make_actor(env: PettingZooWrapper, args: Args) -> QValueActor:
    """Return the agents' shared network; it takes the best action that does not bump."""
    n_numbers = env.observation_spec[OBSERVATION].shape[-1]
    network = LandmarkSet(
        n_features=n_numbers // env.task.n_landmarks,
        n_actions=env.full_action_spec[ACTION].space.n,
        n_units=args.hidden_units,
    )
    return QValueActor(
        TensorDictModule(network, in_keys=[OBSERVATION], out_keys=[ACTION_VALUE]),
        spec=env.full_action_spec_unbatched,
        action_key=ACTION,
        action_value_key=ACTION_VALUE,
        chosen_action_value_key=CHOSEN_VALUE,
        action_mask_key=MASK,
    )


def make_loss(actor: QValueActor, env: PettingZooWrapper, args: Args) -> QMixerLoss:
    """Return the VDN loss: QMIX with a sum as its mixer."""
    mixer = VDNMixer(n_agents=len(env.group_map["agent"]), device="cpu")
    loss = QMixerLoss(
        actor,
        TensorDictModule(mixer, in_keys=[CHOSEN_VALUE], out_keys=["chosen_action_value"]),
        loss_function="smooth_l1",
        delay_value=True,
        action_space="categorical",
    )
    loss.set_keys(local_value=CHOSEN_VALUE, action=ACTION, action_value=ACTION_VALUE)
    loss.make_value_estimator(gamma=args.discount)
    return loss


def for_replay(played: TensorDictBase, env: PettingZooWrapper, args: Args) -> TensorDictBase:
    """Convert the collector's transitions to what the loss needs.

    The reward is the team's, once rather than per agent. On an episode's last step the wrapper
    opens all action masks; since the loss bootstraps from the last state of a truncated episode,
    the masks are restored from the agents' cells, with which the state begins.
    """
    following = played["next"]
    n_agents = following[MASK].shape[-2]
    cells = following["state"][..., :n_agents].long()
    moves = torch.tensor(env.task.grid.moves)
    kept = played.select(OBSERVATION, ACTION, MASK, "state").clone()
    kept["next"] = following.select(OBSERVATION, "state", "done", "terminated").clone()
    kept["next", *MASK] = moves[cells] != cells.unsqueeze(-1)
    kept["next", "reward"] = args.reward_scale * following["agent", "reward"][..., 0, :]
    return kept


class Returns:
    """Accumulates rewards into episode returns."""

    def __init__(self) -> None:
        self.total = 0.0  # of the episode in progress
        self.ended: list[float] = []

    def add(self, played: TensorDictBase) -> None:
        """Add the next steps."""
        rewards = played["next", "agent", "reward"][:, 0, 0].tolist()
        for reward, done in zip(rewards, played["next", "done"][:, 0].tolist(), strict=True):
            self.total += reward
            if done:
                self.ended.append(self.total)
                self.total = 0.0


def judge_actor(actor: QValueActor, landmarks: np.ndarray, args: Args) -> Judgement:
    """Evaluate the greedy policy."""

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        views = TensorDict(
            {OBSERVATION: torch.as_tensor(observations), MASK: torch.as_tensor(masks != 0)},
            batch_size=len(observations),
        )
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(views)[ACTION].numpy()

    return judge(act, landmarks, observation="geodesic", reward=args.reward)


def train(env: PettingZooWrapper, actor: QValueActor, args: Args) -> TensorDictReplayBuffer:
    """Train the actor; return all transitions collected."""
    loss = make_loss(actor, env, args)
    targets = SoftUpdate(loss, tau=args.tau)
    optimiser = torch.optim.Adam(loss.parameters(), lr=args.learning_rate)
    explorer = EGreedyModule(
        spec=env.full_action_spec_unbatched,
        eps_init=1.0,
        eps_end=args.explore,
        annealing_num_steps=max(args.steps // 2, 1),
        action_key=ACTION,
        action_mask_key=MASK,
    )
    collector = Collector(
        env,
        TensorDictSequential(actor, explorer),
        frames_per_batch=args.steps_per_batch,
        total_frames=args.steps,
        auto_register_policy_transforms=False,  # none needed
    )
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(args.steps + args.steps_per_batch), batch_size=args.batch_size
    )
    returns, start, reported = Returns(), time.process_time(), 0
    for played in collector:
        returns.add(played)
        replay.extend(for_replay(played, env, args))
        explorer.step(args.steps_per_batch)
        for _ in range(args.updates_per_batch):
            optimiser.zero_grad()
            loss(replay.sample())["loss"].backward()
            optimiser.step()
            targets.step()
        if len(replay) // 1000 > reported:
            reported = len(replay) // 1000
            seconds = time.process_time() - start
            print(
                f"{len(replay):6d} steps {seconds:4.0f} s: return of the last "
                f"{len(returns.ended)} episodes {np.mean(returns.ended):.1f}",
                flush=True,
            )
            returns.ended.clear()
    collector.shutdown(close_env=False)
    return replay


def main(args: Args) -> None:
    """Train, and evaluate before and after."""
    torch.manual_seed(args.seed)
    env = make_env(args)
    check_env_specs(env)
    env.set_seed(args.seed)
    actor = make_actor(env, args)
    untrained = {name: weights.clone() for name, weights in actor.state_dict().items()}
    start = time.process_time()
    replay = train(env, actor, args)
    seconds = time.process_time() - start

    task = env.task
    places = slice(task.n_agents, task.n_agents + task.n_landmarks)
    met = replay[:]["state"][:, places].long().unique(dim=0)
    landmarks = unseen_landmarks(args.problems, met.tolist())
    after = judge_actor(actor, landmarks, args)
    actor.load_state_dict(untrained)
    before = judge_actor(actor, landmarks, args)
    print(f"{args.problems} unseen problems, greedy; {len(met)} problems met")
    print(f"trained {seconds:.0f} s of one core")
    print(f"before: {before}")
    print(f"after:  {after}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

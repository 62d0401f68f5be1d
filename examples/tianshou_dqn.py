"""Tianshou 2: independent double DQN on the AEC environment, one network per agent.

Tianshou takes PettingZoo's AEC environment, `mapp_v0.env()`, in which agents act in turns, and
stores their turns one after the other. An agent's next turn is thus three turns later: with a
three-step return each agent learns from its own observations. Results are in docs/trainers.md.

    python examples/tianshou_dqn.py                # a minute of CPU time; --help for more

Needs Tianshou 2. It requires older versions of filelock and pandas than the pinned ones, so install
it in a separate virtual environment (in bash):

    python3 -m venv .venv-tianshou
    .venv-tianshou/bin/pip install -c <(grep -vE '^(filelock|pandas)=' constraints.txt) \
        -e ".[baselines]" tianshou==2.0.1
    .venv-tianshou/bin/python examples/tianshou_dqn.py
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from beside_optimum import check_options, report
from tianshou.algorithm import DQN
from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
from tianshou.algorithm.multiagent.marl import MultiAgentOffPolicyAlgorithm
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Collector, CollectStats, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv
from tianshou.trainer import OffPolicyTrainer, OffPolicyTrainerParams
from tianshou.utils.net.common import Net

from mapp_env import mapp_v0


@dataclass
class Args:
    """Options of the training."""

    seconds: float = 60.0
    """CPU seconds to train for"""
    problems: int = 1000
    """number of problems to evaluate on, greedily"""
    seed: int = 0
    """seed of networks, exploration and problems"""
    num_envs: int = 64
    """number of parallel environments"""
    learning_rate: float = 1e-3
    """learning rate of Adam"""
    reward_scale: float = 0.05
    """factor for rewards, which may be -30 in one step"""
    discount: float = 0.9
    """discount per step of the team"""


class ScaledEnv(PettingZooEnv):
    """Tianshou's wrapper of the environment, with scaled rewards."""

    scale = 1.0

    def step(self, action: int) -> tuple[dict, list[float], bool, bool, dict]:
        """Take an agent's turn; return the next agent's observation, and everyone's reward."""
        observation, rewards, terminated, truncated, info = super().step(action)
        return observation, [self.scale * r for r in rewards], terminated, truncated, info


def make_learner(env: PettingZooEnv, args: Args) -> DQN:
    """Return one agent's learner."""
    network = Net(
        state_shape=env.observation_space.shape,
        action_shape=env.action_space.n,
        hidden_sizes=[64, 64],
    )
    policy = DiscreteQLearningPolicy(
        model=network,
        action_space=env.action_space,
        observation_space=env.observation_space,
    )
    n_agents = len(env.agents)
    return DQN(
        policy=policy,
        optim=AdamOptimizerFactory(lr=args.learning_rate),
        gamma=args.discount ** (1 / n_agents),  # per turn of one agent
        n_step_return_horizon=n_agents,
        target_update_freq=200,
        huber_loss_delta=1.0,
    )


def main(args: Args) -> None:
    """Train and print the results."""
    check_options(args.seconds, args.problems)
    # Otherwise it warns at each step that it flattens multi-agent returns for its statistics.
    logging.getLogger("tianshou").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    np.random.seed(args.seed)  # noqa: NPY002 - Tianshou explores with it
    torch.manual_seed(args.seed)

    def make_env() -> PettingZooEnv:
        env = ScaledEnv(mapp_v0.env(observation="geodesic"))
        env.scale = args.reward_scale
        return env

    env = make_env()
    learners = [make_learner(env, args) for _ in env.agents]
    algorithm = MultiAgentOffPolicyAlgorithm(algorithms=learners, env=env)
    envs = DummyVectorEnv([make_env] * args.num_envs)
    envs.seed([int(s) for s in np.random.SeedSequence(args.seed).generate_state(args.num_envs)])

    returns: list[float] = []

    def keep_return(episode: object) -> None:
        returns.append(float(episode.rew[:, 0].sum() / args.reward_scale))  # type: ignore[attr-defined]

    collector = Collector[CollectStats](
        algorithm,
        envs,
        VectorReplayBuffer(60_000, args.num_envs),
        exploration_noise=True,
        on_episode_done_hook=keep_return,
        raise_on_nan_in_buffer=False,  # it would scan the whole buffer at each step
    )
    trainer = OffPolicyTrainer(
        algorithm,
        OffPolicyTrainerParams(
            training_collector=collector,
            max_epochs=1_000_000,
            epoch_num_steps=48 * args.num_envs,
            # Keeps gradient steps below 20: from 20 on the progress bar cannot be disabled.
            collection_step_num_env_steps=24 * args.num_envs,
            update_step_num_gradient_steps_per_sample=1 / 80,
            batch_size=384,
            multi_agent_return_reduction=lambda rewards: rewards[:, 0],
            verbose=False,
            show_progress=False,
        ),
    )
    started = time.process_time()
    trainer.reset()
    while (elapsed := time.process_time() - started) < args.seconds:
        for learner in learners:
            # Tianshou marks only the joint policy as training, not the individual ones.
            learner.policy.set_eps_inference(max(0.05, 1.0 - 2.0 * elapsed / args.seconds))
        trainer.execute_epoch()

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            values = [
                learner.policy.model(observations[:, agent])[0]
                for agent, learner in enumerate(learners)
            ]
        return torch.stack(values, 1).argmax(2).numpy()

    report(elapsed, returns, act, args.problems, observation="geodesic")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

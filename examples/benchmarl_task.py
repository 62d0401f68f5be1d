"""BenchMARL: a task for ``mapp_env``, and IQL, VDN or QMIX trained on it for about a minute.

BenchMARL 1.5 needs TorchRL below 0.12, but the tests need a newer one: install it in a separate
virtual environment, with the versions of ``constraints.txt`` for everything else. Usage::

    python3 -m venv .venv-benchmarl
    grep -vE "^(torchrl|tensordict)=" constraints.txt > .venv-benchmarl/constraints.txt
    .venv-benchmarl/bin/pip install -c .venv-benchmarl/constraints.txt -e . benchmarl==1.5.2 tyro
    OMP_NUM_THREADS=1 .venv-benchmarl/bin/python examples/benchmarl_task.py --algorithm vdn
    OMP_NUM_THREADS=1 .venv-benchmarl/bin/python examples/benchmarl_task.py --algorithm iql
    .venv-benchmarl/bin/python examples/benchmarl_task.py --help

This installed torchrl 0.11.1, tensordict 0.11.0, torchvision 0.28.0 and torch 2.13.0.

IQL: each agent learns from the team's reward independently; VDN: the sum of the agents' values is
trained to be the team's value; QMIX: in place of the sum, a mixing network that is monotonic in
each agent's value and receives the state. In all three the agents share one network, BenchMARL's
model for sets, here sets of landmarks.

Output: the mean return of the training episodes every thousand steps; then the greedy policy on
unseen problems before and after training, compared with the proven optima.
"""

from __future__ import annotations

import copy
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
import tyro
from benchmarl.algorithms import IqlConfig, QmixConfig, VdnConfig
from benchmarl.environments import Task, TaskClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models import DeepsetsConfig
from beside_optimum import Judgement, judge, unseen_landmarks
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import Composite
from torchrl.envs import EnvBase, PettingZooWrapper, Transform, UnaryTransform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from mapp_env import mapp_v0

ALGORITHMS = {"iql": IqlConfig, "vdn": VdnConfig, "qmix": QmixConfig}
GROUP = "agent"  # TorchRL's name of the group of agent_0, agent_1, ...


@dataclass(frozen=True)
class Args:
    """Options of the training."""

    algorithm: Literal["iql", "vdn", "qmix"] = "vdn"
    """learning algorithm"""
    seed: int = 0
    """seed of problems, exploration and weights"""
    steps: int = 8000
    """steps played in the environment"""
    steps_per_batch: int = 40
    """steps played before the network is updated"""
    updates_per_batch: int = 30
    """updates after that"""
    batch_size: int = 128
    """transitions per update"""
    reward: Literal["manhattan", "geodesic", "step"] = "geodesic"
    """the team reward"""
    discount: float = 0.9
    """discount factor of future rewards"""
    learning_rate: float = 0.001
    """learning rate of Adam"""
    hidden_units: int = 64
    """rectifier units in a hidden layer"""
    explore: float = 0.1
    """final share of random actions; decreases from 1 during the first half of the steps"""
    problems: int = 500
    """unseen problems to evaluate on"""


# -- the task: for BenchMARL users to copy -----------------------------------------------------


def as_set(observations: torch.Tensor, n_landmarks: int) -> torch.Tensor:
    """Return observations (..., K * features) as (..., K, features)."""
    return observations.unflatten(-1, (n_landmarks, -1))


class MappTask(TaskClass):
    """``mapp_env`` as a BenchMARL task; the config holds the arguments of ``parallel_env``."""

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any
    ) -> Callable[[], EnvBase]:
        """Return a function that makes the environment."""
        return lambda: PettingZooWrapper(
            mapp_v0.parallel_env(**self.config),
            categorical_actions=True,
            return_state=True,
            seed=seed,
            device=device,
        )

    def supports_continuous_actions(self) -> bool:
        """Return False."""
        return False

    def supports_discrete_actions(self) -> bool:
        """Return True."""
        return True

    def has_render(self, env: EnvBase) -> bool:
        """Return whether the environment renders RGB frames."""
        return self.config.get("render_mode") == "rgb_array"

    def max_steps(self, env: EnvBase) -> int:
        """Return the step limit of an episode."""
        return env.max_cycles

    def group_map(self, env: EnvBase) -> dict[str, list[str]]:
        """Return the agents of each group."""
        return env.group_map

    def _only(self, env: EnvBase, key: str) -> Composite:
        spec = env.observation_spec[GROUP].clone()
        for other in [name for name in spec.keys() if name != key]:  # noqa: SIM118 - not a dict
            del spec[other]
        return Composite({GROUP: spec})

    def observation_spec(self, env: EnvBase) -> Composite:
        """Return the spec of the observations."""
        return self._only(env, "observation")

    def action_mask_spec(self, env: EnvBase) -> Composite:
        """Return the spec of the action masks."""
        return self._only(env, "action_mask")

    def info_spec(self, env: EnvBase) -> None:
        """Return None: the masks are the only info."""

    def state_spec(self, env: EnvBase) -> Composite:
        """Return the spec of the global observation, for QMIX's mixer."""
        return Composite({"state": env.observation_spec["state"].clone()})

    def action_spec(self, env: EnvBase) -> Composite:
        """Return the spec of the actions."""
        return env.full_action_spec

    def get_env_transforms(self, env: EnvBase) -> list[Transform]:
        """Return the transform of "geodesic" into a set of landmarks, for BenchMARL's set model."""
        if self.config.get("observation") != "geodesic":
            return []
        key = GROUP, "observation"
        return [UnaryTransform([key], [key], fn=partial(as_set, n_landmarks=env.task.n_landmarks))]

    @staticmethod
    def env_name() -> str:
        """Return the name of the family of tasks."""
        return "mapp_env"


class MappEnvTask(Task):
    """The tasks of ``mapp_env``: ``MappEnvTask.PAPER_7X7.get_task(config)``."""

    PAPER_7X7 = None

    @staticmethod
    def associated_class() -> type[TaskClass]:
        """Return the class of these tasks."""
        return MappTask


# -- training it -------------------------------------------------------------------------------


class Report(Callback):
    """Prints the mean return of finished episodes every thousand steps; records problems met."""

    def __init__(self) -> None:
        super().__init__()
        self.start = time.process_time()
        self.returns: list[float] = []
        self.met: set[tuple[int, ...]] = set()
        self.steps = 0

    def on_batch_collected(self, batch: TensorDictBase) -> None:
        """Read the episodes' returns, which BenchMARL sums per agent, and the problems."""
        task = self.experiment.test_env.task
        places = slice(task.n_agents, task.n_agents + task.n_landmarks)
        self.met.update(map(tuple, batch["state"][..., places].flatten(0, -2).int().tolist()))
        ended = batch["next", "done"].squeeze(-1)
        self.returns += batch["next", GROUP, "episode_reward"][ended][:, 0, 0].tolist()
        self.steps += batch.numel()
        if self.steps % 1000 < batch.numel():
            print(
                f"{self.steps:6d} steps {time.process_time() - self.start:4.0f} s: return of the "
                f"last {len(self.returns)} episodes {np.mean(self.returns):.1f}",
                flush=True,
            )
            self.returns.clear()


def make_model(args: Args) -> DeepsetsConfig:
    """Return the agents' network: BenchMARL's set model, here for sets of landmarks."""
    model = DeepsetsConfig.get_from_yaml()
    model.local_nn_num_cells = model.global_nn_num_cells = [args.hidden_units]
    model.out_features_local_nn = args.hidden_units
    model.local_nn_activation_class = model.global_nn_activation_class = nn.ReLU
    return model


def make_config(args: Args, folder: str) -> ExperimentConfig:
    """Return BenchMARL's experiment config: its defaults, except for these."""
    config = ExperimentConfig.get_from_yaml()
    config.gamma, config.lr, config.polyak_tau = args.discount, args.learning_rate, 0.01
    config.exploration_eps_init, config.exploration_eps_end = 1.0, args.explore
    config.exploration_anneal_frames = max(args.steps // 2, 1)
    config.max_n_frames = args.steps
    config.off_policy_collected_frames_per_batch = args.steps_per_batch
    config.off_policy_n_envs_per_worker = 1
    config.off_policy_n_optimizer_steps = args.updates_per_batch
    config.off_policy_train_batch_size = args.batch_size
    config.off_policy_memory_size = args.steps
    config.evaluation = config.render = config.create_json = False
    config.loggers, config.save_folder = [], folder
    return config


def judge_experiment(experiment: Experiment, landmarks: np.ndarray, **arguments: Any) -> Judgement:
    """Evaluate the greedy policy."""

    def act(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        views = TensorDict(
            {
                (GROUP, "observation"): as_set(torch.as_tensor(observations), landmarks.shape[1]),
                (GROUP, "action_mask"): torch.as_tensor(masks != 0),
            },
            batch_size=len(observations),
        )
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return experiment.policy(views)[GROUP, "action"].numpy()

    return judge(act, landmarks, **arguments)


def main(args: Args) -> None:
    """Train, and evaluate before and after."""
    # TorchRL warns that it tests with one PettingZoo version, from 2024.
    warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested", UserWarning)
    arguments = {"observation": "geodesic", "reward": args.reward}
    algorithm = ALGORITHMS[args.algorithm].get_from_yaml()
    algorithm.loss_function = "smooth_l1"
    report = Report()
    with tempfile.TemporaryDirectory() as folder:
        experiment = Experiment(
            task=MappEnvTask.PAPER_7X7.get_task(config=arguments),
            algorithm_config=algorithm,
            model_config=make_model(args),
            seed=args.seed,
            config=make_config(args, folder),
            callbacks=[report],
        )
        untrained = copy.deepcopy(experiment.policy.state_dict())
        start = time.process_time()
        experiment.run()
        seconds = time.process_time() - start
    landmarks = unseen_landmarks(args.problems, report.met)
    after = judge_experiment(experiment, landmarks, **arguments)
    experiment.policy.load_state_dict(untrained)
    before = judge_experiment(experiment, landmarks, **arguments)
    print(f"{args.problems} unseen problems, greedy; {len(report.met)} problems met")
    print(f"{args.algorithm}: trained {seconds:.0f} s of one core")
    print(f"before: {before}")
    print(f"after:  {after}")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))

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
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from baselines.experiment import N_ACTIONS, Streams, run_experiment
from baselines.imagined_replay import ImaginedReplay, RelabelledReward
from baselines.networks import (
    Network,
    NetworkSpec,
    build_network,
    greedy_actions,
    torch_generator,
)
from baselines.optimiser import optimiser_arrays, restore_optimiser
from baselines.options import Options, parse_options
from baselines.policy import NetworkPolicy
from baselines.replay_memory import Batch, ReplayMemory
from mapp_env import Grid

ALGORITHM = "meta_dqn"


# -- configuration -----------------------------------------------------------------------------


class Args(Options):
    """Options of the meta-agent."""


# -- network -----------------------------------------------------------------------------------


def make_network(args: Args, grid: Grid, generator: torch.Generator) -> Network:
    """Build the network that commands all agents."""
    spec = NetworkSpec(
        kind=args.network,
        n_agents=args.n_agents,
        n_landmarks=args.n_landmarks,
        n_actions=N_ACTIONS,
        n_cells=grid.n_cells,
        hidden_units=args.hidden_units,
        outputs=args.outputs,
        dueling=args.dueling,
        code_units=args.code_units,
        landmark_units=args.landmark_units,
    )
    return build_network(spec, generator)


# -- loss --------------------------------------------------------------------------------------


def td_targets(rewards: Tensor, terminated: Tensor, next_values: Tensor, discount: float) -> Tensor:
    """Return what the chosen values should be.

    With a value for each joint action that is the reward and the best value of the next state.
    With values for each agent's actions every agent gets the team reward, and goes on with the
    best of its own. After a termination nothing follows; after a truncation the episode would have
    gone on.

    Parameters
    ----------
    rewards, terminated
        (M,) the team reward; whether the episode ended because all landmarks were visited.
    next_values
        (M,) or (M, N) the value of the next states.
    discount
        Discount factor.
    """
    follows = discount * (~terminated).to(rewards.dtype)
    if next_values.dim() == 2:
        return rewards[:, None] + follows[:, None] * next_values
    return rewards + follows * next_values


def next_values(values: Tensor, chooser: Tensor, known: np.ndarray | None) -> Tensor:
    """Return the value of the best next action, (M,) or (M, N).

    Parameters
    ----------
    values
        (M, A ** N) or (M, N, A), the target network's.
    chooser
        The same of the network that picks the action: the target network's own, or (double
        DQN, van Hasselt et al. 2016) the trained one's.
    known
        (M, N, A) bool, the actions that may be picked; None for all.
    """
    if known is not None:
        allowed = torch.from_numpy(known)
        if values.dim() == 2:
            whole = allowed[:, 0]
            for agent in range(1, allowed.shape[1]):
                whole = (whole[:, :, None] & allowed[:, agent, None, :]).flatten(1)
            allowed = whole
        chooser = chooser.masked_fill(~allowed, -torch.inf)
    best = chooser.argmax(dim=-1, keepdim=True)
    return values.gather(-1, best).squeeze(-1)


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


class Goal(NamedTuple):
    """What imagined transitions are rewarded with, and how far the learner looks ahead."""

    reward: RelabelledReward
    discount: float


class MetaLearner:
    """The network, its target network, optimiser and replay."""

    def __init__(self, args: Args, grid: Grid, streams: Streams) -> None:
        self.args = args
        self.network = make_network(args, grid, torch_generator(streams.network))
        self.target = make_network(args, grid, torch.Generator())
        self.target.load_state_dict(self.network.state_dict())
        self.spec = self.network.spec
        self.weights = list(self.network.parameters())
        self.target_weights = list(self.target.parameters())
        # The fused step on a CPU is what needs torch 2.4.
        self.optimiser = torch.optim.Adam(self.weights, lr=args.learning_rate, fused=True)
        self.rng = np.random.default_rng(streams.replay)
        self.updates = 0
        self.prepared: tuple[Batch, Tensor] | None = None  # the next batch and its targets
        # Stored transitions are drawn when they are needed, and double DQN needs the network as it
        # is then; all else can be prepared ahead.
        self.ahead = args.replay == "imagined" and not args.double
        self.helper = ThreadPoolExecutor(1) if self.ahead and args.prefetch else None
        self.memory: ReplayMemory | None = None
        self.imagined: ImaginedReplay | None = None
        final = args.reward if args.final_reward == "same" else args.final_reward
        self.goals = (
            Goal(relabelled_reward(grid, args.reward, args.reward_scale), args.discount),
            Goal(relabelled_reward(grid, final, args.final_reward_scale), args.final_discount),
        )
        if args.replay == "stored":
            self.memory = ReplayMemory(args.memory_size, self.spec.observation_size, args.n_agents)
        else:
            self.imagined = ImaginedReplay(
                self.spec,
                grid.depot,
                args.batch_size,
                args.tried_actions,
                args.temperature,
                args.imagined_exploration,
                args.imagined_from_depot,
                args.imagined_length,
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

    def update(self, progress: float) -> float:
        """One step of Adam on the Huber loss of a batch; return the loss.

        Parameters
        ----------
        progress
            Part of the training that is over, 0 to 1.
        """
        args = self.args
        batch, targets = self.prepared or self.prepare(progress)
        if self.helper is not None:
            # Beside the step below: it reads the target network only, which does not change before
            # the step is done. So the weights are the same as without a helper.
            coming = self.helper.submit(self.prepare, progress)
            loss = self.fit(batch, targets, progress)
            self.prepared = coming.result()
        else:
            if self.ahead:
                self.prepared = self.prepare(progress)
            loss = self.fit(batch, targets, progress)
        self.updates += 1
        if args.target_interval:
            if self.updates % args.target_interval == 0:
                self.target.load_state_dict(self.network.state_dict())
        else:
            with torch.no_grad():
                torch._foreach_lerp_(self.target_weights, self.weights, args.target_rate)
        return loss

    def prepare(self, progress: float) -> tuple[Batch, Tensor]:
        """Return a batch and the targets of its values."""
        args = self.args
        late = args.final_reward != "same" and progress >= args.final_from
        goal = self.goals[late and args.replay == "imagined"]
        with torch.no_grad():
            if self.memory is not None:
                batch, known = self.memory.sample(args.batch_size, self.rng), None
                scale = args.reward_scale
            else:
                assert self.imagined is not None
                self.imagined.start_over(self.rng)
                seen = torch.from_numpy(self.imagined.observations())
                values = joint_values(self.target(seen), self.spec)
                batch = self.imagined.draw(values.numpy(), goal.reward, self.rng)
                scale = 1.0  # already in the reward
            following = batch.next_observations.reshape(-1, self.spec.observation_size)
            if self.imagined is not None:
                known = self.imagined.known_actions(following)
            seen = torch.from_numpy(following)
            values = self.target(seen)
            chooser = self.network(seen) if args.double else values
            targets = td_targets(
                scale * torch.from_numpy(batch.rewards.reshape(-1)),
                torch.from_numpy(batch.terminated.reshape(-1)),
                next_values(values, chooser, known),
                goal.discount,
            )
        return batch, targets.view(*batch.rewards.shape, *targets.shape[1:])

    def fit(self, batch: Batch, targets: Tensor, progress: float) -> float:
        """Step towards the targets; return the loss."""
        args = self.args
        rate = args.learning_rate * (1.0 - progress if args.learning_rate_falls else 1.0)
        if args.learning_rate_warmup:
            rate *= min(1.0, (self.updates + 1) / args.learning_rate_warmup)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        values = self.network(torch.from_numpy(batch.observations))
        chosen = chosen_values(values, torch.from_numpy(batch.actions), self.spec)
        loss = nn.functional.smooth_l1_loss(chosen, targets, beta=args.huber)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        return loss.item()

    # -- checkpoints

    @property
    def replay(self) -> ReplayMemory | ImaginedReplay:
        """What is learned from."""
        if self.memory is not None:
            return self.memory
        assert self.imagined is not None
        return self.imagined

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        parts: dict[str, dict[str, np.ndarray]] = {
            "network": {name: t.numpy() for name, t in self.network.state_dict().items()},
            "target": {name: t.numpy() for name, t in self.target.state_dict().items()},
            "optimiser": optimiser_arrays(self.optimiser),
            "replay": self.replay.arrays_by_name(),
        }
        if self.prepared is not None:
            batch, targets = self.prepared
            parts["prepared"] = {**batch._asdict(), "targets": targets.numpy()}
        return {
            f"{part}.{name}": array
            for part, arrays in parts.items()
            for name, array in arrays.items()
        }

    def state(self) -> dict[str, Any]:
        """Return all else that changes, ready for JSON."""
        return {"updates": self.updates, "rng": self.rng.bit_generator.state}

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what :meth:`arrays` and :meth:`state` returned."""

        def part(name: str) -> dict[str, np.ndarray]:
            start = name + "."
            return {k.removeprefix(start): v for k, v in arrays.items() if k.startswith(start)}

        for name, network in (("network", self.network), ("target", self.target)):
            network.load_state_dict({k: torch.from_numpy(v) for k, v in part(name).items()})
        restore_optimiser(self.optimiser, part("optimiser"))
        self.replay.restore(part("replay"))
        prepared = part("prepared")
        if prepared:
            targets = torch.from_numpy(prepared.pop("targets"))
            self.prepared = Batch(**prepared), targets
        self.updates = state["updates"]
        self.rng.bit_generator.state = state["rng"]


def relabelled_reward(grid: Grid, reward: str, scale: float) -> RelabelledReward:
    """Return what the rules give for any landmarks."""
    if reward == "step":
        return RelabelledReward(np.zeros((0, 0), np.float32), scale)
    if reward == "geodesic":
        return RelabelledReward(np.asarray(grid.distances, np.float32), scale)
    rows, cols = np.divmod(np.arange(grid.n_cells), grid.cols)
    steps = abs(rows[:, None] - rows) + abs(cols[:, None] - cols)
    return RelabelledReward(steps.astype(np.float32), scale)


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

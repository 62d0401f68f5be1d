"""Each agent has a network of its own: independent learners, trained by deep Q-learning.

Method: independent Q-learning (Tan 1993) with DQN (Mnih et al. 2015). Every learner has its own
network, target network, optimiser, memory and random numbers, tosses its own coin to explore, sees
the global observation and gets the team reward. It has values of its own four actions only and is
never told what the others did: they are a part of its environment, one that changes while they
learn. With ``--share-parameters`` one network learns from all agents' transitions and each agent
uses it by itself: it is given the agent's own cell first, and whose turn it is. Two presets, each
as close to the meta-agent's as an agent by itself can come:

- ``default``: a network that sees cells as categories and landmarks as a set, with agents in a
  fixed order, and replay of the agent's own transitions with fresh landmarks. What the meta-agent
  has besides, recombined moves of several agents and two joint actions compared in one state,
  takes commands over all agents and is left out;
- ``paper``: a network on the plain numbers, replay of what was played, and the decaying guidance
  that points agents to close landmarks while training.

Two options are for controlled comparisons: ``--network geodesic`` gives every agent its own
shortest paths to look at (the observation of that name) in place of the 13 numbers; ``--replay
imagined`` recombines moves as the meta-agent's replay does, but only the agent's own. What the
others do in imagined states is what the agent saw them do: they go through the cells that they went
through in the episodes played, whatever the landmarks are now (``own_imagined_replay.py``).

Fairness: the same episodes, and for every network as many updates, of as many states, as the
meta-agent's one network gets. In the default preset three learners take about twice the
meta-agent's time, and learners that share their parameters about four fifths of it.

Paper: M. Cetinkaya, Multi-Agent Path Planning Using Deep Reinforcement Learning, section 5
(arXiv 2110.01460), which leaves open how independent learners would do.

Command::

    python baselines/independent_dqn.py --seed 0
    python baselines/independent_dqn.py --network geodesic --replay imagined
    python baselines/independent_dqn.py --preset paper --share-parameters
    python baselines/independent_dqn.py --resume runs/independent_dqn-default-seed0-...

Output: a run folder as of meta_dqn.py; policy.safetensors holds the networks of all agents.
"""

import sys
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from baselines.learning.config import Options, parse_options
from baselines.learning.experiment import run_experiment
from baselines.learning.q_learning import Goal, QLearner, next_values, td_targets
from baselines.learning.training import Streams
from baselines.networks import (
    Network,
    Team,
    build_network,
    greedy_actions,
    spec_from_options,
    torch_generator,
    view,
)
from baselines.policies.policy import NetworkPolicy
from baselines.replay.own_imagined import OwnImaginedReplay
from baselines.replay.relabelled import RelabelledReplay
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import part
from mapp_env import Grid
from mapp_env.validation import check_flag, check_number

ALGORITHM = "independent_dqn"


# -- configuration -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Args(Options):
    """Options of independent learners; those of joint values have no effect."""

    OUTPUTS: ClassVar[tuple[str, ...]] = ("agents",)
    REPLAYS: ClassVar[tuple[str, ...]] = ("relabelled", "imagined", "stored")
    NETWORKS: ClassVar[tuple[str, ...]] = ("pairs", "paper", "geodesic")

    network: Literal["pairs", "paper", "geodesic"] = "pairs"
    """"paper": two layers of hidden units on the plain numbers; "pairs": cells as categories,
    landmarks as a set, agents in a fixed order; "geodesic": the agent's own shortest paths, the
    observation of that name, landmarks as a set (baselines/networks/__init__.py)"""
    outputs: Literal["agents"] = "agents"
    """a value for each action of the agent itself"""
    replay: Literal["relabelled", "imagined", "stored"] = "relabelled"
    """"stored": transitions as they were played; "relabelled": the agent's own transitions, most of
    them with fresh landmarks (baselines/replay/relabelled.py); "imagined": the agent's own moves
    put together anew, the others as they were seen to go (baselines/replay/own_imagined.py)"""

    share_parameters: bool = False
    """whether all agents use one network, which learns from all of them"""
    fresh_landmarks: float = 0.9
    """share of the relabelled transitions that get fresh landmarks; the others keep their own"""
    fresh_as_far: float = 0.9
    """share of those with as many landmarks visited as were; the others with any number"""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_flag("share_parameters", self.share_parameters)
        if self.share_parameters and self.replay == "imagined":
            raise ValueError("share_parameters must be False with replay 'imagined', got True")
        check_number("fresh_landmarks", self.fresh_landmarks, 0.0, 1.0)
        check_number("fresh_as_far", self.fresh_as_far, 0.0, 1.0)


# -- network -----------------------------------------------------------------------------------


def make_network(args: Args, grid: Grid, generator: torch.Generator) -> Team:
    """Build the networks of all agents."""
    kind = "shared" if args.share_parameters else "independent"
    team = build_network(spec_from_options(args, args.network, grid, team=kind), generator)
    assert isinstance(team, Team)
    return team


# -- loss --------------------------------------------------------------------------------------


def chosen_values(values: Tensor, actions: Tensor) -> Tensor:
    """Return the values (B, T) of the agent's own actions taken.

    Parameters
    ----------
    values
        (B, 1, A).
    actions
        (B, T, 1).
    """
    return values[:, 0].gather(1, actions[:, :, 0])


# -- learner -----------------------------------------------------------------------------------


class AgentLearner(QLearner):
    """One network, its target network, optimiser and replay.

    Parameters
    ----------
    args
        Options.
    grid
        The grid.
    network, target
        One agent's networks.
    agent
        Which agent it is, if it is one agent's.
    n_sources
        Agents whose transitions it learns from: itself, or all that share the network.
    seeds
        Of its own random numbers.
    """

    def __init__(
        self,
        args: Args,
        grid: Grid,
        network: Network,
        target: Network,
        agent: int,
        n_sources: int,
        seeds: np.random.SeedSequence,
    ) -> None:
        super().__init__(args, grid, network, target, np.random.default_rng(seeds))
        self.memory: ReplayMemory | None = None
        self.relabelled: RelabelledReplay | None = None
        self.imagined: OwnImaginedReplay | None = None
        # Of each agent, as many transitions as are kept of it when it learns alone.
        capacity = n_sources * args.memory_size
        if args.replay == "stored":
            self.memory = ReplayMemory(capacity, self.spec.n_inputs, 1)
        elif args.replay == "imagined":
            self.imagined = OwnImaginedReplay(
                self.spec,
                agent,
                grid.depot,
                capacity,
                args.fresh_landmarks,
                args.batch_size,
                args.tried_actions,
                args.temperature,
                args.imagined_exploration,
                args.imagined_from_depot,
                args.imagined_length,
                args.imagined_retries,
            )
        else:
            self.relabelled = RelabelledReplay(
                self.spec, grid.depot, capacity, args.fresh_landmarks, args.fresh_as_far
            )

    # -- learning

    def remember(
        self,
        observation: np.ndarray,
        action: int,
        reward: float,
        next_observation: np.ndarray,
        terminated: bool,
    ) -> None:
        """Take note of an agent's transition: its own action, nobody else's."""
        if self.memory is not None:
            self.memory.add(observation, np.array([action]), reward, next_observation, terminated)
        if self.relabelled is not None:
            self.relabelled.remember(observation, action, next_observation)
        if self.imagined is not None:
            self.imagined.remember(observation, np.array([action]), next_observation)

    @property
    def ready(self) -> bool:
        """Whether there is something to learn from."""
        replay = self.replay
        return True if isinstance(replay, ReplayMemory) else replay.ready

    @property
    def replay(self) -> ReplayMemory | RelabelledReplay | OwnImaginedReplay:
        """What is learned from."""
        if self.memory is not None:
            return self.memory
        if self.imagined is not None:
            return self.imagined
        assert self.relabelled is not None
        return self.relabelled

    def prepare(self, progress: float) -> tuple[Batch, Tensor]:
        """Return a batch and the targets of its values."""
        if self.imagined is not None:
            return self.prepare_imagined(self.imagined, self.goal(progress))
        args = self.args
        with torch.no_grad():
            if self.memory is not None:
                batch = self.memory.sample(args.batch_size, self.rng)
                scale, discount = args.reward_scale, args.discount
            else:
                assert self.relabelled is not None
                goal = self.goal(progress)
                batch = self.relabelled.draw(args.batch_size, goal.reward, self.rng)
                scale, discount = 1.0, goal.discount  # already in the reward
            seen = torch.from_numpy(batch.next_observations[:, 0])
            values = self.target(seen)[:, 0]
            chooser = self.network(seen)[:, 0] if args.double else values
            following = next_values(values, chooser, None)
            if self.relabelled is not None:
                # No reward of the rules is above 0, so no value is. Without this bound the values
                # of a learner can feed on themselves and grow past all measure: where it has not
                # been with the others, nothing it experienced contradicts them.
                following = following.clamp(max=0.0)
            targets = td_targets(
                scale * torch.from_numpy(batch.rewards[:, 0]),
                torch.from_numpy(batch.terminated[:, 0]),
                following,
                discount,
            ).view(*batch.rewards.shape)
            if args.action_gap and self.relabelled is not None:
                here = self.target(torch.from_numpy(batch.observations))
                taken = chosen_values(here, torch.from_numpy(batch.actions))
                targets -= args.action_gap * (here[:, 0].amax(1, keepdim=True) - taken)
        return batch, targets

    def prepare_imagined(self, imagined: OwnImaginedReplay, goal: Goal) -> tuple[Batch, Tensor]:
        """Return imagined transitions, and the targets of their values."""
        with torch.no_grad():
            imagined.start_over(self.rng)
            here = self.target(torch.from_numpy(imagined.observations()))
            batch = imagined.draw(here[:, 0].numpy(), goal.reward, self.rng)
            flat = batch.next_observations.reshape(-1, self.spec.n_inputs)
            seen = torch.from_numpy(flat)
            values = self.target(seen)
            chooser = self.network(seen) if self.args.double else values
            following = next_values(values, chooser, imagined.known_actions(flat))[:, 0]
            targets = td_targets(
                torch.from_numpy(batch.rewards.reshape(-1)),
                torch.from_numpy(batch.terminated.reshape(-1)),
                following.clamp(max=0.0),  # as above
                goal.discount,
            ).view(*batch.rewards.shape)
            if self.args.action_gap:
                best = next_values(here, here, imagined.known_actions(batch.observations))
                taken = chosen_values(here, torch.from_numpy(batch.actions))
                targets -= self.args.action_gap * (best - taken)
        return batch, targets

    def chosen(self, values: Tensor, actions: Tensor) -> Tensor:
        """Return the values of the agent's own actions taken."""
        return chosen_values(values, actions)


class IndependentLearners:
    """The learners of all agents, side by side; or one, if they share their parameters."""

    def __init__(self, args: Args, grid: Grid, streams: Streams) -> None:
        self.network = make_network(args, grid, torch_generator(streams.network))
        self.spec = self.network.spec
        targets = make_network(args, grid, torch.Generator()).members
        n_learners = len(self.network.members)
        self.learners = [
            AgentLearner(args, grid, network, target, agent, args.n_agents // n_learners, seeds)
            for agent, (network, target, seeds) in enumerate(
                zip(self.network.members, targets, streams.replay.spawn(n_learners), strict=True)
            )
        ]

    # -- acting

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return each agent's own greedy action (N,)."""
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
        """Hand every agent's learner what that agent saw, did and got."""
        for agent, action in enumerate(actions.tolist()):
            self.learners[agent % len(self.learners)].remember(
                view(observation, agent, self.spec),
                action,
                reward,
                view(next_observation, agent, self.spec),
                terminated,
            )

    @property
    def ready(self) -> bool:
        """Whether there is something to learn from."""
        return all(learner.ready for learner in self.learners)

    def update(self, progress: float) -> float:
        """One update of every learner; return their mean loss."""
        return sum(learner.update(progress) for learner in self.learners) / len(self.learners)

    @property
    def updates(self) -> int:
        """Updates of each learner."""
        return self.learners[0].updates

    # -- checkpoints

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        return {
            f"{index}.{name}": array
            for index, learner in enumerate(self.learners)
            for name, array in learner.arrays().items()
        }

    def state(self) -> dict[str, Any]:
        """Return all else that changes, ready for JSON."""
        return {"learners": [learner.state() for learner in self.learners]}

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Take over what :meth:`arrays` and :meth:`state` returned."""
        states = state["learners"]
        for index, (learner, own) in enumerate(zip(self.learners, states, strict=True)):
            learner.restore(part(arrays, str(index)), own)


def main(args: Args) -> int:
    """Train, evaluate, draw; return the exit code."""
    return run_experiment(args, ALGORITHM, IndependentLearners)


if __name__ == "__main__":
    try:
        sys.exit(main(parse_options(Args, __doc__ or "")))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from error

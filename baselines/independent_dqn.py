"""Independent learners: one network per agent, trained by deep Q-learning.

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
through in the episodes played, whatever the landmarks are now (``replay/own_imagined.py``).

Fairness: the same episodes, and for every network as many updates, of as many states, as the
meta-agent's one network gets. In the default preset three learners take about twice the
meta-agent's time, and learners that share their parameters about four fifths of it.

Paper: M. Cetinkaya, Multi-Agent Path Planning Using Deep Reinforcement Learning, section 5
(arXiv 2110.01460), which leaves open how independent learners would do.

The algorithm stands in :class:`AgentLearner`, step by step as the meta-agent's in ``meta_dqn.py``.
What differs is what an agent is told, ``remember`` of :class:`IndependentLearners`, and what it
can learn from that: the replay in ``sample``, where values are bounded by 0, as nothing else bounds
them, and those of imagined states are computed anew for each batch.

Command::

    python baselines/independent_dqn.py --seed 0
    python baselines/independent_dqn.py --network geodesic --replay imagined
    python baselines/independent_dqn.py --preset paper --share-parameters
    python baselines/independent_dqn.py --resume runs/independent_dqn-default-seed0-...

Output: a run folder as of meta_dqn.py; policy.safetensors holds the networks of all agents.
"""

from dataclasses import dataclass
from typing import Any, Literal

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
    learning_rate,
    move_target,
    next_values,
    td_targets,
)
from baselines.learning.ranges import Share
from baselines.learning.training import Streams, train_learner
from baselines.networks import (
    NETWORKS,
    NetworkSpec,
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
from baselines.runs.checkpoints import joined, part
from mapp_env import Grid

ALGORITHM = "independent_dqn"


@dataclass(frozen=True)
class Args(Options):
    """Options of independent learners; those of joint values have no effect."""

    network: Literal[tuple(NETWORKS)] = "pairs"  # type: ignore[valid-type]
    """"paper": two layers of hidden units on the plain numbers; "pairs": cells as categories,
    landmarks as a set, agents in a fixed order; "geodesic": the agent's own shortest paths, the
    observation of that name, landmarks as a set (baselines/networks/geodesic.py)"""
    outputs: Literal["agents"] = "agents"
    """a value for each action of the agent itself"""
    replay: Literal["relabelled", "imagined", "stored"] = "relabelled"
    """"stored": transitions as they were played; "relabelled": the agent's own transitions, most of
    them with fresh landmarks (baselines/replay/relabelled.py); "imagined": the agent's own moves
    put together anew, the others as they were seen to go (baselines/replay/own_imagined.py)"""

    share_parameters: bool = False
    """whether all agents use one network, which learns from all of them"""
    fresh_landmarks: Share = 0.9
    """share of the relabelled transitions that get fresh landmarks; the others keep their own"""
    fresh_as_far: Share = 0.9
    """share of those with as many landmarks visited as were; the others with any number"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.share_parameters and self.replay == "imagined":
            raise ValueError("share_parameters must be False with replay 'imagined', got True")


def make_replay(
    args: Args, grid: Grid, spec: NetworkSpec, agent: int, n_sources: int
) -> ReplayMemory | OwnImaginedReplay:
    """Build the memory of what an agent did, or of what several did that share a network."""
    # Of each agent, as many transitions as are kept of it when it learns alone.
    capacity = n_sources * args.memory_size
    if args.replay == "stored":
        return ReplayMemory(capacity, spec.n_inputs, 1, args.reward_scale)
    fresh = args.fresh_landmarks
    if args.replay == "relabelled":
        return RelabelledReplay(spec, grid.depot, capacity, fresh, args.fresh_as_far)
    options = imagination(args)
    return OwnImaginedReplay(spec, grid, agent, capacity=capacity, fresh=fresh, **options)


class AgentLearner(QLearner):
    """One agent's network, or one that all share, and what it learns with."""

    @torch.no_grad()
    def sample(self, progress: float) -> tuple[Batch, Tensor]:
        """Draw a batch, and compute the targets of its values."""
        args, goal, replay = self.args, self.goal(progress), self.replay
        # The states: imagined along the policy, relabelled, or stored.
        here = None
        if isinstance(replay, OwnImaginedReplay):
            replay.start_over(self.rng)
            here = self.target(torch.from_numpy(replay.observations()))
            batch, _ = replay.draw(here[:, 0].cpu().numpy(), goal.reward, self.rng)
        elif isinstance(replay, RelabelledReplay):
            batch = replay.relabel(args.batch_size, goal.reward, self.rng)
            here = self.target(torch.from_numpy(batch.observations))
        else:
            batch = replay.sample(args.batch_size, self.rng)

        # The targets: the reward, and the best that can follow.
        next_obs = torch.from_numpy(batch.next_observations)
        values = action_values(self.target, next_obs)
        chooser = action_values(self.network, next_obs) if args.double else values
        best = next_values(values, chooser, replay.known_actions(batch.next_observations))
        if here is not None:
            # No reward of the rules is above 0, so no value is. Without this bound the values of
            # a learner can feed on themselves and grow past all measure: where it has not been
            # with the others, nothing it experienced contradicts them.
            best = best.clamp(max=0.0)
        rewards, terminated = map(torch.from_numpy, (batch.rewards, batch.terminated))
        targets = td_targets(rewards, terminated, best, goal.discount)

        if args.action_gap and here is not None:
            best = next_values(here, here, replay.known_actions(batch.observations))[:, None]
            taken = chosen_values(here, torch.from_numpy(batch.actions), self.spec)
            targets -= args.action_gap * (best - taken)
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


class IndependentLearners:
    """The learners of all agents, side by side; or one, if they share their parameters."""

    def __init__(self, args: Args, grid: Grid, streams: Streams) -> None:
        team = "shared" if args.share_parameters else "independent"
        spec = spec_from_options(args, args.network, grid, team=team)
        self.network = build_network(spec, torch_generator(streams.network))
        self.spec = spec
        members, targets = self.network.members, build_network(spec).members
        seeds = streams.replay.spawn(len(members))
        self.learners = []
        for agent, (network, target) in enumerate(zip(members, targets, strict=True)):
            replay = make_replay(args, grid, spec, agent, args.n_agents // len(members))
            rng = np.random.default_rng(seeds[agent])
            self.learners.append(AgentLearner(args, grid, network, target, replay, rng))

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return each agent's own greedy action (N,)."""
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
        """Store for every agent what that agent saw, did and got; never what the others did."""
        for agent in range(self.spec.n_agents):
            obs, next_obs = (view(o, agent, self.spec) for o in (observation, next_observation))
            replay = self.learners[agent % len(self.learners)].replay
            replay.add(obs, actions[[agent]], reward, next_obs, terminated)

    @property
    def ready(self) -> bool:
        """Whether enough has been stored to learn."""
        return all(learner.replay.ready for learner in self.learners)

    def update(self, progress: float) -> float:
        """One update of every learner; return their mean loss."""
        return sum(learner.update(progress) for learner in self.learners) / len(self.learners)

    @property
    def updates(self) -> int:
        """Updates of each learner."""
        return self.learners[0].updates

    def policy(self) -> NetworkPolicy:
        """Return the trained policy."""
        return NetworkPolicy(self.network)

    # -- checkpoints

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        return joined({str(i): learner.arrays() for i, learner in enumerate(self.learners)})

    def state(self) -> dict[str, Any]:
        """Return all other state, as JSON-ready values."""
        return {"learners": [learner.state() for learner in self.learners]}

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Restore what :meth:`arrays` and :meth:`state` returned."""
        states = state["learners"]
        for index, (learner, own) in enumerate(zip(self.learners, states, strict=True)):
            learner.restore(part(arrays, str(index)), own)


def main(args: Args) -> int:
    """Train, evaluate, draw; return the exit code."""
    return train_learner(args, ALGORITHM, IndependentLearners)


if __name__ == "__main__":
    run_script(main, Args, __doc__)

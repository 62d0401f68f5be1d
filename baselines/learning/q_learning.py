"""What all deep Q-learners share: targets, values, step sizes and the target network.

Plain functions, and a class that holds what a learner changes, for its checkpoints. How a learner
acts, stores, samples and learns stands in its script: ``meta_dqn.py``, ``independent_dqn.py``.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from baselines.learning.config import Options
from baselines.learning.optimiser import optimiser_arrays, restore_optimiser
from baselines.networks import Network, NetworkSpec
from baselines.replay.imagined import ImaginedReplay
from baselines.replay.relabelled import RelabelledReward, relabelled_reward
from baselines.replay.stored import Batch, ReplayMemory
from baselines.runs.checkpoints import joined, part
from mapp_env import Grid
from mapp_env.grid import MAX_ALL_PAIRS_CELLS

# -- what is learned, and with what -----------------------------------------------------------


class Goal(NamedTuple):
    """What relabelled transitions are rewarded with, and how far the learner looks ahead."""

    reward: RelabelledReward
    discount: float


def make_goals(args: Options, grid: Grid) -> tuple[Goal, Goal]:
    """Return the reward and discount of the initial and of the final phase.

    Raises a ValueError if transitions are relabelled, and the grid has too many cells for a table
    of distances between all of them.
    """
    sizes = grid, args.n_agents, args.n_landmarks
    if args.replay == "stored":  # with its rewards: none is ever asked for
        return (Goal(relabelled_reward(*sizes, "step"), args.discount),) * 2
    if grid.n_cells > MAX_ALL_PAIRS_CELLS:
        raise ValueError(
            f"grid must have at most {MAX_ALL_PAIRS_CELLS:,} cells for replay {args.replay!r}, got "
            f"{grid.n_cells:,}"
        )
    final = args.reward if args.final_reward == "same" else args.final_reward
    return (
        Goal(relabelled_reward(*sizes, args.reward, args.reward_scale), args.discount),
        Goal(relabelled_reward(*sizes, final, args.final_reward_scale), args.final_discount),
    )


def imagination(args: Options) -> dict[str, Any]:
    """Return the options of imagined replay by the names that it gives them."""
    return {
        "n_rows": args.batch_size,
        "n_tried": args.tried_actions,
        "temperature": args.temperature,
        "exploration": args.imagined_exploration,
        "from_depot": args.imagined_from_depot,
        "max_length": args.imagined_length,
        "retries": args.imagined_retries,
    }


# -- values of actions -------------------------------------------------------------------------


def action_values(network: Network, observations: Tensor) -> Tensor:
    """Return a network's values (B, T, ...) of observations (B, T, D)."""
    values: Tensor = network(observations.flatten(0, 1))
    return values.unflatten(0, observations.shape[:2])


def chosen_values(values: Tensor, actions: Tensor, spec: NetworkSpec) -> Tensor:
    """Return the values of the actions taken (B, T, N), one per agent.

    Of joint values (B, A ** N) they are (B, T), of agents' values (B, N, A) they are (B, T, N).
    """
    if spec.outputs == "joint":
        weights = spec.n_actions ** torch.arange(spec.n_agents - 1, -1, -1)
        return values.gather(1, (actions * weights).sum(-1))
    return values.gather(2, actions.transpose(1, 2)).transpose(1, 2)


def joint_values(values: Tensor, spec: NetworkSpec) -> Tensor:
    """Return a value for each joint action, (B, A ** N): agents' values are summed."""
    return values if spec.outputs == "joint" else over_joint_actions(values, torch.add)


def over_joint_actions(parts: Tensor, combine: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Combine what is said of each agent's actions, (..., N, A), for joint ones: (..., A ** N)."""
    whole = parts[..., 0, :]
    for agent in range(1, parts.shape[-2]):
        whole = combine(whole[..., :, None], parts[..., agent, None, :]).flatten(-2)
    return whole


def next_values(values: Tensor, chooser: Tensor, known: np.ndarray | None) -> Tensor:
    """Return the target network's value of the best action: (...), or (..., N) of each agent's.

    `values` are its (..., A ** N) or (..., N, A); `chooser` are those of the network that picks the
    action: its own, or (double DQN, van Hasselt et al. 2016) the trained one's. `known` (..., N, A)
    are the actions that may be picked; None for all.
    """
    if known is not None:
        allowed = torch.from_numpy(known)
        if values.dim() < allowed.dim():
            allowed = over_joint_actions(allowed, torch.logical_and)
        chooser = chooser.masked_fill(~allowed, -torch.inf)
    best = chooser.argmax(dim=-1, keepdim=True)
    return values.gather(-1, best).squeeze(-1)


# -- targets and steps -------------------------------------------------------------------------


def td_targets(rewards: Tensor, terminated: Tensor, next_values: Tensor, discount: float) -> Tensor:
    """Return the TD targets of the chosen values.

    With a value for each joint action, `next_values` (...), that is the team reward (...) and the
    best value of the next state. With values for each agent's actions, (..., N), every agent gets
    the team reward, and goes on with the best of its own. After a termination (all landmarks
    visited) nothing follows; after a truncation the episode would have gone on.
    """
    follows = discount * (~terminated).to(rewards.dtype)
    if next_values.dim() > rewards.dim():
        rewards, follows = rewards[..., None], follows[..., None]
    return rewards + follows * next_values


def learning_rate(args: Options, progress: float, updates: int) -> float:
    """Return the step size after a number of updates, at a part of the training (0 to 1)."""
    rate = args.learning_rate * (1.0 - progress if args.learning_rate_falls else 1.0)
    if args.learning_rate_warmup:
        rate *= min(1.0, (updates + 1) / args.learning_rate_warmup)
    return rate


def move_target(target: Network, network: Network, args: Options, updates: int) -> None:
    """Let the target network follow: a copy every so many updates, or a small step at each."""
    if args.target_interval:
        if updates % args.target_interval == 0:
            target.load_state_dict(network.state_dict())
    else:
        with torch.no_grad():
            torch._foreach_lerp_([*target.parameters()], [*network.parameters()], args.target_rate)


# -- what a learner holds ----------------------------------------------------------------------


class QLearner:
    """A network, its target network, optimiser and random numbers; and their checkpoints.

    The target, a network of the same kind, starts as a copy; all batches are drawn with `rng`.
    """

    def __init__(
        self,
        args: Options,
        grid: Grid,
        network: Network,
        target: Network,
        replay: ReplayMemory | ImaginedReplay,
        rng: np.random.Generator,
    ) -> None:
        self.args, self.network, self.target = args, network, target
        self.replay, self.rng = replay, rng
        self.target.load_state_dict(self.network.state_dict())
        self.spec = self.network.spec
        # The fused step on a CPU is what needs torch 2.4.
        self.optimiser = torch.optim.AdamW(
            network.parameters(), lr=args.learning_rate, weight_decay=args.weight_decay, fused=True
        )
        self.goals = make_goals(args, grid)
        self.updates = 0
        self.prepared: tuple[Batch, Tensor] | None = None  # the next batch and its targets
        self.helper = ThreadPoolExecutor(1) if self.ahead and args.prefetch else None

    def goal(self, progress: float) -> Goal:
        """Return what is aimed at when a part of the training (0 to 1) is over."""
        args = self.args
        return self.goals[args.final_reward != "same" and progress >= args.final_from]

    @property
    def ahead(self) -> bool:
        """Whether a batch is drawn one update before it is learned from.

        Not if it is drawn from stored transitions, nor with double DQN, which asks the network as
        it is when it learns.
        """
        return self.args.replay != "stored" and not self.args.double

    def draw_ahead(self, progress: float) -> Callable[[], tuple[Batch, Tensor] | None]:
        """Begin to draw the next batch, if it is drawn ahead; return what waits for it.

        Drawing reads the target network and the replay, and a step of the optimiser neither: with
        or without a second thread the weights are the same.
        """
        if not self.ahead:
            return lambda: None
        if self.helper is not None:
            return self.helper.submit(self.sample, progress).result
        drawn = self.sample(progress)
        return lambda: drawn

    def sample(self, progress: float) -> tuple[Batch, Tensor]:
        """Draw a batch, and compute the targets of its values."""
        raise NotImplementedError

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        parts: dict[str, dict[str, np.ndarray]] = {
            "network": {k: t.cpu().numpy() for k, t in self.network.state_dict().items()},
            "target": {k: t.cpu().numpy() for k, t in self.target.state_dict().items()},
            "optimiser": optimiser_arrays(self.optimiser),
            "replay": self.replay.arrays_by_name(),
        }
        if self.prepared is not None:
            batch, targets = self.prepared
            parts["prepared"] = {**batch._asdict(), "targets": targets.cpu().numpy()}
        return joined(parts)

    def state(self) -> dict[str, Any]:
        """Return all other state, as JSON-ready values."""
        return {"updates": self.updates, "rng": self.rng.bit_generator.state}

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Restore what :meth:`arrays` and :meth:`state` returned."""
        for name, network in (("network", self.network), ("target", self.target)):
            weights = part(arrays, name)
            network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
        self.updates = state["updates"]
        restore_optimiser(self.optimiser, part(arrays, "optimiser"), self.updates)
        self.replay.restore(part(arrays, "replay"))
        prepared = part(arrays, "prepared")
        if self.ahead and self.updates:
            targets = torch.from_numpy(prepared.pop("targets"))
            self.prepared = Batch(**prepared), targets
        self.rng.bit_generator.state = state["rng"]

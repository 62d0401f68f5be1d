"""Deep Q-learning of one network: targets, loss, target network, checkpoints.

What a learner with one network has, be it the meta-agent's or one agent's: the two differ in what
they see of a transition and in which values their network gives, so in ``prepare`` and ``chosen``.
"""

from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from baselines.learning.config import Options
from baselines.learning.optimiser import optimiser_arrays, restore_optimiser
from baselines.networks import Network
from baselines.replay.imagined import RelabelledReward, relabelled_reward
from baselines.replay.stored import Batch
from baselines.runs.checkpoints import part
from mapp_env import Grid
from mapp_env.grid import MAX_ALL_PAIRS_CELLS


class Goal(NamedTuple):
    """What imagined transitions are rewarded with, and how far the learner looks ahead."""

    reward: RelabelledReward
    discount: float


def make_goals(args: Options, grid: Grid) -> tuple[Goal, ...]:
    """Return what is aimed at to begin with, and later.

    Raises
    ------
    ValueError
        If the grid has too many cells for a table of distances between all of them.
    """
    if grid.n_cells > MAX_ALL_PAIRS_CELLS:
        raise ValueError(
            f"grid must have at most {MAX_ALL_PAIRS_CELLS:,} cells for replay {args.replay!r}, got "
            f"{grid.n_cells:,}"
        )
    final = args.reward if args.final_reward == "same" else args.final_reward
    return (
        Goal(relabelled_reward(grid, args.reward, args.reward_scale), args.discount),
        Goal(relabelled_reward(grid, final, args.final_reward_scale), args.final_discount),
    )


class Replay(Protocol):
    """What is learned from."""

    def arrays_by_name(self) -> dict[str, np.ndarray]:
        """Return all that changes, for a checkpoint."""
        ...

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`arrays_by_name` returned."""
        ...


class QLearner(ABC):
    """A network, its target network and its optimiser.

    Parameters
    ----------
    args
        Options.
    grid
        The grid.
    network, target
        Two networks of one kind; the target starts as the network's copy.
    rng
        Source of all batches.
    """

    def __init__(
        self,
        args: Options,
        grid: Grid,
        network: Network,
        target: Network,
        rng: np.random.Generator,
    ) -> None:
        self.args = args
        self.network, self.target = network, target
        self.target.load_state_dict(self.network.state_dict())
        self.spec = self.network.spec
        self.weights = list(self.network.parameters())
        self.target_weights = list(self.target.parameters())
        # The fused step on a CPU is what needs torch 2.4.
        self.optimiser = torch.optim.AdamW(
            self.weights, lr=args.learning_rate, weight_decay=args.weight_decay, fused=True
        )
        self.rng = rng
        self.updates = 0
        self.prepared: tuple[Batch, Tensor] | None = None  # the next batch and its targets
        # Stored transitions are drawn when they are needed, and double DQN needs the network as it
        # is then; all else can be prepared ahead.
        self.ahead = args.replay != "stored" and not args.double
        self.helper = ThreadPoolExecutor(1) if self.ahead and args.prefetch else None
        self.goals = make_goals(args, grid) if args.replay != "stored" else ()

    @property
    @abstractmethod
    def replay(self) -> Replay:
        """What is learned from."""

    @abstractmethod
    def prepare(self, progress: float) -> tuple[Batch, Tensor]:
        """Return a batch and the targets of its values."""

    @abstractmethod
    def chosen(self, values: Tensor, actions: Tensor) -> Tensor:
        """Return the values of the actions taken, in the shape of their targets."""

    def goal(self, progress: float) -> Goal:
        """Return what relabelled transitions are rewarded with by now."""
        args = self.args
        return self.goals[args.final_reward != "same" and progress >= args.final_from]

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

    def fit(self, batch: Batch, targets: Tensor, progress: float) -> float:
        """Step towards the targets; return the loss."""
        args = self.args
        rate = args.learning_rate * (1.0 - progress if args.learning_rate_falls else 1.0)
        if args.learning_rate_warmup:
            rate *= min(1.0, (self.updates + 1) / args.learning_rate_warmup)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        values = self.network(torch.from_numpy(batch.observations))
        chosen = self.chosen(values, torch.from_numpy(batch.actions))
        loss = nn.functional.smooth_l1_loss(chosen, targets, beta=args.huber)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        return loss.item()

    # -- checkpoints

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

"""Imitation: a network learns, state by state, which joint actions to take.

What distillation (``distill.py``: the exact solver says it) and self-improvement
(``self_improve.py``: the best of several own episodes says it) have in common. The network is
trained as a classifier: its outputs are read as logits, and the greedy policy takes the largest, as
it does of values.
"""

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from baselines.learning.config import RunOptions
from baselines.learning.optimiser import optimiser_arrays, restore_optimiser
from baselines.learning.ranges import Share, Within
from baselines.learning.train import Trainable
from baselines.networks import Network
from baselines.policies.evaluation import Evaluation
from baselines.runs.checkpoints import joined, part
from baselines.runs.folder import WEIGHTS_FILE

METRICS = ("updates", "loss")
LOGGED = 100  # updates in a row of metrics.csv
WARMUP = 200  # updates over which the step size rises to its value


@dataclass(frozen=True)
class ImitationOptions(RunOptions):
    """Options of an imitation."""

    updates: Annotated[int, Within(1, 1_000_000_000)] = 60_000
    """steps of Adam"""
    learning_rate: Annotated[float, Within(1e-12, 1.0)] = 0.003
    """step size of Adam; it falls in a straight line to 0"""
    weight_decay: Share = 0.05
    """share of every weight, times the step size, that each update takes off it"""
    half_precision: bool = True
    """keep the finished policy's weights in 16 bits"""


class Imitation(Trainable):
    """A network, its optimiser, and the states and joint actions that it learns from."""

    UNIT, COLUMNS, SHOWN = "updates", METRICS, ("loss",)
    args: ImitationOptions

    def __init__(self, args: ImitationOptions, network: Network, rng: np.random.Generator) -> None:
        super().__init__(args, args.updates, args.updates)
        self.spec, self.rng = network.spec, rng
        self._network = network
        # Without decay the weights grow as the gradients vanish, and steps of Adam become noise.
        self.optimiser = torch.optim.AdamW(
            network.parameters(), weight_decay=args.weight_decay, fused=True
        )
        self.updates = 0
        self.losses: list[float] = []  # since the last row of metrics.csv

    @abstractmethod
    def batch_loss(self) -> Tensor:
        """Return the loss of the next batch."""

    @abstractmethod
    def own_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the arrays that :meth:`batch_loss` changes, by part and name."""

    @abstractmethod
    def restore_own(self, arrays: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`own_arrays` returned."""

    @property
    def network(self) -> Network:
        """What is trained."""
        return self._network

    def counts(self) -> dict[str, int]:
        """Return what was done so far."""
        return {"updates": self.updates}

    def advance(self) -> dict[str, object] | None:
        """Learn from one batch; return a row of every so many."""
        loss = self.batch_loss()
        rate = self.args.learning_rate * (1 - self.updates / self.args.updates)
        for group in self.optimiser.param_groups:
            group["lr"] = rate * min(1.0, (self.updates + 1) / WARMUP)
        self.optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimiser.step()
        self.updates += 1
        self.losses.append(loss.item())
        self.watch.lap("update")
        if self.updates % LOGGED:
            return None
        row: dict[str, object] = {"updates": self.updates, "loss": sum(self.losses) / LOGGED}
        self.losses.clear()
        return row

    def draw(self, folder: Path, evaluations: dict[str, Evaluation]) -> None:
        """Draw nothing: the paper's figures are of episodes."""

    # -- checkpoints

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that change, by name."""
        weights = {name: t.numpy() for name, t in self.network.state_dict().items()}
        optimiser = optimiser_arrays(self.optimiser)
        return joined({"network": weights, "optimiser": optimiser, **self.own_arrays()})

    def state(self) -> dict[str, Any]:
        """Return all other state, as JSON-ready values."""
        return {
            "updates": self.updates,
            "rng": self.rng.bit_generator.state,
            "losses": self.losses,
            "seconds": self.watch.seconds,
        }

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Restore a checkpoint."""
        weights = part(arrays, "network")
        self.network.load_state_dict({k: torch.from_numpy(v) for k, v in weights.items()})
        self.updates, self.losses = state["updates"], list(state["losses"])
        restore_optimiser(self.optimiser, part(arrays, "optimiser"), self.updates)
        self.restore_own(arrays)
        self.rng.bit_generator.state = state["rng"]
        self.watch.seconds = dict(state["seconds"])

    def check_metrics(self, table: dict[str, list[float]]) -> None:
        """Check the progress against the rows of metrics.csv."""
        rows, left = divmod(self.updates, LOGGED)
        if (len(table["updates"]), len(self.losses)) != (rows, left):
            raise ValueError(
                f"after {self.updates} updates there must be {rows} rows in metrics.csv and {left} "
                f"losses, got {len(table['updates'])} and {len(self.losses)}"
            )


def good_actions_loss(scores: Tensor, good: Tensor) -> Tensor:
    """Return minus the log-probability of taking a good joint action, its mean over states.

    `scores` (B, A ** N) are read as logits; in each state at least one action is `good`.
    """
    of_good = scores.masked_fill(~good, -torch.inf).logsumexp(1)
    return (scores.logsumexp(1) - of_good).mean()


def start_of(resume: Path | None, policy: str | Path | None) -> str | Path | None:
    """Return the path of the policy to start from.

    Of a resumed run it is in its own folder, if the run was not killed before it was there.
    """
    own = resume is not None and (resume / WEIGHTS_FILE).is_file()
    return resume if own else policy

"""Networks of agents that act for themselves, and what each of them is given."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from baselines.networks.base import Network, NetworkSpec

Array = TypeVar("Array", np.ndarray, Tensor)


class Team(Network):
    """Networks of independent agents: one per agent, or one shared by all.

    An agent's network gives values of this agent's own actions. With one for each, all see the
    observation as it is, but for "geodesic". A shared one is told whose turn it is (:func:`view`).
    """

    def __init__(
        self,
        spec: NetworkSpec,
        generator: torch.Generator | None,
        member: Callable[[Any, torch.Generator | None], Network],
    ) -> None:
        super().__init__(spec)
        n_networks = spec.n_agents if spec.team == "independent" else 1
        # One after the other from one generator: no two start alike.
        self.members = nn.ModuleList(member(spec, generator) for _ in range(n_networks))

    def forward(self, observations: Tensor) -> Tensor:
        """Return each agent's action values (B, N, A)."""
        values = [
            self.members[agent % len(self.members)](view(observations, agent, self.spec))
            for agent in range(self.spec.n_agents)
        ]
        return torch.cat(values, dim=1)


def view(observations: Array, agent: int, spec: NetworkSpec) -> Array:
    """Return global observations (..., N + 2K) as an agent's network in a team gets them.

    A network of one's own gets them as they are. A shared one gets the agent's own cell first, the
    others' after it in the order of the agents, and at the end a 1 at the agent's place among N
    numbers: agents that stand on one cell, as all do at the start, can still act differently.
    "geodesic" gets that 1 in any team, and the cells in the order of the agents.
    """
    if not spec.told_agent:
        return observations
    n = spec.n_agents
    parts = [observations[..., :n], observations[..., n:], 0 * observations[..., :n]]
    parts[2][..., agent] = 1
    if spec.own_cell_first:
        parts[:1] = [observations[..., agent:n], observations[..., :agent]]
    joined: Array = (torch.cat if isinstance(observations, Tensor) else np.concatenate)(parts, -1)  # type: ignore
    return joined

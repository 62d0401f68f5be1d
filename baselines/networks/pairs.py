"""The network "pairs": cells as categories, landmarks as a set, agents in no order."""

import itertools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from baselines.networks.base import Network, NetworkSpec
from baselines.networks.layers import EmbeddingBag, Head, encode, linear
from mapp_env.compiled import nogil_kernel
from mapp_env.validation import check_count

NONE = np.zeros(0, np.int64)  # rows of a table that a network does without
MAX_SORTED_AGENTS = 5  # 5 ** 5 orders of agents, of which each has a table of joint actions


@dataclass(frozen=True)
class PairsSpec(NetworkSpec):
    """What all networks have, and how many numbers describe what."""

    kind: ClassVar[str] = "pairs"

    code_units: int = 64  # an agent among the landmarks
    landmark_units: int = 0  # a landmark among the agents
    route_units: int = 0  # an agent among pairs of landmarks

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("n_agents", self.n_agents, 1, MAX_SORTED_AGENTS)
        check_count("code_units", self.code_units, 1, 4096)
        check_count("landmark_units", self.landmark_units, 0, 4096)
        check_count("route_units", self.route_units, 0, 4096)


class PairsNetwork(Network):
    """Sees cells as categories and landmarks as a set; agents are exchangeable.

    An agent is described by the sum, over the unvisited landmarks, of a learned vector for the pair
    (its cell, the landmark's cell), and by one for its cell. The agents' descriptions, in the order
    of their cells, and the set of unvisited landmarks go through a layer of rectifier units. With
    ``landmark_units`` the landmarks are described among the agents as well, and summed. With
    ``route_units`` agents are described among pairs of landmarks too, as a route through several
    is not the sum of the ways to each; and landmarks among one another. Values are given back in
    the agents' own order, so that, exactly:

    - to rename landmarks changes nothing, and where the visited ones stand does not matter;
    - to rename agents renames their actions.

    One agent's network in a team keeps the agents in the order they are given in, so that it can
    tell itself from the others.
    """

    spec_type = PairsSpec
    spec: PairsSpec
    orders: Tensor
    places: Tensor
    slots: Tensor

    def __init__(self, spec: PairsSpec, generator: torch.Generator | None = None) -> None:
        super().__init__(spec)
        n, units = spec.n_agents, spec.code_units
        n_pairs = spec.n_cells * (spec.n_cells + 2)  # arrange says why 2
        self.pairs = EmbeddingBag(n_pairs, units + spec.route_units, 0.3, generator)
        self.unvisited = EmbeddingBag(spec.n_cells + 1, spec.hidden_units, 0.1, generator)
        self.crossed = self.whose = self.routes = self.between = None
        n_codes = n * (units + spec.route_units)
        if spec.landmark_units:
            self.crossed = EmbeddingBag(n * n_pairs, spec.landmark_units, 0.3, generator)
            self.register_buffer("slots", torch.arange(n) * n_pairs, persistent=False)
            n_codes += spec.landmark_units
        self.hidden = linear(n_codes, spec.hidden_units, generator)
        self.head = Head(spec, generator)
        if spec.told_agent:
            self.whose = EmbeddingBag(n, spec.hidden_units, 0.1, generator)
        if spec.route_units:
            self.routes = EmbeddingBag(n_routes(spec.n_cells), spec.route_units, 0.1, generator)
            if spec.landmark_units:
                n_between = (spec.n_cells + 1) ** 2
                self.between = EmbeddingBag(n_between, spec.landmark_units, 0.1, generator)
        self.register_buffer("orders", _joint_actions_by_order(spec), persistent=False)
        self.register_buffer("places", n ** torch.arange(n), persistent=False)

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values."""
        spec = self.spec
        pairs, landmarks, order, *more = encode(rows_to_look_up, observations, spec)
        hidden = self.hidden(self.codes(pairs, *more)) + self.unvisited(landmarks)
        if self.whose is not None:
            own = observations[:, spec.observation_size :].argmax(dim=1, keepdim=True)
            hidden = hidden + self.whose(own)
        values: Tensor = self.head(torch.relu_(hidden))
        if spec.team != "one":
            return values
        if spec.outputs == "joint":
            return values.gather(1, self.orders.index_select(0, (order * self.places).sum(1)))
        rank = order.argsort(dim=1)
        return values.gather(1, rank[:, :, None].expand(-1, -1, spec.n_actions))

    def codes(self, pairs: Tensor, through: Tensor, between: Tensor) -> Tensor:
        """Return what describes agents and landmarks: (B, units), of :func:`rows_to_look_up`."""
        spec = self.spec
        n, k = spec.n_agents, spec.n_landmarks
        agents = self.pairs(pairs.view(-1, k + 1))
        if self.routes is not None:
            ways = agents[:, spec.code_units :] + self.routes(through)
            agents = torch.cat((agents[:, : spec.code_units], ways), 1)
        codes = torch.relu_(agents).view(-1, n * (spec.code_units + spec.route_units))
        if self.crossed is None:
            return codes
        crossed = self.crossed(
            (pairs[:, :, :k] + self.slots[:, None]).transpose(1, 2).reshape(-1, n)
        )
        if self.between is not None:
            crossed = crossed + self.between(between)
        crossed = torch.relu_(crossed).view(-1, k, spec.landmark_units).sum(1)
        return torch.cat((codes, crossed), 1)


def _joint_actions_by_order(spec: NetworkSpec) -> Tensor:
    """Return which joint action of the sorted agents is each of the agents' own: (N ** N, A ** N).

    The row for sorted agents ``order`` (first to last) is the sum of ``order[i] * N ** i``.
    """
    if spec.outputs != "joint":
        return torch.zeros(0, dtype=torch.long)
    n, a = spec.n_agents, spec.n_actions
    own = torch.tensor(list(itertools.product(range(a), repeat=n)))  # (A ** N, N)
    table = torch.zeros(n**n, a**n, dtype=torch.long)
    for order in itertools.permutations(range(n)):
        row = sum(agent * n**place for place, agent in enumerate(order))
        for agent in order:
            table[row] = table[row] * a + own[:, agent]
    return table


# -- rows of the tables --------------------------------------------------------------------------


def rows_to_look_up(observations: np.ndarray, spec: PairsSpec) -> tuple[np.ndarray, ...]:
    """Return what is to be looked up for global observations (B, N + 2K).

    What :func:`arrange` returns, and of :func:`routes` and :func:`between_landmarks` what has
    a table.
    """
    n_cells = spec.n_cells
    pairs, landmarks, order = arrange(
        observations, spec.n_agents, spec.n_landmarks, n_cells, spec.team == "one"
    )
    through = routes(pairs, landmarks, n_cells) if spec.route_units else NONE
    both = spec.route_units and spec.landmark_units
    between = between_landmarks(landmarks, n_cells) if both else NONE
    return pairs, landmarks, order, through, between


@nogil_kernel
def arrange(observations, n, k, n_cells, sort):  # type: ignore[no-untyped-def]
    """Return what is to be looked up for global observations (B, N + 2K).

    Two places are added to the grid's cells: where all visited landmarks are put, and one that
    every agent pairs with besides, for what its cell says by itself.
    """
    n_rows, n_places = len(observations), n_cells + 2
    # Of each agent, its cell with each landmark's and with the second added place.
    pairs = np.empty((n_rows, n, k + 1), np.int64)
    landmarks = np.empty((n_rows, k), np.int64)  # their cells, or the first added place
    # The agents in the order of pairs: with `sort` that of their cells, of equal ones the first.
    order = np.empty((n_rows, n), np.int64)
    for row in range(n_rows):
        for index in range(k):
            visited = observations[row, n + k + index] > 0
            landmarks[row, index] = n_cells if visited else observations[row, n + index]
        for agent in range(n):
            place = agent
            while sort and place > 0:
                if observations[row, order[row, place - 1]] <= observations[row, agent]:
                    break
                order[row, place] = order[row, place - 1]
                place -= 1
            order[row, place] = agent
        for agent in range(n):
            cell = np.int64(observations[row, order[row, agent]])
            for index in range(k):
                pairs[row, agent, index] = cell * n_places + landmarks[row, index]
            pairs[row, agent, k] = cell * n_places + n_cells + 1
    return pairs, landmarks, order


@nogil_kernel
def routes(pairs, landmarks, n_cells):  # type: ignore[no-untyped-def]
    """Return the agents' cells with every two unvisited landmarks: (B * N, K (K - 1) / 2).

    Pairs and landmarks are those of :func:`arrange`. A pair with a visited landmark has one row for
    itself, the last; so has a single landmark.
    """
    n_rows, n, k = len(pairs), pairs.shape[1], landmarks.shape[1]
    n_two = n_cells * (n_cells - 1) // 2
    out = np.full((n_rows * n, max(1, k * (k - 1) // 2)), n_cells * n_two, np.int64)
    for row in range(n_rows):
        place = 0
        for one in range(k):
            for other in range(one):
                low = min(landmarks[row, one], landmarks[row, other])
                high = max(landmarks[row, one], landmarks[row, other])
                if high < n_cells and low != high:
                    two = high * (high - 1) // 2 + low
                    for agent in range(n):
                        cell = pairs[row, agent, k] // (n_cells + 2)
                        out[row * n + agent, place] = cell * n_two + two
                place += 1
    return out


def n_routes(n_cells: int) -> int:
    """Return how many rows :func:`routes` numbers."""
    return n_cells * math.comb(n_cells, 2) + 1


def between_landmarks(landmarks: np.ndarray, n_cells: int) -> np.ndarray:
    """Return each landmark with each: (B * K, K), of what :func:`arrange` returned."""
    k = landmarks.shape[1]
    both: np.ndarray = landmarks[:, :, None] * (n_cells + 1) + landmarks[:, None, :]
    return both.reshape(-1, k)

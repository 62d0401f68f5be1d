"""Networks from a global observation to action values, buildable from a few plain words.

A network describes itself by its ``spec`` (plain numbers and words). The spec travels with the
weights, so that ``policy.load_policy`` can build the same network again without running any code
from the file.
"""

import itertools
import math
from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import Tensor, nn

from baselines.checks import check_choice, check_count, check_flag

MAX_WEIGHTS = 20_000_000  # numbers in a network: 76 MiB
MAX_JOINT_ACTIONS = 1024

OUTPUTS = ("agents", "joint")


@dataclass(frozen=True)
class NetworkSpec:
    """What is needed to build a network; validated, since it is also read from files."""

    kind: str  # a key of NETWORKS
    n_agents: int
    n_landmarks: int
    n_actions: int
    n_cells: int
    hidden_units: int
    outputs: str = "agents"  # values of each agent's actions (N x A), or of joint actions (A ** N)
    dueling: bool = False  # a value and advantages (Wang et al. 2016) in place of values
    code_units: int = 64  # of "pairs": numbers that describe an agent among the landmarks
    landmark_units: int = 0  # of "pairs": numbers that describe a landmark among the agents

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, tuple(NETWORKS))
        check_count("n_agents", self.n_agents, 1, 16)
        check_count("n_landmarks", self.n_landmarks, 1, 256)
        check_count("n_actions", self.n_actions, 4, 5)
        check_count("n_cells", self.n_cells, 2, 512 * 512)
        check_count("hidden_units", self.hidden_units, 1, 4096)
        check_choice("outputs", self.outputs, OUTPUTS)
        check_flag("dueling", self.dueling)
        check_count("code_units", self.code_units, 1, 4096)
        check_count("landmark_units", self.landmark_units, 0, 4096)
        if self.outputs == "joint" and self.n_joint_actions > MAX_JOINT_ACTIONS:
            raise ValueError(
                f"outputs must be 'agents' for {self.n_agents} agents: 'joint' would have "
                f"{self.n_joint_actions:,} of them, allowed are {MAX_JOINT_ACTIONS:,}"
            )
        if self.kind == "pairs":
            check_count("n_agents", self.n_agents, 1, MAX_SORTED_AGENTS)
            units = self.code_units + self.n_agents * self.landmark_units
            pairs = self.n_cells * (self.n_cells + 1) * units
            if pairs > MAX_WEIGHTS:
                raise ValueError(
                    f"kind 'pairs' would have {pairs:,} weights on {self.n_cells:,} cells, allowed "
                    f"are {MAX_WEIGHTS:,}"
                )

    @property
    def observation_size(self) -> int:
        """Numbers in the global observation: agents' cells, landmarks' cells, visited flags."""
        return self.n_agents + 2 * self.n_landmarks

    @property
    def n_joint_actions(self) -> int:
        """Joint actions of all agents."""
        return int(self.n_actions**self.n_agents)

    @property
    def values_shape(self) -> tuple[int, ...]:
        """Shape of one observation's values."""
        if self.outputs == "joint":
            return (self.n_joint_actions,)
        return (self.n_agents, self.n_actions)

    def as_dict(self) -> dict[str, int | str | bool]:
        """Return the fields as a dictionary ready for JSON."""
        return asdict(self)


class Head(nn.Module):
    """The last layer: hidden units to action values."""

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None) -> None:
        super().__init__()
        self.shape = spec.values_shape
        self.advantages = linear(spec.hidden_units, math.prod(self.shape), generator)
        n_values = self.shape[0] if len(self.shape) == 2 else 1
        self.value = linear(spec.hidden_units, n_values, generator) if spec.dueling else None

    def forward(self, hidden: Tensor) -> Tensor:
        """Return values (B, A ** N) or (B, N, A)."""
        scores: Tensor = self.advantages(hidden).view(-1, *self.shape)
        if self.value is None:
            return scores
        base = self.value(hidden)
        base = base[..., None] if len(self.shape) == 2 else base
        return base + scores - scores.mean(-1, keepdim=True)


class PaperNetwork(nn.Module):
    """The paper's network: the raw numbers, two layers of rectifier units, a linear output.

    By default the output has one score per action for each agent (12 for three agents and four
    moves). Cells arrive as numbers 0..C-1 and are divided by C-1 in here, so that every input is in
    [0, 1] and whoever holds the weights needs to know nothing about the scaling.
    """

    scale: Tensor

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.spec = spec
        n_cell_inputs = spec.n_agents + spec.n_landmarks
        scale = torch.ones(spec.observation_size)
        scale[:n_cell_inputs] = 1.0 / (spec.n_cells - 1)
        self.register_buffer("scale", scale, persistent=False)
        self.layers = nn.Sequential(
            linear(spec.observation_size, spec.hidden_units, generator),
            nn.ReLU(),
            linear(spec.hidden_units, spec.hidden_units, generator),
            nn.ReLU(),
        )
        self.head = Head(spec, generator)

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values, (B, N, A) or (B, A ** N), of global observations (B, N + 2K)."""
        values: Tensor = self.head(self.layers(observations * self.scale))
        return values


MAX_SORTED_AGENTS = 5  # 5 ** 5 orders of agents, of which each has a table of joint actions


class PairsNetwork(nn.Module):
    """Sees cells as categories and landmarks as a set; agents are exchangeable.

    An agent is described by the sum, over the unvisited landmarks, of a learned vector for the pair
    (its cell, the landmark's cell), and by one for its cell. The agents' descriptions, in the order
    of their cells, and the set of unvisited landmarks go through a layer of rectifier units. With
    ``landmark_units`` the landmarks are described among the agents as well, and summed. Values
    are given back in the agents' own order, so that, exactly:

    - to rename landmarks changes nothing, and where the visited ones stand does not matter;
    - to rename agents renames their actions.
    """

    places: Tensor
    orders: Tensor
    slots: Tensor

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.spec = spec
        n, cells, units = spec.n_agents, spec.n_cells, spec.code_units
        # One more place for landmarks: where the visited ones are put.
        self.pairs = bag(cells * (cells + 1), units, 0.3, generator)
        self.cell = bag(cells, units, 0.3, generator)
        self.unvisited = bag(cells + 1, spec.hidden_units, 0.1, generator)
        self.crossed = None
        n_codes = n * units
        if spec.landmark_units:
            self.crossed = bag(n * cells * (cells + 1), spec.landmark_units, 0.3, generator)
            self.register_buffer("slots", torch.arange(n) * (cells * (cells + 1)), persistent=False)
            n_codes += spec.landmark_units
        self.hidden = linear(n_codes, spec.hidden_units, generator)
        self.head = Head(spec, generator)
        self.register_buffer("places", n ** torch.arange(n), persistent=False)
        self.register_buffer("orders", _joint_actions_by_order(spec), persistent=False)

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values, (B, N, A) or (B, A ** N), of global observations (B, N + 2K)."""
        n, k = self.spec.n_agents, self.spec.n_landmarks
        numbers = observations.long()
        cells, order = numbers[:, :n].sort(dim=1, stable=True)
        landmarks = torch.where(numbers[:, n + k :] > 0, self.spec.n_cells, numbers[:, n : n + k])
        pairs = cells[:, :, None] * (self.spec.n_cells + 1) + landmarks[:, None, :]
        codes = self.pairs(pairs.view(-1, k)) + self.cell(cells.reshape(-1, 1))
        codes = torch.relu(codes).view(-1, n * self.spec.code_units)
        if self.crossed is not None:
            seen = (pairs + self.slots[:, None]).transpose(1, 2).reshape(-1, n)
            crossed = torch.relu(self.crossed(seen)).view(-1, k, self.spec.landmark_units).sum(1)
            codes = torch.cat((codes, crossed), 1)
        hidden = torch.relu(self.hidden(codes) + self.unvisited(landmarks))
        values = self.head(hidden)
        if self.spec.outputs == "joint":
            return values.gather(1, self.orders[(order * self.places).sum(1)])
        rank = order.argsort(dim=1)
        return values.gather(1, rank[:, :, None].expand(-1, -1, self.spec.n_actions))


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


NETWORKS = {"paper": PaperNetwork, "pairs": PairsNetwork}
Network = PaperNetwork | PairsNetwork


def linear(n_in: int, n_out: int, generator: torch.Generator | None) -> nn.Linear:
    """Build a linear layer with PyTorch's usual start values, drawn from `generator`.

    ``nn.Linear`` would draw them from the global generator, which is not ours to move.
    """
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)  # type: ignore
    bound = 1.0 / math.sqrt(n_in)
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


def bag(n_in: int, n_out: int, std: float, generator: torch.Generator | None) -> nn.EmbeddingBag:
    """Build a table of learned vectors that are looked up and summed."""
    layer: nn.EmbeddingBag = nn.utils.skip_init(nn.EmbeddingBag, n_in, n_out, mode="sum")  # type: ignore
    nn.init.normal_(layer.weight, std=std, generator=generator)
    return layer


def build_network(spec: NetworkSpec, generator: torch.Generator | None = None) -> Network:
    """Build the network a spec describes; start values come from `generator`."""
    return NETWORKS[spec.kind](spec, generator or torch.Generator())


def greedy_actions(values: Tensor, spec: NetworkSpec) -> np.ndarray:
    """Return the joint actions (B, N) of the highest values; of equal ones the first."""
    best = values.argmax(dim=-1).numpy()
    if spec.outputs == "agents":
        return best
    return split_joint(best, spec.n_agents, spec.n_actions)


def split_joint(joint: np.ndarray, n_agents: int, n_actions: int) -> np.ndarray:
    """Return the actions (..., N) of joint actions (...): the first agent is most significant."""
    return np.stack(np.unravel_index(joint, (n_actions,) * n_agents), axis=-1)


def torch_generator(seeds: np.random.SeedSequence) -> torch.Generator:
    """Make a torch generator of its own from a NumPy seed sequence."""
    return torch.Generator().manual_seed(int(seeds.generate_state(1, np.uint64)[0] >> np.uint64(1)))

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

from baselines.networks.bags import Bag
from baselines.networks.lookups import arrange, between_landmarks, n_routes, routes
from mapp_env import Grid
from mapp_env.engine.loops import observe_rows
from mapp_env.engine.observation import N_FEATURES, Observation
from mapp_env.engine.task import make_world
from mapp_env.validation import check_choice, check_count, check_flag

MAX_WEIGHTS = 20_000_000  # numbers in a network: 76 MiB
MAX_JOINT_ACTIONS = 1024
MAX_PATH_CELLS = 4096  # the most cells for which a Grid keeps the distances of all pairs

OUTPUTS = ("agents", "joint")
TEAMS = ("one", "independent", "shared")


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
    route_units: int = 0  # of "pairs": numbers that describe an agent among pairs of landmarks
    team: str = "one"  # one network for all agents, one for each, or one that each uses by itself
    grid: str = ""  # of "geodesic": the map whose shortest paths it sees

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
        check_count("route_units", self.route_units, 0, 4096)
        check_choice("team", self.team, TEAMS)
        if self.team != "one":
            check_choice("outputs", self.outputs, ("agents",))
        if self.kind == "geodesic":
            check_choice("team", self.team, ("independent", "shared"))
            check_count("n_cells", self.n_cells, 2, MAX_PATH_CELLS)
            try:
                n_cells = Grid.from_text(self.grid).n_cells
            except ValueError as error:
                raise ValueError(f"grid must be a map, got {self.grid!r}: {error}") from error
            if n_cells != self.n_cells:
                raise ValueError(f"grid must have n_cells={self.n_cells} cells, got {n_cells}")
        elif self.grid != "":
            raise ValueError(f"grid must be '' for kind {self.kind!r}, got {self.grid!r}")
        if self.outputs == "joint" and self.n_joint_actions > MAX_JOINT_ACTIONS:
            raise ValueError(
                f"outputs must be 'agents' for {self.n_agents} agents: 'joint' would have "
                f"{self.n_joint_actions:,} of them, allowed are {MAX_JOINT_ACTIONS:,}"
            )
        if self.kind == "pairs":
            check_count("n_agents", self.n_agents, 1, MAX_SORTED_AGENTS)
        if self.n_weights > MAX_WEIGHTS:
            raise ValueError(
                f"kind {self.kind!r} would have {self.n_weights:,} weights on {self.n_cells:,} "
                f"cells, allowed are {MAX_WEIGHTS:,}"
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

    @property
    def head_shape(self) -> tuple[int, ...]:
        """Shape of what one network of the team gives for one observation."""
        return self.values_shape if self.team == "one" else (1, self.n_actions)

    @property
    def n_inputs(self) -> int:
        """Numbers that one network of the team is given: some also whose turn it is (view)."""
        told = self.team == "shared" or self.kind == "geodesic"
        return self.observation_size + (self.n_agents if told else 0)

    @property
    def n_weights(self) -> int:
        """Weights of all networks together."""
        hidden, shape = self.hidden_units, self.head_shape
        last = (hidden + 1) * math.prod(shape)
        if self.dueling:
            last += (hidden + 1) * (shape[0] if len(shape) == 2 else 1)
        if self.kind == "paper":
            first = (self.n_inputs + 1) * hidden + (hidden + 1) * hidden
        elif self.kind == "geodesic":
            units = self.code_units
            first = (N_FEATURES + 1) * units + (units + 1) * units + (units + 1) * hidden
        else:
            n_pairs = self.n_cells * (self.n_cells + 2)
            first = n_pairs * self.code_units
            first += (self.n_cells + 1 + self.n_agents * self.code_units + 1) * hidden
            first += (self.n_inputs - self.observation_size) * hidden
            first += self.landmark_units * (self.n_agents * n_pairs + hidden)
            if self.route_units:
                first += self.route_units * (
                    n_pairs + n_routes(self.n_cells) + self.n_agents * hidden
                )
                first += self.landmark_units * (self.n_cells + 1) ** 2
        return (self.n_agents if self.team == "independent" else 1) * (first + last)

    def as_dict(self) -> dict[str, int | str | bool]:
        """Return the fields as a dictionary ready for JSON, without a grid if there is none."""
        return {name: value for name, value in asdict(self).items() if name != "grid" or value}


class Head(nn.Module):
    """The last layer: hidden units to action values."""

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None) -> None:
        super().__init__()
        self.shape = spec.head_shape
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
        scale = torch.ones(spec.n_inputs)
        scale[:n_cell_inputs] = 1.0 / (spec.n_cells - 1)
        self.register_buffer("scale", scale, persistent=False)
        self.layers = nn.Sequential(
            linear(spec.n_inputs, spec.hidden_units, generator),
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
    ``landmark_units`` the landmarks are described among the agents as well, and summed. With
    ``route_units`` agents are described among pairs of landmarks too, as a route through several
    is not the sum of the ways to each; and landmarks among one another. Values are given back in
    the agents' own order, so that, exactly:

    - to rename landmarks changes nothing, and where the visited ones stand does not matter;
    - to rename agents renames their actions.

    One agent's network in a team keeps the agents in the order they are given in, so that it can
    tell itself from the others.
    """

    orders: Tensor
    slots: Tensor

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.spec = spec
        n, units = spec.n_agents, spec.code_units
        n_pairs = spec.n_cells * (spec.n_cells + 2)  # arrange says why 2
        self.pairs = Bag(n_pairs, units + spec.route_units, 0.3, generator)
        self.unvisited = Bag(spec.n_cells + 1, spec.hidden_units, 0.1, generator)
        self.crossed = None
        n_codes = n * (units + spec.route_units)
        if spec.landmark_units:
            self.crossed = Bag(n * n_pairs, spec.landmark_units, 0.3, generator)
            self.register_buffer("slots", torch.arange(n) * n_pairs, persistent=False)
            n_codes += spec.landmark_units
        self.hidden = linear(n_codes, spec.hidden_units, generator)
        self.head = Head(spec, generator)
        self.whose = Bag(n, spec.hidden_units, 0.1, generator) if spec.team == "shared" else None
        self.routes = self.between = None
        if spec.route_units:
            self.routes = Bag(n_routes(spec.n_cells), spec.route_units, 0.1, generator)
            if spec.landmark_units:
                n_between = (spec.n_cells + 1) ** 2
                self.between = Bag(n_between, spec.landmark_units, 0.1, generator)
        self.register_buffer("orders", _joint_actions_by_order(spec), persistent=False)

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values, (B, N, A) or (B, A ** N), of global observations (B, N + 2K)."""
        spec = self.spec
        n, k = spec.n_agents, spec.n_landmarks
        pairs, landmarks, order = arrange(
            observations.numpy(), n, k, spec.n_cells, spec.team == "one"
        )
        codes = self.codes(pairs, landmarks)
        landmarks, order = torch.from_numpy(landmarks), torch.from_numpy(order)
        hidden = self.hidden(codes) + self.unvisited(landmarks)
        if self.whose is not None:
            whose = observations[:, n + 2 * k :].argmax(dim=1, keepdim=True)
            hidden = hidden + self.whose(whose)
        values: Tensor = self.head(torch.relu_(hidden))
        if spec.team != "one":
            return values
        if spec.outputs == "joint":
            places = n ** torch.arange(n)
            return values.gather(1, self.orders.index_select(0, (order * places).sum(1)))
        rank = order.argsort(dim=1)
        return values.gather(1, rank[:, :, None].expand(-1, -1, spec.n_actions))

    def codes(self, pairs: np.ndarray, landmarks: np.ndarray) -> Tensor:
        """Return what describes agents and landmarks: (B, units), of what `arrange` returned."""
        spec = self.spec
        n, k = spec.n_agents, spec.n_landmarks
        looked_up = torch.from_numpy(pairs)
        agents = self.pairs(looked_up.view(-1, k + 1))
        if self.routes is not None:
            through = torch.from_numpy(routes(pairs, landmarks, spec.n_cells))
            ways = agents[:, spec.code_units :] + self.routes(through)
            agents = torch.cat((agents[:, : spec.code_units], ways), 1)
        codes = torch.relu_(agents).view(-1, n * (spec.code_units + spec.route_units))
        if self.crossed is None:
            return codes
        seen = (looked_up[:, :, :k] + self.slots[:, None]).transpose(1, 2).reshape(-1, n)
        crossed = self.crossed(seen)
        if self.between is not None:
            crossed = crossed + self.between(
                torch.from_numpy(between_landmarks(landmarks, spec.n_cells))
            )
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


class GeodesicNetwork(nn.Module):
    """Sees one agent's shortest paths, the observation "geodesic", and landmarks as a set.

    The global observation is turned into the agent's own view in here, by the environment's own
    kernel. Each unvisited landmark's eight numbers go through two layers, the sum through a third:
    to rename landmarks changes nothing, and where the visited ones stand does not matter.

    It is always one agent's, and told which (:func:`view`): with equal paths the agent with the
    lower index counts as nearer.
    """

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.spec = spec
        grid = Grid.from_text(spec.grid)
        world = make_world(grid, spec.n_agents, spec.n_landmarks, observation=Observation.GEODESIC)
        self.world = tuple(world)
        units = spec.code_units
        self.landmark = nn.Sequential(
            linear(N_FEATURES, units, generator),
            nn.ReLU(),
            linear(units, units, generator),
            nn.ReLU(),
        )
        self.hidden = linear(units, spec.hidden_units, generator)
        self.head = Head(spec, generator)

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values (B, 1, A) of what :func:`view` gives (B, N + 2K + N)."""
        seen = torch.from_numpy(self.paths(observations.numpy()))
        landmarks: Tensor = seen[:, :, :1] * self.landmark(seen)  # the visited ones count nothing
        values: Tensor = self.head(torch.relu_(self.hidden(landmarks.sum(1))))
        return values

    def paths(self, observations: np.ndarray) -> np.ndarray:
        """Return the agent's own view (B, K, 8) of what :func:`view` gives."""
        spec, n_rows = self.spec, len(observations)
        n, k = spec.n_agents, spec.n_landmarks
        views = np.empty((n_rows, n, N_FEATURES * k), np.float32)
        observe_rows(
            observations[:, : n + 2 * k].astype(np.int32),
            np.arange(n_rows),
            views,
            np.empty((n_rows, n, spec.n_actions), np.int8),
            self.world,
        )
        whose = observations[:, n + 2 * k :].argmax(axis=1)
        own: np.ndarray = views[np.arange(n_rows), whose].reshape(n_rows, k, N_FEATURES)
        return own


NETWORKS = {"paper": PaperNetwork, "pairs": PairsNetwork, "geodesic": GeodesicNetwork}


class Team(nn.Module):
    """Networks of agents that act for themselves: one for each agent, or one that each uses.

    An agent's network gives values of this agent's own actions. With one for each, all see the
    observation as it is, but for "geodesic". A shared one is told whose turn it is (:func:`view`).
    """

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.spec = spec
        n_networks = spec.n_agents if spec.team == "independent" else 1
        # One after the other from one generator: no two start alike.
        self.members = nn.ModuleList(
            NETWORKS[spec.kind](spec, generator) for _ in range(n_networks)
        )

    def forward(self, observations: Tensor) -> Tensor:
        """Return each agent's action values (B, N, A) of global observations (B, N + 2K)."""
        values = []
        for agent in range(self.spec.n_agents):
            seen = torch.from_numpy(view(observations.numpy(), agent, self.spec))
            values.append(self.members[agent % len(self.members)](seen))
        return torch.cat(values, dim=1)


def view(observations: np.ndarray, agent: int, spec: NetworkSpec) -> np.ndarray:
    """Return global observations (..., N + 2K) as an agent's network in a team gets them.

    A network of one's own gets them as they are. A shared one gets the agent's own cell first, the
    others' after it in the order of the agents, and at the end a 1 at the agent's place among N
    numbers: agents that stand on one cell, as all do at the start, can still act differently.
    "geodesic" gets that 1 in any team, and the cells in the order of the agents.
    """
    if spec.n_inputs == spec.observation_size:
        return observations
    n = spec.n_agents
    whose = np.zeros((*observations.shape[:-1], n), observations.dtype)
    whose[..., agent] = 1
    cells = observations[..., :n]
    if spec.kind != "geodesic":
        cells = np.roll(cells, -agent, axis=-1)
    return np.concatenate((cells, observations[..., n:], whose), axis=-1)


Network = PaperNetwork | PairsNetwork | GeodesicNetwork | Team


def linear(n_in: int, n_out: int, generator: torch.Generator | None) -> nn.Linear:
    """Build a linear layer with PyTorch's usual start values, drawn from `generator`.

    ``nn.Linear`` would draw them from the global generator, which is not ours to move.
    """
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)  # type: ignore
    bound = 1.0 / math.sqrt(n_in)
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


def build_network(spec: NetworkSpec, generator: torch.Generator | None = None) -> Network:
    """Build the network a spec describes; start values come from `generator`."""
    kind = NETWORKS[spec.kind] if spec.team == "one" else Team
    return kind(spec, generator or torch.Generator())


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

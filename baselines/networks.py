"""Networks from a global observation to action values, buildable from a few plain words.

A network describes itself by its ``spec`` (plain numbers and words). The spec travels with the
weights, so that ``policy.load_policy`` can build the same network again without running any code
from the file.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np
import torch
from torch import Tensor, nn

from baselines.checks import check_choice, check_count


@dataclass(frozen=True)
class NetworkSpec:
    """What is needed to build a network; validated, since it is also read from files."""

    kind: str  # a key of NETWORKS
    n_agents: int
    n_landmarks: int
    n_actions: int
    n_cells: int
    hidden_units: int

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, tuple(NETWORKS))
        check_count("n_agents", self.n_agents, 1, 16)
        check_count("n_landmarks", self.n_landmarks, 1, 256)
        check_count("n_actions", self.n_actions, 4, 5)
        check_count("n_cells", self.n_cells, 2, 512 * 512)
        check_count("hidden_units", self.hidden_units, 1, 4096)

    @property
    def observation_size(self) -> int:
        """Numbers in the global observation: agents' cells, landmarks' cells, visited flags."""
        return self.n_agents + 2 * self.n_landmarks

    def as_dict(self) -> dict[str, int | str]:
        """Return the fields as a dictionary ready for JSON."""
        return asdict(self)


class PaperNetwork(nn.Module):
    """The paper's network: the raw numbers, two layers of rectifier units, a linear output.

    The output has one score per action for each agent (12 for three agents and four moves).
    Cells arrive as numbers 0..C-1 and are divided by C-1 in here, so that every input is in
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
            linear(spec.hidden_units, spec.n_agents * spec.n_actions, generator),
        )

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values (B, N, A) of global observations (B, N + 2K)."""
        scores: Tensor = self.layers(observations * self.scale)
        return scores.view(-1, self.spec.n_agents, self.spec.n_actions)


NETWORKS = {"paper": PaperNetwork}


def linear(n_in: int, n_out: int, generator: torch.Generator | None) -> nn.Linear:
    """Build a linear layer with PyTorch's usual start values, drawn from `generator`.

    ``nn.Linear`` would draw them from the global generator, which is not ours to move.
    """
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out)  # type: ignore
    bound = 1.0 / math.sqrt(n_in)
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


def build_network(spec: NetworkSpec, generator: torch.Generator | None = None) -> PaperNetwork:
    """Build the network a spec describes; start values come from `generator`."""
    return NETWORKS[spec.kind](spec, generator or torch.Generator())


def torch_generator(seeds: np.random.SeedSequence) -> torch.Generator:
    """Make a torch generator of its own from a NumPy seed sequence."""
    return torch.Generator().manual_seed(int(seeds.generate_state(1, np.uint64)[0] >> np.uint64(1)))

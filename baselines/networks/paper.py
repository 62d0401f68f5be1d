"""The network "paper": the raw numbers and two layers of rectifier units."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from baselines.networks.base import Network, NetworkSpec
from baselines.networks.layers import Head, linear


@dataclass(frozen=True)
class PaperSpec(NetworkSpec):
    """What all networks have."""

    kind: ClassVar[str] = "paper"


class PaperNetwork(Network):
    """The paper's network: the raw numbers, two layers of rectifier units, a linear output.

    By default the output has one score per action for each agent (12 for three agents and four
    moves). Cells arrive as numbers 0..C-1 and are divided by C-1 in here, so that every input is in
    [0, 1] and whoever holds the weights needs to know nothing about the scaling.
    """

    spec_type = PaperSpec
    scale: Tensor

    def __init__(self, spec: PaperSpec, generator: torch.Generator | None = None) -> None:
        super().__init__(spec)
        scale = torch.ones(spec.n_inputs)
        scale[: spec.n_agents + spec.n_landmarks] = 1.0 / (spec.n_cells - 1)
        self.register_buffer("scale", scale, persistent=False)
        self.layers = nn.Sequential(
            linear(spec.n_inputs, spec.hidden_units, generator),
            nn.ReLU(),
            linear(spec.hidden_units, spec.hidden_units, generator),
            nn.ReLU(),
        )
        self.head = Head(spec, generator)

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values."""
        values: Tensor = self.head(self.layers(observations * self.scale))
        return values

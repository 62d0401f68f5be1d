"""The network "geodesic": one agent's shortest paths to a set of landmarks."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from baselines.networks.base import Network, NetworkSpec
from baselines.networks.layers import Head, encode, linear
from mapp_env import Grid
from mapp_env.engine.loops import observe_rows
from mapp_env.engine.observation import N_FEATURES, Observation
from mapp_env.engine.state import pack
from mapp_env.engine.world import make_world
from mapp_env.grid import MAX_ALL_PAIRS_CELLS
from mapp_env.validation import check_count


@dataclass(frozen=True)
class GeodesicSpec(NetworkSpec):
    """What all networks have, and the map."""

    kind: ClassVar[str] = "geodesic"
    commands_all: ClassVar[bool] = False
    own_cell_first: ClassVar[bool] = False

    code_units: int = 64  # numbers that describe an agent among the landmarks
    grid: str = field(default="", kw_only=True)  # the map whose shortest paths are seen

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("code_units", self.code_units, 1, 4096)
        check_count("n_cells", self.n_cells, 2, MAX_ALL_PAIRS_CELLS)
        try:
            super().check_grid(Grid.from_text(self.grid))
        except ValueError as error:
            raise ValueError(f"grid must be a map, got {self.grid!r}: {error}") from error

    def check_grid(self, grid: Grid | None) -> None:
        """Refuse any grid but the one whose paths are seen."""
        if grid != Grid.from_text(self.grid):
            raise ValueError("grid must be the one whose shortest paths the network sees")

    @property
    def told_agent(self) -> bool:
        """Always: only the agent's own paths are seen."""
        return True


class GeodesicNetwork(Network):
    """Sees one agent's shortest paths, the observation "geodesic", and landmarks as a set.

    Each unvisited landmark's eight numbers go through two layers, the sum through a third: to
    rename landmarks changes nothing, and where the visited ones stand does not matter.

    It is always one agent's, and told which (:func:`~baselines.networks.view`): with equal paths
    the agent with the lower index counts as nearer.
    """

    spec_type = GeodesicSpec

    def __init__(self, spec: GeodesicSpec, generator: torch.Generator | None = None) -> None:
        super().__init__(spec)
        grid = Grid.from_text(spec.grid)
        world = make_world(grid, spec.n_agents, spec.n_landmarks, observation=Observation.GEODESIC)
        self.world = pack(world)
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
        """Return action values."""
        (paths,) = encode(self.paths, observations)
        landmarks: Tensor = paths[:, :, :1] * self.landmark(paths)  # the visited ones count nothing
        values: Tensor = self.head(torch.relu_(self.hidden(landmarks.sum(1))))
        return values

    def paths(self, observations: np.ndarray) -> tuple[np.ndarray]:
        """Return the agent's own observation "geodesic" (B, K, 8), by the environment's kernel."""
        n_rows, n, k = len(observations), self.spec.n_agents, self.spec.n_landmarks
        views = np.empty((n_rows, n, N_FEATURES * k), np.float32)
        observe_rows(
            observations[:, : n + 2 * k].astype(np.int32),
            np.arange(n_rows),
            views,
            np.empty((n_rows, n, self.spec.n_actions), np.int8),
            self.world,
        )
        agents = observations[:, n + 2 * k :].argmax(axis=1)
        return (views[np.arange(n_rows), agents].reshape(n_rows, k, N_FEATURES),)

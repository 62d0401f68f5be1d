"""What all networks are: a spec of plain numbers and words, and a module that is built from it."""

from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from mapp_env import Grid
from mapp_env.map_format import MAX_SIDE
from mapp_env.problem import MAX_AGENTS, MAX_LANDMARKS
from mapp_env.validation import check_choice, check_count, check_flag

MAX_JOINT_ACTIONS = 1024
ANY = 0  # of a size: the network takes any

OUTPUTS = ("agents", "joint")
TEAMS = ("one", "independent", "shared")


@dataclass(frozen=True)
class NetworkSpec:
    """Specification of a network; validated, since it is also read from files.

    Each network has a spec of its own, with what only it needs beside these fields.
    """

    kind: ClassVar[str]  # the network's name, its key in NETWORKS
    any_size: ClassVar[tuple[str, ...]] = ()  # n_cells, n_agents, n_landmarks that may be ANY
    commands_all: ClassVar[bool] = True  # whether it may be the one network of all agents
    own_cell_first: ClassVar[bool] = True  # for the one network that all agents of a team share

    n_agents: int
    n_landmarks: int
    n_actions: int
    n_cells: int  # of the grid
    hidden_units: int
    outputs: str = "agents"  # values of each agent's actions (N x A), or of joint actions (A ** N)
    dueling: bool = False  # a value and advantages (Wang et al. 2016) in place of values
    # One network for all agents, one for each, or one that each uses by itself.
    team: str = field(default="one", kw_only=True)

    def __post_init__(self) -> None:
        sizes = ("n_agents", 1, MAX_AGENTS), ("n_landmarks", 1, MAX_LANDMARKS)
        for name, least, most in (*sizes, ("n_cells", 2, MAX_SIDE**2)):
            size = getattr(self, name)
            if name not in self.any_size or size != ANY:
                check_count(name, size, least, most)
        check_count("n_actions", self.n_actions, 4, 5)
        check_count("hidden_units", self.hidden_units, 1, 4096)
        check_choice("outputs", self.outputs, OUTPUTS)
        check_flag("dueling", self.dueling)
        check_choice("team", self.team, TEAMS if self.commands_all else TEAMS[1:])
        if self.team != "one":
            check_choice("outputs", self.outputs, ("agents",))
        if self.outputs == "joint" and self.n_joint_actions > MAX_JOINT_ACTIONS:
            raise ValueError(
                f"outputs must be 'agents' for {self.n_agents} agents: 'joint' would have "
                f"{self.n_joint_actions:,} of them, allowed are {MAX_JOINT_ACTIONS:,}"
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
    def told_agent(self) -> bool:
        """Whether one network of the team is told whose actions it is asked for."""
        return self.team == "shared"

    @property
    def n_inputs(self) -> int:
        """Numbers that one network of the team is given (:func:`~baselines.networks.view`)."""
        return self.observation_size + (self.n_agents if self.told_agent else 0)

    def check_grid(self, grid: Grid | None) -> None:
        """Raise a ValueError if a grid, None for any, has not the network's number of cells."""
        if self.n_cells not in (ANY, ANY if grid is None else grid.n_cells):
            found = "any grid" if grid is None else f"one of {grid.n_cells}"
            raise ValueError(f"grid must have the network's {self.n_cells} cells, got {found}")

    def as_dict(self) -> dict[str, Any]:
        """Return the kind and the fields as a dictionary ready for JSON."""
        return {"kind": self.kind, **asdict(self)}


class Network(nn.Module):
    """A network from global observations to action values.

    Its initial weights come from the generator; on the device "meta", where there are none, None.
    """

    spec_type: ClassVar[type[NetworkSpec]]
    spec: NetworkSpec

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.spec = spec

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return next(self.parameters()).device

    def forward(self, observations: Tensor) -> Tensor:
        """Return action values, (B, N, A) or (B, A ** N), of global observations (B, N + 2K).

        One network of a team returns those of one agent, (B, 1, A).
        """
        raise NotImplementedError

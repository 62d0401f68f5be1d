"""Networks from a global observation to action values, buildable from a few plain words.

A network describes itself by its ``spec`` (plain numbers and words). The spec travels with the
weights, so that ``load_policy`` can build the same network again without running any code from the
file. A new network is a file with its spec and its module, and a line in ``NETWORKS``.
"""

import sys
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.networks.base import ANY, MAX_JOINT_ACTIONS, Network, NetworkSpec
from baselines.networks.geodesic import GeodesicNetwork
from baselines.networks.pairs import PairsNetwork
from baselines.networks.paper import PaperNetwork
from baselines.networks.team import Team, view
from mapp_env import Grid
from mapp_env.engine.state import N_ACTIONS
from mapp_env.validation import check_choice

__all__ = [
    "ANY",
    "CENTRAL",
    "MAX_JOINT_ACTIONS",
    "NETWORKS",
    "Network",
    "NetworkSpec",
    "Team",
    "build_network",
    "greedy_actions",
    "network_spec",
    "spec_from_options",
    "split_joint",
    "torch_generator",
    "view",
]

MAX_WEIGHTS = 20_000_000  # numbers in a network: 76 MiB

NETWORKS: dict[str, type[Network]] = {
    "paper": PaperNetwork,
    "pairs": PairsNetwork,
    "geodesic": GeodesicNetwork,
}
CENTRAL = tuple(kind for kind, network in NETWORKS.items() if network.spec_type.commands_all)
"""Those that may be the one network of all agents."""


def network_spec(kind: str, *sizes: Any, **options: Any) -> NetworkSpec:
    """Return the spec of a kind of network, a key of NETWORKS.

    Raises a ValueError if there is no such kind, or one of its fields is invalid; a TypeError if it
    has no such field.
    """
    check_choice("kind", kind, tuple(NETWORKS))
    return NETWORKS[kind].spec_type(*sizes, **options)


def spec_from_options(options: object, kind: str, grid: Grid, **changes: Any) -> NetworkSpec:
    """Return the spec of a kind of network for a grid; a field is the option of its name.

    Raises a ValueError if there is no such kind, or one of its fields is invalid.
    """
    check_choice("kind", kind, tuple(NETWORKS))
    sizes = {"n_actions": N_ACTIONS, "n_cells": grid.n_cells}
    values = {**vars(options), **sizes, "grid": grid.to_text()}
    values |= changes
    spec_type = NETWORKS[kind].spec_type
    return spec_type(**{f.name: values[f.name] for f in fields(spec_type) if f.name in values})


def build_network(spec: NetworkSpec, generator: torch.Generator | None = None) -> Network:
    """Build the network a spec describes; its initial weights come from `generator`.

    Raises a ValueError if it would have too many weights: before any memory is allocated for them.
    """
    try:
        with torch.device("meta"):  # shapes without numbers
            n_weights = sum(weights.numel() for weights in _build(spec, None).parameters())
    except RuntimeError:  # a single one of its tables has more than can be counted
        n_weights = sys.maxsize
    if n_weights > MAX_WEIGHTS:
        raise ValueError(
            f"kind {spec.kind!r} would have {n_weights:,} weights on {spec.n_cells:,} cells, "
            f"allowed are {MAX_WEIGHTS:,}"
        )
    return _build(spec, generator or torch.Generator())


def _build(spec: NetworkSpec, generator: torch.Generator | None) -> Network:
    network = NETWORKS[spec.kind]
    return network(spec, generator) if spec.team == "one" else Team(spec, generator, network)


def greedy_actions(values: Tensor, spec: NetworkSpec) -> np.ndarray:
    """Return the joint actions (B, N) of the highest values; of equal ones the first."""
    best = values.argmax(dim=-1).cpu().numpy()
    if spec.outputs == "agents":
        return best
    return split_joint(best, spec.n_agents, spec.n_actions)


def split_joint(joint: np.ndarray, n_agents: int, n_actions: int) -> np.ndarray:
    """Return the actions (..., N) of joint actions (...): the first agent is most significant."""
    return np.stack(np.unravel_index(joint, (n_actions,) * n_agents), axis=-1)


def torch_generator(seeds: np.random.SeedSequence) -> torch.Generator:
    """Make a torch generator of its own from a NumPy seed sequence."""
    return torch.Generator().manual_seed(int(seeds.generate_state(1, np.uint64)[0] >> np.uint64(1)))

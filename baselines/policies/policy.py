"""Policies of trained networks, and the files that hold their weights."""

import json
import os
import reprlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch

from baselines.networks import Network, NetworkSpec, build_network, greedy_actions, network_spec
from baselines.policies.acting import check_observations
from baselines.runs.folder import WEIGHTS_FILE
from mapp_env import Grid
from mapp_env.files import parse_json, read_bytes, write_bytes

WEIGHTS_KEY = "mapp_env_policy"  # the one metadata entry of our safetensors files
WEIGHTS_VERSION = 2
ANY_GRID = "any"  # in place of a map
# The largest network that can be built takes 76 MiB.
MAX_WEIGHTS_BYTES = 80 * 1024 * 1024
MAX_HEADER_BYTES = 1024 * 1024
ZIP = b"PK\x03\x04"  # how such a file begins
PRETRAINED = Path(__file__).parents[1] / "pretrained"  # a folder for each name, like a run's


class NetworkPolicy:
    """Greedy commands of a network: the joint action, or each agent's, of the highest value.

    ``grid`` is the one it was trained on; None if it plays on any.
    """

    def __init__(self, network: Network, grid: Grid | None = None) -> None:
        self.network, self.spec, self.grid = network, network.spec, grid

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return greedy joint actions (B, N) int64: no guidance, no search.

        Of equal scores the first action is taken.

        Raises
        ------
        ValueError
            If the observations have another shape or hold numbers that are no cells or flags.
        """
        spec = self.spec
        checked = check_observations(observations, spec.n_agents, spec.n_landmarks, spec.n_cells)
        given = torch.from_numpy(checked).to(self.network.device)
        with torch.inference_mode():
            return greedy_actions(self.network(given), spec)


def save_policy(
    path: Path, network: Network, grid: Grid | None, half_precision: bool = False
) -> None:
    """Write a network's weights, its spec and its grid to a safetensors file, in one piece.

    The grid of a network that plays on any is None. With `half_precision` weights are rounded to 16
    bits: half the size, and nearly the same values; tensors with values that 16 bits have no room
    for keep theirs.

    Raises a ValueError if the network is for another number of cells than the grid has.
    """
    # One metadata entry only: safetensors writes several in no fixed order.
    about = json.dumps(header(network.spec, grid), sort_keys=True)
    tensors = {name: t.detach().cpu().contiguous() for name, t in network.state_dict().items()}
    if half_precision:
        most = torch.finfo(torch.float16).max
        tensors = {k: t.half() if t.abs().max() <= most else t for k, t in tensors.items()}
    write_bytes(path, safetensors.torch.save(tensors, {WEIGHTS_KEY: about}), MAX_WEIGHTS_BYTES)


def header(spec: NetworkSpec, grid: Grid | None) -> dict[str, Any]:
    """Return what a weights file says of its network; a ValueError if the grid is none for it."""
    spec.check_grid(grid)
    text = ANY_GRID if grid is None else grid.to_text()
    return {"version": WEIGHTS_VERSION, "grid": text, "network": spec.as_dict()}


def load_policy(path: str | os.PathLike[str], device: str = "cpu") -> NetworkPolicy:
    """Load a trained policy.

    Parameters
    ----------
    path
        The name of a pretrained policy, a run folder, or a weights file.
    device
        Where its network computes, as PyTorch names it.

    Returns
    -------
    NetworkPolicy
        Acts greedily: ``.act(observations (B, N + 2K)) -> actions (B, N)``, on ``.grid``.

    Raises
    ------
    ValueError
        If there is no such file, or it is damaged, was written by something else, or its weights
        have other names, shapes or dtypes than its network, or are not finite; or if there is no
        such device. No code is run from the file.
    """
    file = find_weights(path)
    content = read_bytes(file, MAX_WEIGHTS_BYTES, "a weights file", ValueError)
    try:
        spec, grid = read_header(content)
        network = build_network(spec)
        check_weights(network, weights := safetensors.torch.load(content))
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{file}: {error}") from error
    except safetensors.SafetensorError as error:
        raise ValueError(f"{file}: damaged weights: {error}") from error
    network.load_state_dict(weights)
    try:
        network.to(device)
    except (RuntimeError, AssertionError) as error:  # unknown to PyTorch, or not on this machine
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"device must be one that PyTorch has here, got {device!r}: {reason}"
        ) from error
    return NetworkPolicy(network.eval(), grid)


def check_weights(network: Network, weights: dict[str, torch.Tensor]) -> None:
    """Raise a ValueError unless weights are finite and, one for one, those that a network has."""
    expected = network.state_dict()
    if weights.keys() != expected.keys():
        missing, extra = expected.keys() - weights.keys(), weights.keys() - expected.keys()
        raise ValueError(
            f"other weights than a {network.spec.kind!r} network has: "
            f"missing {sorted(missing)}, unknown {sorted(extra)}"
        )
    for name, wanted in expected.items():
        found = weights[name]
        if found.shape != wanted.shape or found.dtype not in (wanted.dtype, torch.float16):
            raise ValueError(
                f"{name}: got {found.dtype} of shape {tuple(found.shape)}, expected "
                f"{wanted.dtype} or {torch.float16} of shape {tuple(wanted.shape)}"
            )
        if not torch.isfinite(found).all():
            raise ValueError(f"{name}: holds NaN or infinite weights")


def pretrained_names() -> list[str]:
    """Return the names of the policies that come with the baselines."""
    if not PRETRAINED.is_dir():
        return []
    return sorted(path.name for path in PRETRAINED.iterdir() if (path / WEIGHTS_FILE).is_file())


def find_weights(path: object) -> Path:
    """Return the weights file that is meant by a pretrained policy's name, a run folder or itself.

    Raises a ValueError if there is none.
    """
    names = pretrained_names()
    try:
        place = PRETRAINED / path if path in names else Path(path)  # type: ignore
        file = place / WEIGHTS_FILE if place.is_dir() else place
        found = file.exists()
    except (TypeError, OSError):  # no path at all, or one that the system does not take
        found = False
    if not found:
        raise ValueError(
            f"path must be a run folder or a weights file{', or one of ' if names else ''}"
            f"{', '.join(names)}, got {reprlib.repr(path)}"
        )
    return file


def read_header(content: bytes) -> tuple[NetworkSpec, Grid | None]:
    """Read from the header of a safetensors file which network and grid its weights are for.

    Raises a ValueError or TypeError if the header is damaged, has an entry twice, or is not one of
    ours.
    """
    if content.startswith(ZIP):
        raise ValueError(
            "foreign weights: this is a zip file, as Stable-Baselines3 and torch.save "
            "write; a policy must be a safetensors file that a training of the baselines wrote"
        )
    length = struct.unpack("<Q", content[:8])[0] if len(content) >= 8 else 0
    if not 2 <= length <= min(MAX_HEADER_BYTES, len(content) - 8):
        raise ValueError("damaged weights: this is not a safetensors file")
    entries = parse_json(content[8 : 8 + length], "the header", ValueError)
    metadata = entries.get("__metadata__") if isinstance(entries, dict) else None
    text = metadata.get(WEIGHTS_KEY) if isinstance(metadata, dict) else None
    if not isinstance(text, str):
        raise ValueError(f"foreign weights: the header has no {WEIGHTS_KEY!r}")
    about = parse_json(text, WEIGHTS_KEY, ValueError)
    version = about.pop("version", None) if isinstance(about, dict) else None
    if type(version) is int and version == 1:  # True and 1.0 equal 1
        raise ValueError(
            f"the weights do not say which grid they are for: {WEIGHTS_KEY} is of version 1, as "
            f"written before 'grid' was part of it; train again (version {WEIGHTS_VERSION})"
        )
    if type(version) is not int or version != WEIGHTS_VERSION:
        raise ValueError(f"foreign weights: {WEIGHTS_KEY} is not of version {WEIGHTS_VERSION}")
    if about.keys() != {"grid", "network"} or not isinstance(about["network"], dict):
        raise ValueError(f"damaged weights: {WEIGHTS_KEY} must have 'grid' and 'network' alone")
    spec = network_spec(**about["network"])
    grid = None if about["grid"] == ANY_GRID else Grid.from_text(about["grid"])
    spec.check_grid(grid)
    return spec, grid

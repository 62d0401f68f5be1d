"""Policies: who commands the agents. Trained networks from files, and three rivals without any.

A policy has one method, ``act(observations) -> actions``: global observations (B, N + 2K) to
joint actions (B, N).
"""

import json
import os
import reprlib
import struct
from pathlib import Path

import numpy as np
import safetensors.torch
import torch

from baselines.networks import Network, NetworkSpec, build_network, greedy_actions
from baselines.policies.acting import check_observations, check_rows
from baselines.policies.settings import read_grid
from baselines.runs.folder import CONFIG_FILE, WEIGHTS_FILE
from mapp_env import Grid
from mapp_env.files import parse_json, read_bytes, write_bytes
from mapp_env.grid import MAX_ALL_PAIRS_CELLS
from mapp_env.solvers.earliest_arrival import assign_landmarks
from mapp_env.validation import check_count

WEIGHTS_KEY = "mapp_env_policy"  # the one metadata entry of our safetensors files
WEIGHTS_VERSION = 1
# The largest network that NetworkSpec allows takes 74 MiB.
MAX_WEIGHTS_BYTES = 80 * 1024 * 1024
MAX_HEADER_BYTES = 1024 * 1024
ZIP = b"PK\x03\x04"  # how such a file begins
PRETRAINED = Path(__file__).parents[1] / "pretrained"  # a folder for each name, like a run's


class NetworkPolicy:
    """Greedy commands of a network: the joint action, or each agent's, of the highest value.

    Parameters
    ----------
    network
        Gives the values.
    grid
        The grid it was trained on, or an error that says why that is not known; by default the
        policy plays on any.
    """

    def __init__(self, network: Network, grid: Grid | ValueError | None = None) -> None:
        self.network = network
        self.spec = network.spec
        self._grid = grid

    @property
    def grid(self) -> Grid | None:
        """The grid it was trained on; None if it plays on any.

        Raises
        ------
        ValueError
            If that is not known.
        """
        if isinstance(self._grid, ValueError):
            raise ValueError(str(self._grid))
        return self._grid

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
        with torch.inference_mode():
            return greedy_actions(self.network(torch.from_numpy(checked)), spec)


class RandomPolicy:
    """Every agent takes each action with the same probability."""

    def __init__(self, n_agents: int, n_actions: int, rng: np.random.Generator) -> None:
        self.n_agents, self.n_actions, self.rng = n_agents, n_actions, rng

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return joint actions (B, N), whatever is seen.

        Raises
        ------
        ValueError
            If the observations are not rows of numbers.
        """
        n_rows = len(check_rows(observations))
        return self.rng.integers(self.n_actions, size=(n_rows, self.n_agents))


class NearestLandmarkPolicy:
    """Every agent walks a shortest path to the unvisited landmark nearest to it.

    Of equally near landmarks the one given first counts, of equally good moves the first action.
    Nobody coordinates: agents that stand together walk together.
    """

    def __init__(self, grid: Grid, n_agents: int, n_landmarks: int) -> None:
        # The table of first moves has one entry per pair of cells.
        check_count("n_cells", grid.n_cells, 2, MAX_ALL_PAIRS_CELLS)
        self.grid, self.n_agents, self.n_landmarks = grid, n_agents, n_landmarks
        distances = np.asarray(grid.distances)  # (C, C), -1 unreachable
        self.distances = np.where(distances < 0, np.iinfo(np.int32).max, distances)
        after = self.distances[np.asarray(grid.moves)]  # (C, 4, C)
        self.first_moves = after.argmin(axis=1)  # (C, C): the action that comes nearest

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return joint actions (B, N).

        Raises
        ------
        ValueError
            If the observations have another shape or hold numbers that are no cells or flags.
        """
        n, k = self.n_agents, self.n_landmarks
        observations = check_observations(observations, n, k, len(self.distances))
        cells = observations[:, :n].astype(np.int64)
        landmarks = observations[:, n : n + k].astype(np.int64)
        actions: np.ndarray = self.first_moves[
            cells, self.choose(cells, landmarks, observations[:, n + k :] < 0.5)
        ]
        return actions

    def choose(self, cells: np.ndarray, landmarks: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return the cell that each agent goes to, (B, N), by which landmarks are left, (B, K)."""
        steps = self.distances[cells[:, :, None], landmarks[:, None, :]].astype(np.int64)
        steps[np.broadcast_to(~left[:, None, :], steps.shape)] = np.iinfo(np.int64).max
        chosen: np.ndarray = np.take_along_axis(landmarks, steps.argmin(axis=-1), axis=1)
        return chosen


class EarliestArrivalPolicy(NearestLandmarkPolicy):
    """Of all agents and landmarks the pair that can meet first is settled first, then the next.

    Each agent walks to the first landmark that falls to it, and stays, or steps to and fro, if none
    does. Asked again at every step, it carries out the plan that it would have made at the start.
    """

    def choose(self, cells: np.ndarray, landmarks: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return the cell that each agent goes to, (B, N), by which landmarks are left, (B, K)."""
        who, when = assign_landmarks(self.distances, cells, landmarks, left)
        own = who[:, None, :] == np.arange(self.n_agents)[:, None]  # (B, N, K)
        first = np.where(own, when[:, None, :], np.iinfo(np.int64).max).argmin(axis=-1)
        chosen = np.take_along_axis(landmarks, first, axis=1)
        return np.where(own.any(axis=-1), chosen, cells)


def save_policy(path: Path, network: Network, half_precision: bool = False) -> None:
    """Write a network's weights and its spec to a safetensors file, in one piece.

    With `half_precision` in 16 bits each, rounded: half the size, and nearly the same values.
    Tensors with values that 16 bits have no room for keep theirs.
    """
    # One metadata entry only: safetensors writes several in no fixed order.
    about = json.dumps({"version": WEIGHTS_VERSION, **network.spec.as_dict()}, sort_keys=True)
    tensors = {name: t.detach().contiguous() for name, t in network.state_dict().items()}
    if half_precision:
        most = torch.finfo(torch.float16).max
        tensors = {k: t.half() if t.abs().max() <= most else t for k, t in tensors.items()}
    write_bytes(path, safetensors.torch.save(tensors, {WEIGHTS_KEY: about}), MAX_WEIGHTS_BYTES)


def load_policy(path: str | os.PathLike[str]) -> NetworkPolicy:
    """Load a trained policy.

    Parameters
    ----------
    path
        The name of a pretrained policy, a run folder, or a weights file.

    Returns
    -------
    NetworkPolicy
        Acts greedily: ``.act(observations (B, N + 2K)) -> actions (B, N)``, on ``.grid``, which
        the config.json beside the weights names; without one the policy acts, but is refused
        where a grid is known.

    Raises
    ------
    ValueError
        If there is no such file, or it is damaged, was written by something else, or its weights
        have other names, shapes or dtypes than its network, or are not finite. No code is run
        from the file.
    """
    file = find_weights(path)
    content = read_bytes(file, MAX_WEIGHTS_BYTES, "a weights file", ValueError)
    spec = read_spec(file, content)
    try:
        weights = safetensors.torch.load(content)
    except Exception as error:  # safetensors raises its own error type, a plain Exception
        raise ValueError(f"{file}: damaged weights: {error}") from error

    network = build_network(spec)
    expected = network.state_dict()
    if weights.keys() != expected.keys():
        missing, extra = expected.keys() - weights.keys(), weights.keys() - expected.keys()
        raise ValueError(
            f"{file}: other weights than a {spec.kind!r} network has: "
            f"missing {sorted(missing)}, unknown {sorted(extra)}"
        )
    for name, wanted in expected.items():
        found = weights[name]
        if found.shape != wanted.shape or found.dtype not in (wanted.dtype, torch.float16):
            raise ValueError(
                f"{file}: {name}: got {found.dtype} of shape {tuple(found.shape)}, expected "
                f"{wanted.dtype} or {torch.float16} of shape {tuple(wanted.shape)}"
            )
        if not torch.isfinite(found).all():
            raise ValueError(f"{file}: {name}: holds NaN or infinite weights")
    network.load_state_dict(weights)
    return NetworkPolicy(network.eval(), find_grid(file, spec))


def find_grid(file: Path, spec: NetworkSpec) -> Grid | ValueError:
    """Return the grid that weights were trained on, or why it is not known."""
    try:
        grid = read_grid(file.parent)
        if grid.n_cells != spec.n_cells:
            raise ValueError(f"its grid has {grid.n_cells} cells, the weights have {spec.n_cells}")
    except ValueError as error:
        return ValueError(
            f"{file}: the grid that these weights were trained on is not known: put the "
            f"{CONFIG_FILE} of their run beside them ({error})"
        )
    return grid


def pretrained_names() -> list[str]:
    """Return the names of the policies that come with the baselines."""
    if not PRETRAINED.is_dir():
        return []
    return sorted(path.name for path in PRETRAINED.iterdir() if (path / WEIGHTS_FILE).is_file())


def find_weights(path: object) -> Path:
    """Return the weights file that is meant by a pretrained policy's name, a run folder or itself.

    Raises
    ------
    ValueError
        If there is none.
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


def read_spec(file: Path, content: bytes) -> NetworkSpec:
    """Read which network the weights in a safetensors file belong to, from its header.

    Raises
    ------
    ValueError
        If the header is damaged, has an entry twice, or is not one of ours.
    """
    if content.startswith(ZIP):
        raise ValueError(
            f"{file}: foreign weights: this is a zip file, as Stable-Baselines3 and torch.save "
            "write; a policy must be a safetensors file that a training of the baselines wrote"
        )
    length = struct.unpack("<Q", content[:8])[0] if len(content) >= 8 else 0
    if not 2 <= length <= min(MAX_HEADER_BYTES, len(content) - 8):
        raise ValueError(f"{file}: damaged weights: this is not a safetensors file")
    try:
        header = parse_json(content[8 : 8 + length], "the header", ValueError)
        metadata = header.get("__metadata__") if isinstance(header, dict) else None
        text = metadata.get(WEIGHTS_KEY) if isinstance(metadata, dict) else None
        if not isinstance(text, str):
            raise ValueError(f"foreign weights: the header has no {WEIGHTS_KEY!r}")
        about = parse_json(text, WEIGHTS_KEY, ValueError)
        version = about.pop("version", None) if isinstance(about, dict) else None
        if type(version) is not int or version != WEIGHTS_VERSION:  # True and 1.0 equal 1
            raise ValueError(f"foreign weights: {WEIGHTS_KEY} is not of version {WEIGHTS_VERSION}")
        return NetworkSpec(**about)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from error

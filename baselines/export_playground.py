"""Write a trained policy's weights for the page in docs/playground.

Command::

    python baselines/export_playground.py                       # of the policy `pretrained`
    python baselines/export_playground.py --policy runs/mine --out docs/playground/weights.js
    python baselines/export_playground.py --rounding            # three minutes

Output: a script of one assignment, so that the page can be opened as a file. It holds the network's
spec, the grid, the name and checksum of the source and the weights: 16-bit floats, little-endian,
in base64. Of tables that have a row for every pair of cells only those rows are written that an
episode can look up. The same policy gives the same bytes. With ``--rounding`` nothing is written:
it is counted on how many of all problems the weights' rounding changes the greedy episode.
"""

import base64
import hashlib
import itertools
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from baselines.networks import NetworkSpec
from baselines.policies.evaluation import evaluate, every_problem
from baselines.policies.policy import find_weights, load_policy
from baselines.policies.settings import PolicyOfRun, Setting, load_run
from mapp_env import Grid, make_grid
from mapp_env.files import write_bytes
from mapp_env.grid import tell_apart

PLAYGROUND = Path(__file__).resolve().parents[1] / "docs" / "playground"
COMMAND = "python baselines/export_playground.py"
MAX_SCRIPT_BYTES = 64 << 20


@dataclass
class Args:
    """Options of an export."""

    policy: str = "pretrained"
    """a pretrained policy's name or a run folder"""
    out: Path | None = None
    """the script to write (docs/playground/weights.js)"""
    rounding: bool = False
    """count the episodes that rounding changes, and write nothing"""

    def __post_init__(self) -> None:
        if self.rounding and self.out is not None:
            raise ValueError("out has no effect with rounding: leave it out")


def export(policy: str) -> str:
    """Return the script that holds a policy's weights.

    Raises a ValueError if there is no such policy, or the page cannot run it: it is of another
    setting or kind, or has weights that 16 bits have no room for.
    """
    run = load_run(policy)
    check_runs(policy, run)
    file, (network, setting) = find_weights(policy), (run.policy.network, run.setting)
    rows = kept_rows(network.spec, setting.grid)
    tensors = {}
    for name, tensor in sorted(network.state_dict().items()):
        if tensor.abs().max() > torch.finfo(torch.float16).max:
            raise ValueError(f"policy {policy!r}: {name} holds more than 16 bits have room for")
        values = tensor.numpy()
        table = name.removesuffix(".weight")
        values = (values[rows[table]] if table in rows else values).astype("<f2")
        data = base64.b64encode(values.tobytes()).decode()
        tensors[name] = {"shape": list(values.shape), "data": data}
    about = {
        "name": file.parent.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "grid": setting.grid.to_text(),
        "max_cycles": setting.max_cycles,
        "spec": network.spec.as_dict(),
        "tensors": tensors,
    }
    fields = ",\n".join(f"{json.dumps(name)}: {_lines(about[name])}" for name in about)
    return (
        f"// Made by `{COMMAND}`, do not edit.\n"
        f'"use strict";\n\n(window.mapp = window.mapp || {{}}).policy = {{\n{fields}\n}};\n'
    )


def _lines(value: object) -> str:
    """Return JSON with a line for each tensor."""
    if not isinstance(value, dict) or not all(isinstance(item, dict) for item in value.values()):
        return json.dumps(value)
    entries = ",\n".join(f"{json.dumps(name)}: {json.dumps(item)}" for name, item in value.items())
    return f"{{\n{entries}\n}}"


def check_runs(policy: str, run: PolicyOfRun) -> None:
    """Raise a ValueError for another task than the page shows, or a network it has no code for."""
    shown = Setting(make_grid())
    if run.setting.grid != shown.grid:
        raise ValueError(
            f"policy {policy!r} is of another grid than the page's, paper-7x7: "
            f"{tell_apart(shown.grid, run.setting.grid)}"
        )
    for name in ("n_agents", "n_landmarks", "max_cycles"):
        found, wanted = getattr(run.setting, name), getattr(shown, name)
        if found != wanted:
            raise ValueError(f"policy {policy!r} has {name}={found}, the page {wanted}")
    for name, wanted in {"kind": "pairs", "outputs": "joint", "team": "one"}.items():
        found = getattr(run.policy.spec, name)
        if found != wanted:
            raise ValueError(
                f"policy {policy!r} has a network with {name}={found!r}, the page runs {wanted!r}"
            )


def kept_rows(spec: NetworkSpec, grid: Grid) -> dict[str, np.ndarray]:
    """Return for each big table the rows that an episode can look up, in the order of the file.

    Landmarks are free cells but the depot; agents stand on these or on the depot, and never on an
    unvisited landmark. The page lists the rows in the same way (``keptRows`` in network.js), and
    :mod:`baselines.networks.pairs` numbers them.
    """
    c = spec.n_cells
    landmarks = grid.reachable.tolist()
    cells = sorted([*landmarks, grid.depot])
    places = [*landmarks, c]
    pairs = [cell * (c + 2) + place for cell in cells for place in places if place != cell]
    slots = [slot * c * (c + 2) for slot in range(spec.n_agents)]
    n_two = c * (c - 1) // 2
    routes = [
        cell * n_two + high * (high - 1) // 2 + low
        for cell in cells
        for high, low in itertools.product(landmarks, repeat=2)
        if low < high and cell not in (low, high)
    ]
    rows = {
        "pairs": [*pairs, *(cell * (c + 2) + c + 1 for cell in cells)],
        "unvisited": places,
        "crossed": [slot + row for slot in slots for row in pairs],
        "between": [one * (c + 1) + other for one, other in itertools.product(places, repeat=2)],
        "routes": [*routes, c * n_two],
    }
    return {name: np.array(numbers) for name, numbers in rows.items()}


def count_changed(policy: str) -> tuple[int, int, int]:
    """Return how many problems there are, and on how many rounding changes actions, or steps."""
    exact, setting, _ = load_run(policy)
    rounded = load_policy(policy)
    with torch.no_grad():
        for tensor in rounded.network.parameters():
            tensor.copy_(tensor.half().float())
    problems = every_problem(setting)
    changed = other_steps = 0
    for landmarks in np.array_split(problems, -(-len(problems) // 65_536)):
        one, other = (
            evaluate(policy, setting, landmarks, n_kept=len(landmarks))
            for policy in (exact, rounded)
        )
        steps = (one.steps != other.steps) | (one.success != other.success)
        # Actions after the end are kept as 0, whatever the policy.
        changed += int((steps | (one.actions != other.actions).any(axis=(0, 2))).sum())
        other_steps += int(steps.sum())
    return len(problems), changed, other_steps


def main(args: Args) -> None:
    """Write the script, or count what rounding changes."""
    if args.rounding:
        torch.set_num_threads(1)
        total, changed, steps = count_changed(args.policy)
        print(
            f"of {total:,} greedy episodes {changed:,} change, {steps:,} in their steps or success"
        )
        return
    script = export(args.policy).encode()
    out = args.out or PLAYGROUND / "weights.js"
    write_bytes(out, script, MAX_SCRIPT_BYTES)
    print(f"{out}: {len(script) / 1e6:.2f} MB")


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")

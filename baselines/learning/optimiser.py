"""Adam's memory as plain arrays, for checkpoints."""

import numpy as np
import torch


def optimiser_arrays(optimiser: torch.optim.Optimizer) -> dict[str, np.ndarray]:
    """Return what an optimiser remembers of each weight: none before its first step."""
    state = optimiser.state_dict()["state"]
    return {
        f"{index}.{name}": np.asarray(value)
        for index, memory in state.items()
        for name, value in memory.items()
    }


def restore_optimiser(
    optimiser: torch.optim.Optimizer, arrays: dict[str, np.ndarray], steps: int
) -> None:
    """Take over what :func:`optimiser_arrays` returned after a number of steps.

    Raises
    ------
    ValueError
        If it is not there of each weight, and of no other, or after another number of steps.
    """
    weights = [weight for group in optimiser.param_groups for weight in group["params"]]
    wanted = {}
    for index, weight in enumerate(weights):
        if not steps or not weight.requires_grad:
            continue
        shapes = {"step": (), "exp_avg": tuple(weight.shape), "exp_avg_sq": tuple(weight.shape)}
        wanted |= {f"{index}.{name}": shape for name, shape in shapes.items()}
    found = {name: array.shape for name, array in arrays.items()}
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            raise ValueError(
                f"optimiser.{name} must have the shape {wanted.get(name)}, got {found.get(name)}"
            )
        # A count in 32 bits ends there.
        if name.endswith(".step") and arrays[name] != min(steps, 2**24):
            raise ValueError(f"optimiser.{name} must be {steps}, got {arrays[name]}")
    content = optimiser.state_dict()
    content["state"] = {}
    for key, array in arrays.items():
        index, name = key.split(".")
        content["state"].setdefault(int(index), {})[name] = torch.from_numpy(array.copy())
    optimiser.load_state_dict(content)

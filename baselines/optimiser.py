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


def restore_optimiser(optimiser: torch.optim.Optimizer, arrays: dict[str, np.ndarray]) -> None:
    """Take over what :func:`optimiser_arrays` returned."""
    content = optimiser.state_dict()
    content["state"] = {}
    for key, array in arrays.items():
        index, name = key.split(".")
        content["state"].setdefault(int(index), {})[name] = torch.from_numpy(array.copy())
    optimiser.load_state_dict(content)

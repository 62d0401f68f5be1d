"""Adam's memory as plain arrays, for checkpoints."""

import numpy as np
import torch

from baselines.runs.checkpoints import take


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

    Raises a ValueError if it is not there of each weight, or after another number of steps.
    """
    content = optimiser.state_dict()
    content["state"] = {}
    weights = [weight for group in optimiser.param_groups for weight in group["params"]]
    for index, weight in enumerate(weights):
        if not steps or not weight.requires_grad:
            continue
        step = take(arrays, f"{index}.step", np.array(steps, np.float32))
        if step != min(steps, 2**24):  # a count in 32 bits ends there
            raise ValueError(f"optimiser.{index}.step must be {steps}, got {step}")
        memory = {"step": step}
        for name in ("exp_avg", "exp_avg_sq"):
            memory[name] = take(arrays, f"{index}.{name}", weight.detach().numpy())
        content["state"][index] = {k: torch.from_numpy(array) for k, array in memory.items()}
    optimiser.load_state_dict(content)

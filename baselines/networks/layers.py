"""Layers that networks are made of, with initial weights from a generator of their own."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from baselines.networks.base import NetworkSpec
from mapp_env.compiled import nogil_kernel


def linear(n_in: int, n_out: int, generator: torch.Generator | None) -> nn.Linear:
    """Build a linear layer with PyTorch's usual initial weights, drawn from `generator`.

    ``nn.Linear`` would draw them from the global generator, which is not ours to move.
    """
    device = torch.get_default_device()
    layer: nn.Linear = nn.utils.skip_init(nn.Linear, n_in, n_out, device=device)  # type: ignore
    bound = 1.0 / math.sqrt(n_in)
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.uniform_(layer.bias, -bound, bound, generator=generator)
    return layer


class Head(nn.Module):
    """The last layer: hidden units to action values."""

    def __init__(self, spec: NetworkSpec, generator: torch.Generator | None) -> None:
        super().__init__()
        self.shape = spec.head_shape
        self.advantages = linear(spec.hidden_units, math.prod(self.shape), generator)
        n_values = self.shape[0] if len(self.shape) == 2 else 1
        self.value = linear(spec.hidden_units, n_values, generator) if spec.dueling else None

    def forward(self, hidden: Tensor) -> Tensor:
        """Return values (B, A ** N) or (B, N, A)."""
        scores: Tensor = self.advantages(hidden).view(-1, *self.shape)
        if self.value is None:
            return scores
        base = self.value(hidden)
        base = base[..., None] if len(self.shape) == 2 else base
        return base + scores - scores.mean(-1, keepdim=True)


class EmbeddingBag(nn.Module):
    """A table of learned vectors that are looked up and summed: ``nn.EmbeddingBag``, mode "sum"."""

    def __init__(
        self, n_vectors: int, n_units: int, std: float, generator: torch.Generator | None
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(n_vectors, n_units))
        nn.init.normal_(self.weight, std=std, generator=generator)

    def forward(self, indices: Tensor) -> Tensor:
        """Return sums (B, units) of the vectors of each bag (B, n) int64."""
        if self.weight.is_cpu:
            total: Tensor = SumRowsOnCPU.apply(self.weight, indices)  # type: ignore
            return total
        return nn.functional.embedding_bag(indices, self.weight, mode="sum")


class SumRowsOnCPU(torch.autograd.Function):
    """The sums, with a compiled loop for their gradients.

    On a CPU PyTorch's own sorts the indices first, which takes longer than the sums themselves.
    """

    @staticmethod
    def forward(ctx: Any, table: Tensor, indices: Tensor) -> Tensor:
        """Return the sums."""
        ctx.save_for_backward(indices)
        ctx.shape = table.shape
        return nn.functional.embedding_bag(indices, table, mode="sum")

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        """Return the gradient of the table."""
        (indices,) = ctx.saved_tensors
        table = np.zeros(ctx.shape, np.float32)
        add_to_rows(table, indices.numpy(), gradients[0].contiguous().numpy())
        return torch.from_numpy(table), None


@nogil_kernel
def add_to_rows(table, indices, values):  # type: ignore[no-untyped-def]
    """Add values (B, units) to each of the table's rows (B, n) that they came from."""
    n_units = table.shape[1]
    for bag in range(indices.shape[0]):
        for place in range(indices.shape[1]):
            row = indices[bag, place]
            for unit in range(n_units):
                table[row, unit] += values[bag, unit]


def encode(
    encoder: Callable[..., tuple[np.ndarray, ...]], observations: Tensor, *args: Any
) -> list[Tensor]:
    """Return what a compiled encoder makes of observations, on their device.

    What a network is given in place of numbers of cells, rows of its tables or distances, is
    computed by loops on the CPU, before the network and wherever that is.
    """
    if observations.is_cpu:
        return [torch.from_numpy(array) for array in encoder(observations.numpy(), *args)]
    encoded = encoder(observations.cpu().numpy(), *args)
    return [torch.from_numpy(array).to(observations.device) for array in encoded]

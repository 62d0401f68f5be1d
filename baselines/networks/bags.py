"""Sums of learned vectors: what an agent's or a landmark's description is made of.

``nn.EmbeddingBag`` in mode "sum", with a compiled loop for its backward pass: on a CPU PyTorch's
sorts the indices first, which takes longer than the sums themselves.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from mapp_env.compiled import nogil_kernel


class Bag(nn.Module):
    """A table of learned vectors that are looked up and summed."""

    def __init__(
        self, n_vectors: int, n_units: int, std: float, generator: torch.Generator | None
    ) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(n_vectors, n_units))
        nn.init.normal_(self.weight, std=std, generator=generator)

    def forward(self, indices: Tensor) -> Tensor:
        """Return sums (B, units) of the vectors of each bag (B, n) int64."""
        total: Tensor = SumRows.apply(self.weight, indices)  # type: ignore[no-untyped-call]
        return total


class SumRows(torch.autograd.Function):
    """Sums of a table's rows, and of their gradients."""

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

"""Entries of batches picked, thinned out, summed by group and put in an order."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

BITS = 16  # of each coordinate in a Morton code


def pick(value: Any, index: Any, batch: Sequence[int], event_dims: int = 0) -> Any:
    """`value` (*batch, *event) indexed as if it had its batch dimensions alone; they may still need broadcasting.

    What is not a tensor, or has no batch dimension, belongs to every element and is returned as it is.
    """
    if not isinstance(value, Tensor) or value.dim() == event_dims:
        return value
    parts = index if isinstance(index, tuple) else (index,)
    if any(part is Ellipsis for part in parts):
        parts = (*parts, *(slice(None) for _ in range(event_dims)))
    event = value.shape[value.dim() - event_dims :]
    return value.expand(*batch, *event)[parts]


def thin(rows: Shaped[Tensor, "n *row"], count: int) -> Shaped[Tensor, "m *row"]:
    """`count` of the rows, spread evenly, or all where there are fewer."""
    if len(rows) <= count:
        return rows
    return rows[torch.linspace(0, len(rows) - 1, count, dtype=torch.float64, device=rows.device).round().long()]


def segment_sum(
    values: Shaped[Tensor, "n *row"], segment: Int[Tensor, " n"], num_segments: int
) -> Shaped[Tensor, "{num_segments} *row"]:
    """Sum the rows of `values` that carry the same id in `segment`."""
    total = values.new_zeros(num_segments, *values.shape[1:])
    return total.index_add_(0, segment, values)


def segment_sum_columns(
    values: Shaped[Tensor, "k n"], segment: Int[Tensor, " n"], num_segments: int
) -> Shaped[Tensor, "k {num_segments}"]:
    """Sum the columns of `values` that carry the same id in `segment`. Where k is small this is much faster on a CPU
    than sums of rows of the transpose."""
    return values.new_zeros(len(values), num_segments).index_add_(1, segment, values)


def columns_at(table: Shaped[Tensor, "k m"], index: Int[Tensor, " n"]) -> Shaped[Tensor, "k n"]:
    """The columns `index` of a table. Where k is small this is several times as fast on a CPU as `index_select`."""
    return table.gather(1, index.expand(len(table), -1))


def morton_code(points: Float[Tensor, "n 3"]) -> Int[Tensor, " n"]:
    """Morton (Z-order) codes of points in their bounding cube: points with near codes are near each other."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.long, device=points.device)
    finite = torch.where(points.isfinite(), points, 0.0)
    low = finite.amin(dim=0)
    side = (finite.amax(dim=0) - low).amax().clamp(min=torch.finfo(points.dtype).tiny)
    grid = ((finite - low) / side * (2**BITS - 1)).long()
    code = torch.zeros_like(grid[:, 0])
    for bit in range(BITS):
        for axis in range(3):
            code |= ((grid[:, axis] >> bit) & 1) << (3 * bit + axis)
    return code

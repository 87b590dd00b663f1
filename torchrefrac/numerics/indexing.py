"""Indexing of batches whose elements have dimensions of their own."""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Shaped
from torch import Tensor


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

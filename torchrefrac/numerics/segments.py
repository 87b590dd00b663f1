"""Sums over groups of rows."""

from jaxtyping import Int, Shaped
from torch import Tensor


def segment_sum(
    values: Shaped[Tensor, "n *row"], segment: Int[Tensor, " n"], num_segments: int
) -> Shaped[Tensor, "{num_segments} *row"]:
    """Sum the rows of `values` that carry the same id in `segment`."""
    total = values.new_zeros(num_segments, *values.shape[1:])
    return total.index_add_(0, segment, values)


def segment_sum_columns(
    values: Shaped[Tensor, "k n"], segment: Int[Tensor, " n"], num_segments: int
) -> Shaped[Tensor, "k {num_segments}"]:
    """Sum the columns of `values` that carry the same id in `segment`.

    Where k is small this is much faster on a CPU than sums of rows of the transpose.
    """
    return values.new_zeros(len(values), num_segments).index_add_(1, segment, values)

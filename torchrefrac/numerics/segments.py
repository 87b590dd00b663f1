"""Sums over groups of rows."""

from torch import Tensor


def segment_sum(values: Tensor, segment: Tensor, num_segments: int) -> Tensor:
    """Sum the rows of `values` (N, *F) that carry the same id in `segment` (N,): (num_segments, *F)."""
    total = values.new_zeros(num_segments, *values.shape[1:])
    return total.index_add_(0, segment, values)


def segment_sum_columns(values: Tensor, segment: Tensor, num_segments: int) -> Tensor:
    """Sum the columns of `values` (k, N) that carry the same id in `segment` (N,): (k, num_segments).

    Where k is small this is much faster on a CPU than sums of rows of the transpose.
    """
    return values.new_zeros(len(values), num_segments).index_add_(1, segment, values)

"""Batched numerical building blocks that know no geometry."""

from torchrefrac.numerics.blocks import in_blocks, in_double
from torchrefrac.numerics.devices import AUTO, CPU, detached, device_of, on_device
from torchrefrac.numerics.four import adjugate_4x4, determinant_4x4
from torchrefrac.numerics.groups import components, counted_in_runs, equal_before, first_equal, first_of_each, joined
from torchrefrac.numerics.indexing import columns_at, morton_code, pick, segment_sum, segment_sum_columns, thin
from torchrefrac.numerics.likeness import alike, like
from torchrefrac.numerics.permutation import permuted
from torchrefrac.numerics.roots import fourier_coefficients, real_roots, roots_on_circle
from torchrefrac.numerics.small import (
    determines,
    inverse_cholesky_3x3,
    inverse_cholesky_components,
    least_squares_on_circle,
    smallest_eigenvector_2x2,
)
from torchrefrac.numerics.spread import typical_deviation

__all__ = [
    "AUTO", "CPU", "adjugate_4x4", "alike", "columns_at", "components", "counted_in_runs", "detached",
    "determinant_4x4", "determines", "device_of", "equal_before", "first_equal", "first_of_each",
    "fourier_coefficients", "in_blocks", "in_double", "inverse_cholesky_3x3", "inverse_cholesky_components", "joined",
    "least_squares_on_circle", "like", "morton_code", "on_device", "permuted", "pick", "real_roots", "roots_on_circle",
    "segment_sum", "segment_sum_columns", "smallest_eigenvector_2x2", "thin", "typical_deviation",
]  # fmt: skip

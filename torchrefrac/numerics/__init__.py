"""Batched numerical building blocks that know no geometry."""

from torchrefrac.numerics.blocks import in_blocks
from torchrefrac.numerics.circle import least_squares_on_circle
from torchrefrac.numerics.four import adjugate_4x4, determinant_4x4
from torchrefrac.numerics.indexing import pick, thin
from torchrefrac.numerics.likeness import alike, like
from torchrefrac.numerics.morton import morton_code
from torchrefrac.numerics.polynomial import real_roots
from torchrefrac.numerics.precision import in_double
from torchrefrac.numerics.segments import segment_sum, segment_sum_columns
from torchrefrac.numerics.small import inverse_cholesky_3x3, inverse_cholesky_components, smallest_eigenvector_2x2
from torchrefrac.numerics.trigonometric import fourier_coefficients, roots_on_circle

__all__ = [
    "adjugate_4x4", "alike", "determinant_4x4", "fourier_coefficients", "in_blocks", "in_double",
    "inverse_cholesky_3x3", "inverse_cholesky_components", "least_squares_on_circle", "like", "morton_code", "pick",
    "real_roots", "roots_on_circle", "segment_sum", "segment_sum_columns", "smallest_eigenvector_2x2", "thin",
]  # fmt: skip

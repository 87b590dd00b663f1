"""Closed forms for batches of 2x2 and 3x3 symmetric matrices."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def inverse_cholesky_3x3(matrix: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """The lower triangular X with X A X^T = I for symmetric positive definite A.

    X is the inverse of the Cholesky factor, so A^-1 = X^T X. Pivots are raised above rounding error of
    the diagonal: a singular A gives a large but finite X.
    """
    a = matrix
    x = inverse_cholesky_components(
        (a[..., 0, 0], a[..., 1, 0], a[..., 1, 1], a[..., 2, 0], a[..., 2, 1], a[..., 2, 2])
    )
    zero = torch.zeros_like(x[0])
    rows = (x[0], zero, zero, x[1], x[2], zero, x[3], x[4], x[5])
    return torch.stack(rows, dim=-1).reshape(matrix.shape)


def inverse_cholesky_components(a: Sequence[Float[Tensor, "*batch"]]) -> tuple[Float[Tensor, "*batch"], ...]:
    """`inverse_cholesky_3x3` of matrices whose lower triangles are given as six tensors, row by row."""
    a00, a10, a11, a20, a21, a22 = a
    eps, tiny = torch.finfo(a00.dtype).eps, torch.finfo(a00.dtype).tiny
    x00 = a00.clamp(min=tiny).rsqrt()
    l10, l20 = a10 * x00, a20 * x00
    x11 = torch.maximum(a11 - l10 * l10, (eps * a11).clamp(min=tiny)).rsqrt()
    l21 = (a21 - l20 * l10) * x11
    x22 = torch.maximum(a22 - l20 * l20 - l21 * l21, (eps * a22).clamp(min=tiny)).rsqrt()
    x10 = -l10 * x00 * x11
    x21 = -l21 * x11 * x22
    x20 = -(l20 * x00 + l21 * x10) * x22
    return x00, x10, x11, x20, x21, x22


def smallest_eigenvector_2x2(matrix: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2"]:
    """Unit eigenvector of the smaller eigenvalue of symmetric matrices.

    Its angle follows from the double-angle formula, which needs no division and no case distinction;
    for a multiple of the identity any vector is right and (0, 1) is returned.
    """
    difference = matrix[..., 0, 0] - matrix[..., 1, 1]
    angle = 0.5 * torch.atan2(2.0 * matrix[..., 0, 1], difference) + 0.5 * torch.pi
    return torch.stack((angle.cos(), angle.sin()), dim=-1)

"""Closed forms for batches of 2x2 and 3x3 symmetric matrices."""

import torch
from torch import Tensor


def inverse_cholesky_3x3(matrix: Tensor) -> Tensor:
    """The lower triangular X with X A X^T = I for symmetric positive definite A (*B, 3, 3).

    X is the inverse of the Cholesky factor, so A^-1 = X^T X. Pivots are kept above rounding error of
    the diagonal: a singular A gives a large but finite X.
    """
    eps, tiny = torch.finfo(matrix.dtype).eps, torch.finfo(matrix.dtype).tiny
    floor = (eps * matrix.diagonal(dim1=-2, dim2=-1)).clamp(min=tiny)
    a00, a10, a11 = matrix[..., 0, 0], matrix[..., 1, 0], matrix[..., 1, 1]
    a20, a21, a22 = matrix[..., 2, 0], matrix[..., 2, 1], matrix[..., 2, 2]
    x00 = a00.clamp(min=tiny).rsqrt()
    l10, l20 = a10 * x00, a20 * x00
    x11 = (a11 - l10 * l10).clamp(min=floor[..., 1]).rsqrt()
    l21 = (a21 - l20 * l10) * x11
    x22 = (a22 - l20 * l20 - l21 * l21).clamp(min=floor[..., 2]).rsqrt()
    x10 = -l10 * x00 * x11
    x21 = -l21 * x11 * x22
    x20 = -(l20 * x00 + l21 * x10) * x22
    zero = torch.zeros_like(x00)
    rows = (x00, zero, zero, x10, x11, zero, x20, x21, x22)
    return torch.stack(rows, dim=-1).reshape(matrix.shape)


def smallest_eigenvector_2x2(matrix: Tensor) -> Tensor:
    """Unit eigenvector (*B, 2) of the smaller eigenvalue of symmetric matrices (*B, 2, 2).

    Its angle follows from the double-angle formula, which needs no division and no case distinction;
    for a multiple of the identity any vector is right and (0, 1) is returned.
    """
    difference = matrix[..., 0, 0] - matrix[..., 1, 1]
    angle = 0.5 * torch.atan2(2.0 * matrix[..., 0, 1], difference) + 0.5 * torch.pi
    return torch.stack((angle.cos(), angle.sin()), dim=-1)

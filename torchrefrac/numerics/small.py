"""Batches of least-squares problems in a few unknowns, and closed forms for 2x2 and 3x3 symmetric matrices."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

SECULAR_ITERATIONS = 30
ROUNDING = 64.0
"""Multiple of the machine epsilon below which a remainder counts as rounding of the column it is left of."""


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


def least_squares_on_circle(
    gram: Float[Tensor, "*batch 2 2"], rhs: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 2"]:
    """The unit vector y that minimises y^T G y - 2 g^T y, for G = `gram` and g = `rhs`.

    With G = A^T A and g = A^T b this is min |A y - b| on |y| = 1. Lagrange: (G + mu I) y = g. In the
    eigenbasis of G (values l_1 <= l_2, g = (b_1, b_2)) the secular equation sum (b_i / (l_i + mu))^2 = 1 has
    one root with mu > -l_1, and it is the global minimum. Newton on 1/|y| = 1 climbs to it monotonically in
    shift = mu + l_1 (which keeps its digits near zero) from max(|b_i| - l_i) + l_1, where one term alone reaches 1.
    If b_1 = 0 and the root is lost (the "hard case"), both signs of the remaining component are optimal and
    the positive one is returned.
    """
    values, vectors = torch.linalg.eigh(gram)
    b = (vectors.mT @ rhs[..., None])[..., 0]
    tiny = torch.finfo(gram.dtype).tiny ** 0.5
    above = values - values[..., :1]
    shift = (b.abs() - above).amax(dim=-1, keepdim=True)
    for _ in range(SECULAR_ITERATIONS):
        gap = (above + shift).clamp(min=tiny)
        y = b / gap
        norm = y.norm(dim=-1, keepdim=True).clamp(min=tiny)
        slope = (y * y / gap).sum(dim=-1, keepdim=True).clamp(min=tiny)
        shift = shift + (norm - 1.0).clamp(min=0.0) * norm * norm / slope
    y = b / (above + shift).clamp(min=tiny)
    lost = y.norm(dim=-1, keepdim=True) < 1.0 - 64.0 * torch.finfo(gram.dtype).eps
    missing = (1.0 - y[..., 1:].square()).clamp(min=0.0).sqrt()
    y = torch.where(lost, torch.cat((missing, y[..., 1:]), dim=-1), y)
    y = y / y.norm(dim=-1, keepdim=True)
    return (vectors @ y[..., None])[..., 0]


def determines(triangle: Float[Tensor, "*batch rows columns"], head: int, tail: int) -> Bool[Tensor, "*batch"]:
    """Whether R, of at least head + tail columns, fixes both groups of unknowns.

    Each of the first `head` columns must be independent of those before it, and one of the `tail` columns that follow
    must be independent of the head. Columns are compared with their own length, so that their units do not matter.
    """
    square = triangle[..., : head + tail].square()
    rest = square[..., head:, head:].sum(dim=-2)
    own = torch.cat((square[..., :head, :head].diagonal(dim1=-2, dim2=-1), rest), dim=-1)
    independent = own > (ROUNDING * torch.finfo(triangle.dtype).eps) ** 2 * square.sum(dim=-2)
    return independent[..., :head].all(dim=-1) & independent[..., head:].any(dim=-1)

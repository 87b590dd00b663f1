"""Vectors as three separate tensors, one a component: long batches then run through contiguous memory."""

from torch import Tensor

Triple = tuple[Tensor, Tensor, Tensor]


def split(vectors: Tensor) -> Triple:
    """Components of vectors (*B, 3), each (*B)."""
    x, y, z = vectors.unbind(dim=-1)
    return x, y, z


def dot(a: Triple, b: Triple) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Triple, b: Triple) -> Triple:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def minus(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def add_scaled(a: Triple, factor: Tensor, b: Triple) -> Triple:
    """a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def scaled(factor: Tensor, a: Triple) -> Triple:
    return factor * a[0], factor * a[1], factor * a[2]


def rows(matrices: Tensor) -> tuple[Triple, Triple, Triple]:
    """Rows of matrices (*B, 3, 3), each a triple of (*B)."""
    first, second, third = matrices.unbind(dim=-2)
    return split(first), split(second), split(third)

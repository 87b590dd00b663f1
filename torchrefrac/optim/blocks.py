"""The damped reduced system block by block: what is not zero of it, where blocks meet few others."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.plan import REDUCED_SIZE, Chunk


class MatrixLayout(Protocol):
    """Where the elements of a symmetric matrix are found among `elements` numbers. position: of every reduced unknown,
    those of the border last; -1 for one that takes no part."""

    @property
    def position(self) -> Int[Tensor, " size"]: ...
    @property
    def elements(self) -> int: ...

    def address(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Int[Tensor, "*k"]:
        """Of the element of two positions, in either order; of what it has not, anything."""
        ...

    def has(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Bool[Tensor, "*k"]:
        """Whether it has the element of two positions that meet."""
        ...


@dataclass(frozen=True)
class ReducedBlocks:
    """A part of the damped reduced system. Unknowns that nothing depends on have a unit diagonal.

    row, column: the pairs of different reduced blocks of which there is a block, `between`; the row is the larger one.
    own: of each block with itself. border: the rows of all other unknowns. gradient: of the reduced system.
    """

    row: Int[Tensor, " pairs"]
    column: Int[Tensor, " pairs"]
    between: Float[Tensor, "pairs 6 6"]
    own: Float[Tensor, "blocks 6 6"]
    border: Float[Tensor, "border size"]
    gradient: Float[Tensor, " size"]

    @classmethod
    def of(cls, elimination: Elimination, pairs: Int[Tensor, "pairs 2"] | None = None) -> "ReducedBlocks":
        """Of those pairs of blocks, in the order of `NormalEquations.pairs`; by default of all that meet."""
        system, plan = elimination.system, elimination.system.plan
        m, first = plan.num_reduced, REDUCED_SIZE * plan.num_reduced
        row, column = (system.pairs if pairs is None else pairs).T
        every = torch.arange(m, device=row.device)
        code = torch.cat((row * (m + 1) + column, every * (m + 2)))
        code, order = torch.sort(code)

        def slots(codes: Int[Tensor, "*k"]) -> Int[Tensor, "*k"]:
            at = torch.searchsorted(code, codes).clamp(max=len(code) - 1)
            return torch.where(code[at] == codes, order[at], len(code))

        def of_chunk(chunk: Chunk) -> Int[Tensor, "tiles width width"]:
            return slots(plan.codes(chunk))

        by_pair, mixed, shared, gradient = elimination.products(len(code) + 1, of_chunk)
        blocks, border = by_pair.neg_().flatten(), by_pair.new_zeros(plan.size - first + 1, plan.size + 1)
        border[: plan.num_shared, :first] -= mixed.T
        border[: plan.num_shared, first : first + plan.num_shared] -= shared
        for columns, hessian, _ in system.blocks:
            one, other = columns[:, :, None], columns[:, None]
            block, beside = (torch.div(of, REDUCED_SIZE, rounding_mode="floor").clamp(max=m) for of in (one, other))
            inside = torch.maximum(one, other) < first
            slot = slots(torch.where(inside & (block >= beside), block * (m + 1) + beside, -1))
            at = slot * REDUCED_SIZE**2 + one % REDUCED_SIZE * REDUCED_SIZE + other % REDUCED_SIZE
            blocks.index_add_(0, at.flatten(), hessian.flatten())
            below = (one - first).clamp(min=-1) * (plan.size + 1) + other
            below = torch.where(one >= first, below, border.numel() - 1)
            border.view(-1).index_add_(0, below.flatten(), hessian.flatten())
        lift = torch.where(system.dead, 1.0, elimination.damping * system.diagonal)
        between, own, _ = blocks.view(-1, REDUCED_SIZE, REDUCED_SIZE).split((len(row), m, 1))
        own.diagonal(dim1=1, dim2=2).add_(lift[:first].view(m, REDUCED_SIZE))
        border = border[:-1, :-1]
        border[:, first:].diagonal().add_(lift[first:])
        return cls(row, column, between, own, border, gradient)

    @property
    def diagonal(self) -> Float[Tensor, " size"]:
        own = self.own.diagonal(dim1=1, dim2=2).flatten()
        return torch.cat((own, self.border[:, len(own) :].diagonal()))

    def times(self, x: Float[Tensor, " size"]) -> Float[Tensor, " size"]:
        """The matrix times a vector."""
        first = REDUCED_SIZE * len(self.own)
        block, rest = x[:first].view(-1, REDUCED_SIZE, 1), x[first:]
        total = self.own @ block
        total.index_add_(0, self.row, self.between @ block[self.column])
        total.index_add_(0, self.column, self.between.mT @ block[self.row])
        return torch.cat((total.flatten() + rest @ self.border[:, :first], self.border @ x))

    def laid_out(self, layout: MatrixLayout) -> Float[Tensor, " elements"]:
        """In another layout; what that has not is left out."""
        first = REDUCED_SIZE * len(self.own)
        numbers = self.own.new_zeros(layout.elements + 1)  # the last one for what is left out
        position = layout.position
        of_block, of_border = position[:first].view(-1, REDUCED_SIZE), position[first:, None]

        def put(one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"], values: Float[Tensor, "*k"]) -> None:
            there = (torch.minimum(one, other) >= 0) & layout.has(one, other)
            numbers[torch.where(there, layout.address(one, other), layout.elements)] = values

        put(of_block[self.row][:, :, None], of_block[self.column][:, None], self.between)
        put(of_block[:, :, None], of_block[:, None], self.own)
        put(of_border, position, self.border)
        return numbers[:-1]

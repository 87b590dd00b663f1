"""The numbers of the reduced matrix, or of a part of it, brought into the layout of whoever factorises it."""

from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.plan import REDUCED_SIZE, Chunk


class MatrixLayout(Protocol):
    """Where the elements of a symmetric matrix are found among `elements` numbers. position: of every reduced unknown;
    -1 for one that takes no part."""

    @property
    def position(self) -> Int[Tensor, " size"]: ...
    @property
    def elements(self) -> int: ...

    def address(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Int[Tensor, "*k"]:
        """Of the elements of two positions, in either order; only what is in the layout needs a meaning."""
        ...

    def has(self, one: Int[Tensor, "*#k"], other: Int[Tensor, "*#k"]) -> Bool[Tensor, "*k"]:
        """Whether the elements of two positions, which some observation or term depends on both of, are in it."""
        ...


def assemble(
    elimination: Elimination, layout: MatrixLayout
) -> tuple[Float[Tensor, " elements"], Float[Tensor, " size"]]:
    """The reduced matrix, undamped in the reduced unknowns, and the gradient of the reduced system."""
    system, plan = elimination.system, elimination.system.plan
    m, first, fixed = plan.num_reduced, REDUCED_SIZE * plan.num_reduced, -1
    position = torch.nn.functional.pad(layout.position, (0, 1), value=fixed)
    numbers = elimination.factor.new_zeros(layout.elements)

    def add(
        one: Int[Tensor, "*#k"],
        other: Int[Tensor, "*#k"],
        values: Float[Tensor, "*k"],
        once: bool | Bool[Tensor, "*#k"] = False,
    ) -> None:
        """once: those that come once; of others, which come in both orders, one is taken."""
        kept = ((one >= other) | once) & (torch.minimum(one, other) > fixed) & layout.has(one, other)
        at = torch.where(kept, layout.address(one, other), 0)
        numbers.index_add_(0, at.flatten(), torch.where(kept, values, 0.0).flatten())

    row, column = torch.div(plan.pairs, m + 1, rounding_mode="floor"), plan.pairs % (m + 1)
    of_block = position[:first].view(m, REDUCED_SIZE)
    there = torch.nn.functional.pad(of_block[:, 0], (0, 1), value=fixed)
    below = (row >= column) & (row < m) & layout.has(there[row], there[column])
    pairs, row, column = plan.pairs[below], row[below], column[below]

    def slots(chunk: Chunk) -> Int[Tensor, "tiles width width"]:
        codes = plan.codes(chunk)
        at = torch.searchsorted(pairs, codes).clamp(max=len(pairs) - 1)
        return torch.where(pairs[at] == codes, at, len(pairs))

    by_pair, mixed, shared, gradient = elimination.products(len(pairs) + 1, slots)
    for columns, hessian, _ in system.blocks:
        of_term = position[columns]
        add(of_term[:, :, None], of_term[:, None], hessian)
    by_block = by_pair[:-1].unflatten(1, (REDUCED_SIZE, REDUCED_SIZE))
    add(of_block[row][:, :, None], of_block[column][:, None], -by_block, (row > column)[:, None, None])
    of_shared = position[first : first + plan.num_shared]
    add(of_shared, position[:first, None], -mixed, once=True)
    add(of_shared[:, None], of_shared, -shared)
    return numbers, gradient

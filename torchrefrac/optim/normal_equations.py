"""The normal equations at one state.

With J_c the derivatives in the reduced unknowns and J_p those in the eliminated ones,

    [ B   E ] [dc]     [gc]
    [ E^T V ] [dp] = - [gp]

B is given as small dense matrices, one a reduced block and one a further term, V as 3x3 blocks; E stays factored as
rows of the Jacobian. Solving is in `elimination` and in the two solvers of the reduced system, `dense` and `iterative`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.optim.plan import CACHED, ELIMINATED_SIZE, REDUCED_SIZE, SchurPlan

NEGLIGIBLE = 1e-18
MANY_LONE = 100
"""Blocks of further unknowns, from which on it pays to look whether they are alone."""
LOWER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
Rows = Float[Tensor, "residuals row observations"]


class Blocks(NamedTuple):
    """Terms of the cost that depend on a few reduced unknowns each.

    columns: which ones; the number of reduced unknowns itself stands for one that does not vary. hessian and gradient:
    J^T J and J^T r.
    """

    columns: Int[Tensor, "terms width"]
    hessian: Float[Tensor, "terms width width"]
    gradient: Float[Tensor, "terms width"]

    @classmethod
    def of_rows(
        cls,
        columns: Int[Tensor, "terms width"],
        jacobian: Float[Tensor, "terms residuals width"],
        residual: Float[Tensor, "terms residuals"],
    ) -> "Blocks":
        """From residuals and their derivatives."""
        return cls(columns, jacobian.mT @ jacobian, (jacobian.mT @ residual[..., None])[..., 0])


@dataclass(frozen=True)
class NormalEquations:
    """rows: weighted derivatives and residuals of every observation, in the order of the plan, see `RowLayout`.
    eliminated_hessian: lower triangles. cost: of the state.

    null_space: orthonormal directions of the reduced unknowns in which the cost is flat (the gauge); undamped steps get
    no component along them, damped ones next to none (of the order of the damping).
    """

    plan: SchurPlan
    cost: Float[Tensor, ""]
    rows: Rows
    blocks: tuple[Blocks, ...]
    eliminated_hessian: Float[Tensor, "6 places"]
    eliminated_gradient: Float[Tensor, "3 places"]
    null_space: Float[Tensor, "size directions"] | None = None

    @cached_property
    def gradient(self) -> Float[Tensor, " size"]:
        """In the reduced unknowns."""
        return self._scattered([(block.columns, block.gradient) for block in self.blocks])

    @cached_property
    def diagonal(self) -> Float[Tensor, " size"]:
        """Of B."""
        return self._scattered([(b.columns, b.hessian.diagonal(dim1=1, dim2=2)) for b in self.blocks])

    @cached_property
    def eliminated_diagonal(self) -> Float[Tensor, "3 places"]:
        """Of V."""
        return torch.stack([self.eliminated_hessian[LOWER.index((i, i))] for i in range(ELIMINATED_SIZE)])

    @property
    def dead(self) -> Bool[Tensor, " size"]:
        """Mask of the unknowns that nothing depends on, but for rounding."""
        return self.diagonal <= NEGLIGIBLE

    @cached_property
    def lone_blocks(self) -> int:
        """How many blocks of ELIMINATED_SIZE there are at the end of the reduced unknowns, where they are many and no
        two of them have a term in common; none where a gauge joins all unknowns."""
        plan = self.plan
        first, count = plan.size - plan.num_extra, plan.num_extra // ELIMINATED_SIZE
        if count < MANY_LONE or self.null_space is not None:
            return 0
        for columns, _, _ in self.blocks:
            block, there = (columns - first) // ELIMINATED_SIZE, (columns >= first) & (columns < plan.size)
            lowest = torch.where(there, block, count).amin(dim=1)
            if bool((torch.where(there, block, -1) > lowest[:, None]).any()):
                return 0
        return count

    @cached_property
    def pairs(self) -> Int[Tensor, "pairs 2"]:
        """Different reduced blocks that meet in a tile or in a term, the larger first, ascending."""
        m = self.plan.num_reduced
        codes = [self.plan.pairs]
        for columns, *_ in self.blocks[1:]:  # the first are those of the observations
            block = torch.div(columns, REDUCED_SIZE, rounding_mode="floor").clamp(max=m)
            codes.append((block[:, :, None] * (m + 1) + block[:, None]).flatten())
        code = torch.unique(torch.cat(codes))
        pairs = torch.stack((torch.div(code, m + 1, rounding_mode="floor"), code % (m + 1)), dim=1)
        return pairs[(pairs[:, 0] > pairs[:, 1]) & (pairs[:, 0] < m)]

    def apply(self, x: Float[Tensor, " size"]) -> Float[Tensor, " size"]:
        """B x."""
        padded = torch.nn.functional.pad(x, (0, 1))
        return self._scattered([(b.columns, (b.hessian @ padded[b.columns][..., None])[..., 0]) for b in self.blocks])

    def dense(self) -> Float[Tensor, "size size"]:
        """B as a matrix."""
        across = self.plan.size + 1
        matrix = self.rows.new_zeros(across * across)
        for columns, hessian, _ in self.blocks:
            matrix.index_add_(0, (columns[:, :, None] * across + columns[:, None, :]).flatten(), hessian.flatten())
        return matrix.view(across, across)[:-1, :-1]

    def _scattered(
        self, parts: Sequence[tuple[Int[Tensor, "terms width"], Float[Tensor, "terms width"]]]
    ) -> Float[Tensor, " size"]:
        total = self.rows.new_zeros(self.plan.size + 1)
        for columns, values in parts:
            total.index_add_(0, columns.flatten(), values.flatten())
        return total[:-1]


def linearize(
    plan: SchurPlan,
    rows: Rows,
    cost: Float[Tensor, ""],
    terms: Sequence[Blocks] = (),
    null_space: Float[Tensor, "size directions"] | None = None,
) -> NormalEquations:
    """Normal equations of the observations `rows` and of further `terms`; see `NormalEquations`."""
    hessian, gradient = _eliminated_sums(plan, rows)
    blocks = (_reduced_blocks(plan, rows), *terms)
    return NormalEquations(plan, cost, rows, blocks, hessian, gradient, null_space)


def _eliminated_sums(plan: SchurPlan, rows: Rows) -> tuple[Float[Tensor, "6 places"], Float[Tensor, "3 places"]]:
    total = rows.new_zeros(len(LOWER) + ELIMINATED_SIZE, plan.num_places)
    for here in in_cache(rows.shape[-1]):
        *by, residual = rows[:, plan.layout.eliminated.start :, here].unbind(dim=1)
        products = [by[i] * by[j] for i, j in LOWER] + [derivative * residual for derivative in by]
        total.index_add_(1, plan.place[here], torch.stack([product.sum(dim=0) for product in products]))
    return total[: len(LOWER)], total[len(LOWER) :]


def _reduced_blocks(plan: SchurPlan, rows: Rows) -> Blocks:
    """J^T J and J^T r of each block: products of matrices with the observations of a block below each other."""
    layout, width = plan.layout, plan.layout.reduced.stop + 1
    total = rows.new_zeros(plan.num_reduced, width, width)
    table, owner, ends = plan.gram_rows
    listed = rows.new_zeros(CACHED + 1, rows.shape[0] * width)  # what fills up the table is the last row, zero
    for here, first, end in zip(in_cache(rows.shape[-1]), (0, *ends), ends, strict=False):
        part = torch.cat((rows[:, layout.reduced, here], rows[:, layout.residual, here]), dim=1)
        listed[: part.shape[-1]] = part.flatten(0, 1).T
        mine = listed.index_select(0, table[first:end].flatten()).view(end - first, -1, width)
        total.index_add_(0, owner[first:end], mine.mT @ mine)
    return Blocks(plan.columns, total[:, :-1, :-1], total[:, :-1, -1])


def in_cache(count: int, size: int = CACHED) -> list[slice]:
    """Slices of `count` elements that are worked through one after another."""
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]

"""The normal equations of a bundle adjustment at one state.

With J_c the derivatives in what is kept (cameras, shared unknowns, whatever else) and J_p those in the points,

    [ B   E ] [dc]     [gc]
    [ E^T V ] [dp] = - [gp]

B is given as small dense blocks, one a camera and one a further term; V as 3x3 blocks; E stays factored, as the rows of
the Jacobian. Solving is in `elimination` and in the two solvers of the reduced system, `dense` and `iterative`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchrefrac.optim.plan import CACHED, SchurPlan

NEGLIGIBLE = 1e-18
UPPER = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))


class Blocks(NamedTuple):
    """K terms of the cost that depend on w reduced unknowns each.

    columns (K, w): which ones; the number of reduced unknowns itself stands for one that is held. hessian (K, w, w) and
    gradient (K, w): J^T J and J^T r.
    """

    columns: Tensor
    hessian: Tensor
    gradient: Tensor

    @classmethod
    def of_rows(cls, columns: Tensor, jacobian: Tensor, residual: Tensor) -> "Blocks":
        """From residuals (K, r) and their derivatives (K, r, w)."""
        return cls(columns, jacobian.mT @ jacobian, (jacobian.mT @ residual[..., None])[..., 0])


@dataclass(frozen=True)
class NormalEquations:
    """rows (r, w + 4, N): weighted derivatives of every observation in the w unknowns of its camera and in its point,
    then its weighted residual, in the order of the plan. point_hessian (6, places): lower triangles;
    point_gradient (3, places). cost: of the state, a scalar.

    null_space (size, k): orthonormal directions of the reduced unknowns in which the cost is flat (the gauge);
    undamped steps get no component along them, damped ones next to none (of the order of the damping).
    """

    plan: SchurPlan
    cost: Tensor
    rows: Tensor
    blocks: tuple[Blocks, ...]
    point_hessian: Tensor
    point_gradient: Tensor
    null_space: Tensor | None = None

    @cached_property
    def gradient(self) -> Tensor:
        """In the reduced unknowns (size)."""
        return self._scattered([(block.columns, block.gradient) for block in self.blocks])

    @cached_property
    def diagonal(self) -> Tensor:
        """Of B (size)."""
        return self._scattered([(b.columns, b.hessian.diagonal(dim1=1, dim2=2)) for b in self.blocks])

    @property
    def dead(self) -> Tensor:
        """Mask (size) of the unknowns that nothing depends on, but for rounding."""
        return self.diagonal <= NEGLIGIBLE

    def apply(self, x: Tensor) -> Tensor:
        """B x, for x (size)."""
        padded = torch.nn.functional.pad(x, (0, 1))
        return self._scattered([(b.columns, (b.hessian @ padded[b.columns][..., None])[..., 0]) for b in self.blocks])

    def dense(self) -> Tensor:
        """B as a matrix (size, size)."""
        across = self.plan.size + 1
        matrix = self.rows.new_zeros(across * across)
        for columns, hessian, _ in self.blocks:
            matrix.index_add_(0, (columns[:, :, None] * across + columns[:, None, :]).flatten(), hessian.flatten())
        return matrix.view(across, across)[:-1, :-1]

    def _scattered(self, parts: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
        total = self.rows.new_zeros(self.plan.size + 1)
        for columns, values in parts:
            total.index_add_(0, columns.flatten(), values.flatten())
        return total[:-1]


def linearize(
    plan: SchurPlan,
    rows: Tensor,
    cost: Tensor,
    terms: Sequence[Blocks] = (),
    null_space: Tensor | None = None,
) -> NormalEquations:
    """Normal equations of the observations `rows` (r, w + 4, N) and of further `terms`; see `NormalEquations`."""
    hessian, gradient = _point_sums(plan, rows)
    blocks = (_camera_blocks(plan, rows), *terms)
    return NormalEquations(plan, cost, rows, blocks, hessian, gradient, null_space)


def _point_sums(plan: SchurPlan, rows: Tensor) -> tuple[Tensor, Tensor]:
    total = rows.new_zeros(9, plan.num_places)
    for here in in_cache(rows.shape[-1]):
        *by_point, residual = rows[:, -4:, here].unbind(dim=1)
        products = [by_point[i] * by_point[j] for i, j in UPPER] + [by * residual for by in by_point]
        total.index_add_(1, plan.point[here], torch.stack([product.sum(dim=0) for product in products]))
    return total[:6], total[6:]


def _camera_blocks(plan: SchurPlan, rows: Tensor) -> Blocks:
    """J^T J and J^T r of each camera: products of matrices with the observations of a camera below each other."""
    width = rows.shape[1] - 3
    total = rows.new_zeros(plan.num_cameras, width, width)
    table, owner, ends = plan.gram_rows
    listed = rows.new_zeros(CACHED + 1, rows.shape[0] * width)  # what fills up the table is the last row, zero
    for here, first, end in zip(in_cache(rows.shape[-1]), (0, *ends), ends, strict=False):
        part = torch.cat((rows[:, :-4, here], rows[:, -1:, here]), dim=1)
        listed[: part.shape[-1]] = part.flatten(0, 1).T
        mine = listed.index_select(0, table[first:end].flatten()).view(end - first, -1, width)
        total.index_add_(0, owner[first:end], mine.mT @ mine)
    return Blocks(plan.columns, total[:, :-1, :-1], total[:, :-1, -1])


def in_cache(count: int, size: int = CACHED) -> list[slice]:
    """Slices of `count` elements that are worked through one after another."""
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]

"""Linear least-squares problems of cameras, points and shared unknowns, and their full normal equations: an oracle."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.optim import Blocks, Elimination, Family, Linearized, NormalEquations, SchurPlan, Step, linearize


@dataclass(frozen=True)
class Term:
    """K further residuals (K, r) and their derivatives (K, r, w) in the reduced unknowns `columns` (K, w)."""

    columns: Tensor
    jacobian: Tensor
    residual: Tensor


@dataclass(frozen=True)
class Linear:
    """Observations of `point` (N) by `camera` (N): residual (N, 2), derivatives by_reduced (N, 2, w) in the unknowns of
    the camera and of its families and by_eliminated (N, 2, 3), and weight (N)."""

    camera: Tensor
    point: Tensor
    residual: Tensor
    by_reduced: Tensor
    by_eliminated: Tensor
    weight: Tensor
    num_reduced: int
    num_eliminated: int
    families: tuple[Family, ...] = ()
    num_extra: int = 0
    terms: tuple[Term, ...] = ()

    def where(self, keep: Tensor) -> "Linear":
        """The observations that `keep` picks: a mask (N), or ids in some order."""
        names = ("camera", "point", "residual", "by_reduced", "by_eliminated", "weight")
        return replace(self, **{name: getattr(self, name)[keep] for name in names})

    def in_units(self, unit: Tensor) -> "Linear":
        """Each unknown of a camera and its families, and each of a point (w + 3), in a unit of its own."""
        return replace(self, by_reduced=self.by_reduced * unit[:-3], by_eliminated=self.by_eliminated * unit[-3:])

    def plan(self, locality: Tensor | None = None) -> SchurPlan:
        return SchurPlan.create(
            self.camera, self.point, self.num_reduced, self.num_eliminated, self.families, self.num_extra, locality
        )

    def system(self, null_space: Tensor | None = None, locality: Tensor | None = None) -> NormalEquations:
        plan = self.plan(locality)
        rows = torch.cat((self.by_reduced, self.by_eliminated, self.residual[..., None]), dim=-1)
        rows = (rows * self.weight.sqrt()[:, None, None]).permute(1, 2, 0)[..., plan.order]
        blocks = [Blocks.of_rows(term.columns, term.jacobian, term.residual) for term in self.terms]
        return linearize(plan, rows.contiguous(), self.cost, blocks, null_space)

    def step(self, damping: float, null_space: Tensor | None = None) -> Step:
        return Linearized(self.system(null_space), "dense").solve(damping)

    @property
    def cost(self) -> Tensor:
        squares = [self.weight[:, None] * self.residual.square(), *(term.residual.square() for term in self.terms)]
        return 0.5 * torch.stack([square.sum() for square in squares]).sum()

    @property
    def size(self) -> int:
        """How many unknowns there are beside the points."""
        return 6 * self.num_reduced + sum(size * count for size, _, count in self.families) + self.num_extra

    def rows(self) -> tuple[Tensor, Tensor]:
        """The whole Jacobian, one observation and one term after another, and the residuals; what is kept comes first,
        then the points, and in the end a column of what is held."""
        width = self.size + 3 * self.num_eliminated + 1
        jacobian, residual = [torch.zeros(0, width, dtype=torch.float64)], [torch.zeros(0, dtype=torch.float64)]
        for k, (camera, point) in enumerate(zip(self.camera.tolist(), self.point.tolist(), strict=True)):
            columns, first = [6 * camera + i for i in range(6)], 6 * self.num_reduced
            for size, member, count in self.families:
                columns += [first + size * int(member[camera]) + i for i in range(size)]
                first += size * count
            row = torch.zeros(2, width, dtype=torch.float64)
            row[:, columns] = self.by_reduced[k]
            row[:, self.size + 3 * point : self.size + 3 * point + 3] = self.by_eliminated[k]
            jacobian.append(self.weight[k].sqrt() * row)
            residual.append(self.weight[k].sqrt() * self.residual[k])
        for term in self.terms:
            for columns, by, value in zip(term.columns.tolist(), term.jacobian, term.residual, strict=True):
                row = torch.zeros(len(value), width, dtype=torch.float64)
                row[:, [-1 if column == self.size else column for column in columns]] = by
                jacobian.append(row)
                residual.append(value)
        return torch.cat(jacobian), torch.cat(residual)

    def dense(self) -> tuple[Tensor, Tensor]:
        """Hessian and gradient of all unknowns, but for those that are held."""
        jacobian, residual = self.rows()
        return (jacobian.T @ jacobian)[:-1, :-1], (jacobian.T @ residual)[:-1]

    def dense_step(self, damping: float) -> Tensor:
        """Of all unknowns; zero for those that nothing depends on."""
        hessian, gradient = self.dense()
        alive = hessian.diagonal() > 0.0
        damped = (hessian + damping * torch.diag(hessian.diagonal()))[alive][:, alive]
        step = torch.zeros_like(gradient)
        step[alive] = torch.linalg.solve(damped, -gradient[alive])
        return step


@dataclass(frozen=True)
class DenseElimination:
    """Of the Hessian [B E; E^T V]: B, undamped, E, and the inverse of the damped V (zero for points that nobody sees);
    and the gradients in what is kept and in the points."""

    b: Tensor
    e: Tensor
    v_inverse: Tensor
    reduced_gradient: Tensor
    eliminated_gradient: Tensor

    @classmethod
    def of(cls, linear: Linear, damping: float) -> "DenseElimination":
        hessian, gradient = linear.dense()
        k = linear.size
        v = hessian[k:, k:] + damping * torch.diag(hessian.diagonal()[k:])
        alive = v.diagonal() > 0.0
        inverse = torch.zeros_like(v)
        inverse[alive.nonzero(), alive.nonzero().T] = torch.linalg.inv(v[alive][:, alive])
        return cls(hessian[:k, :k], hessian[:k, k:], inverse, gradient[:k], gradient[k:])


def flat(step: Step) -> Tensor:
    return torch.cat((step.reduced, step.eliminated.flatten()))


def at_places(elimination: Elimination, by_eliminated: Tensor) -> Tensor:
    """(3 n) of all points one after another, as (3, places)."""
    plan = elimination.system.plan
    result = by_eliminated.new_zeros(3, plan.num_places)
    result[:, plan.place_of] = by_eliminated.view(-1, 3).T
    return result


def of_eliminated(elimination: Elimination, at: Tensor) -> Tensor:
    """(3, places) as (3 n) of all points one after another."""
    return at[:, elimination.system.plan.place_of].T.flatten()


def with_gauge(linear: Linear, draw) -> tuple[Linear, Tensor]:
    """The same observations made blind to four random directions, and an orthonormal basis (size, 4) of these."""
    kept, points = draw.normal(linear.size, 4), draw.normal(linear.num_eliminated, 3, 4)
    local = torch.cat((kept[linear.plan().columns[linear.camera]], points[linear.point]), dim=1)
    basis = torch.linalg.qr(local).Q
    rows = torch.cat((linear.by_reduced, linear.by_eliminated), dim=-1)
    rows = rows - (rows @ basis) @ basis.mT
    return replace(linear, by_reduced=rows[..., :-3], by_eliminated=rows[..., -3:]), torch.linalg.qr(kept).Q

"""The inverse of the Gauss-Newton matrix as an operator, factorised once."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.optim.dense import prepare
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.normal_equations import NEGLIGIBLE, NormalEquations

ROUNDING = 0.1  # of a zero eigenvalue, in units of the size of the matrix and the precision


class SingularError(TorchrefracError, ArithmeticError):
    """The normal equations do not determine their unknowns."""


@dataclass(frozen=True)
class GaussNewtonInverse:
    """Of all unknowns: the reduced ones (size), then the points (n, 3), flattened. Symmetric.

    Directions of the null space are as stiff as `gauge_times` says; unknowns that nothing depends on stand still.
    """

    elimination: Elimination
    factor: Tensor
    scale: Tensor
    stiffness: Tensor
    dead: Tensor

    @classmethod
    def of(cls, system: NormalEquations) -> "GaussNewtonInverse":
        """Factorise undamped. Raises SingularError where the system is singular beyond its null space."""
        if system.null_space is not None:  # as the unknowns that something depends on see it
            moving = torch.where(system.dead[:, None], 0.0, system.null_space)
            system = replace(system, null_space=torch.linalg.qr(moving).Q)
        elimination = Elimination(system, 0.0)
        matrix, _ = elimination.reduced()
        scale, stiffness = prepare(matrix, system)
        factor, info = torch.linalg.cholesky_ex(matrix)
        if int(info) or _smallest_eigenvalue(factor) < ROUNDING * len(factor) * torch.finfo(factor.dtype).eps:
            raise SingularError("the normal equations are singular")
        return cls(elimination, factor, scale, stiffness, system.dead)

    def __call__(self, vector: Tensor) -> Tensor:
        """The inverse times a vector (size + 3 n)."""
        plan = self.elimination.system.plan
        right, by_point = torch.where(self.dead, 0.0, vector[: plan.size]), vector[plan.size :].view(-1, 3)
        points = vector.new_zeros(3, plan.num_places)
        points[:, plan.place_of_point] = by_point.T
        points *= (self.elimination.system.point_hessian[[0, 2, 5]] > NEGLIGIBLE).any(dim=0)
        reduced = right - self.elimination.along_cameras(self.elimination.times_inverse(points))
        kept = torch.cholesky_solve((reduced * self.scale)[:, None], self.factor)[:, 0] * self.scale
        kept = torch.where(self.dead, 0.0, kept)
        points = self.elimination.times_inverse(points - self.elimination.along_points(kept))
        return torch.cat((kept, points[:, plan.place_of_point].T.flatten()))

    def gauge_times(self, vector: Tensor) -> Tensor:
        """The stiffness added along the null space, times a vector (size + 3 n)."""
        system = self.elimination.system
        if system.null_space is None:
            return torch.zeros_like(vector)
        kept = system.null_space @ (self.stiffness * (system.null_space.T @ vector[: system.plan.size]))
        return torch.nn.functional.pad(kept, (0, len(vector) - len(kept)))


def _smallest_eigenvalue(factor: Tensor) -> float:
    """Of L L^T, by inverse iteration. A small pivot need not betray it."""
    vector = torch.arange(len(factor), dtype=factor.dtype, device=factor.device).cos()[:, None]
    for _ in range(3):
        vector = torch.cholesky_solve(vector / vector.norm(), factor)
    return 1.0 / float(vector.norm())

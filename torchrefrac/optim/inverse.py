"""The inverse of the Gauss-Newton matrix as an operator, factorised once."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.optim.dense import prepare
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.normal_equations import NormalEquations


class SingularError(ArithmeticError):
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
        elimination = Elimination(system, 0.0)
        matrix, _ = elimination.reduced()
        scale, stiffness = prepare(matrix, system)
        factor, info = torch.linalg.cholesky_ex(matrix)
        if int(info):
            raise SingularError("the normal equations are singular")
        return cls(elimination, factor, scale, stiffness, system.dead)

    def __call__(self, vector: Tensor) -> Tensor:
        """The inverse times a vector (size + 3 n)."""
        plan = self.elimination.system.plan
        right, by_point = vector[: plan.size], vector[plan.size :].view(-1, 3)
        points = vector.new_zeros(3, plan.num_places)
        points[:, plan.place_of_point] = by_point.T
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

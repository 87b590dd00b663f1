"""The inverse of the Gauss-Newton matrix as an operator, factorised once."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.optim.dense import prepare
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.normal_equations import DIAGONAL, NEGLIGIBLE, NormalEquations
from torchrefrac.optim.plan import ELIMINATED_SIZE

ROUNDING = 0.1  # of a zero eigenvalue, in units of the size of the matrix and the precision


class SingularError(TorchrefracError, ArithmeticError):
    """The normal equations do not determine their unknowns."""


@dataclass(frozen=True)
class GaussNewtonInverse:
    """Of all unknowns: the reduced ones, then the eliminated blocks one after another. Symmetric.

    Directions of the null space are as stiff as `gauge_times` says; unknowns that nothing depends on stand still.
    """

    elimination: Elimination
    factor: Float[Tensor, "size size"]
    scale: Float[Tensor, " size"]
    stiffness: Float[Tensor, ""]
    dead: Bool[Tensor, " size"]

    @classmethod
    def of(cls, system: NormalEquations) -> "GaussNewtonInverse":
        """Factorise undamped. Raises SingularError where the system is singular beyond its null space."""
        if system.null_space is not None:  # restricted to the unknowns that something depends on
            moving = torch.where(system.dead[:, None], 0.0, system.null_space)
            system = replace(system, null_space=torch.linalg.qr(moving).Q)
        elimination = Elimination(system, 0.0)
        matrix, _ = elimination.reduced()
        scale, stiffness = prepare(matrix, system)
        factor, info = torch.linalg.cholesky_ex(matrix)
        if int(info) or _smallest_eigenvalue(factor) < ROUNDING * len(factor) * torch.finfo(factor.dtype).eps:
            raise SingularError("the normal equations are singular")
        return cls(elimination, factor, scale, stiffness, system.dead)

    def __call__(self, vector: Float[Tensor, " unknowns"]) -> Float[Tensor, " unknowns"]:
        """The inverse times a vector."""
        plan = self.elimination.system.plan
        right, by_eliminated = (
            torch.where(self.dead, 0.0, vector[: plan.size]),
            vector[plan.size :].view(-1, ELIMINATED_SIZE),
        )
        places = vector.new_zeros(ELIMINATED_SIZE, plan.num_places)
        places[:, plan.place_of] = by_eliminated.T
        places *= (self.elimination.system.eliminated_hessian[DIAGONAL] > NEGLIGIBLE).any(dim=0)
        right = right - self.elimination.to_reduced(self.elimination.times_inverse(places))
        reduced = torch.cholesky_solve((right * self.scale)[:, None], self.factor)[:, 0] * self.scale
        reduced = torch.where(self.dead, 0.0, reduced)
        places = self.elimination.times_inverse(places - self.elimination.to_eliminated(reduced))
        return torch.cat((reduced, places[:, plan.place_of].T.flatten()))

    def gauge_times(self, vector: Float[Tensor, " unknowns"]) -> Float[Tensor, " unknowns"]:
        """The stiffness added along the null space, times a vector."""
        system = self.elimination.system
        if system.null_space is None:
            return torch.zeros_like(vector)
        reduced = system.null_space @ (self.stiffness * (system.null_space.T @ vector[: system.plan.size]))
        return torch.nn.functional.pad(reduced, (0, len(vector) - len(reduced)))


def _smallest_eigenvalue(factor: Float[Tensor, "size size"]) -> float:
    """Of L L^T, by inverse iteration. A small pivot need not betray it."""
    vector = torch.arange(len(factor), dtype=factor.dtype, device=factor.device).cos()[:, None]
    for _ in range(3):
        vector = torch.cholesky_solve(vector / vector.norm(), factor)
    return 1.0 / float(vector.norm())

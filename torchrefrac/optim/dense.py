"""The reduced system as a dense matrix, up to some thousand unknowns: steps to the last weak mode."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.optim.bordered import BorderedFactor
from torchrefrac.optim.elimination import Elimination
from torchrefrac.optim.factor import step_of, stiffness_of
from torchrefrac.optim.normal_equations import NormalEquations


def solve_dense(elimination: Elimination) -> tuple[Float[Tensor, " size"], Bool[Tensor, ""]]:
    """Step of the damped reduced system, see `step_of`."""
    return step_of(DenseFactor.of(elimination))


@dataclass(frozen=True)
class DenseFactor:
    """See `Factor`. cholesky: of S A S with a unit diagonal; scale: S."""

    cholesky: BorderedFactor
    scale: Float[Tensor, " size"]
    stiffness: Float[Tensor, ""]
    gradient: Float[Tensor, " size"]

    @classmethod
    def of(cls, elimination: Elimination) -> "DenseFactor":
        system = elimination.system
        matrix, gradient = elimination.reduced()
        diagonal = matrix.diagonal()
        diagonal.add_(elimination.damping * system.diagonal)
        diagonal.copy_(torch.where(system.dead, 1.0, diagonal))
        stiffness = diagonal.new_ones(())
        if (null_space := system.null_space) is not None:
            stiffness = stiffness_of(null_space, diagonal)
            matrix.addmm_(null_space * stiffness, null_space.T)
        scale = diagonal.clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()
        matrix.mul_(scale[:, None]).mul_(scale)
        return cls(BorderedFactor.of(matrix, system.lone_blocks), scale, stiffness, gradient)

    @property
    def definite(self) -> Bool[Tensor, ""]:
        return self.cholesky.found

    @property
    def root(self) -> Float[Tensor, " size"]:
        return self.scale.reciprocal()

    @property
    def pivot(self) -> Float[Tensor, ""]:
        return self.cholesky.diagonal().square().amin()

    def solve(self, right: Float[Tensor, "size k"]) -> Float[Tensor, "size k"]:
        return self.cholesky.solve(right * self.scale[:, None]) * self.scale[:, None]

    def covariance(self, system: NormalEquations) -> "DenseCovariance":
        inverse = self.cholesky.inverse()
        inverse.mul_(self.scale[:, None]).mul_(self.scale)
        if (null_space := system.null_space) is not None:
            inverse.addmm_(null_space / self.stiffness, null_space.T, alpha=-1.0)
        inverse[system.dead] = 0.0
        inverse[:, system.dead] = 0.0
        return DenseCovariance(inverse)


@dataclass(frozen=True)
class DenseCovariance:
    """See `ReducedCovariance`."""

    values: Float[Tensor, "size size"]

    def matrix(self) -> Float[Tensor, "size size"]:
        return self.values

    def __getitem__(self, pair: tuple[Int[Tensor, "..."], Int[Tensor, "..."]]) -> Float[Tensor, "..."]:
        return self.values[pair]

    def times(self, factor: float) -> "DenseCovariance":
        return DenseCovariance(self.values * factor)

    def plus(self, draws: Float[Tensor, "draws size"]) -> "DenseCovariance":
        return DenseCovariance(self.values + draws.mT @ draws / len(draws))

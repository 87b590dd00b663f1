"""What a direct method makes of the reduced system, whichever it is."""

from typing import Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.optim.normal_equations import NormalEquations


class SingularError(TorchrefracError, ArithmeticError):
    """The normal equations do not determine their unknowns, or their inverse does not fit."""


class ReducedCovariance(Protocol):
    """Of the reduced unknowns: elements [rows, columns], at least of pairs that some observation or term depends on
    both of."""

    def matrix(self) -> Float[Tensor, "size size"]:
        """All elements. Raises SingularError where most were never computed."""
        ...

    def __getitem__(self, pair: tuple[Int[Tensor, "..."], Int[Tensor, "..."]]) -> Float[Tensor, "..."]: ...

    def times(self, factor: float) -> "ReducedCovariance":
        """As many times as large."""
        ...

    def plus(self, draws: Float[Tensor, "draws size"]) -> "ReducedCovariance":
        """With the mean of products of draws added."""
        ...


class Factor(Protocol):
    """The damped reduced matrix, factorised. Unknowns that nothing depends on have a row of their own; directions of
    the null space are made as stiff, `stiffness`, as the unknowns are that they move.

    gradient: of the reduced system. root: square roots of the diagonal. definite: whether the matrix has a factor;
    pivot: the least that appeared on the way, of a matrix with a unit diagonal.
    """

    @property
    def gradient(self) -> Float[Tensor, " size"]: ...
    @property
    def root(self) -> Float[Tensor, " size"]: ...
    @property
    def stiffness(self) -> Float[Tensor, ""]: ...
    @property
    def definite(self) -> Bool[Tensor, ""]: ...
    @property
    def pivot(self) -> Float[Tensor, ""]: ...

    def solve(self, right: Float[Tensor, "size k"]) -> Float[Tensor, "size k"]:
        """The inverse times vectors."""
        ...

    def covariance(self, system: NormalEquations) -> ReducedCovariance:
        """The inverse without what was added along the null space of `system`; zero for what nothing depends on."""
        ...


def step_of(factor: Factor) -> tuple[Float[Tensor, " size"], Bool[Tensor, ""]]:
    """Step of the damped reduced system, and whether there is one; zero where there is not. Unknowns that nothing
    depends on stand still."""
    solution = -factor.solve(factor.gradient[:, None])[:, 0]
    eps = torch.finfo(solution.dtype).eps
    solved = factor.definite & (factor.pivot > len(solution) * eps) & solution.isfinite().all()
    return torch.where(solved, solution, 0.0), solved


def stiffness_of(null_space: Float[Tensor, "size directions"], diagonal: Float[Tensor, " size"]) -> Float[Tensor, ""]:
    """How stiff the unknowns are, in the mean, that the directions move."""
    return (null_space.square().T @ diagonal).mean()

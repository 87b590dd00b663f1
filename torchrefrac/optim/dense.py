"""The reduced system as a dense matrix, up to some thousand unknowns: steps to the last weak mode, and the inverse of
the Gauss-Newton matrix.

That of the reduced system is the covariance of the reduced unknowns. That of an eliminated block is

    V^-1 + V^-1 E^T S^-1 E V^-1 = X^T (I + Z S^-1 Z^T) X,

for which the rows and columns of S^-1 of the reduced blocks that it meets are enough: it is formed tile by tile, the
inverse for all eliminated blocks never. A gauge that is free is fixed by inner constraints on the reduced unknowns:
the covariance has the least trace, and none along the gauge.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.optim.elimination import Elimination, Tiles
from torchrefrac.optim.normal_equations import DIAGONAL, NEGLIGIBLE, NormalEquations
from torchrefrac.optim.plan import ELIMINATED_SIZE, REDUCED_SIZE, TILE

MAX_COVARIANCE = 12000
ROUNDING = 0.1  # of a zero eigenvalue, in units of the size of the matrix and the precision


def solve_dense(elimination: Elimination) -> tuple[Float[Tensor, " size"], Bool[Tensor, ""]]:
    """Step of the damped reduced system, and whether there is one; zero where there is not. Unknowns that nothing
    depends on stand still."""
    system = elimination.system
    matrix, negative = elimination.reduced()
    matrix.diagonal().add_(elimination.damping * system.diagonal)
    scale, _ = prepare(matrix, system)
    factor, info = torch.linalg.cholesky_ex(matrix)
    solution = -torch.cholesky_solve((negative * scale)[:, None], factor)[:, 0] * scale
    pivot = factor.diagonal().square().amin()  # of a matrix with a unit diagonal
    solved = (info == 0) & (pivot > len(factor) * torch.finfo(factor.dtype).eps) & solution.isfinite().all()
    return torch.where(solved, solution, 0.0), solved


def prepare(
    matrix: Float[Tensor, "size size"], system: NormalEquations
) -> tuple[Float[Tensor, " size"], Float[Tensor, ""]]:
    """Make a reduced matrix of `system` one that has a Cholesky factor, in place: S A S with a unit diagonal.

    Unknowns that nothing depends on get the diagonal 1; directions of the null space are made as stiff as the unknowns
    are that they move. Returns S and that stiffness.
    """
    diagonal = matrix.diagonal()
    diagonal.copy_(torch.where(system.dead, 1.0, diagonal))
    stiffness = diagonal.new_ones(())
    null_space = system.null_space
    if null_space is not None:
        stiffness = (null_space.square().T @ diagonal).mean()
        matrix.addmm_(null_space * stiffness, null_space.T)
    scale = diagonal.clamp(min=torch.finfo(matrix.dtype).tiny).rsqrt()
    matrix.mul_(scale[:, None]).mul_(scale)
    return scale, stiffness


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
        places = vector.new_zeros(ELIMINATED_SIZE, plan.num_places)
        places[:, plan.place_of] = vector[plan.size :].view(-1, ELIMINATED_SIZE).T
        places *= (self.elimination.system.eliminated_hessian[DIAGONAL] > NEGLIGIBLE).any(dim=0)
        right = torch.where(self.dead, 0.0, vector[: plan.size])
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


@dataclass(frozen=True)
class Covariance:
    """In units in which residuals have variance one. reduced: zero for unknowns that nothing depends on."""

    elimination: Elimination
    reduced: Float[Tensor, "size size"]

    @classmethod
    def of(cls, system: NormalEquations) -> "Covariance":
        """Raises SingularError where something beyond the null space of `system` is not determined, or where there are
        more than MAX_COVARIANCE reduced unknowns, whose dense inverse does not fit."""
        if system.plan.size > MAX_COVARIANCE:
            raise SingularError(f"there are {system.plan.size} reduced unknowns, more than {MAX_COVARIANCE}")
        found = GaussNewtonInverse.of(system)
        inverse = torch.cholesky_inverse(found.factor)
        inverse.mul_(found.scale[:, None]).mul_(found.scale)
        null_space = found.elimination.system.null_space
        if null_space is not None:
            inverse.addmm_(null_space / found.stiffness, null_space.T, alpha=-1.0)
        inverse[found.dead] = 0.0
        inverse[:, found.dead] = 0.0
        return cls(found.elimination, inverse)

    def eliminated(self) -> Float[Tensor, "blocks 3 3"]:
        """Of the eliminated blocks."""
        plan = self.elimination.system.plan
        spread = torch.nn.functional.pad(self.reduced, (0, 1, 0, 1))  # what is padded in a tile has no spread
        result = self.reduced.new_zeros(plan.num_places, ELIMINATED_SIZE, ELIMINATED_SIZE)
        identity = torch.eye(ELIMINATED_SIZE, dtype=result.dtype, device=result.device)
        for tiles in self.elimination.tiles():
            columns = self._columns(tiles)
            z = torch.cat((tiles.by_block, tiles.by_shared), dim=-1)
            here = spread[columns[:, :, None], columns[:, None, :]]
            rows = z.unflatten(1, (TILE, ELIMINATED_SIZE))
            among = (z @ here).unflatten(1, (TILE, ELIMINATED_SIZE)) @ rows.mT
            places = slice(tiles.chunk.tiles.start * TILE, tiles.chunk.tiles.stop * TILE)
            result[places] = identity + among.flatten(0, 1)
        x = self.elimination.factor.new_zeros(plan.num_places, ELIMINATED_SIZE, ELIMINATED_SIZE)
        i, j = torch.tril_indices(ELIMINATED_SIZE, ELIMINATED_SIZE)
        x[:, i, j] = self.elimination.factor.T
        return (x.mT @ result @ x)[plan.place_of]

    def _columns(self, tiles: Tiles) -> Int[Tensor, "tiles columns"]:
        """Which of the reduced unknowns the columns of the tiles are."""
        plan, blocks = self.elimination.system.plan, tiles.chunk.reduced
        own = REDUCED_SIZE * blocks[..., None] + torch.arange(REDUCED_SIZE, device=blocks.device)
        own = torch.where(blocks[..., None] < plan.num_reduced, own, plan.size).flatten(1)
        first = REDUCED_SIZE * plan.num_reduced
        shared = torch.arange(first, first + plan.num_shared, device=blocks.device)
        return torch.cat((own, shared.expand(len(own), -1)), dim=1)

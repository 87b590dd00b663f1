"""The reduced system as a dense matrix, up to some thousand unknowns: steps to the last weak mode, and the inverse of
the Gauss-Newton matrix.

That of the reduced system is the covariance of the reduced unknowns. That of an eliminated block is

    V^-1 + V^-1 E^T S^-1 E V^-1 = X^T (I + Z S^-1 Z^T) X,

for which the rows and columns of S^-1 of the reduced blocks that it meets are enough: it is formed tile by tile, the
inverse for all eliminated blocks never. A gauge that is free is fixed by inner constraints on the reduced unknowns:
the covariance has the least trace, and none along the gauge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.checks import TorchrefracError
from torchrefrac.optim.bordered import BorderedFactor
from torchrefrac.optim.elimination import Elimination, Tiles
from torchrefrac.optim.normal_equations import DIAGONAL, NEGLIGIBLE, NormalEquations, in_cache
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
    factor = BorderedFactor.of(matrix, system.lone_blocks)
    solution = -factor.solve((negative * scale)[:, None])[:, 0] * scale
    pivot = factor.diagonal().square().amin()  # of a matrix with a unit diagonal
    solved = factor.found & (pivot > len(factor) * torch.finfo(scale.dtype).eps) & solution.isfinite().all()
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
    factor: BorderedFactor
    scale: Float[Tensor, " size"]
    stiffness: Float[Tensor, ""]
    dead: Bool[Tensor, " size"]

    @classmethod
    def of(cls, system: NormalEquations) -> "GaussNewtonInverse":
        """Factorise undamped. Raises SingularError where the system is singular beyond its null space, or where there
        are more than MAX_COVARIANCE reduced unknowns, whose dense matrix does not fit."""
        if system.plan.size > MAX_COVARIANCE:
            raise SingularError(f"there are {system.plan.size} reduced unknowns, more than {MAX_COVARIANCE}")
        if system.null_space is not None:  # restricted to the unknowns that something depends on
            moving = torch.where(system.dead[:, None], 0.0, system.null_space)
            system = replace(system, null_space=torch.linalg.qr(moving).Q)
        elimination = Elimination(system, 0.0)
        matrix, _ = elimination.reduced()
        scale, stiffness = prepare(matrix, system)
        factor = BorderedFactor.of(matrix, system.lone_blocks)
        rounding = ROUNDING * len(factor) * torch.finfo(scale.dtype).eps
        if not bool(factor.found) or _smallest_eigenvalue(factor) < rounding:
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
        reduced = self.factor.solve((right * self.scale)[:, None])[:, 0] * self.scale
        reduced = torch.where(self.dead, 0.0, reduced)
        places = self.elimination.times_inverse(places - self.elimination.to_eliminated(reduced))
        return torch.cat((reduced, places[:, plan.place_of].T.flatten()))

    def covariance_times(self, directions: Float[Tensor, "size k"]) -> Float[Tensor, "size k"]:
        """The covariance of the reduced unknowns (see `Covariance`) times columns."""
        moving, null_space = torch.where(self.dead[:, None], 0.0, directions), self.elimination.system.null_space
        times = self.factor.solve(moving * self.scale[:, None]) * self.scale[:, None]
        if null_space is not None:
            times = times - null_space @ (null_space.T @ moving) / self.stiffness
        return torch.where(self.dead[:, None], 0.0, times)

    def deviations(self, directions: Float[Tensor, "size k"]) -> Float[Tensor, " k"]:
        """Standard deviations of combinations of the reduced unknowns, where residuals have variance one."""
        return (directions * self.covariance_times(directions)).sum(dim=0).clamp(min=0.0).sqrt()

    def deviations_of(self, unknowns: Sequence[int]) -> Float[Tensor, " k"]:
        """Those of some of the reduced unknowns."""
        units = self.scale.new_zeros(len(self.scale), len(unknowns))
        units[list(unknowns), range(len(unknowns))] = 1.0
        return self.deviations(units)

    def propagate(
        self, errors: Float[Tensor, "residuals observations"]
    ) -> tuple[Float[Tensor, " size"], Float[Tensor, "blocks 3"], Float[Tensor, "residuals observations"]]:
        """What errors of the residuals of the rows (in their order, weighted alike) do to the minimum, to first order:
        the steps of reduced and of eliminated unknowns, and what is left in the residuals."""
        system = self.elimination.system
        plan, rows = system.plan, system.rows
        local = rows.new_zeros(plan.columns.shape[1], plan.num_reduced)
        places = rows.new_zeros(ELIMINATED_SIZE, plan.num_places)
        for here in in_cache(rows.shape[-1]):
            part, by = errors[:, None, here], rows[..., here]
            local.index_add_(1, plan.reduced[here], (by[:, plan.layout.reduced] * part).sum(dim=0))
            places.index_add_(1, plan.place[here], (by[:, plan.layout.eliminated] * part).sum(dim=0))
        right = rows.new_zeros(plan.size).index_add_(0, plan.columns.T.flatten(), local.flatten())
        step = -self(torch.cat((right, places[:, plan.place_of].T.flatten())))
        reduced, eliminated = step[: plan.size], step[plan.size :].view(-1, ELIMINATED_SIZE)
        local = reduced[plan.columns].T.contiguous()
        places[:, plan.place_of] = eliminated.T
        left = errors.clone()
        for here in in_cache(rows.shape[-1]):
            by = rows[..., here]
            left[:, here] += (by[:, plan.layout.reduced] * local.index_select(1, plan.reduced[here])).sum(dim=1)
            left[:, here] += (by[:, plan.layout.eliminated] * places.index_select(1, plan.place[here])).sum(dim=1)
        return reduced, eliminated, left

    def gauge_times(self, vector: Float[Tensor, " unknowns"]) -> Float[Tensor, " unknowns"]:
        """The stiffness added along the null space, times a vector."""
        system = self.elimination.system
        if system.null_space is None:
            return torch.zeros_like(vector)
        reduced = system.null_space @ (self.stiffness * (system.null_space.T @ vector[: system.plan.size]))
        return torch.nn.functional.pad(reduced, (0, len(vector) - len(reduced)))


def _smallest_eigenvalue(factor: BorderedFactor) -> float:
    """Of L L^T, by inverse iteration. A small pivot need not betray it."""
    vector = torch.arange(len(factor), dtype=factor.head.dtype, device=factor.head.device).cos()[:, None]
    for _ in range(3):
        vector = factor.solve(vector / vector.norm())
    return 1.0 / float(vector.norm())


@dataclass(frozen=True)
class Covariance:
    """In units in which residuals have variance one, or as scaled. reduced: zero for unknowns that nothing depends
    on. inverse: what it was made from."""

    inverse: GaussNewtonInverse
    reduced: Float[Tensor, "size size"]

    @classmethod
    def of(cls, system: NormalEquations) -> "Covariance":
        """Raises what `GaussNewtonInverse.of` raises."""
        found = GaussNewtonInverse.of(system)
        inverse = found.factor.inverse()
        inverse.mul_(found.scale[:, None]).mul_(found.scale)
        null_space = found.elimination.system.null_space
        if null_space is not None:
            inverse.addmm_(null_space / found.stiffness, null_space.T, alpha=-1.0)
        inverse[found.dead] = 0.0
        inverse[:, found.dead] = 0.0
        return cls(found, inverse)

    @property
    def elimination(self) -> Elimination:
        """Of the eliminated blocks, undamped."""
        return self.inverse.elimination

    def eliminated(self, variance: Float[Tensor, " blocks"] | None = None) -> Float[Tensor, "blocks 3 3"]:
        """Of the eliminated blocks. variance: of the residuals of each, by default 1; what the reduced unknowns add is
        as they are scaled."""
        plan = self.elimination.system.plan
        own = self.reduced.new_ones(plan.num_places)
        if variance is not None:
            own[plan.place_of] = variance
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
            result[places] = own[places, None, None] * identity + among.flatten(0, 1)
        x = self._factors()
        return (x.mT @ result @ x)[plan.place_of]

    def own(self, variance: Float[Tensor, " blocks"]) -> Float[Tensor, "blocks 3 3"]:
        """Of the eliminated blocks if the reduced unknowns were known: V^-1 times the variance of the residuals."""
        x = self._factors()[self.elimination.system.plan.place_of]
        return variance[:, None, None] * (x.mT @ x)

    def _factors(self) -> Float[Tensor, "places 3 3"]:
        """X of every place as a matrix."""
        factor = self.elimination.factor
        x = factor.new_zeros(factor.shape[1], ELIMINATED_SIZE, ELIMINATED_SIZE)
        i, j = torch.tril_indices(ELIMINATED_SIZE, ELIMINATED_SIZE)
        x[:, i, j] = factor.T
        return x

    def _columns(self, tiles: Tiles) -> Int[Tensor, "tiles columns"]:
        """Which of the reduced unknowns the columns of the tiles are."""
        plan, blocks = self.elimination.system.plan, tiles.chunk.reduced
        own = REDUCED_SIZE * blocks[..., None] + torch.arange(REDUCED_SIZE, device=blocks.device)
        own = torch.where(blocks[..., None] < plan.num_reduced, own, plan.size).flatten(1)
        first = REDUCED_SIZE * plan.num_reduced
        shared = torch.arange(first, first + plan.num_shared, device=blocks.device)
        return torch.cat((own, shared.expand(len(own), -1)), dim=1)

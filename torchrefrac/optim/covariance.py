"""The inverse of the Gauss-Newton matrix.

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

from torchrefrac.numerics import columns_at
from torchrefrac.optim.choice import choose
from torchrefrac.optim.elimination import Elimination, Tiles
from torchrefrac.optim.factor import Factor, ReducedCovariance, SingularError
from torchrefrac.optim.normal_equations import NEGLIGIBLE, NormalEquations, in_cache
from torchrefrac.optim.plan import ELIMINATED_SIZE, REDUCED_SIZE, TILE

MAX_COVARIANCE = 12000
ROUNDING = 0.1  # of a zero eigenvalue, in units of the size of the matrix and the precision


@dataclass(frozen=True)
class GaussNewtonInverse:
    """Of all unknowns: the reduced ones, then the eliminated blocks one after another. Symmetric.

    Directions of the null space are as stiff as `gauge_times` says; unknowns that nothing depends on stand still.
    """

    elimination: Elimination
    factor: Factor
    dead: Bool[Tensor, " size"]

    @classmethod
    def of(cls, system: NormalEquations) -> "GaussNewtonInverse":
        """Factorise undamped. Raises SingularError where the system is singular beyond its null space, or where there
        are more than MAX_COVARIANCE reduced unknowns, too many for a dense matrix, and no banded one is affordable."""
        if system.null_space is not None:  # restricted to the unknowns that something depends on
            moving = torch.where(system.dead[:, None], 0.0, system.null_space)
            system = replace(system, null_space=torch.linalg.qr(moving).Q)
        method = choose(system, max_dense=MAX_COVARIANCE)
        if method.name == "iterative":
            raise SingularError(f"there are {system.plan.size} reduced unknowns, more than {MAX_COVARIANCE}")
        elimination = Elimination(system, 0.0)
        factor = method.factor(elimination)
        rounding = ROUNDING * system.plan.size * torch.finfo(system.rows.dtype).eps
        if not bool(factor.definite) or _smallest_eigenvalue(factor) < rounding:
            raise SingularError("the normal equations are singular")
        return cls(elimination, factor, system.dead)

    def __call__(self, vector: Float[Tensor, " unknowns"]) -> Float[Tensor, " unknowns"]:
        """The inverse times a vector."""
        plan = self.elimination.system.plan
        places = vector.new_zeros(ELIMINATED_SIZE, plan.num_places)
        places[:, plan.place_of] = vector[plan.size :].view(-1, ELIMINATED_SIZE).T
        places *= (self.elimination.system.eliminated_diagonal > NEGLIGIBLE).any(dim=0)
        right = torch.where(self.dead, 0.0, vector[: plan.size])
        right = right - self.elimination.to_reduced(self.elimination.times_inverse(places))
        reduced = self.factor.solve(right[:, None])[:, 0]
        reduced = torch.where(self.dead, 0.0, reduced)
        places = self.elimination.times_inverse(places - self.elimination.to_eliminated(reduced))
        return torch.cat((reduced, places[:, plan.place_of].T.flatten()))

    @property
    def stiffness(self) -> Float[Tensor, ""]:
        """Of what is added along each direction of the null space."""
        return self.factor.stiffness

    def covariance_times(self, directions: Float[Tensor, "size k"]) -> Float[Tensor, "size k"]:
        """The covariance of the reduced unknowns (see `Covariance`) times columns."""
        moving, null_space = torch.where(self.dead[:, None], 0.0, directions), self.elimination.system.null_space
        times = self.factor.solve(moving)
        if null_space is not None:
            times = times - null_space @ (null_space.T @ moving) / self.stiffness
        return torch.where(self.dead[:, None], 0.0, times)

    def deviations(self, directions: Float[Tensor, "size k"]) -> Float[Tensor, " k"]:
        """Standard deviations of combinations of the reduced unknowns, where residuals have variance one."""
        return (directions * self.covariance_times(directions)).sum(dim=0).clamp(min=0.0).sqrt()

    def deviations_of(self, unknowns: Sequence[int]) -> Float[Tensor, " k"]:
        """Those of some of the reduced unknowns."""
        units = self.elimination.factor.new_zeros(len(self.dead), len(unknowns))
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
            left[:, here] += (by[:, plan.layout.reduced] * columns_at(local, plan.reduced[here])).sum(dim=1)
            left[:, here] += (by[:, plan.layout.eliminated] * columns_at(places, plan.place[here])).sum(dim=1)
        return reduced, eliminated, left

    def gauge_times(self, vector: Float[Tensor, " unknowns"]) -> Float[Tensor, " unknowns"]:
        """The stiffness added along the null space, times a vector."""
        system = self.elimination.system
        if system.null_space is None:
            return torch.zeros_like(vector)
        reduced = system.null_space @ (self.stiffness * (system.null_space.T @ vector[: system.plan.size]))
        return torch.nn.functional.pad(reduced, (0, len(vector) - len(reduced)))


def _smallest_eigenvalue(factor: Factor) -> float:
    """Of the matrix with a unit diagonal, by inverse iteration. A small pivot need not betray it."""
    root = factor.root[:, None]
    vector = torch.arange(len(root), dtype=root.dtype, device=root.device).cos()[:, None]
    for _ in range(3):
        vector = root * factor.solve(root * (vector / vector.norm()))
    return 1.0 / float(vector.norm())


@dataclass(frozen=True)
class Covariance:
    """In units in which residuals have variance one, or as scaled. among: of the reduced unknowns, zero for those that
    nothing depends on. inverse: what it was made from."""

    inverse: GaussNewtonInverse
    among: ReducedCovariance

    @classmethod
    def of(cls, system: NormalEquations) -> "Covariance":
        """Raises SingularError where something beyond the null space of `system` is not determined, or where there are
        too many unknowns, see `GaussNewtonInverse.of`."""
        inverse = GaussNewtonInverse.of(system)
        return cls(inverse, inverse.factor.covariance(inverse.elimination.system))

    @property
    def reduced(self) -> Float[Tensor, "size size"]:
        """`among` as a matrix. Raises SingularError where there are too many unknowns for one."""
        return self.among.matrix()

    @property
    def elimination(self) -> Elimination:
        """Of the eliminated blocks, undamped."""
        return self.inverse.elimination

    def eliminated(self, variance: Float[Tensor, " blocks"] | None = None) -> Float[Tensor, "blocks 3 3"]:
        """Of the eliminated blocks. variance: of the residuals of each, by default 1; what the reduced unknowns add is
        as they are scaled."""
        plan = self.elimination.system.plan
        own = self.elimination.factor.new_ones(plan.num_places)
        if variance is not None:
            own[plan.place_of] = variance
        result = own.new_zeros(plan.num_places, ELIMINATED_SIZE, ELIMINATED_SIZE)
        identity = torch.eye(ELIMINATED_SIZE, dtype=result.dtype, device=result.device)
        for tiles in self.elimination.tiles():
            columns = self._columns(tiles)
            z = torch.cat((tiles.by_block, tiles.by_shared), dim=-1)
            here = self.among[columns[:, :, None], columns[:, None, :]]
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
        i, j = torch.tril_indices(ELIMINATED_SIZE, ELIMINATED_SIZE, device=x.device)
        x[:, i, j] = factor.T
        return x

    def _columns(self, tiles: Tiles) -> Int[Tensor, "tiles columns"]:
        """Which of the reduced unknowns the columns of the tiles are; of what tiles are filled up with, which is zero,
        those of their first block."""
        plan, blocks = self.elimination.system.plan, tiles.chunk.reduced
        blocks = torch.where(blocks < plan.num_reduced, blocks, blocks[:, :1])
        own = (REDUCED_SIZE * blocks[..., None] + torch.arange(REDUCED_SIZE, device=blocks.device)).flatten(1)
        first = REDUCED_SIZE * plan.num_reduced
        shared = torch.arange(first, first + plan.num_shared, device=blocks.device)
        return torch.cat((own, shared.expand(len(own), -1)), dim=1)

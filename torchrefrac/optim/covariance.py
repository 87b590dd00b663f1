"""How well the unknowns are determined: the inverse of the normal matrix, block by block.

The inverse of the reduced system is the covariance of the reduced unknowns. That of an eliminated block is

    V^-1 + V^-1 E^T S^-1 E V^-1 = X^T (I + Z S^-1 Z^T) X,

for which the rows and columns of S^-1 of the reduced blocks that it meets are enough: it is formed tile by tile, the
inverse for all eliminated blocks never. A gauge that is free is fixed by inner constraints on the reduced unknowns:
the covariance has the least trace, and none along the gauge.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchrefrac.optim.elimination import Elimination, Tiles
from torchrefrac.optim.inverse import GaussNewtonInverse, SingularError
from torchrefrac.optim.normal_equations import NormalEquations
from torchrefrac.optim.plan import ELIMINATED_SIZE, REDUCED_SIZE, TILE

MAX_COVARIANCE = 12000


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

"""How well the unknowns of a bundle adjustment are determined: the inverse of the normal matrix, block by block.

The inverse of the reduced system is the covariance of what is kept. That of a point is

    V^-1 + V^-1 E^T S^-1 E V^-1 = X^T (I + Z S^-1 Z^T) X,

for which the rows and columns of S^-1 that belong to the cameras that see the point are enough: it is formed tile by
tile, and the inverse for the points never is. A gauge that is free is fixed by inner constraints on what is kept: the
covariance has the least trace, and none along the gauge.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.optim.elimination import Elimination, Tiles
from torchrefrac.optim.inverse import GaussNewtonInverse, SingularError
from torchrefrac.optim.normal_equations import NormalEquations
from torchrefrac.optim.plan import CAMERA_SIZE, POINT_SIZE, TILE

MAX_COVARIANCE = 12000


@dataclass(frozen=True)
class Covariance:
    """In units in which residuals have variance one. kept (size, size): zero for unknowns that are held."""

    elimination: Elimination
    kept: Tensor

    @classmethod
    def of(cls, system: NormalEquations) -> "Covariance":
        """Raises SingularError where something beyond the null space of `system` is not determined, or where there are
        more than MAX_COVARIANCE reduced unknowns, whose dense inverse does not fit."""
        if system.plan.size > MAX_COVARIANCE:
            raise SingularError(f"there are {system.plan.size} unknowns beside the points, more than {MAX_COVARIANCE}")
        found = GaussNewtonInverse.of(system)
        inverse = torch.cholesky_inverse(found.factor)
        inverse.mul_(found.scale[:, None]).mul_(found.scale)
        null_space = found.elimination.system.null_space
        if null_space is not None:
            inverse.addmm_(null_space / found.stiffness, null_space.T, alpha=-1.0)
        inverse[found.dead] = 0.0
        inverse[:, found.dead] = 0.0
        return cls(found.elimination, inverse)

    def points(self) -> Tensor:
        """Of the points that were eliminated: (n, 3, 3)."""
        plan = self.elimination.system.plan
        spread = torch.nn.functional.pad(self.kept, (0, 1, 0, 1))  # what is padded in a tile has no spread
        result = self.kept.new_zeros(plan.num_places, POINT_SIZE, POINT_SIZE)
        identity = torch.eye(POINT_SIZE, dtype=result.dtype, device=result.device)
        for tiles in self.elimination.tiles():
            columns = self._columns(tiles)
            z = torch.cat((tiles.by_camera, tiles.by_shared), dim=-1)
            here = spread[columns[:, :, None], columns[:, None, :]]
            rows = z.unflatten(1, (TILE, POINT_SIZE))
            among = (z @ here).unflatten(1, (TILE, POINT_SIZE)) @ rows.mT
            places = slice(tiles.chunk.tiles.start * TILE, tiles.chunk.tiles.stop * TILE)
            result[places] = identity + among.flatten(0, 1)
        x = self.elimination.factor.new_zeros(plan.num_places, POINT_SIZE, POINT_SIZE)
        i, j = torch.tril_indices(POINT_SIZE, POINT_SIZE)
        x[:, i, j] = self.elimination.factor.T
        return (x.mT @ result @ x)[plan.place_of_point]

    def _columns(self, tiles: Tiles) -> Tensor:
        """Which of the kept unknowns the columns of the tiles are (B, 6 C + g)."""
        plan, cameras = self.elimination.system.plan, tiles.chunk.cameras
        own = CAMERA_SIZE * cameras[..., None] + torch.arange(CAMERA_SIZE, device=cameras.device)
        own = torch.where(cameras[..., None] < plan.num_cameras, own, plan.size).flatten(1)
        first = CAMERA_SIZE * plan.num_cameras
        shared = torch.arange(first, first + plan.num_shared, device=cameras.device)
        return torch.cat((own, shared.expand(len(own), -1)), dim=1)

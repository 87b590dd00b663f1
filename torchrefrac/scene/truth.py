"""What is true of a scene: cameras, planes and surface. For evaluation only."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry.triangle_mesh import TriangleMesh


@dataclass(frozen=True)
class Truth:
    """names and poses of the true cameras; planes as rectangles.

    rotation (m, 3, 3), center (m, 3); corner, edge1, edge2 (k, 3): a plane is corner + s edge1 + t edge2 with
    s and t from 0 to 1. The water surface, where there is one, is z = 0; index_ratio is n_water / n_air, intrinsics the
    lens of all photographs, None where it is not known. surface: all that cameras see, the planes among it, as
    triangles; None: there are only the planes.
    """

    names: tuple[str, ...]
    rotation: Tensor
    center: Tensor
    corner: Tensor
    edge1: Tensor
    edge2: Tensor
    length_unit: str
    index_ratio: float | None = None
    intrinsics: Intrinsics | None = None
    surface: TriangleMesh | None = None

    @property
    def normal(self) -> Tensor:
        """Unit normals (k, 3)."""
        return torch.nn.functional.normalize(torch.linalg.cross(self.edge1, self.edge2), dim=-1)


@dataclass(frozen=True)
class TruthPoints:
    """What m images truly see, on a grid of h x w pixels each.

    The entry of row i and column j is what its image sees at pixel (step j + offset, step i + offset), in COLMAP's
    convention. points (m, h, w, 3) float64 in the frame and the unit of truth.json; plane (m, h, w) int64: index of the
    true plane that a point lies on, -1 where it lies on none; valid (m, h, w): where there is a point. Elsewhere points
    are zero.
    """

    names: tuple[str, ...]
    step: int
    offset: float
    points: Tensor
    plane: Tensor
    valid: Tensor

    def pixels(self) -> Tensor:
        """Pixels (h, w, 2) of the grid, in COLMAP's convention."""
        height, width = self.valid.shape[1:]
        x, y = (self.step * torch.arange(n, dtype=torch.float64) + self.offset for n in (width, height))
        return torch.stack((x.expand(height, width), y[:, None].expand(height, width)), dim=-1)

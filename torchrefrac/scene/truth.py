"""What is true of a scene: cameras, planes and surface. For evaluation only."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import Intrinsics
from torchrefrac.geometry.triangle_mesh import TriangleMesh
from torchrefrac.scene.interfaces import Interfaces


@dataclass(frozen=True)
class Truth:
    """True cameras by the names of their photographs; planes as rectangles. Lengths are in length_unit.

    rotation: cam_from_world; center: where each stands. A plane is corner + s edge1 + t edge2 with s and t from 0 to 1.
    The water surface, where there is one, or the wall, is z = 0; interfaces has the one that all look through, None
    where it is not known; intrinsics are those of all photographs or, as a batch, of each, None where they are not
    known. surface: all that cameras see, the planes among it, as triangles; None: there are only the planes.
    water_extent: corners of the water as seen from above; None: it is everywhere. folder: where it was read from.
    """

    names: tuple[str, ...]
    rotation: Float[Tensor, "m 3 3"]
    center: Float[Tensor, "m 3"]
    corner: Float[Tensor, "k 3"]
    edge1: Float[Tensor, "k 3"]
    edge2: Float[Tensor, "k 3"]
    length_unit: str
    interfaces: Interfaces | None = None
    intrinsics: Intrinsics | None = None
    surface: TriangleMesh | None = None
    water_extent: Float[Tensor, "c 2"] | None = None
    folder: Path | None = None

    @property
    def index_ratio(self) -> float | None:
        """Index ratio n_water / n_air; None where it is not known."""
        return None if self.interfaces is None else float(self.interfaces.index_ratio[0])

    @property
    def normal(self) -> Float[Tensor, "k 3"]:
        """Unit normals of the planes."""
        return torch.nn.functional.normalize(torch.linalg.cross(self.edge1, self.edge2), dim=-1)


@dataclass(frozen=True)
class TruthPoints:
    """What images truly see, on a grid of pixels each.

    The entry of row i and column j is what its image sees at pixel (step j + offset, step i + offset), in COLMAP's
    convention. points in the frame and the unit of truth.json; plane: index of the true plane that a point lies on, -1
    where it lies on none; valid: where there is a point. Elsewhere points are zero.
    """

    names: tuple[str, ...]
    step: int
    offset: float
    points: Float[Tensor, "m h w 3"]
    plane: Int[Tensor, "m h w"]
    valid: Bool[Tensor, "m h w"]

    def pixels(self) -> Float[Tensor, "h w 2"]:
        """Pixels of the grid, in COLMAP's convention."""
        height, width = self.valid.shape[1:]
        x, y = (self.step * torch.arange(n, dtype=torch.float64) + self.offset for n in (width, height))
        return torch.stack((x.expand(height, width), y[:, None].expand(height, width)), dim=-1)

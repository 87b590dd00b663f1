"""One reference image, or a tile of it, with the images that it is compared with."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.dense.atlas import Atlas
from torchrefrac.dense.matching.interest_points import InterestPoints


@dataclass(frozen=True)
class Scope:
    """v images; the first is the reference, of which the cells in `tile` are worked on.

    ids: which views of the scene these are; cameras (v); atlas: of the same images, or of the parts that show what the
    tile can see; allowed: pixels that no mask excludes, None: all; near, far: distances along the reference's rays (see
    `PixelRays`) between which the surface lies; tile: left, top, right, bottom in pixels; interest_points: those of an
    image, given its id; points: sparse points that the reference observes, at pixels.
    """

    ids: Int[Tensor, " v"]
    cameras: RefractiveCamera
    atlas: Atlas
    allowed: Bool[Tensor, "v height width"] | None
    near: float
    far: float
    tile: tuple[int, int, int, int]
    interest_points: Callable[[int], InterestPoints]
    points: Float[Tensor, "k 3"]
    pixels: Float[Tensor, "k 2"]

    @property
    def device(self) -> torch.device:
        return self.atlas.sheet.device

    @property
    def others(self) -> int:
        return len(self.ids) - 1

    def is_allowed(self, image: Int[Tensor, "*batch"], pixels: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
        """Whether pixels of local images are inside and not masked."""
        intrinsics = self.cameras.intrinsics
        inside = intrinsics.contains(pixels)
        if self.allowed is None:
            return inside
        column = pixels[..., 0].long().clamp(0, intrinsics.width - 1)
        row = pixels[..., 1].long().clamp(0, intrinsics.height - 1)
        return inside & self.allowed[image, row, column]

    def centers(self, cell: int) -> Float[Tensor, "rows columns 2"]:
        """Centres of the tile's cells; those cut off by the image's border are left out.

        Cell row i, column j of the image has its centre in the middle of a pixel, or between pixels where `cell` is
        even.
        """
        left, top, right, bottom = self.tile
        columns = torch.arange(left // cell, right // cell, dtype=torch.float64, device=self.device)
        rows = torch.arange(top // cell, bottom // cell, dtype=torch.float64, device=self.device)
        y, x = torch.meshgrid((rows + 0.5) * cell, (columns + 0.5) * cell, indexing="ij")
        return torch.stack((x, y), dim=-1)

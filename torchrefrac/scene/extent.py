"""Where the water ends: what lies beyond is seen straight, however deep it is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.geometry.polygon import inside_polygon
from torchrefrac.scene.tables import Observations


@dataclass(frozen=True, eq=False)
class WaterExtent:
    """Corners of the water as seen from above, in the frame and the unit of the finished scene, or in photographs, in
    pixels; of each photograph, if of any, or None. Who gives both means the photographs where these say something."""

    from_above: Float[Tensor, "c 2"] | None = None
    in_images: tuple[Float[Tensor, "_ 2"] | None, ...] = ()

    def of_views(self, rows: Sequence[int]) -> "WaterExtent":
        """That in some of the photographs, by their numbers."""
        return replace(self, in_images=tuple(self.in_images[i] for i in rows) if self.in_images else ())

    @property
    def is_drawn(self) -> bool:
        """Whether it is known in any photograph."""
        return any(corners is not None for corners in self.in_images)

    def outside(self, view: int, pixels: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
        """Which pixels of a photograph look past the water; none where that is not known."""
        corners = self.in_images[view] if self.in_images else None
        if corners is None:
            return torch.zeros_like(pixels[..., 0], dtype=torch.bool)
        return ~inside_polygon(pixels, corners)

    def beyond(self, points: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
        """Which points of a finished scene do not lie under the water or above it; none where that is not known."""
        if self.from_above is None:
            return torch.zeros_like(points[:, 0], dtype=torch.bool)
        return ~inside_polygon(points[:, :2], self.from_above)

    def votes(self, view: int, pixels: Float[Tensor, "*batch 2"]) -> Int[Tensor, "*batch"]:
        """1 for pixels of a photograph that look past the water, -1 for those that look at it, 0 where it is not
        known."""
        known = bool(self.in_images) and self.in_images[view] is not None
        return (2 * self.outside(view, pixels).long() - 1) * int(known)

    def all_votes(self, seen: Observations, points: int) -> Int[Tensor, " n"]:
        """The votes for each of so many points, added up over its observations."""
        votes = torch.zeros(points, dtype=torch.long, device=seen.view.device)
        for view in range(len(self.in_images)):
            mine = seen[seen.view == view]
            votes.index_add_(0, mine.point, self.votes(view, mine.pixels))
        return votes

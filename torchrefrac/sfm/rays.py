"""Where rays meet, whether they stay in air or enter the water."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.minimal import triangulate, triangulation_angle
from torchrefrac.scene import Scene


@dataclass(frozen=True, eq=False)
class Rays:
    """What pixels look along: from the centre through air, and from the surface through water."""

    center: Float[Tensor, "*batch 3"]
    in_air: Float[Tensor, "*batch 3"]
    origin: Float[Tensor, "*batch 3"]
    in_water: Float[Tensor, "*batch 3"]

    @classmethod
    def of(cls, cameras: RefractiveCamera, pixels: Float[Tensor, "*#batch 2"]) -> "Rays":
        """Of pixels in a batch of cameras."""
        origin, in_air, in_water, _ = cameras.follow_rays(pixels)
        return cls(cameras.center_in_world.expand_as(origin), in_air, origin, in_water)

    def __getitem__(self, rows: Int[Tensor, "..."]) -> "Rays":
        return Rays(*(part[rows] for part in (self.center, self.in_air, self.origin, self.in_water)))

    def meet(
        self, height: Callable[[Float[Tensor, "*track 3"]], Float[Tensor, "*track"]]
    ) -> tuple[Float[Tensor, "*track 3"], Float[Tensor, "*track"], Bool[Tensor, "*track"]]:
        """Points nearest to the rays of each track (*track, n), the largest angle between these (radians), and whether
        they meet at all.

        The bent rays decide first; where they meet above the surface (`height` of points), the point lies in air and
        the straight rays do.
        """
        wet, wet_valid = triangulate(self.origin, self.in_water)
        dry, dry_valid = triangulate(self.center, self.in_air)
        above = height(wet) >= 0.0
        angle = self.opening(above)
        return torch.where(above[..., None], dry, wet), angle, torch.where(above, dry_valid, wet_valid)

    def opening(self, above: Bool[Tensor, "*track"]) -> Float[Tensor, "*track"]:
        """Largest angle (radians) at which the rays of each track meet, in air or in water."""
        directions = torch.where(above[..., None, None], self.in_air, self.in_water)
        return triangulation_angle(directions, torch.ones_like(directions[..., 0], dtype=torch.bool))


class Tracks(NamedTuple):
    """Observations `rows` of a scene by their points: `ids` of these, `slot` of each observation among them."""

    scene: Scene
    rows: Int[Tensor, " k"]
    ids: Int[Tensor, " l"]
    slot: Int[Tensor, " k"]

    @classmethod
    def of(cls, scene: Scene, rows: Int[Tensor, " k"]) -> "Tracks":
        """Of observations in ascending order."""
        return cls(scene, rows, *torch.unique_consecutive(scene.observations.point[rows], return_inverse=True))

    @property
    def cameras(self) -> RefractiveCamera:
        """Of each observation."""
        return self.scene.cameras_of(self.scene.observations[self.rows])

    @property
    def pixels(self) -> Float[Tensor, "k 2"]:
        return self.scene.observations.pixels[self.rows]

    def meet(self) -> tuple[Float[Tensor, "l 3"], Float[Tensor, " l"], Bool[Tensor, " l"]]:
        """Where the rays of each track meet, at which angle, and whether they do (see `Rays.meet`)."""
        rays = Rays.of(self.cameras, self.pixels)
        points = rays.center.new_zeros(len(self.ids), 3)
        angle, valid = points[:, 0].clone(), torch.zeros(len(points), dtype=torch.bool, device=points.device)
        for lines, table in self._by_length():
            found = rays[table].meet(lambda at, table=table: self._height(at, table))
            points[lines], angle[lines], valid[lines] = found
        return points, angle, valid

    def opening(self) -> Float[Tensor, " l"]:
        """Largest angle (radians) at which the rays of each track meet in its point."""
        rays, points = Rays.of(self.cameras, self.pixels), self.scene.points[self.ids]
        angle = points.new_zeros(len(points))
        for lines, table in self._by_length():
            angle[lines] = rays[table].opening(self._height(points[lines], table) >= 0.0)
        return angle

    def height(self, points: Float[Tensor, "l 3"]) -> Float[Tensor, " l"]:
        """Mean height of points, one for each track, above the surfaces that their observations look through."""
        height = points[:, 2].clone()
        if not self.scene.interfaces.is_level:
            for lines, table in self._by_length():
                height[lines] = self._height(points[lines], table)
        return height

    def _height(self, points: Float[Tensor, "t 3"], table: Int[Tensor, "t n"]) -> Float[Tensor, " t"]:
        """Mean height of points above the surfaces that their observations look through; -inf beyond ports."""
        scene = self.scene
        if scene.interfaces.is_level:
            return points[..., 2]
        interface = scene.views.interface[scene.observations.view[self.rows[table]]]
        return scene.interfaces.heights(points[:, None], interface).mean(dim=-1)

    def _by_length(self) -> Iterator[tuple[Int[Tensor, " t"], Int[Tensor, "t n"]]]:
        """Tracks of one length are a table, and there are not many lengths: which they are, and their observations."""
        length = torch.bincount(self.slot, minlength=len(self.ids))
        first = length.cumsum(dim=0) - length
        for n in length.unique().tolist():
            lines = (length == n).nonzero()[:, 0]
            yield lines, first[lines, None] + torch.arange(n, device=lines.device)

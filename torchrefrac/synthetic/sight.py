"""What rays see that go straight through air and bend where they enter the water, or at glass before it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchrefrac.camera import RefractiveCamera
from torchrefrac.geometry.polygon import inside_polygon
from torchrefrac.geometry.surfaces import Nearest, by_component, nearest
from torchrefrac.refraction import FlatInterface, refract_rays
from torchrefrac.synthetic.stage import Piece
from torchrefrac.synthetic.waves import Entry, Waves

OVERLAP = 1e-6  # of the way to the water: a mesh that is met in single precision closes up with its part below


@dataclass(frozen=True, eq=False)
class Sight:
    """What rays see.

    piece: index of the piece that the ray ends on, -1 where it ends on none. start, way and length: the last
    straight part of the ray, length infinite where it ends on nothing. uv and normal at its end. in_water: whether that
    part lies in the water, which the ray then entered with `cosine` of incidence.
    """

    start: Float[Tensor, "n 3"]
    way: Float[Tensor, "n 3"]
    length: Float[Tensor, " n"]
    piece: Int[Tensor, " n"]
    uv: Float[Tensor, "n 2"]
    normal: Float[Tensor, "n 3"]
    in_water: Bool[Tensor, " n"]
    cosine: Float[Tensor, " n"]

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """Where the rays end; NaN where they end on nothing."""
        return torch.where((self.piece >= 0)[:, None], self.start + self.length[:, None] * self.way, torch.nan)


@dataclass(frozen=True, eq=False)
class Scenery:
    """Pieces in and above water whose surface is z = 0, or has waves about it. extent: corners of the water as seen
    from above, beyond which nothing is bent; none: it is everywhere. glass: the water stands behind it instead, behind
    a wall whose dry face is z = 0 or around a port, which leaves nothing dry."""

    pieces: Sequence[Piece]
    index_ratio: float
    waves: Waves | None = None
    extent: Sequence[tuple[float, float]] = ()
    glass: FlatInterface | None = None

    @cached_property
    def below(self) -> tuple[int, ...]:
        """Indices of the pieces that reach below some of the water surface."""
        return tuple(i for i, (low, _) in enumerate(self._reach) if low < self.crest or self.is_submerged)

    @cached_property
    def above(self) -> tuple[int, ...]:
        """Indices of the pieces that reach above some of the water surface; of all where there is none somewhere."""
        reach = () if self.is_submerged else self._reach
        return tuple(i for i, (_, high) in enumerate(reach) if high > -self.crest or self.extent)

    @property
    def is_submerged(self) -> bool:
        """Whether all is under water, the cameras too."""
        return self.glass is not None and self.glass.moves_with_camera

    @property
    def crest(self) -> float:
        """How high the water goes."""
        return 0.0 if self.waves is None else self.waves.crest

    @cached_property
    def _reach(self) -> list[tuple[float, float]]:
        levels = (piece.surface.triangles()[0][:, 2] for piece in self.pieces)
        return [(float(z.min()), float(z.max())) for z in levels]

    def look(self, center: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"], moment: int = 0) -> Sight:
        """What rays see that start at center, above the water, along unit directions, at a moment of its waves.

        A ray ends on what it meets before the water; else it is bent there and goes on. One that does not meet the
        water goes on straight, and may meet what reaches above the water.
        """
        directions = by_component(directions)
        entry, start = self._enter(center, directions, moment)
        if self.extent:
            corners = torch.tensor(self.extent, dtype=start.dtype)
            entry = entry._replace(valid=entry.valid & inside_polygon(start[:, :2], corners))
        return self._meet(center, directions, entry, start)

    def look_through_glass(self, camera: RefractiveCamera, pixels: Float[Tensor, "n 2"]) -> Sight:
        """What a camera, whose interface is `glass`, sees at pixels. A ray ends on what it meets before a wall, else it
        is bent at both of its faces; one that glass reflects goes on straight, and sees nothing that lies in water."""
        start, directions, onward, valid = camera.follow_rays(pixels)
        plane, center = camera.plane_in_world(), camera.center_in_world
        cosine = -directions @ plane.normal_like(center)
        length = plane.signed_distance(center) / torch.where(valid, cosine, 1.0)
        entry = Entry(length, by_component(onward), cosine, valid)
        return self._meet(center, by_component(directions), entry, by_component(start))

    def _meet(
        self, center: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"], entry: Entry, start: Float[Tensor, "n 3"]
    ) -> Sight:
        """What rays meet from center to the water, which they enter at start, or in it."""
        wet = self._nearest(self.below, start, entry.direction)
        wet = wet._replace(
            length=torch.where(entry.valid, wet.length, torch.inf), surface=torch.where(entry.valid, wet.surface, -1)
        )
        sight = Sight(start, entry.direction, wet.length, wet.surface, wet.uv, wet.normal, entry.valid, entry.cosine)
        if not self.above:
            return sight
        dry = self._nearest(self.above, by_component(center.expand_as(directions)), directions)
        return _first(sight, dry, center, directions, entry)

    def _enter(
        self, center: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"], moment: int
    ) -> tuple[Entry, Float[Tensor, "n 3"]]:
        if self.waves is not None:
            entry = self.waves.at(moment).enter(center, directions, self.index_ratio)
            return entry, center + entry.length[:, None] * directions
        start, onward, valid = refract_rays(center, directions, FlatInterface(self.index_ratio, check=False))
        cosine = -directions[:, 2]
        length = center[2] / torch.where(valid, cosine, 1.0)
        return Entry(length, by_component(onward), cosine, valid), by_component(start)

    def _nearest(
        self, chosen: Sequence[int], origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]
    ) -> Nearest:
        """`nearest` among some of the pieces, with their indices among all."""
        found = nearest([self.pieces[i].surface for i in chosen], origins, directions)
        if tuple(chosen) == tuple(range(len(self.pieces))):
            return found
        return found._replace(surface=torch.tensor((*chosen, -1))[found.surface])


def see(
    pieces: Sequence[Piece], camera: RefractiveCamera, pixels: Float[Tensor, "n 2"], waves: Waves | None = None
) -> Sight:
    """What one camera sees at pixels; its interface is a water surface at z = 0, a wall of glass there, or a port.

    With waves the interface gives nothing but its index ratio.
    """
    index_ratio = float(camera.interface.index_like(camera.center_in_world))
    if camera.interface.layers is not None:
        return Scenery(pieces, index_ratio, glass=camera.interface).look_through_glass(camera, pixels)
    scenery = Scenery(pieces, index_ratio, waves)
    return scenery.look(camera.center_in_world, camera.view_directions(pixels))


def _first(
    sight: Sight, dry: Nearest, center: Float[Tensor, " 3"], directions: Float[Tensor, "n 3"], entry: Entry
) -> Sight:
    """`sight` in the water, but what is met in air where that comes first, or where there is no water on the way."""
    to_water = torch.where(entry.valid, (1.0 + OVERLAP) * entry.length, torch.inf)
    is_dry = (dry.length < to_water) | ~entry.valid
    column = is_dry[:, None]
    return Sight(
        start=torch.where(column, center, sight.start),
        way=torch.where(column, directions, sight.way),
        length=torch.where(is_dry, dry.length, sight.length),
        piece=torch.where(is_dry, dry.surface, sight.piece),
        uv=torch.where(column, dry.uv, sight.uv),
        normal=torch.where(column, dry.normal, sight.normal),
        in_water=~is_dry,
        cosine=sight.cosine,
    )

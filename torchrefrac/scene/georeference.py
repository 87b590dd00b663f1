"""Where the local frame of a scene stands on Earth."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchrefrac.geometry import Plane, levelling, rotate

LEVEL = (0.0, 0.0)
"""The slope of a plane that has none."""


@dataclass(frozen=True)
class Georeference:
    """crs: the coordinate reference system by a name that pyproj knows ("EPSG:32633"). origin: coordinates there
    (easting, northing, height) of the point in which the local frame has its origin; its x is east, its y north.
    vertical: what heights count from, by such a name, where crs does not say so; None: by crs. scale: how long a metre
    on the ground is in the plane of the map; heights are not scaled. slope: by how much the plane z = 0 of the local
    frame rises to the east and to the north, per metre, as the water of a river does; the frame is one in which it is
    level, turned the shortest way."""

    crs: str
    origin: tuple[float, float, float]
    vertical: str | None = None
    scale: float = 1.0
    slope: tuple[float, float] = LEVEL

    def raised(self, by: float, slope: tuple[float, float] = LEVEL) -> "Georeference":
        """Of a frame whose origin is so much higher than that of this one, which is level, and whose plane z = 0 rises
        by `slope` from there."""
        east, north, height = self.origin
        return replace(self, origin=(east, north, height + by), slope=slope)

    @property
    def level_from_local(self) -> Float[Tensor, "3 3"]:
        """Rotation into the frame that is level."""
        east, north = self.slope
        up = torch.tensor((east, north, 1.0), dtype=torch.float64)
        return levelling(-up / up.norm())

    @property
    def water(self) -> Plane:
        """The plane z = 0 of the local frame, in coordinates of the reference system."""
        east, north = self.slope
        return Plane.through(self.origin, (0.0 - east / self.scale, 0.0 - north / self.scale, 1.0))

    @property
    def name(self) -> str:
        """Of the whole system, horizontal and, where it has a code, vertical, as pyproj and rasterio take it."""
        code = (self.vertical or "").removeprefix("EPSG:")
        return f"{self.crs}+{code}" if code.isdecimal() else self.crs

    def water_heights(self, east: Float[Tensor, "*#batch"], north: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch"]:
        """Of the plane z = 0 of the local frame, at eastings and northings."""
        x, y, height = self.origin
        return height + (self.slope[0] * (east - x) + self.slope[1] * (north - y)) / self.scale

    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Of points in the local frame: easting, northing, height, float64."""
        points = points.double()
        level = points if self.slope == LEVEL else rotate(self.level_from_local.to(points.device), points)
        stretched = level * points.new_tensor((self.scale, self.scale, 1.0))
        return stretched + points.new_tensor(self.origin)

    def local(self, coordinates: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points in the local frame, of which these are the `coordinates`, float64."""
        moved = coordinates.double() - coordinates.new_tensor(self.origin, dtype=torch.float64)
        level = moved / moved.new_tensor((self.scale, self.scale, 1.0))
        return level if self.slope == LEVEL else rotate(self.level_from_local.mT.to(moved.device), level)

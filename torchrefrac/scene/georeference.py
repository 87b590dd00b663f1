"""Where the local frame of a scene stands on Earth."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Georeference:
    """crs: the coordinate reference system by a name that pyproj knows ("EPSG:32633"). origin: coordinates there
    (easting, northing, height) of the point in which the local frame has its origin; its x is east, its y north.
    vertical: what heights count from, by such a name, where crs does not say so; None: by crs. scale: how long a metre
    on the ground is in the plane of the map; heights are not scaled."""

    crs: str
    origin: tuple[float, float, float]
    vertical: str | None = None
    scale: float = 1.0

    def raised(self, by: float) -> "Georeference":
        """Of a frame whose origin is so much higher."""
        east, north, height = self.origin
        return replace(self, origin=(east, north, height + by))

    @property
    def name(self) -> str:
        """Of the whole system, horizontal and, where it has a code, vertical, as pyproj and rasterio take it."""
        code = (self.vertical or "").removeprefix("EPSG:")
        return f"{self.crs}+{code}" if code.isdecimal() else self.crs

    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Of points in the local frame: easting, northing, height, float64."""
        points = points.double()
        stretched = points * points.new_tensor((self.scale, self.scale, 1.0))
        return stretched + points.new_tensor(self.origin)

    def local(self, coordinates: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points in the local frame, of which these are the `coordinates`, float64."""
        moved = coordinates.double() - coordinates.new_tensor(self.origin, dtype=torch.float64)
        return moved / moved.new_tensor((self.scale, self.scale, 1.0))

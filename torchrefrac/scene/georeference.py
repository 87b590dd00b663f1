"""Where the local frame of a scene stands on Earth."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Georeference:
    """crs: the coordinate reference system by a name that pyproj knows ("EPSG:32633"). origin: coordinates there
    (easting, northing, height) of the point in which the local frame has its origin; its x is east, its y north.
    vertical: what heights count from, by such a name, where crs does not say so; None: by crs."""

    crs: str
    origin: tuple[float, float, float]
    vertical: str | None = None

"""What the dense stage writes."""

from dataclasses import dataclass

from torchrefrac.checks import require
from torchrefrac.files.raster import require_geotiff


@dataclass(frozen=True)
class DenseOutputs:
    """Files that the dense stage writes besides dense.ply and its pictures.

    mesh: the surface as triangles; raster: heights on a grid, seen from above, in cells of raster_cell length units
    (None: by the spacing of the points); depth_maps: what each image sees; geotiff: the raster for geographic
    information systems, in the reference system `crs`, such as "EPSG:32633" (None: local coordinates).

    Raises ValueError for a raster_cell that is no length, and where rasterio is missing or does not know `crs`.
    """

    mesh: bool = True
    raster: bool = True
    raster_cell: float | None = None
    depth_maps: bool = True
    geotiff: bool = False
    crs: str | None = None

    @property
    def needs_raster(self) -> bool:
        """Whether something is made from heights on a grid."""
        return self.mesh or self.raster or self.geotiff

    def __post_init__(self) -> None:
        if self.raster_cell is not None:
            require(self.raster_cell, "raster_cell", above=0.0)
        if self.crs is not None and not self.geotiff:
            raise ValueError(f"crs is {self.crs!r}, but only a GeoTIFF has one: set geotiff to true")
        if self.geotiff:
            try:
                require_geotiff(self.crs)
            except ImportError as error:
                raise ValueError(f"geotiff is true, but {error}") from None

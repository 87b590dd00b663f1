"""Cloud-optimised GeoTIFF: rasters for geographic information systems. Needs rasterio, of the extra `geo`."""

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from torchrefrac.atomic import passing, replacing
from torchrefrac.scene.raster import Raster, RasterGrid

MISSING = "a GeoTIFF needs rasterio, which is not installed: pip install torchrefrac[geo]"
TILE = 512
FLOAT_PREDICTOR, WHOLE_PREDICTOR = "3", "2"  # of the compression, as GDAL counts them
PLAIN: dict[str, Any] = {"tiled": True, "blockxsize": TILE, "blockysize": TILE, "BIGTIFF": "IF_SAFER"}
"""Of the file that is written first; the one that stays is a compressed copy with overviews."""


def require_geotiff(crs: str | None = None) -> None:
    """Raise what writing would: ImportError where rasterio is missing, ValueError where crs is not known."""
    try:
        import rasterio  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra
        from rasterio.errors import CRSError  # type: ignore[import-not-found]  # noqa: PLC0415
    except ImportError:
        raise ImportError(MISSING) from None
    try:
        if crs is not None:
            rasterio.CRS.from_user_input(crs)
    except CRSError as error:
        raise ValueError(f"crs is {crs!r}, which is no coordinate reference system: {error}") from None


@dataclass(frozen=True)
class Place:
    """Where a raster lies: its cells; the unit of their lengths, and the reference system of x and y, as "EPSG:32633"
    (None: local coordinates)."""

    grid: RasterGrid
    length_unit: str
    crs: str | None = None

    @classmethod
    def of(cls, raster: Raster, crs: str | None = None) -> "Place":
        """That of a raster."""
        return cls(raster.grid, raster.length_unit, crs)


@dataclass(frozen=True)
class BandFile:
    """A GeoTIFF that is being written, part by part."""

    file: Any  # of rasterio

    def write(
        self, bands: Sequence[Float[Tensor, "rows columns"]], valid: Bool[Tensor, "rows columns"], row: int, column: int
    ) -> None:
        """Numbers of a part of the cells, one grid a band, where there is a surface; row, column: the first of them."""
        values = torch.stack(tuple(bands)).where(valid, torch.nan).float().cpu().numpy()
        self._write(values, row, column)

    def write_colors(
        self, colors: UInt8[Tensor, "rows columns 3"], valid: Bool[Tensor, "rows columns"], row: int, column: int
    ) -> None:
        """The same for colours."""
        alpha = 255 * valid.to(torch.uint8)[..., None]
        self._write(torch.cat((colors, alpha), dim=-1).permute(2, 0, 1).cpu().numpy(), row, column)

    def _write(self, values: Shaped[np.ndarray, "bands rows columns"], row: int, column: int) -> None:
        from rasterio.windows import Window  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra

        self.file.write(values, window=Window(column, row, values.shape[2], values.shape[1]))  # type: ignore[call-arg]


@contextmanager
def band_file(path: str | Path, names: Sequence[str], place: Place, unit: str = "") -> Generator[BandFile, None, None]:
    """A GeoTIFF of numbers, float32, NaN where there is no surface: one band for each name, of this unit.

    It is there, cloud-optimised, when the block has ended. Its tags hold the unit of length. Raises ImportError where
    rasterio is missing, ValueError where the raster has no cells or its reference system is unknown.
    """
    options: dict[str, Any] = {"count": len(names), "dtype": "float32", "nodata": np.nan}
    with _writing(path, names, place, options, FLOAT_PREDICTOR, unit) as file:
        yield file


@contextmanager
def color_file(path: str | Path, place: Place) -> Generator[BandFile, None, None]:
    """The same for red, green, blue and alpha, which is 0 where there is no surface."""
    options: dict[str, Any] = {"count": 4, "dtype": "uint8", "photometric": "RGB", "alpha": "YES"}
    with _writing(path, ("red", "green", "blue", "alpha"), place, options, WHOLE_PREDICTOR) as file:
        yield file


@contextmanager
def _writing(
    path: str | Path, names: Sequence[str], place: Place, options: Mapping[str, Any], predictor: str, unit: str = ""
) -> Generator[BandFile, None, None]:
    require_geotiff(place.crs)
    import rasterio  # type: ignore[import-not-found]  # noqa: PLC0415 - of an extra
    from rasterio.shutil import copy  # type: ignore[import-not-found]  # noqa: PLC0415

    grid = place.grid
    if not grid.rows * grid.columns:
        raise ValueError(f"the raster for {path} has no cells, but a GeoTIFF must have at least one")
    system = None if place.crs is None else rasterio.CRS.from_user_input(place.crs)
    transform = rasterio.Affine(grid.cell_size, 0.0, grid.x_west, 0.0, -grid.cell_size, grid.y_north)
    shape = {"width": grid.columns, "height": grid.rows, "crs": system, "transform": transform}
    with replacing(Path(path)) as final, passing(final.with_suffix(".plain.tif")) as plain:
        with rasterio.open(plain, "w", driver="GTiff", **shape, **options, **PLAIN) as file:
            yield BandFile(file)
            file.update_tags(length_unit=place.length_unit)
            for band, name in enumerate(names, start=1):
                file.set_band_description(band, name)
                if unit:
                    file.set_band_unit(band, unit)
        copy(
            plain, final, driver="COG", COMPRESS="DEFLATE", PREDICTOR=predictor, BLOCKSIZE=str(TILE),
            BIGTIFF="IF_SAFER", OVERVIEWS="AUTO", RESAMPLING="AVERAGE",
        )  # fmt: skip
